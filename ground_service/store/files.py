"""File archive: each file is stored once, immutable, under the SHA-256 of its content.

A stored file survives a power failure: its content, its name and every new folder are synchronised to the disk before
`FileArchive.put` returns.

With an object store, a file is stored when the object store has it; the folder then is a cache of this machine.
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
from typing import TYPE_CHECKING, BinaryIO

from sqlalchemy import Connection, select

from ground_service.errors import FileDamaged, NotFound, StoreError, storage_error
from ground_service.store import repository
from ground_service.store.objects import ObjectStore

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


BLOCK_OCTETS = 1 << 20

INCOMING = ".incoming-"
"""Prefix of files that are still being written; host and process follow, to identify leftovers."""

UNPACKING = ".unpacking-"
"""Prefix of folders that an archive is being unpacked into."""

UNFINISHED_AGE_S = 86_400.0
"""Age from which an unfinished file of another host is a leftover."""

TRIM_S = 600.0
"""Shortest time between two trims of a cache by one process."""

CACHED_S = 3600.0
"""Time after its last use for which a file stays in the cache of an object store."""


@dataclass(frozen=True, slots=True)
class StoredFile:
    """Location and content of a file of the archive."""

    sha256: str
    octets: int
    path: Path


@dataclass(frozen=True, slots=True)
class FileArchive:
    """Files under `root`, named by content; a file appears whole or not at all.

    Attributes
    ----------
    objects
        Object store that has the files, which `root` caches; None: `root` has the files.
    """

    root: Path
    objects: ObjectStore | None = None

    def place(self, sha256: str) -> Path:
        """Return where the file of this content lies on this machine, or would lie."""
        return self.root / sha256[:2] / sha256

    def path(self, sha256: str) -> Path:
        """Return the file of this content, fetched from the object store if it is not here; it may be missing."""
        place = self.place(sha256)
        if self.objects is not None:
            try:
                os.utime(place)  # used now
            except FileNotFoundError:
                self._fetch(self.objects, sha256)
            except OSError as error:
                raise storage_error(error, place) from None
        return place

    def octets(self, sha256: str) -> int | None:
        """Return the size of a stored file; None if it is not stored."""
        if self.objects is not None:
            return self.objects.octets(sha256)
        place = self.place(sha256)
        return place.stat().st_size if place.is_file() else None

    def blocks(self, sha256: str) -> Iterator[bytes]:
        """Yield the octets of a file as they are stored, unchecked and without filling the cache."""
        return read_blocks(self.place(sha256)) if self.objects is None else self.objects.read(sha256)

    def names(self) -> Iterator[tuple[str, bool]]:
        """Yield the name of each file that is stored, and whether it lies where a file of this name belongs."""
        if self.objects is not None:
            for key in self.objects.names():
                name = key.rpartition("/")[2]
                yield name, key == f"{name[:2]}/{name}"
            return
        for path in sorted(self.root.rglob("*")):
            if path.is_file() and not path.name.startswith("."):
                yield path.name, path == self.place(path.name)

    def remove(self, sha256: str) -> None:
        """Remove a file, if it is stored."""
        if self.objects is not None:
            self.objects.remove(sha256)
        self.place(sha256).unlink(missing_ok=True)

    def trim(self, now_s: float | None = None) -> int:
        """Trim the cache of an object store: remove the files that were not used for longest; return their number.

        Files used within `CACHED_S` remain, and files that the object store does not have.
        """
        if self.objects is None:
            return 0
        limit_octets = self.objects.cache_octets
        now_s = time.time() if now_s is None else now_s
        found = []
        for path in self.root.rglob("*"):
            with contextlib.suppress(FileNotFoundError):
                if path.is_file() and not path.name.startswith("."):
                    found.append((path.stat().st_mtime, path.stat().st_size, path))
        total = sum(octets for _, octets, _ in found)
        removed = 0
        for used_s, octets, path in sorted(found):
            if total <= limit_octets or now_s - used_s < CACHED_S:
                break
            if self.objects.octets(path.name) == octets:
                path.unlink(missing_ok=True)
                total -= octets
                removed += 1
        return removed

    def _fetch(self, objects: ObjectStore, sha256: str) -> None:
        incoming = IncomingFile(self)
        try:
            for block in objects.read(sha256):
                incoming.append(block)
            incoming.keep(fetched=sha256)
            self.trim_at_times()
        except NotFound:
            return
        finally:
            incoming.discard()

    def trim_at_times(self) -> None:
        """Trim the cache, at most once in `TRIM_S`."""
        now = time.monotonic()
        if now - _trimmed.setdefault(self.root, now) < TRIM_S:
            return
        _trimmed[self.root] = now
        with contextlib.suppress(OSError, StoreError):
            self.trim()

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
        StorageFull, StorageReadOnly, ObjectsUnavailable
            If it could not.
        """
        if self.objects is not None:
            self.objects.require_reachable()
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
        """Return octets [start, stop) of a stored file, fewer if it ends before."""
        path = self.path(sha256)
        try:
            with path.open("rb") as stream:
                stream.seek(start)
                return stream.read(stop - start)
        except FileNotFoundError:
            raise NotFound("file", sha256) from None
        except OSError as error:
            raise storage_error(error, path) from None


_trimmed: dict[Path, float] = {}
"""Monotonic time at which this process last trimmed each cache."""


_durable: set[Path] = set()
"""Folders of an archive whose entries in its root this process has synchronised; they are not removed."""


def files_of(home: Path, objects: ObjectStore | None = None) -> FileArchive:
    """Return the file archive of a service, in an object store or under its home folder."""
    return FileArchive(home / "files", None if objects is None else objects.under("files"))


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

    def keep(self, *, fetched: str | None = None) -> StoredFile:
        """Make the file part of the archive, durably; storing the same octets again changes nothing.

        Parameters
        ----------
        fetched
            SHA-256 of the object that the octets were read from; None: they are new.

        Raises
        ------
        FileDamaged
            If the octets are not those of the object.
        """
        with self._lock:
            try:
                stream = self._stream or self._open()
                assert self._temporary is not None
                stream.flush()
                os.fsync(stream.fileno())
                stream.close()
                sha256 = self._digest.hexdigest()
                objects = self._archive.objects
                if fetched is not None and fetched != sha256:
                    raise FileDamaged(f"object {fetched}", fetched, sha256)
                if objects is not None and fetched is None:
                    with self._temporary.open("rb") as written:
                        objects.put(sha256, written, self._octets)
                target = self._archive.place(sha256)
                if not target.exists():
                    target.parent.mkdir(exist_ok=True)
                    self._temporary.chmod(0o400)
                    os.replace(self._temporary, target)
                    self._temporary = None
                # also if another process stored it, because its synchronisation may still be pending
                sync_folder(target.parent)
                if target.parent not in _durable:
                    sync_folder(self._archive.root)
                    _durable.add(target.parent)
                if objects is not None and fetched is None:
                    self._archive.trim_at_times()
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
    import numpy as np

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


def register_file(connection: Connection, stored: StoredFile, kind: str, name: str, now_utc_ns: int) -> None:
    """Enter a file of the archive into the database; entering it again changes nothing."""
    repository.add_new(
        connection,
        repository.FILES,
        sha256=stored.sha256,
        kind=kind,
        name=name,
        octets=stored.octets,
        received_utc_ns=now_utc_ns,
    )


def file_names(connection: Connection) -> list[str]:
    """Return the SHA-256 of all files, ascending."""
    return sorted(connection.execute(select(repository.FILES.c.sha256)).scalars())


def files_beginning(connection: Connection, prefix: str) -> list[str]:
    """Return the SHA-256 of the files whose SHA-256 begins so."""
    query = select(repository.FILES.c.sha256).where(repository.FILES.c.sha256.startswith(prefix))
    return list(connection.execute(query).scalars())


def recorded_name(connection: Connection, sha256: str) -> str:
    """Return the name of a file of the archive."""
    return str(repository.get(connection, repository.FILES, sha256, "file")["name"])
