"""Tables, generic and bulk queries, for store modules only.

Every function takes the connection of the caller's transaction. Rows are dictionaries of column values, which a store
turns into the entities of its capability.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

from sqlalchemy import (
    BigInteger,
    ColumnElement,
    Connection,
    Float,
    Integer,
    LargeBinary,
    SmallInteger,
    Table,
    Text,
    and_,
    func,
    insert,
    select,
    update,
)
from sqlalchemy.sql import Select

from ground_service.errors import NotFound
from ground_service.store import models

if TYPE_CHECKING:
    from numpy.typing import NDArray

Row = dict[str, Any]


class ListQuery(Protocol):
    """The page of a list and the filters that are asked for."""

    @property
    def limit(self) -> int: ...
    @property
    def offset(self) -> int: ...
    def filters(self) -> Mapping[str, Any]: ...


FILES = models.FILES
VEHICLES = models.VEHICLES
INGESTS = models.INGESTS
PACKETS = models.PACKETS
IMPLAUSIBLE_PACKETS = models.IMPLAUSIBLE_PACKETS
PASSES = models.PASSES
MISSIONS = models.MISSIONS
PACKET_DEFINITIONS = models.PACKET_DEFINITIONS
PACKET_DECODINGS = models.PACKET_DECODINGS
PARAMETER_SAMPLES = models.PARAMETER_SAMPLES
PIECES = models.PIECES
STANDING_REQUESTS = models.STANDING_REQUESTS
FRAGMENTS = models.FRAGMENTS
PASS_FRAMES = models.PASS_FRAMES
EPHEMERIDES = models.EPHEMERIDES
CORRELATIONS = models.CORRELATIONS
RECEPTIONS = models.RECEPTIONS
JOBS = models.JOBS
REPORTS = models.REPORTS
MONTHLY_REPORTS = models.MONTHLY_REPORTS
USERS = models.USERS
TOKENS = models.TOKENS
AUDIT = models.AUDIT
AUDIT_HEAD = models.AUDIT_HEAD
EVENT_LOG = models.EVENT_LOG
ANSWERS = models.ANSWERS
TELECOMMANDS = models.TELECOMMANDS
HANDOVERS = models.HANDOVERS
LINKS = models.LINKS
LEASES = models.LEASES
CONTACTS = models.CONTACTS
TRANSMISSIONS = models.TRANSMISSIONS
COMMAND_COUNTERS = models.COMMAND_COUNTERS
WINDOWS = models.WINDOWS
LANDMARKS = models.LANDMARKS
BUILDS = models.BUILDS
REGRESSION_ARCHIVES = models.REGRESSION_ARCHIVES
REPLAYS = models.REPLAYS
REGRESSIONS = models.REGRESSIONS
SAMPLES: dict[str, Table] = {table.name: table for table in models.SAMPLE_TABLES}


def add(connection: Connection, table: Table, **values: Any) -> Any:
    """Insert one row; its primary key."""
    key = connection.execute(insert(table).values(**values)).inserted_primary_key
    return key[0] if key is not None and len(key) == 1 else key


def add_new(connection: Connection, table: Table, **values: Any) -> Any | None:
    """Insert one row and return its primary key; None if a row with the same unique value exists already.

    The function waits for a concurrent insert of the same row by another process.
    """
    make = insert_of(connection)
    key = next(iter(table.primary_key.columns))
    return connection.execute(make(table).values(**values).on_conflict_do_nothing().returning(key)).scalar()


def change(connection: Connection, table: Table, key: Any, **values: Any) -> None:
    """Change columns of the row with this primary key; states are changed by `states.move` alone."""
    column = next(iter(table.primary_key.columns))
    connection.execute(update(table).where(column == key).values(**values))


def get(connection: Connection, table: Table, key: Any, kind: str) -> Row:
    """The row with this primary key.

    Raises
    ------
    NotFound
        If there is none; `kind` names it in the message.
    """
    column = next(iter(table.primary_key.columns))
    row = connection.execute(select(table).where(column == key)).mappings().first()
    if row is None:
        raise NotFound(kind, key)
    return dict(row)


def find(connection: Connection, table: Table, **equal: Any) -> Row | None:
    """The first row whose columns have these values; None where there is none."""
    row = connection.execute(_where(table, equal).limit(1)).mappings().first()
    return dict(row) if row is not None else None


def page(
    connection: Connection, query: Select[Any], asked: ListQuery, *order: Any, others: Sequence[str] = ()
) -> tuple[list[Row], int]:
    """Return a page of the rows of a query in an order, and the number of all rows.

    A filter with the name of a column selects the rows with its value, or one of its values; `others` are filters with
    another meaning, which the query has already. A connection with the option `spacecraft` selects their rows only.
    """
    columns = query.selected_columns
    spacecraft = connection.get_execution_options().get("spacecraft")
    if spacecraft is not None and (owner := spacecraft_of(next(iter(columns)).table)) is not None:
        query = query.where(owner.in_(spacecraft))
    for name, value in asked.filters().items():
        if name in columns and name not in others:
            query = query.where(columns[name].in_(value) if isinstance(value, list) else columns[name] == value)
    total = connection.execute(select(func.count()).select_from(query.subquery())).scalar_one()
    rows = connection.execute(query.order_by(*order).limit(asked.limit).offset(asked.offset)).mappings()
    return [dict(row) for row in rows], int(total)


def newest(connection: Connection, table: Table, asked: ListQuery, **equal: Any) -> tuple[list[Row], int]:
    """Return a page of the rows of a table with these values, newest first, and the number of all rows."""
    key = next(iter(table.primary_key.columns))
    order = [table.c.created_utc_ns, key] if "created_utc_ns" in table.c else [key]
    return page(connection, _where(table, equal), asked, *(column.desc() for column in order))


def spacecraft_of(table: Table) -> ColumnElement[Any] | None:
    """Return the spacecraft of a row of a table, as an expression; None: rows have none."""
    vehicles, passes, pieces, columns = VEHICLES.alias(), PASSES.alias(), PIECES.alias(), table.c
    for name in ("ccsds_id", "spacecraft_id"):
        if name in columns:
            return columns[name]
    if "vehicle_id" in columns:
        known = select(vehicles.c.ccsds_id).where(vehicles.c.id == columns.vehicle_id).scalar_subquery()
        if table is not INGESTS:
            return known
        stated = select(pieces.c.spacecraft_id).where(pieces.c.ingest_id == columns.id).scalar_subquery()
        return func.coalesce(known, stated)
    if "pass_id" in columns:
        of_pass = select(vehicles.c.ccsds_id).join(passes, passes.c.vehicle_id == vehicles.c.id)
        return of_pass.where(passes.c.id == columns.pass_id).scalar_subquery()
    return None


def insert_of(connection: Connection) -> Any:
    """Return the insert statement of the database, which has conflict clauses; each dialect takes long to import."""
    if connection.dialect.name == "postgresql":
        from sqlalchemy.dialects import postgresql

        return postgresql.insert
    from sqlalchemy.dialects import sqlite

    return sqlite.insert


def _where(table: Table, equal: dict[str, Any]) -> Select[Any]:
    query = select(table)
    for name, value in equal.items():
        query = query.where(table.c[name] == value)
    return query


def within(table: Table, where: tuple[int, int, int, int]) -> ColumnElement[bool]:
    """Return the condition that samples of a table are in a span (`telemetry.Where`)."""
    vehicle, start_ticks, stop_ticks, dictionary_version = where
    return and_(
        table.c.vehicle_id == vehicle,
        table.c.dictionary_version == dictionary_version,
        table.c.ticks.between(start_ticks, stop_ticks),
    )


FEW_ROWS = 64

Column: TypeAlias = "Sequence[Any] | NDArray[Any]"

_COPY_TYPES = (
    (SmallInteger, "int2"),
    (BigInteger, "int8"),
    (Integer, "int4"),
    (Float, "float8"),
    (LargeBinary, "bytea"),
    (Text, "text"),
)


def insert_columns(
    connection: Connection, table: Table, columns: Mapping[str, Column], *, replace: bool = False
) -> int:
    """Insert rows given as equally long columns; return their number.

    With `replace`, at most `FEW_ROWS` rows with the same primary key are replaced.
    """
    values = [plain_column(column) for column in columns.values()]
    count = len(values[0]) if values else 0
    if count == 0:
        return 0
    names = ", ".join(f'"{name}"' for name in columns)
    conflict = _on_conflict(table, columns) if replace else ""
    if connection.dialect.name == "postgresql":
        driver: Any = connection.connection.driver_connection
        types = [table.c[name].type for name in columns]
        kinds = [next(code for of, code in _COPY_TYPES if isinstance(one, of)) for one in types]
        if count <= FEW_ROWS:
            arrays = ", ".join(f"%b::{kind}[]" for kind in kinds)
            with driver.cursor() as cursor:
                cursor.execute(f'INSERT INTO "{table.name}" ({names}) SELECT * FROM unnest({arrays}){conflict}', values)
            return count
        with (
            driver.cursor() as cursor,
            cursor.copy(f'COPY "{table.name}" ({names}) FROM STDIN (FORMAT BINARY)') as copy,
        ):
            copy.set_types(kinds)
            for row in zip(*values, strict=True):
                copy.write_row(row)
    else:
        marks = ", ".join("?" * len(values))
        connection.exec_driver_sql(
            f'INSERT INTO "{table.name}" ({names}) VALUES ({marks}){conflict}', list(zip(*values, strict=True))
        )
    return count


def _on_conflict(table: Table, columns: Mapping[str, Column]) -> str:
    key = [column.name for column in table.primary_key.columns]
    changed = ", ".join(f'"{name}" = excluded."{name}"' for name in columns if name not in key)
    return f" ON CONFLICT ({', '.join(key)}) DO UPDATE SET {changed}"


def plain_column(column: Column) -> list[Any]:
    """A column as Python values, NaN as None (SQL has no other word for "not known")."""
    if isinstance(column, Sequence):
        return list(column)
    values: list[Any] = column.tolist()
    if column.dtype.kind == "f" and (column != column).any():
        return [None if value != value else value for value in values]
    return values
