"""File archive: each file is stored once, immutable, under the SHA-256 of its content.

A stored file survives a power failure: its content, its name and every new folder are synchronised to the disk before
`FileArchive.put` returns.
"""

from __future__ import annotations

import contextlib
import hashlib
import mmap
import os
import shutil
import socket
import tempfile
import threading
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ground_service.errors import FileDamaged, NotFound, StoreError, storage_error

BLOCK_OCTETS = 1 << 20

INCOMING = ".incoming-"
"""Prefix of files that are still being written; host and process follow, to identify leftovers."""

UNPACKING = ".unpacking-"
"""Prefix of folders that an archive is being unpacked into."""

UNFINISHED_AGE_S = 86_400.0
"""Age from which an unfinished file of another host is a leftover."""


@dataclass(frozen=True, slots=True)
class StoredFile:
    """Where a file of the archive lies and what it holds."""

    sha256: str
    octets: int
    path: Path


@dataclass(frozen=True, slots=True)
class FileArchive:
    """Files under `root`, named by content; a file appears whole or not at all."""

    root: Path

    def path(self, sha256: str) -> Path:
        """Where the file of this content lies, or would lie."""
        return self.root / sha256[:2] / sha256

    def incoming(self) -> IncomingFile:
        """Return a new file, which can be appended to and then kept."""
        return IncomingFile(self)

    def put(self, blocks: Iterable[bytes]) -> StoredFile:
        """Store the octets of `blocks`; storing the same octets again changes nothing."""
        incoming = self.incoming()
        try:
            for block in blocks:
                incoming.append(block)
            return incoming.keep()
        except OSError as error:  # an error of the producer of the blocks
            raise storage_error(error, self.root) from None
        finally:
            incoming.discard()

    def require_writable(self) -> None:
        """Store nothing, to see that something could be stored.

        Raises
        ------
        StorageFull, StorageReadOnly
            If it could not.
        """
        try:
            make_durable_folder(self.root)
            with tempfile.TemporaryFile(dir=self.root, prefix=unfinished_prefix(INCOMING)) as stream:
                stream.write(bytes(4096))
        except OSError as error:
            raise storage_error(error, self.root) from None

    def remove_leftovers(self, now_s: float | None = None) -> int:
        """Remove unfinished files of ended processes; return their number."""
        return remove_leftovers(self.root, INCOMING, now_s)

    def put_file(self, path: Path) -> StoredFile:
        """Store a copy of the file at `path`."""
        return self.put(read_blocks(path))

    def put_octets(self, octets: bytes) -> StoredFile:
        """Store these octets."""
        return self.put((octets,))

    def get(self, sha256: str) -> bytes:
        """The octets of a stored file.

        Raises
        ------
        NotFound
            If no file with this hash is stored.
        FileDamaged
            If the octets on disk are no longer those that were stored.
        """
        path = self.path(sha256)
        try:
            octets = path.read_bytes()
        except FileNotFoundError:
            raise NotFound("file", sha256) from None
        except OSError as error:
            raise storage_error(error, path) from None
        found = hashlib.sha256(octets).hexdigest()
        if found != sha256:
            raise FileDamaged(path, sha256, found)
        return octets

    def read(self, sha256: str, start: int, stop: int) -> bytes:
        """Return octets [start, stop) of a stored file, fewer if it ends before.

        Raises
        ------
        NotFound
            If no file with this hash is stored.
        """
        path = self.path(sha256)
        try:
            with path.open("rb") as stream:
                stream.seek(start)
                return stream.read(stop - start)
        except FileNotFoundError:
            raise NotFound("file", sha256) from None
        except OSError as error:
            raise storage_error(error, path) from None


class IncomingFile:
    """File that is being added to the archive: it is appended to, then kept or discarded.

    The methods may be called from different threads. After `discard` nothing can be appended, so that a pending write
    of a cancelled upload leaves no file.
    """

    def __init__(self, archive: FileArchive) -> None:
        self._archive = archive
        self._digest = hashlib.sha256()
        self._octets = 0
        self._temporary: Path | None = None
        self._stream: BinaryIO | None = None
        self._lock = threading.Lock()
        self._over = False

    def append(self, block: bytes) -> None:
        """Write the next octets; the first call creates the file."""
        with self._lock:
            try:
                stream = self._stream or self._open()
                stream.write(block)
            except OSError as error:
                raise storage_error(error, self._archive.root) from None
            self._digest.update(block)
            self._octets += len(block)

    def keep(self) -> StoredFile:
        """Make the file part of the archive, durably; storing the same octets again changes nothing."""
        with self._lock:
            try:
                stream = self._stream or self._open()
                assert self._temporary is not None
                stream.flush()
                os.fsync(stream.fileno())
                stream.close()
                sha256 = self._digest.hexdigest()
                target = self._archive.path(sha256)
                if not target.exists():
                    target.parent.mkdir(exist_ok=True)
                    self._temporary.chmod(0o400)
                    os.replace(self._temporary, target)
                    self._temporary = None
                # also if another process stored it, because its synchronisation may still be pending
                sync_folder(target.parent)
                sync_folder(self._archive.root)
                return StoredFile(sha256, self._octets, target)
            except OSError as error:
                raise storage_error(error, self._archive.root) from None

    def discard(self) -> None:
        """Remove the file if it was not kept."""
        with self._lock:
            self._over = True
            with contextlib.suppress(OSError):
                if self._stream is not None:
                    self._stream.close()
            if self._temporary is not None:
                with contextlib.suppress(OSError):
                    self._temporary.unlink()
                self._temporary = None

    def _open(self) -> BinaryIO:
        if self._over:
            raise StoreError("incoming file: expected no octets after it was discarded, found some")
        make_durable_folder(self._archive.root)
        descriptor, name = tempfile.mkstemp(dir=self._archive.root, prefix=unfinished_prefix(INCOMING))
        self._temporary = Path(name)
        self._stream = os.fdopen(descriptor, "wb")
        return self._stream


def read_blocks(path: Path, start: int = 0, stop: int | None = None) -> Iterator[bytes]:
    """Yield the octets [start, stop) of a file, block by block; by default all of them."""
    try:
        with path.open("rb") as stream:
            stream.seek(start)
            left = BLOCK_OCTETS if stop is None else stop - start
            while left > 0 and (block := stream.read(min(BLOCK_OCTETS, left))):
                left -= 0 if stop is None else len(block)
                yield block
    except OSError as error:
        raise storage_error(error, path) from None


def mapped_octets(path: Path) -> NDArray[np.uint8]:
    """Return the octets of a file as a memory map, which is closed with the last reference to it."""
    try:
        with path.open("rb") as stream:
            if not os.fstat(stream.fileno()).st_size:
                return np.empty(0, dtype=np.uint8)
            return np.frombuffer(mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ), dtype=np.uint8)
    except OSError as error:
        raise storage_error(error, path) from None


def sync_folder(folder: Path) -> None:
    """Synchronise the directory entries of a folder to the disk."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def make_durable_folder(folder: Path) -> None:
    """Create a folder and its missing parents durably."""
    missing = []
    for one in (folder, *folder.parents):
        if one.exists():
            break
        missing.append(one)
    for one in reversed(missing):
        one.mkdir(exist_ok=True)
        sync_folder(one.parent)


def replace_durably(written: Path, target: Path) -> None:
    """Rename a written file or folder atomically and durably: after a power failure the new or the old one exists."""
    for folder, _, names in os.walk(written):
        for path in (Path(folder, name) for name in names):
            if path.is_file() and not path.is_symlink():
                _sync_file(path)
        sync_folder(Path(folder))
    if written.is_file():
        _sync_file(written)
    os.replace(written, target)
    sync_folder(target.parent)


def remove_leftovers(folder: Path, prefix: str, now_s: float | None = None) -> int:
    """Remove unfinished files and folders of ended processes in `folder`; return their number.

    Those of running processes of this host are kept, those of other hosts for `UNFINISHED_AGE_S`.
    """
    removed = 0
    now_s = time.time() if now_s is None else now_s
    with contextlib.suppress(FileNotFoundError):
        for path in list(folder.glob(f"{prefix}*")):
            with contextlib.suppress(OSError):
                if not _is_leftover(path, prefix, now_s):
                    continue
                if path.is_dir() and not path.is_symlink():
                    shutil.rmtree(path)
                else:
                    path.unlink()
                removed += 1
    return removed


def unfinished_prefix(prefix: str) -> str:
    """Return a prefix for unfinished names of this process, by which `remove_leftovers` identifies the process."""
    return f"{prefix}{_host()}.{os.getpid()}.{_start_of(os.getpid())}-"


def _sync_file(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _host() -> str:
    return hashlib.blake2b(socket.gethostname().encode(), digest_size=4).hexdigest()


def _is_leftover(path: Path, prefix: str, now_s: float) -> bool:
    host, _, process = path.name.removeprefix(prefix).split("-")[0].partition(".")
    number, _, start = process.partition(".")
    if host == _host() and number.isdigit():
        # a restarted container assigns the same process ids again
        found = _start_of(int(number))
        return not _runs(int(number)) or (start != found and not {"", "0"} & {start, found})
    return now_s - path.stat().st_mtime > UNFINISHED_AGE_S


def _start_of(process: int) -> str:
    """Return the start time of a process in kernel ticks since boot; 0 if unknown."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[19]
    except (OSError, IndexError):
        return "0"


def _runs(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
