"""SQL of the export and import of tables."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from typing import Any

from sqlalchemy import JSON, ColumnDefault, Connection, MetaData, Table, func, insert, select, text

from ground_service.errors import InvalidInput
from ground_service.store import audit, repository, rows

DERIVED = frozenset({"rollups", "parameter_samples", "stream_edges", *repository.SAMPLES})
"""Tables of an earlier revision that are not imported, because they are derived from the packets."""

EARLIER_VALUES: dict[tuple[str, str], Any] = {
    ("windows", "closed"): 0,
    ("users", "state"): "active",
    ("tokens", "hint"): "",
    ("regressions", "missions"): [],
    ("regression_archives", "state"): "complete",
    ("regression_archives", "reason"): "",
}
"""Values of columns missing in an earlier revision, if neither NULL nor the default of the column is correct."""

EARLIER_COPIES = {
    ("windows", "edited_by"): "created_by",
    ("regression_archives", "frames_stored"): "frames",
}


def exported_tables(connection: Connection, *, earlier: bool) -> list[Table]:
    """Return the tables to export, referenced tables first; `earlier`: those of an earlier revision."""
    if not earlier:
        return rows.copied_tables()
    metadata = MetaData()
    metadata.reflect(bind=connection)
    return [table for table in metadata.sorted_tables if table.name != "alembic_version"]


def file_sizes(connection: Connection) -> list[tuple[str, int]]:
    """Return hash and octets of the files of the archive, also in an earlier revision."""
    found = connection.execute(text("SELECT sha256, octets FROM files ORDER BY sha256"))
    return [(str(sha256), int(octets)) for sha256, octets in found]


def imported_tables(*, earlier: bool) -> set[str]:
    """Return the names of the tables to import; derived rows of an earlier revision are decoded again."""
    return {table.name for table in rows.copied_tables()} - (DERIVED if earlier else frozenset())


def insert_tables(
    connection: Connection,
    source: str,
    columns: Mapping[str, Collection[str]],
    lines: Callable[[str], Iterable[bytes]],
    *,
    earlier: bool,
) -> dict[str, int]:
    """Insert the rows of exported tables, whose columns and lines are given by name; return their numbers.

    Raises
    ------
    InvalidInput
        A line of `source` is not a row of its table.
    """
    stored: dict[str, int] = {}
    taken = imported_tables(earlier=earlier)
    for table in rows.copied_tables():
        if table.name not in columns or table.name not in taken:
            continue
        names = columns[table.name]
        parsed = _parsed(source, table, names, lines(table.name))
        if earlier:
            parsed = _upgraded(source, table, names, parsed)
        if earlier and table.name == "audit":
            stored["audit"] = _store_chain(connection, parsed)
        else:
            stored[table.name] = rows.insert_rows(connection, table, _in_blocks(parsed))
    if earlier:
        _count_telecommands(connection)
    rows.advance_sequences(connection)
    return stored


def _parsed(
    source: str, table: Table, names: Collection[str], lines: Iterable[bytes]
) -> Iterator[dict[str, Any]]:
    columns = [table.c[name] if name in table.c else _Unknown(name) for name in names]
    for number, line in enumerate(lines, start=1):
        try:
            yield rows.parse_line(columns, line)
        except (ValueError, TypeError) as error:
            raise InvalidInput(
                source, f"table {table.name}, row {number}", "a row of this table", str(error)[:80]
            ) from None


class _Unknown:
    """Column that this version does not have."""

    def __init__(self, name: str) -> None:
        self.name, self.type = name, JSON()


def _upgraded(
    source: str, table: Table, names: Collection[str], parsed: Iterable[dict[str, Any]]
) -> Iterator[dict[str, Any]]:
    """Yield the rows of an earlier revision with the columns of this one."""
    added: dict[str, Any] = {}
    copies = {new: old for (name, new), old in EARLIER_COPIES.items() if name == table.name}
    for column in table.columns:
        if (
            column.name in names
            or column.name in copies
            or (table.name == "audit" and column.name.endswith("sha256"))
        ):
            continue
        if (table.name, column.name) in EARLIER_VALUES:
            added[column.name] = EARLIER_VALUES[table.name, column.name]
        elif isinstance(column.default, ColumnDefault) and column.default.is_scalar:
            added[column.name] = column.default.arg
        elif column.nullable:
            added[column.name] = None
        else:
            raise InvalidInput(source, f"table {table.name}", f"the column {column.name}", "none")
    again = table.name == "vehicles"
    for row in parsed:
        kept = {name: value for name, value in row.items() if name in table.c}
        if again:  # nothing is decoded yet
            kept |= dict.fromkeys(("decoded_version", "redecoding_version", "redecoded_to", "redecode_until"))
        yield {**kept, **added, **{new: row[old] for new, old in copies.items()}}


def _store_chain(connection: Connection, parsed: Iterable[Mapping[str, Any]]) -> int:
    """Add the audit entries of an earlier revision to a hash chain, in order and with new numbers."""
    count = 0
    for row in parsed:
        audit.add_note(
            connection,
            audit.Note(
                int(row["utc_ns"]),
                str(row["actor"]),
                str(row["action"]),
                str(row["target"]),
                row["detail"] or {},
            ),
        )
        count += 1
        if count % rows.BLOCK_ROWS == 0:
            audit.append_pending(connection)
    audit.append_pending(connection)
    return count


def _count_telecommands(connection: Connection) -> None:
    """Continue the telecommand sequence counts of an earlier revision, which were row counts."""
    table, counters = repository.TELECOMMANDS, repository.COMMAND_COUNTERS
    given = connection.execute(
        select(table.c.vehicle_id, func.count())
        .where(table.c.sequence_count.is_not(None))
        .group_by(table.c.vehicle_id)
    ).all()
    for vehicle, count in given:
        connection.execute(insert(counters).values(vehicle_id=vehicle, telecommands=count))


def _in_blocks(parsed: Iterable[dict[str, Any]]) -> Iterator[list[dict[str, Any]]]:
    block: list[dict[str, Any]] = []
    for row in parsed:
        block.append(row)
        if len(block) == rows.BLOCK_ROWS:
            yield block
            block = []
    yield block
