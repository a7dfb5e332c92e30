"""Errors of the ground service.

GroundError
├── SettingsError            a setting that cannot be used
├── StoreError
│   ├── DatabaseUnavailable      the database cannot be opened or reached
│   ├── DatabaseBusy             the database cancelled a transaction because of a concurrent one
│   ├── OtherRevision            a schema revision that this program does not use
│   │   ├── DatabaseTooNew           written by a newer version of this program
│   │   ├── DatabaseTooOld           written before version 1.0; its raw files can be ingested again
│   │   └── DatabaseNotMigrated      older than this program and not migrated automatically
│   ├── StorageFull              no space left for the archive
│   ├── StorageReadOnly          the archive cannot be written
│   ├── ObjectsUnavailable       the object store cannot be reached
│   ├── AuditBroken              the audit chain cannot be continued
│   └── FileDamaged              the content of a stored file has changed
├── NotFound                 no such pass, ingest, report, job, ...
├── Conflict                 the request contradicts what is stored
│   └── StateConflict            the state of the entity does not permit the request
├── InvalidInput             invalid input (file, manifest, field)
├── BuildNotChecked          the parameters of a payload build cannot be checked here
├── EvaluationError          a pass that cannot be evaluated
├── Stopping                 the service is being stopped during the work
├── NotAuthorised            the caller is unknown or not permitted to do this
├── SignInRefused            a sign-in with an OpenID provider that is not accepted
├── ProviderUnavailable      the OpenID provider cannot be reached or used
└── ServerError              the HTTP server cannot start (port in use, unsafe address)
"""

import errno
import logging
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*://[^\s'\"]*")
_PATH = re.compile(r"(?<![\w./])/(?:[^\s/'\",;:()]+/)+([^\s/'\",;:()]*)")
PUBLIC_LIMIT = 500
_log = logging.getLogger(__name__)


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


class DatabaseBusy(StoreError):
    """The database cancelled a transaction because of a concurrent one; a retry may succeed."""

    def __init__(self, reason: str) -> None:
        super().__init__(f"database: nothing was changed, a retry may succeed: {reason}")


class OtherRevision(StoreError):
    """Base of what a database of another schema revision is refused with; `remedy` ends the message."""

    remedy = ""

    def __init__(self, url: str, expected: str, found: str) -> None:
        super().__init__(f"database {url}: expected schema revision {expected}, found {found}{self.remedy}")
        self.expected = expected
        self.found = found


class DatabaseTooNew(OtherRevision):
    """The database was written by a newer version of this program."""

    remedy = " of a newer version; update linna or use another database"


class DatabaseTooOld(OtherRevision):
    """The database was written before version 1.0; it cannot be migrated."""

    remedy = (
        " of a version before 1.0; ingest the raw files under LINNA_HOME/files into a new database with 'linna ingest'"
    )


class DatabaseNotMigrated(OtherRevision):
    """The database is older than this program; `linna db upgrade` is needed."""

    remedy = "; run 'linna db upgrade'"


class StorageFull(StoreError):
    """No space left where the archive lives."""

    def __init__(self, where: str) -> None:
        super().__init__(f"{where}: no space left; nothing more was stored, free space and run it again")


class StorageReadOnly(StoreError):
    """The archive cannot be written."""

    def __init__(self, where: str, reason: str = "read-only") -> None:
        super().__init__(f"{where}: cannot be written ({reason}); expected a folder that this user may write to")


class Draining(StoreError):
    """The process answers its last requests; others have to go to another process."""

    def __init__(self) -> None:
        super().__init__("the process is being stopped; use another one")


class ObjectsUnavailable(StoreError):
    """The object store cannot be reached or refuses a request; the same request may succeed later."""

    def __init__(self, bucket: str, reason: str) -> None:
        super().__init__(f"object store, bucket {bucket}: cannot be used: {reason}")


class Stopping(GroundError):
    """The service is being stopped in the middle of the work, which goes on when it runs again."""

    def __init__(self) -> None:
        super().__init__("the service is being stopped; the work goes on when it runs again")


PASSING = (DatabaseUnavailable, DatabaseBusy, StorageFull, StorageReadOnly, ObjectsUnavailable, Stopping)
"""Errors that are no fault of the work itself: the same work may succeed later."""


class AuditBroken(StoreError):
    """The audit chain cannot be continued."""


class FileDamaged(StoreError):
    """A stored file no longer has the octets it was stored with."""

    def __init__(self, path: Path | str, expected: str, found: str) -> None:
        super().__init__(f"{path}: expected octets with SHA-256 {expected}, found {found}")


class NotFound(GroundError):
    """No such thing in the database: raised by every function that is given an id or a name of none."""

    def __init__(self, kind: str, key: object) -> None:
        super().__init__(f"{kind} {key}: not found")
        self.kind = kind
        self.key = key


class Conflict(GroundError):
    """The request contradicts what is stored."""


class StateConflict(Conflict):
    """The state of an entity does not permit the request; `found` is that state."""

    def __init__(self, kind: str, key: object, expected: str, found: str) -> None:
        super().__init__(f"{kind} {key}: expected state {expected}, found {found}")
        self.kind = kind
        self.key = key
        self.expected = expected
        self.found = found


class InvalidInput(GroundError):
    """Input that is not acceptable."""

    def __init__(self, what: str, where: str, expected: str, found: str) -> None:
        place = f"{what}, {where}" if where else what
        super().__init__(f"{place}: expected {expected}, found {found}")
        self.what = what
        self.where = where
        self.expected = expected
        self.found = found


class BuildNotChecked(GroundError):
    """The parameters of a payload build cannot be checked here, so it is not registered."""

    def __init__(self, build: str, reason: str) -> None:
        super().__init__(f"build {build}: the parameters cannot be checked: {reason}")
        self.build = build
        self.reason = reason


class EvaluationError(GroundError):
    """A pass that cannot be evaluated."""


class Forbidden(GroundError):
    """The caller is known but not permitted to do this."""


class NotAuthorised(GroundError):
    """The caller is not known, or may not do this."""


class SignInRefused(GroundError):
    """A sign-in with an OpenID provider that is not accepted."""

    def __init__(self, what: str, expected: str, found: str) -> None:
        super().__init__(f"{what}: expected {expected}, found {found}")


class ProviderUnavailable(GroundError):
    """The OpenID provider cannot be reached, or its answer cannot be used."""

    def __init__(self, place: str, expected: str, found: str) -> None:
        super().__init__(f"OpenID provider, {place}: expected {expected}, found {found}")


class ServerError(GroundError):
    """The HTTP server cannot start."""


def storage_error(error: OSError, where: Path | str) -> GroundError:
    """The error of this package that says what an operating-system error at `where` means."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return StorageFull(str(where))
    if error.errno in (errno.EROFS, errno.EACCES, errno.EPERM):
        return StorageReadOnly(str(where), error.strerror or "read-only")
    return StoreError(f"{where}: {error.strerror or error}")


@contextmanager
def fault_of(work: str, *, passing: tuple[type[Exception], ...] = PASSING) -> Iterator[list[str]]:
    """Run one of many pieces of work, none of which a fault of another one stops: the outermost loop of the work.

    A fault is logged, with a traceback if it is unexpected, and its text is in the yielded list after the block. Errors
    of the kinds `passing` are raised.
    """
    found: list[str] = []
    try:
        yield found
    except passing:
        raise
    except Exception as error:
        _log.error("%s: failed: %s", work, error, exc_info=not isinstance(error, GroundError))
        found.append(public_text(error))


def public_text(error: BaseException) -> str:
    """Return the message of an error in one line for any caller: without URLs, and with file names instead of paths.

    The complete text is written to the log of the service.
    """
    text = str(error) if str(error) else type(error).__name__
    if not isinstance(error, GroundError) and type(error).__module__ in ("builtins", "numpy"):
        text = f"{type(error).__name__}: {text}" if str(error) else text
    if isinstance(error, OSError):
        text = f"{type(error).__name__}: {error.strerror or type(error).__name__}"
    shown = _PATH.sub(r"\1", _URL.sub("(address)", text))
    line = " ".join("".join(c if c.isprintable() else " " for c in shown).split())
    return line if len(line) <= PUBLIC_LIMIT else line[: PUBLIC_LIMIT - 1] + "…"


@dataclass(frozen=True, slots=True)
class PlanConflict:
    """Something that stands in the way of a window."""

    kind: str
    window_id: int | None
    detail: str


class PlanConflicts(Conflict):
    """A window contradicts others or the resources; `conflicts` says how."""

    def __init__(self, what: str, conflicts: Sequence[PlanConflict]) -> None:
        super().__init__(f"{what}: " + "; ".join(conflict.detail for conflict in conflicts))
        self.conflicts = tuple(conflicts)
