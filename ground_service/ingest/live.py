"""Telemetry as it comes: from a TCP connection, or as files that appear in a folder.

What comes over a connection is written to a spool first, cut into segments where the sender pauses, and ingested
segment by segment; a segment is removed when it is in the archive. Since ingesting the same octets again changes
nothing, whatever a crash leaves in the spool is simply ingested by the next run: exactly once, nothing lost.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import socket
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ground_service.errors import PASSING, GroundError, InvalidInput, StoreError, storage_error
from ground_service.store.files import make_durable_folder, replace_durably
from tmtc.downlink import decode
from tmtc.errors import TmtcError

log = logging.getLogger(__name__)

SEGMENT_OCTETS = 4 << 20
PAUSE_S = 0.5
"""A sender that is silent for this long has finished a unit: what came so far is ingested."""

CONNECT_S = 30.0
DOCUMENT_LIMIT_OCTETS = 1 << 20
RETRY_S = 1.0
SETTLED_S = 2.0
"""A file that has not changed for this long is taken to be whole."""

_UNFINISHED = (".part", ".tmp", ".filepart", ".crdownload")

Ingest = Callable[[Path], dict[str, Any]]
Report = Callable[[Path, "dict[str, Any] | GroundError"], None]


@dataclass(slots=True)
class Spool:
    """Octets on their way into the archive, in segments under `folder`.

    Data that the ingest refuses (noise) are reported to `report` and not tried again; the file archive keeps them.
    """

    folder: Path
    ingest: Ingest
    report: Report
    _size: int = 0
    _next: int = 0
    _stream: Any = field(default=None)

    def recover(self) -> None:
        """Ingest what an earlier run left behind."""
        self.open()
        self.drain()

    def open(self) -> int:
        """Prepare the folder; return the octets that an earlier run left behind, for `drain`."""
        try:
            make_durable_folder(self.folder)
            current = self._current
            if current.exists() and current.stat().st_size:
                replace_durably(current, self._sealed(self._first_free()))
            self._next = self._first_free()
            return sum(path.stat().st_size for path in self.folder.glob("*.segment"))
        except OSError as error:
            raise storage_error(error, self.folder) from None

    def take(self, octets: bytes) -> None:
        """Keep octets; a full segment is ingested."""
        self.keep(octets)
        if self._size >= SEGMENT_OCTETS:
            self.seal()

    def keep(self, octets: bytes, *, durably: bool = False) -> None:
        """Write octets to the current segment, and to the disk if that is required; after an error none are kept."""
        try:
            if self._stream is None:
                self._stream = self._current.open("ab", buffering=0)
                self._size = os.fstat(self._stream.fileno()).st_size
            rest = memoryview(octets)
            while rest:
                rest = rest[self._stream.write(rest) :]
            if durably:
                os.fdatasync(self._stream.fileno())
        except OSError as error:
            if self._stream is not None:
                with contextlib.suppress(OSError):
                    self._stream.truncate(self._size)
            raise storage_error(error, self.folder) from None
        self._size += len(octets)

    def pause(self) -> None:
        """The sender is silent: ingest what came, unless it is less than one frame or packet."""
        if self.holds_a_unit():
            self.seal()

    def holds_a_unit(self) -> bool:
        """Return whether the current segment holds at least one frame or packet."""
        return self._size > 0 and _holds_a_unit(self._current.read_bytes())

    def seal(self) -> None:
        """Ingest what came so far."""
        if self.cut() is not None:
            self.drain()

    @property
    def size(self) -> int:
        """Octets of the current segment."""
        return self._size

    def cut(self) -> Path | None:
        """End the current segment, for `drain`, which may run in another thread; return its file, None if empty."""
        if self._size == 0:
            return None
        if self._stream is not None:
            self._stream.close()
            self._stream = None
        sealed = self._sealed(self._next)
        self._next += 1  # also after an error: the file may already have its new name
        try:
            replace_durably(self._current, sealed)
        finally:
            self._size = self._current.stat().st_size if self._current.exists() else 0
        return sealed

    def drain(self) -> None:
        """Ingest the segments that have ended, in order."""
        for path in sorted(self.folder.glob("*.segment")):
            try:
                self.report(path, self.ingest(path))
            except (*PASSING, StoreError, OSError):
                raise
            except GroundError as error:
                self.report(path, error)
            path.unlink(missing_ok=True)

    @property
    def _current(self) -> Path:
        return self.folder / "current"

    def _sealed(self, number: int) -> Path:
        return self.folder / f"{number:012d}.segment"

    def _first_free(self) -> int:
        numbers = [int(path.stem) for path in self.folder.glob("*.segment") if path.stem.isdigit()]
        return max(numbers, default=-1) + 1


def spooled_octets(folder: Path) -> int:
    """Return the octets in the folder of a spool, which another process may operate.

    The current segment is looked at first: once cut, it is one of the others.
    """
    try:
        current = (folder / "current").stat().st_size
    except FileNotFoundError:
        current = 0
    total = current
    for path in folder.glob("*.segment"):
        with contextlib.suppress(FileNotFoundError):
            total += path.stat().st_size
    return total


def _holds_a_unit(octets: bytes) -> bool:
    try:
        found = decode(octets)
    except TmtcError:
        return True
    frames = found.frames
    return found.packets > 0 or (frames is not None and len(frames) > 0)


def follow_tcp(address: tuple[str, int], spool: Spool, *, reconnect: bool, stop: Callable[[], bool]) -> int:
    """Take telemetry from a TCP sender until it closes (or for good, with `reconnect`); the octets taken.

    Raises
    ------
    InvalidInput
        If there is no connection within `CONNECT_S`.
    """
    spool.recover()
    taken = 0
    while True:
        with _connected(address, stop, patient=reconnect) as connection:
            for block in _received(connection, spool, stop):
                spool.take(block)
                taken += len(block)
        spool.seal()
        if not reconnect or stop():
            return taken


def receive_document(address: tuple[str, int]) -> bytes:
    """Return what a TCP sender sends until it closes the connection.

    Raises
    ------
    InvalidInput
        If there is no connection within `CONNECT_S`, or the document is longer than `DOCUMENT_LIMIT_OCTETS`.
    """
    octets = b""
    with _connected(address, lambda: False, patient=False) as connection:
        connection.settimeout(CONNECT_S)
        try:
            while block := connection.recv(1 << 16):
                octets += block
                if len(octets) > DOCUMENT_LIMIT_OCTETS:
                    break
        except OSError as error:
            found = error.strerror or str(error)
            raise InvalidInput(f"{address[0]}:{address[1]}", "", "a whole document", found) from None
    if len(octets) > DOCUMENT_LIMIT_OCTETS:
        expected = f"at most {DOCUMENT_LIMIT_OCTETS} octets"
        raise InvalidInput(f"{address[0]}:{address[1]}", "", expected, "more")
    return octets


@contextlib.contextmanager
def _connected(address: tuple[str, int], stop: Callable[[], bool], *, patient: bool) -> Iterator[Any]:
    until = time.monotonic() + CONNECT_S
    while True:
        try:
            connection = socket.create_connection(address, timeout=5.0)
            break
        except OSError as error:
            if stop() or (not patient and time.monotonic() > until):
                raise InvalidInput(
                    f"{address[0]}:{address[1]}", "", "a sender of telemetry", error.strerror or str(error)
                ) from None
            time.sleep(RETRY_S)
    with connection:
        connection.settimeout(PAUSE_S)
        yield connection


def _received(connection: socket.socket, spool: Spool, stop: Callable[[], bool]) -> Iterator[bytes]:
    while not stop():
        try:
            block = connection.recv(1 << 16)
        except TimeoutError:
            spool.pause()
            continue
        except OSError as error:
            log.warning("connection lost: %s", error)
            return
        if not block:
            return
        yield block


@dataclass(slots=True)
class WatchedFolder:
    """Files and pass archives that appear in a folder, each ingested once; `ledger` remembers which were."""

    folder: Path
    ledger: Path
    ingest: Ingest
    report: Report

    def look(self, now_s: float) -> int:
        """Ingest what has settled since the last look; how many files that were."""
        if not self.folder.is_dir():
            raise InvalidInput(str(self.folder), "", "a folder to watch", "nothing there")
        known = self._known()
        done = 0
        for path in sorted(self.folder.iterdir()):
            if path.name.startswith(".") or path.suffix in _UNFINISHED:
                continue
            try:
                mark = _mark(path)
                settled = now_s - max(mark[1] / 1e9, 0.0) >= SETTLED_S
            except OSError:
                continue  # it went away while being looked at
            if not settled or known.get(path.name) == mark:
                continue
            try:
                self.report(path, self.ingest(path))
            except (*PASSING, StoreError, OSError):
                raise
            except GroundError as error:
                self.report(path, error)
            known[path.name] = mark
            self._remember(known)
            done += 1
        return done

    def _known(self) -> dict[str, list[int]]:
        try:
            known = json.loads(self.ledger.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return {}
        return known if isinstance(known, dict) else {}

    def _remember(self, known: dict[str, list[int]]) -> None:
        temporary = self.ledger.with_suffix(".new")
        try:
            make_durable_folder(self.ledger.parent)
            temporary.write_text(json.dumps(known), encoding="utf-8")
            replace_durably(temporary, self.ledger)
        except OSError as error:
            raise storage_error(error, self.ledger.parent) from None


def _mark(path: Path) -> list[int]:
    """Size and time of change of a file, or of all that is in a folder."""
    files = [one for one in path.rglob("*") if one.is_file()] if path.is_dir() else [path]
    stats = [one.stat() for one in files]
    return [sum(stat.st_size for stat in stats), max((stat.st_mtime_ns for stat in stats), default=0)]
