"""Opening the database, keeping its schema current, and the transactions of one writer.

SQLite is opened with a write-ahead log, so readers never wait for the writer; a write transaction takes the
write lock at once (BEGIN IMMEDIATE), so that what it reads first is what it changes.
"""

from __future__ import annotations

import ast
import contextlib
import errno
import functools
import hashlib
import json
import logging
import math
import os
import re
import sqlite3
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sqlalchemy import Connection, Engine, create_engine, event, inspect, make_url, text
from sqlalchemy.engine import ExceptionContext
from sqlalchemy.exc import DataError, DBAPIError, InvalidatePoolError, SQLAlchemyError

import ground_service
from ground_service import errors
from ground_service.store import audit, events
from ground_service.store.files import make_durable_folder

if TYPE_CHECKING:
    from alembic.config import Config
    from sqlalchemy.pool import ConnectionPoolEntry

log = logging.getLogger(__name__)

BUSY_TIMEOUT_MS = 30_000

_USED = "linna_used"
"""Key of the time at which a pooled connection was last given back."""

_REVISION = re.compile(r"^(revision|down_revision) = (.+)$", re.MULTILINE)

WORKS_WITH = "_works_with_"

LOCK_WAIT_MS = 500
LOCK_TRIES = 120
LOCK_PAUSE_S = 0.5
"""A migration waits this long for a lock, shorter than the deadlock detection of PostgreSQL, so that it gives way to
requests; it is then tried again."""

REVISIONS_BEFORE_1_0 = tuple(f"{number:04d}" for number in range(1, 12))
"""Schema revisions before version 1.0, which have no migrations."""

PAGE_CACHE_KIB = 2_048
"""SQLite's own cache of each connection; what falls out of it is still in the system's, which all of them share."""


LOST_HOST = {
    "connect_timeout": 10,
    "keepalives_idle": 10,
    "keepalives_interval": 5,
    "keepalives_count": 3,
    "tcp_user_timeout": 20_000,
}
"""Options of libpq with which a connection to a host that no longer answers fails within half a minute."""

IDLE_S = 1.0
"""A pooled connection that was unused for this long is tested before it is used."""

SAFE_COMMITS = ("on", "remote_apply")
"""Values of synchronous_commit with which a commit is on the disk of the server, and of a synchronous standby."""


@dataclass(frozen=True, slots=True)
class Database:
    """An engine and its transactions; `listeners` are called after commits with events."""

    engine: Engine
    listeners: events.Listeners = field(default_factory=events.Listeners, compare=False, repr=False)
    _readers: Engine = field(init=False, compare=False, repr=False)

    def __post_init__(self) -> None:
        server = self.engine.dialect.name == "postgresql"
        readers = self.engine.execution_options(isolation_level="AUTOCOMMIT") if server else self.engine
        if server:
            event.listen(readers, "before_cursor_execute", _refuse_changes)
        object.__setattr__(self, "_readers", readers)

    @property
    def dialect(self) -> str:
        """Name of the database in use: sqlite or postgresql."""
        return self.engine.dialect.name

    @property
    def label(self) -> str:
        """The URL without its password."""
        return self.engine.url.render_as_string(hide_password=True)

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        """Yield a connection to read with.

        On PostgreSQL each statement sees what is committed when it begins, without the messages that begin and end a
        transaction; server-side cursors need `snapshot`.
        """
        with self._translated(), self._readers.connect() as connection:
            yield connection

    @contextmanager
    def snapshot(self) -> Iterator[Connection]:
        """Yield a read connection with a consistent snapshot of the database."""
        with self._translated(), self.engine.connect() as connection:
            if self.dialect == "postgresql":
                connection = connection.execution_options(isolation_level="REPEATABLE READ")
            with connection.begin():
                yield connection

    @contextmanager
    def writing(self) -> Iterator[Connection]:
        """Yield a connection in a write transaction, committed at the end and rolled back on an error.

        Audit entries and events of the transaction are appended to their logs just before the commit.
        """
        with self._translated(), self.engine.connect() as connection:
            connection.execution_options(**{audit.PENDING: [], events.PENDING: []}, linna_write=True)
            with connection.begin():
                yield connection
                audit.append_pending(connection)
                kinds = events.append_pending(connection)
        self.listeners.notify(kinds)

    def require_writable(self) -> None:
        """Refuse a SQLite file without write permission, without waiting for writers.

        Raises
        ------
        StorageReadOnly
            If it may not.
        """
        path = self.engine.url.database
        if self.dialect == "sqlite" and path and Path(path).exists() and not os.access(path, os.W_OK):
            raise errors.StorageReadOnly(self.label)

    @contextmanager
    def alone(self, name: str) -> Iterator[bool]:
        """Return whether no other process holds the lock of this name now; it is held until the end, or the process's.

        A SQLite database serves the jobs of one process only, which then is alone anyway.
        """
        if self.dialect != "postgresql":
            yield True
            return
        key = int.from_bytes(hashlib.blake2b(name.encode(), digest_size=8).digest(), "big", signed=True)
        with self._translated(), self.engine.connect() as connection:
            connection = connection.execution_options(isolation_level="AUTOCOMMIT")
            held = bool(connection.execute(text("SELECT pg_try_advisory_lock(:key)"), {"key": key}).scalar())
            try:
                yield held
            finally:
                if held and not connection.invalidated:
                    with contextlib.suppress(SQLAlchemyError):
                        connection.execute(text("SELECT pg_advisory_unlock(:key)"), {"key": key})

    @contextmanager
    def _translated(self) -> Iterator[None]:
        try:
            yield
        except DBAPIError as error:
            raise database_error(error, self.label) from error


def open_database(url: str) -> Database:
    """The database at `url`; nothing is created or checked yet, except the folder of a SQLite file."""
    try:
        parsed = make_url(url)
    except SQLAlchemyError:
        raise errors.DatabaseUnavailable(url.split("@")[-1], "expected a URL such as sqlite:///file.db") from None
    if parsed.get_backend_name() == "sqlite":
        if parsed.database and not parsed.database.startswith((":memory:", "file:")):
            _make_folder(Path(parsed.database))
        engine = create_engine(parsed, connect_args={"timeout": BUSY_TIMEOUT_MS / 1000}, json_serializer=_json_text)
        event.listen(engine, "handle_error", _refuse_values)
        event.listen(engine, "connect", _prepare_sqlite)
        event.listen(engine, "begin", _begin_sqlite)
        return Database(engine)
    try:
        engine = create_engine(
            parsed,
            connect_args={name: value for name, value in LOST_HOST.items() if name not in parsed.query},
            pool_size=10,
            max_overflow=20,
            json_serializer=_json_text,
        )
        event.listen(engine, "handle_error", _refuse_values)
        # Before SQLAlchemy reads texts, which another encoding returns as octets.
        event.listen(engine, "connect", _prepare_postgresql, insert=True)
        event.listen(engine, "checkin", _note_use)
        event.listen(engine, "checkout", functools.partial(_test_idle, engine))
        return Database(engine)
    except (SQLAlchemyError, ImportError) as error:
        raise errors.DatabaseUnavailable(parsed.render_as_string(), str(error).splitlines()[0]) from None


def prepare_database(url: str, *, upgrade: bool | None = None) -> Database:
    """Return the database at `url` with the schema of this version.

    A SQLite database is created and upgraded automatically. The schema of a server is changed only by
    `linna db upgrade` (`upgrade` True), so that an administrator decides when.

    Raises
    ------
    DatabaseTooNew
        If a newer version of the program wrote it.
    DatabaseTooOld
        If a version before 1.0 wrote it.
    DatabaseNotMigrated
        If it is older and must not be upgraded here.
    DatabaseUnavailable, StorageReadOnly, StorageFull
        If it is not usable.
    """
    database = open_database(url)
    try:
        _warn_of_unsafe_server(database)
        found, head, known = schema_revisions(database)
        if found == head:
            return database
        if found in REVISIONS_BEFORE_1_0:
            raise errors.DatabaseTooOld(database.label, head, str(found))
        if found is not None and found not in known:
            if oldest_program(found) in known:
                log.info("database %s: schema revision %s of a newer version", database.label, found)
                return database
            raise errors.DatabaseTooNew(database.label, head, found)
        if upgrade is False or (upgrade is None and database.dialect != "sqlite"):
            raise errors.DatabaseNotMigrated(database.label, head, found or "none")
        upgrade_database(database)
    except BaseException:
        database.engine.dispose()
        raise
    return database


def schema_revisions(database: Database) -> tuple[str | None, str, tuple[str, ...]]:
    """Return the revision of the database (None: empty), the newest one known here, and all known, newest first."""
    known = known_revisions()
    with database.reading() as connection:
        found = None
        if inspect(connection).has_table("alembic_version"):
            found = connection.execute(text("SELECT version_num FROM alembic_version")).scalar()
    return found, known[0], known


def known_revisions() -> tuple[str, ...]:
    """Return the revisions of this version, newest first.

    They are read from the names in the scripts: the import of Alembic takes longer than many commands.
    """
    previous = dict(map(_script_revision, sorted((migrations_folder() / "versions").glob("*.py"))))
    known = [next(one for one in previous if one not in previous.values())]
    while (earlier := previous[known[-1]]) is not None:
        known.append(earlier)
    return tuple(known)


def oldest_program(revision: str) -> str:
    """Return the revision of the oldest version of the program that works with a schema of this revision.

    A revision that only expands the schema is named so, for example `1.2_works_with_1.0`.
    """
    name, _, oldest = revision.partition(WORKS_WITH)
    return oldest or name


def _script_revision(path: Path) -> tuple[str, str | None]:
    """Return the revision of a migration script and the one before it."""
    stated = dict(_REVISION.findall(path.read_text(encoding="utf-8")))
    return ast.literal_eval(stated["revision"]), ast.literal_eval(stated["down_revision"])


def upgrade_database(database: Database, revision: str = "head") -> None:
    """Upgrade the schema to a revision in one transaction; wait for a concurrent upgrade."""
    for left in reversed(range(LOCK_TRIES)):
        try:
            _upgrade_once(database, revision)
            return
        except errors.DatabaseBusy as error:
            if left == 0:
                raise
            log.info("the migration is tried again: %s", error)
            time.sleep(LOCK_PAUSE_S)


def migrations_folder() -> Path:
    """Return the folder of the migration scripts, next to the packages of this project."""
    return Path(ground_service.__file__).resolve().parent.parent / "db" / "migrations"


def migration_config() -> Config:
    """Alembic's configuration, made here so that no file and no working directory is needed."""
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", str(migrations_folder()).replace("%", "%%"))
    config.set_main_option("path_separator", "os")
    return config


def database_error(error: DBAPIError, label: str) -> errors.GroundError:
    """The error of this package that says what a database error means."""
    original: Any = error.orig
    message = str(original).splitlines()[0] if original is not None else str(error).splitlines()[0]
    name = getattr(original, "sqlite_errorname", "") or ""
    if name.startswith("SQLITE_FULL") or getattr(original, "sqlstate", None) == "53100":
        return errors.StorageFull(label)
    if name.startswith("SQLITE_READONLY") or getattr(original, "sqlstate", None) == "25006":
        return errors.StorageReadOnly(label)
    state = str(getattr(original, "sqlstate", None) or "")
    if state in ("40001", "40P01", "55P03") or name.startswith("SQLITE_BUSY"):
        return errors.DatabaseBusy(message)
    if isinstance(error, DataError) or state.startswith("22"):
        return _refused(message)
    if name.startswith(("SQLITE_NOTADB", "SQLITE_CORRUPT")):
        return errors.DatabaseUnavailable(label, f"{message}; expected a SQLite database")
    return errors.DatabaseUnavailable(label, message)


_json_text = functools.partial(json.dumps, allow_nan=False)
"""JSON encoder without NaN and infinities, which PostgreSQL refuses; SQLite uses the same rule."""


def _refuse_values(context: ExceptionContext) -> None:
    """Raise an error of this package if a value cannot be passed to the database."""
    error = context.original_exception
    if isinstance(error, (ValueError, OverflowError)):  # NaN in JSON, integers over 64 bits, lone surrogates
        raise _refused(str(error)) from error


def _refused(message: str) -> errors.InvalidInput:
    return errors.InvalidInput("request", "", "text and numbers that the database can hold", message[:200])


def _upgrade_once(database: Database, revision: str) -> None:
    from alembic import command

    config = migration_config()
    with database.writing() as connection:
        if database.dialect == "postgresql":
            connection.execute(text("SELECT pg_advisory_xact_lock(7601)"))
            connection.execute(text(f"SET LOCAL lock_timeout = {LOCK_WAIT_MS}"))
        config.attributes["connection"] = connection
        command.upgrade(config, revision)


def _make_folder(path: Path) -> None:
    folder = path.parent
    try:
        make_durable_folder(folder)
        if not os.access(folder, os.W_OK):
            raise OSError(errno.EACCES, "read-only", str(folder))
    except OSError as error:
        raise errors.storage_error(error, folder) from None


def _prepare_sqlite(connection: sqlite3.Connection, _record: object) -> None:
    """Select WAL and durable commits, without transactions of the driver; `_begin_sqlite` starts them."""
    connection.isolation_level = None
    cursor = connection.cursor()
    cursor.execute("PRAGMA journal_mode=WAL")
    cursor.execute("PRAGMA synchronous=FULL")  # a commit is written to the disk before it is acknowledged
    cursor.execute("PRAGMA foreign_keys=ON")
    cursor.execute("PRAGMA temp_store=MEMORY")
    cursor.execute(f"PRAGMA cache_size=-{PAGE_CACHE_KIB}")
    cursor.close()


def _prepare_postgresql(connection: Any, _record: object) -> None:
    """Request durable commits."""
    encoding = connection.info.parameter_status("server_encoding")
    if encoding != "UTF8":
        raise errors.DatabaseUnavailable(
            f"{connection.info.host}/{connection.info.dbname}",
            f"expected a database with the encoding UTF8, found {encoding}",
        )
    with connection.cursor() as cursor:
        cursor.execute("SHOW synchronous_commit")
        if cursor.fetchone()[0] not in SAFE_COMMITS:
            cursor.execute("SET synchronous_commit = on")
    connection.commit()


def _refuse_changes(*given: Any) -> None:
    """Refuse a change on a connection for reading: no end of a transaction would confirm or undo it."""
    context = given[4]
    if context is not None and (context.isinsert or context.isupdate or context.isdelete):
        raise RuntimeError(f"expected a query on a connection for reading, found: {given[2][:200]}")


def _note_use(_connection: Any, record: ConnectionPoolEntry) -> None:
    record.info[_USED] = time.monotonic()


def _test_idle(engine: Engine, connection: Any, record: ConnectionPoolEntry, _proxy: object) -> None:
    """Test a connection that was unused for a while."""
    if time.monotonic() - record.info.get(_USED, math.inf) < IDLE_S:
        return
    try:
        engine.dialect.do_ping(connection)
    except engine.dialect.loaded_dbapi.Error as error:
        raise InvalidatePoolError from error


def _warn_of_unsafe_server(database: Database) -> None:
    """Log a warning if the server does not synchronise its files, which a session cannot change."""
    if database.dialect != "postgresql":
        return
    with database.reading() as connection:
        for setting in ("fsync", "full_page_writes"):
            if connection.execute(text(f"SHOW {setting}")).scalar() == "off":
                log.warning(
                    "database %s: %s is off; acknowledged data can be lost in a power failure; turn it on",
                    database.label,
                    setting,
                )


def _begin_sqlite(connection: Connection) -> None:
    writing = connection.get_execution_options().get("linna_write", False)
    connection.exec_driver_sql("BEGIN IMMEDIATE" if writing else "BEGIN")
