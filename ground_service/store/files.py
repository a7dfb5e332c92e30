"""The archive of files: each stored once, immutable, under the SHA-256 of its octets."""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from ground_service.errors import FileDamaged, NotFound, storage_error

BLOCK_OCTETS = 1 << 20


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

    def put(self, blocks: Iterable[bytes]) -> StoredFile:
        """Store the octets of `blocks`; storing the same octets again changes nothing."""
        digest = hashlib.sha256()
        octets = 0
        temporary: Path | None = None
        try:
            self.root.mkdir(parents=True, exist_ok=True)
            descriptor, name = tempfile.mkstemp(dir=self.root, prefix=".incoming-")
            temporary = Path(name)
            with os.fdopen(descriptor, "wb") as stream:
                for block in blocks:
                    digest.update(block)
                    octets += len(block)
                    stream.write(block)
                stream.flush()
                os.fsync(stream.fileno())
            sha256 = digest.hexdigest()
            target = self.path(sha256)
            if not target.exists():
                target.parent.mkdir(parents=True, exist_ok=True)
                temporary.chmod(0o444)
                os.replace(temporary, target)
            return StoredFile(sha256, octets, target)
        except OSError as error:
            raise storage_error(error, self.root) from None
        finally:
            if temporary is not None:
                with contextlib.suppress(OSError):
                    temporary.unlink()

    def require_writable(self) -> None:
        """Store nothing, to see that something could be stored.

        Raises
        ------
        StorageFull, StorageReadOnly
            If it could not.
        """
        try:
            self.root.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=self.root, prefix=".incoming-") as stream:
                stream.write(bytes(4096))
        except OSError as error:
            raise storage_error(error, self.root) from None

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
            If nothing of this content is stored.
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


def read_blocks(path: Path) -> Iterator[bytes]:
    """The octets of a file, block by block."""
    try:
        with path.open("rb") as stream:
            while block := stream.read(BLOCK_OCTETS):
                yield block
    except OSError as error:
        raise storage_error(error, path) from None
