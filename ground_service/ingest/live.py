"""Telemetry as it arrives: octets of a connection on their way into the archive, and files that appear in a folder.

What comes over a connection is written to a spool first, as one recording cut into segments, and ingested segment by
segment with its position; a segment is removed when it is in the archive. Since ingesting the same octets again changes
nothing, whatever a crash leaves in the spool is simply ingested by the next run: exactly once, nothing lost.
"""

import contextlib
import json
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ground_service.clock import utc_now_ns
from ground_service.errors import PASSING, GroundError, InvalidInput, StoreError, storage_error
from ground_service.store.files import make_durable_folder, replace_durably

SEGMENT_OCTETS = 4 << 20
SETTLED_S = 2.0
"""A file that has not changed for this long is taken to be whole."""

_UNFINISHED = (".part", ".tmp", ".filepart", ".crdownload")
_SEGMENT, _CURRENT = "segment", "current"

Ingest = Callable[[Path], dict[str, Any]]
IngestSegment = Callable[[Path, str, int], dict[str, Any]]
"""Ingests a file as a piece of a recording at an offset."""
Report = Callable[[Path, "dict[str, Any] | GroundError"], None]


@dataclass(slots=True)
class Spool:
    """Octets on their way into the archive, in segments under `folder`, named after their recording and offset.

    Data that the ingest refuses are reported to `report` and not tried again; the file archive keeps them.
    """

    folder: Path
    ingest: IngestSegment
    report: Report
    _recording: str = ""
    _offset: int = 0
    _size: int = 0
    _stream: Any = field(default=None)

    def open(self) -> int:
        """Prepare the folder; return the octets that an earlier run left behind, for `drain`.

        The recording of that run goes on.
        """
        try:
            make_durable_folder(self.folder)
            self._adopt()
            for path in sorted(self.folder.glob(f"*.{_CURRENT}")):
                (self._recording, self._offset), self._size = _place(path), path.stat().st_size
                if self._size:
                    self.cut()
                else:
                    path.unlink()
            return sum(path.stat().st_size for path in self.folder.glob(f"*.{_SEGMENT}"))
        except OSError as error:
            raise storage_error(error, self.folder) from None

    def begin(self) -> None:
        """Begin a new recording with the next octets."""
        self.cut()
        if self._recording:
            self._current.unlink(missing_ok=True)
        self._recording = ""

    def keep(self, octets: bytes, *, durably: bool = False) -> None:
        """Write octets to the current segment, and to the disk if that is required; after an error none are kept."""
        if not self._recording:
            self._recording, self._offset = f"{utc_now_ns():020d}", 0
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
        current, sealed = self._current, self._current.with_suffix(f".{_SEGMENT}")
        size, self._size = self._size, 0
        self._offset += size
        try:
            self._current.touch()  # keeps the place in the recording when all segments are ingested
            replace_durably(current, sealed)
        except OSError:
            if current.exists():
                self._current.unlink(missing_ok=True)
                self._offset, self._size = self._offset - size, size
            raise
        return sealed

    def drain(self) -> None:
        """Ingest the segments that have ended, in order."""
        for path in sorted(self.folder.glob(f"*.{_SEGMENT}")):
            try:
                self.report(path, self.ingest(path, *_place(path)))
            except (*PASSING, StoreError, OSError):
                raise
            except GroundError as error:
                self.report(path, error)
            path.unlink(missing_ok=True)

    @property
    def _current(self) -> Path:
        return self.folder / f"{self._recording}.{self._offset:015d}.{_CURRENT}"

    def _adopt(self) -> None:
        """Rename the segments of a version whose spools had no recordings: they are consecutive."""
        old = [path for path in self.folder.glob(f"*.{_SEGMENT}") if path.stem.isdigit()]
        offset = 0
        for path in (*sorted(old), self.folder / _CURRENT):
            if path.exists():
                size = path.stat().st_size
                replace_durably(path, self.folder / f"0.{offset:015d}.{_SEGMENT}")
                offset += size


def _place(path: Path) -> tuple[str, int]:
    """Return the recording and the offset of a segment."""
    recording, offset, _ = path.name.split(".")
    return recording, int(offset)


def spooled_octets(folder: Path) -> int:
    """Return the octets in the folder of a spool, which another process may operate.

    The current segment is looked at first: once cut, it is one of the others.
    """
    total = 0
    for suffix in (_CURRENT, _SEGMENT):
        for path in folder.glob(f"*.{suffix}"):
            with contextlib.suppress(FileNotFoundError):
                total += path.stat().st_size
    return total


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
