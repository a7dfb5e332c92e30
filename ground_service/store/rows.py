"""Rows as JSON lines: one form for both databases, for digests of tables in backups.

A row is a JSON array in the order of the columns; octets are base64, non-finite numbers are text.
"""

import base64
import hashlib
import json
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import JSON, Connection, Float, LargeBinary, MetaData, String, collate, insert, select, text
from sqlalchemy import Table as Table

from ground_service.store import models

BLOCK_ROWS = 5000

KEPT_BY_THE_PROGRAM = frozenset({"leases", "alembic_version", "row_digests"})
"""Tables with the state of running processes and of the schema, which are not copied; the last is of version 1.0."""

MADE_WITH_THE_SCHEMA = frozenset({"audit_head"})
"""Tables with rows in an empty database; a copy replaces these rows."""

Row = dict[str, Any]


@dataclass(frozen=True, slots=True)
class TableDigest:
    """Number of rows of a table, and the SHA-256 (hex) of their lines in the order of the key."""

    rows: int
    sha256: str


def copied_tables() -> list[Table]:
    """Return the tables to copy, referenced tables first."""
    return [table for table in models.METADATA.sorted_tables if table.name not in KEPT_BY_THE_PROGRAM]


def row_blocks(connection: Connection, table: Table) -> Iterator[list[Row]]:
    """Yield all rows of a table in the order of its key, which is the same in both databases."""
    key = [
        collate(column, "C") if connection.dialect.name == "postgresql" and isinstance(column.type, String) else column
        for column in table.primary_key.columns
    ]
    rows = connection.execution_options(yield_per=BLOCK_ROWS).execute(select(table).order_by(*key))
    for part in rows.mappings().partitions(BLOCK_ROWS):
        yield [dict(row) for row in part]


def row_line(columns: Sequence[Any], row: Row) -> bytes:
    """Return the line of one row, with its line end."""
    values = [_plain(row[column.name], column.type) for column in columns]
    return json.dumps(values, sort_keys=True, separators=(",", ":"), ensure_ascii=True).encode() + b"\n"


def lines_digest(lines: Iterable[bytes]) -> TableDigest:
    """Return count and digest of lines."""
    digest, count = hashlib.sha256(), 0
    for line in lines:
        digest.update(line)
        count += 1
    return TableDigest(count, digest.hexdigest())


def table_lines(connection: Connection, table: Table) -> Iterator[bytes]:
    """Yield the lines of all rows of a table."""
    columns = list(table.columns)
    for block in row_blocks(connection, table):
        for row in block:
            yield row_line(columns, row)


def table_digests(connection: Connection) -> dict[str, TableDigest]:
    """Return the digest of every copied table, of any revision of the schema."""
    stored = MetaData()
    stored.reflect(connection, only=lambda name, _: name not in KEPT_BY_THE_PROGRAM)
    return {table.name: lines_digest(table_lines(connection, table)) for table in stored.sorted_tables}


def first_filled_table(connection: Connection) -> str | None:
    """Return the name of a table with rows; None for an empty service."""
    for table in copied_tables():
        if table.name in MADE_WITH_THE_SCHEMA:
            continue
        if connection.execute(select(*table.primary_key.columns).limit(1)).first() is not None:
            return table.name
    return None


def insert_rows(connection: Connection, table: Table, blocks: Iterable[list[Row]]) -> int:
    """Insert rows into an empty table, replacing rows created with the schema; return their number."""
    count = 0
    later: list[Row] = []
    if table.name in MADE_WITH_THE_SCHEMA:
        connection.execute(table.delete())
    for block in blocks:
        if not block:
            continue
        if table.name == "windows":
            # A window may reference one with a greater key: link them after all are inserted.
            later += [row for row in block if row["predecessor_id"] is not None]
            block = [{**row, "predecessor_id": None} for row in block]
        connection.execute(insert(table), block)
        count += len(block)
    for row in later:
        connection.execute(table.update().where(table.c.id == row["id"]).values(predecessor_id=row["predecessor_id"]))
    return count


def advance_sequences(connection: Connection) -> None:
    """Set the key sequences of PostgreSQL to continue after the inserted keys."""
    if connection.dialect.name != "postgresql":
        return
    for table in copied_tables():
        keys = list(table.primary_key.columns)
        if len(keys) != 1 or not issubclass(keys[0].type.python_type, int):
            continue
        name = connection.execute(
            text("SELECT pg_get_serial_sequence(:table, :column)"), {"table": f'"{table.name}"', "column": keys[0].name}
        ).scalar()
        if name is not None:
            connection.execute(
                text(f'SELECT setval(:name, (SELECT COALESCE(MAX({keys[0].name}), 0) + 1 FROM "{table.name}"), false)'),
                {"name": name},
            )


def _plain(value: Any, kind: Any) -> Any:
    if value is None or isinstance(kind, JSON):
        return value
    if isinstance(kind, LargeBinary):
        return base64.b64encode(bytes(value)).decode()
    if isinstance(kind, Float):
        return float(value) if math.isfinite(value) else str(float(value))
    return value
