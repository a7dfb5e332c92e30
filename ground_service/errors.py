"""Errors of the ground service.

GroundError
├── SettingsError            a setting that cannot be used
├── StoreError
│   ├── DatabaseUnavailable      the database cannot be opened or reached
│   ├── DatabaseTooNew           written by a newer version of this program
│   ├── DatabaseNotMigrated      older than this program and not migrated by itself
│   ├── StorageFull              no space left where the archive lives
│   ├── StorageReadOnly          the archive cannot be written
│   └── FileDamaged              a stored file no longer has the octets it was stored with
├── NotFound                 no such pass, ingest, report, job, ...
├── Conflict                 the request contradicts what is stored
├── InvalidInput             what was given cannot be accepted (file, manifest, field)
├── EvaluationError          a pass that cannot be evaluated
├── Stopping                 the service is being stopped in the middle of the work
├── NotAuthorised            the caller is not known or may not do this
└── ServerError              the HTTP server cannot start (port in use, unsafe address)
"""

from __future__ import annotations

import errno
from pathlib import Path


class GroundError(Exception):
    """Base of all errors raised by the ground service."""


class SettingsError(GroundError):
    """A setting that cannot be used."""

    def __init__(self, name: str, expected: str, found: str) -> None:
        super().__init__(f"{name}: expected {expected}, found {found}")
        self.name = name


class StoreError(GroundError):
    """Base of what goes wrong with the database or the archive of files."""


class DatabaseUnavailable(StoreError):
    """The database cannot be opened or reached."""

    def __init__(self, url: str, reason: str) -> None:
        super().__init__(f"database {url}: cannot be opened: {reason}")
        self.url = url


class DatabaseTooNew(StoreError):
    """The database was written by a newer version of this program."""

    def __init__(self, url: str, expected: str, found: str) -> None:
        super().__init__(
            f"database {url}: expected schema revision {expected} or older, found {found} of a newer version; "
            "update linna or use another database"
        )
        self.expected = expected
        self.found = found


class DatabaseNotMigrated(StoreError):
    """The database is older than this program; `linna db upgrade` is needed."""

    def __init__(self, url: str, expected: str, found: str) -> None:
        super().__init__(
            f"database {url}: expected schema revision {expected}, found {found}; run 'linna db upgrade'"
        )
        self.expected = expected
        self.found = found


class StorageFull(StoreError):
    """No space left where the archive lives."""

    def __init__(self, where: str) -> None:
        super().__init__(f"{where}: no space left; nothing more was stored, free space and run it again")


class StorageReadOnly(StoreError):
    """The archive cannot be written."""

    def __init__(self, where: str, reason: str = "read-only") -> None:
        super().__init__(
            f"{where}: cannot be written ({reason}); expected a folder that this user may write to"
        )


class Stopping(GroundError):
    """The service is being stopped in the middle of the work, which goes on when it runs again."""

    def __init__(self) -> None:
        super().__init__("the service is being stopped; the work goes on when it runs again")


PASSING = (DatabaseUnavailable, StorageFull, StorageReadOnly, Stopping)
"""What is no fault of the work that meets it: the same work, later, may well succeed."""


class FileDamaged(StoreError):
    """A stored file no longer has the octets it was stored with."""

    def __init__(self, path: Path, expected: str, found: str) -> None:
        super().__init__(f"{path}: expected octets with SHA-256 {expected}, found {found}")


class NotFound(GroundError):
    """No such thing in the database."""

    def __init__(self, kind: str, key: object) -> None:
        super().__init__(f"{kind} {key}: not found")
        self.kind = kind
        self.key = key


class Conflict(GroundError):
    """The request contradicts what is stored."""


class InvalidInput(GroundError):
    """What was given cannot be accepted."""

    def __init__(self, what: str, where: str, expected: str, found: str) -> None:
        place = f"{what}, {where}" if where else what
        super().__init__(f"{place}: expected {expected}, found {found}")
        self.what = what
        self.where = where
        self.expected = expected
        self.found = found


class EvaluationError(GroundError):
    """A pass that cannot be evaluated."""


class NotAuthorised(GroundError):
    """The caller is not known, or may not do this."""


class ServerError(GroundError):
    """The HTTP server cannot start."""


def storage_error(error: OSError, where: Path | str) -> GroundError:
    """The error of this package that says what an operating-system error at `where` means."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return StorageFull(str(where))
    if error.errno in (errno.EROFS, errno.EACCES, errno.EPERM):
        return StorageReadOnly(str(where), error.strerror or "read-only")
    return StoreError(f"{where}: {error.strerror or error}")
