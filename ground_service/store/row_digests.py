"""SHA-256 digests of all rows that cannot be derived from other data, maintained by triggers.

The triggers act only for connections of this program: those of SQLite are temporary triggers of each connection, those
of PostgreSQL check a session setting. A row that is changed, added or removed otherwise does not match its digest, and
a later change by the program does not hide this. The digests detect accidental damage and simple edits. They do not
detect forgery by a person who also writes digests; use a head of the audit chain that is stored elsewhere for that.

Packets and what is decoded from them have no digests: they are compared with the raw files.
"""

from __future__ import annotations

import hashlib
import sqlite3
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import Any

from sqlalchemy import Connection, LargeBinary, MetaData, Table, bindparam, text

from ground_service.store import models

BARE = frozenset(
    {
        "packets",
        "parameter_samples",
        "audit",
        "audit_head",
        "row_digests",
        "leases",
        *(one.name for one in models.SAMPLE_TABLES),
    }
)
"""Tables without digests: derived from raw files, part of the audit chain, or state of running processes."""

WRITER_SETTING = "linna.writer"
FUNCTION = "linna_row_digest"
SPOILT = "changed while it did not fit"

_TRIGGERS_OF_A_TABLE = 3


@dataclass(frozen=True, slots=True)
class StrayRow:
    """Row that does not match its digest."""

    table: str
    key: str
    reason: str


@cache
def guarded_tables() -> tuple[Table, ...]:
    """Return the tables whose rows have digests."""
    return tuple(table for table in models.METADATA.sorted_tables if table.name not in BARE)


def row_sha256(*values: Any) -> str:
    """Return the digest (hex) of the values of a row as stored by SQLite."""
    digest = hashlib.sha256()
    for value in values:
        if value is None:
            digest.update(b"n")
        elif isinstance(value, int):
            digest.update(b"i%d;" % value)
        elif isinstance(value, float):
            digest.update(b"f" + struct.pack("<d", value))
        else:
            octets = value.encode("utf-8", "surrogatepass") if isinstance(value, str) else bytes(value)
            digest.update((b"s" if isinstance(value, str) else b"b") + b"%d;" % len(octets) + octets)
    return digest.hexdigest()


def prepare_sqlite(driver: sqlite3.Connection) -> None:
    """Create the triggers of a SQLite connection outside a transaction, if they do not exist."""
    made = driver.execute("SELECT count(*) FROM temp.sqlite_master WHERE type = 'trigger'").fetchone()[0]
    tables = guarded_tables()
    if made == _TRIGGERS_OF_A_TABLE * len(tables):
        return
    if driver.execute("SELECT 1 FROM main.sqlite_master WHERE name = 'row_digests'").fetchone() is None:
        return
    driver.create_function(FUNCTION, -1, row_sha256, deterministic=True)
    for table in tables:
        for statement in _sqlite_triggers(table):
            driver.execute(statement)


def install(connection: Connection) -> None:
    """Create or replace the triggers of a PostgreSQL schema; triggers of SQLite belong to connections."""
    if connection.dialect.name != "postgresql":
        return
    for table in guarded_tables():
        for statement in _postgresql_triggers(table):
            connection.execute(text(statement))


def missing_triggers(connection: Connection) -> list[str]:
    """Return the tables with missing or disabled triggers; empty for SQLite, whose schema has none."""
    if connection.dialect.name != "postgresql":
        return []
    found = set(
        connection.execute(
            text(
                "SELECT tgrelid::regclass::text FROM pg_trigger WHERE tgname = 'row_digest' AND tgenabled = 'O'"
            )
        ).scalars()
    )
    return [table.name for table in guarded_tables() if table.name not in found]


def stray_rows(connection: Connection, table: Table) -> Iterator[StrayRow]:
    """Yield rows of a table that do not match their digests, and digests without a row."""
    key, digest = _expressions(connection, table)
    kept = "d.table_name = :name AND d.row_key = " + key
    rows = connection.execute(
        text(
            f'SELECT {key}, d.sha256 FROM "{table.name}" AS r LEFT JOIN row_digests AS d ON {kept} '
            f"WHERE d.sha256 IS NULL OR d.sha256 <> {digest}"
        ),
        {"name": table.name},
    )
    for row_key, sha256 in rows:
        reason = "expected the digest of this row, found none: not written by this program"
        if sha256 is not None:
            reason = "expected content that matches its digest, found changed content"
        yield StrayRow(table.name, str(row_key), reason)
    gone = connection.execute(
        text(
            "SELECT row_key FROM row_digests WHERE table_name = :name EXCEPT "
            f'SELECT {key} FROM "{table.name}" AS r ORDER BY 1'
        ),
        {"name": table.name},
    )
    for (row_key,) in gone:
        yield StrayRow(table.name, str(row_key), "expected a row, found only its digest: removed")


@contextmanager
def changed_columns(connection: Connection, name: str) -> Iterator[None]:
    """Keep the digests of a table valid while a migration changes its columns; rows that did not match stay so."""
    strays = [one.key for one in stray_rows(connection, _as_stored(connection, name))]
    yield
    table = _as_stored(connection, name)
    key, digest = _expressions(connection, table)
    excepted = f"AND {key} NOT IN :strays" if strays else ""
    statement = text(
        f'UPDATE row_digests SET sha256 = (SELECT {digest} FROM "{name}" AS r WHERE {key} = row_key) '
        f"WHERE table_name = :name AND row_key IN "
        f'(SELECT {key} FROM "{name}" AS r WHERE true {excepted})'
    )
    given: dict[str, object] = {"name": name}
    if strays:
        statement = statement.bindparams(bindparam("strays", expanding=True))
        given["strays"] = strays
    connection.execute(statement, given)


def _as_stored(connection: Connection, name: str) -> Table:
    """Return a table with the columns that it has now in the database."""
    return Table(name, MetaData(), autoload_with=connection)


def unknown_digests(connection: Connection) -> Iterator[StrayRow]:
    """Yield digests of tables without digests."""
    names = {table.name for table in guarded_tables()}
    for name, key in connection.execute(text("SELECT table_name, row_key FROM row_digests")):
        if name not in names:
            yield StrayRow(str(name), str(key), "expected no digest of this table, found one")


def _expressions(connection: Connection, table: Table) -> tuple[str, str]:
    """Return SQL expressions for the key and the digest of a row r."""
    if connection.dialect.name == "sqlite":
        driver: Any = connection.connection.driver_connection
        driver.create_function(FUNCTION, -1, row_sha256, deterministic=True)
        return _sqlite_key(table, "r"), _sqlite_digest(table, "r")
    return _postgresql_key(table, "r"), _postgresql_digest("r")


def _sqlite_key(table: Table, row: str) -> str:
    return " || '|' || ".join(
        f'hex({row}."{column.name}")'
        if isinstance(column.type, LargeBinary)
        else f'CAST({row}."{column.name}" AS TEXT)'
        for column in table.primary_key.columns
    )


def _sqlite_digest(table: Table, row: str) -> str:
    return f"{FUNCTION}(" + ", ".join(f'{row}."{column.name}"' for column in table.columns) + ")"


def _sqlite_triggers(table: Table) -> Iterator[str]:
    old_key, new_key = _sqlite_key(table, "OLD"), _sqlite_key(table, "NEW")
    old, new = _sqlite_digest(table, "OLD"), _sqlite_digest(table, "NEW")
    where = f"WHERE table_name = '{table.name}' AND row_key = {old_key}"
    for change, action in (
        ("INSERT", f"INSERT OR IGNORE INTO row_digests VALUES ('{table.name}', {new_key}, {new})"),
        (
            "UPDATE",
            f"UPDATE row_digests SET row_key = {new_key}, "
            f"sha256 = CASE WHEN sha256 = {old} THEN {new} ELSE '{SPOILT}' END {where}",
        ),
        ("DELETE", f"DELETE FROM row_digests {where} AND sha256 = {old}"),
    ):
        name = f"linna_{table.name}_{change.lower()}"
        yield (
            f'CREATE TEMP TRIGGER IF NOT EXISTS "{name}" AFTER {change} ON main."{table.name}" '
            f"BEGIN {action}; END"
        )


def _postgresql_key(table: Table, row: str) -> str:
    return " || '|' || ".join(f'{row}."{column.name}"::text' for column in table.primary_key.columns)


def _postgresql_digest(row: str) -> str:
    return f"encode(sha256(convert_to({row}::text, 'UTF8')), 'hex')"


def _postgresql_triggers(table: Table) -> Iterator[str]:
    old_key, new_key = _postgresql_key(table, "OLD"), _postgresql_key(table, "NEW")
    old, new = _postgresql_digest("OLD"), _postgresql_digest("NEW")
    where = f"WHERE table_name = '{table.name}' AND row_key = {old_key}"
    function = f"linna_digest_{table.name}"
    yield f"""
        CREATE OR REPLACE FUNCTION {function}() RETURNS trigger LANGUAGE plpgsql AS $$
        BEGIN
            IF current_setting('{WRITER_SETTING}', true) IS DISTINCT FROM 'on' THEN
                RETURN NULL;
            END IF;
            IF TG_OP = 'INSERT' THEN
                INSERT INTO row_digests VALUES ('{table.name}', {new_key}, {new}) ON CONFLICT DO NOTHING;
            ELSIF TG_OP = 'UPDATE' THEN
                UPDATE row_digests SET row_key = {new_key},
                    sha256 = CASE WHEN sha256 = {old} THEN {new} ELSE '{SPOILT}' END {where};
            ELSE
                DELETE FROM row_digests {where} AND sha256 = {old};
            END IF;
            RETURN NULL;
        END$$"""
    yield f'DROP TRIGGER IF EXISTS row_digest ON "{table.name}"'
    yield (
        f'CREATE TRIGGER row_digest AFTER INSERT OR UPDATE OR DELETE ON "{table.name}" '
        f"FOR EACH ROW EXECUTE FUNCTION {function}()"
    )
