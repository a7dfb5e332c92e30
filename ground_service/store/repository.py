"""Reading and writing of everything but packets: one function per question, plain rows out.

Every function takes the connection of the caller's transaction. Rows come back as dictionaries of column values.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, Table, and_, func, insert, select, update
from sqlalchemy.dialects.postgresql import insert as postgresql_insert
from sqlalchemy.dialects.sqlite import insert as sqlite_insert
from sqlalchemy.exc import IntegrityError
from sqlalchemy.sql import Select

from ground_service.errors import InvalidInput, NotFound
from ground_service.store import models
from ground_service.store.files import StoredFile
from ground_service.text import require_line
from lunar.arrays import IntArray

Row = dict[str, Any]

SPACECRAFT_ID_MAX = 1023
"""Largest spacecraft id: a transfer frame has ten bits for it (CCSDS 132.0-B)."""


@dataclass(frozen=True, slots=True)
class Page:
    """One page of a list: its rows, and the number of rows in all."""

    rows: list[Row]
    total: int


def _table(model: type[models.Base]) -> Table:
    table = model.__table__
    assert isinstance(table, Table)
    return table


FILES = _table(models.File)
VEHICLES = _table(models.Vehicle)
INGESTS = _table(models.Ingest)
PACKETS = _table(models.Packet)
PASSES = _table(models.Pass)
MISSIONS = _table(models.MissionRecord)
PACKET_DEFINITIONS = _table(models.PacketDefinition)
PACKET_DECODINGS = _table(models.PacketDecoding)
PARAMETER_SAMPLES = _table(models.ParameterSample)
PIECES = _table(models.Piece)
GOOD_LINKS = _table(models.GoodLink)
KNOWN_LINKS = _table(models.KnownLink)
STREAM_EDGES = _table(models.StreamEdge)
PASS_FRAMES = _table(models.PassFrame)
EPHEMERIDES = _table(models.EphemerisRecord)
CORRELATIONS = _table(models.Correlation)
RECEPTIONS = _table(models.Reception)
JOBS = _table(models.Job)
REPORTS = _table(models.Report)
USERS = _table(models.User)
TOKENS = _table(models.Token)
AUDIT = _table(models.AuditEntry)
AUDIT_HEAD = _table(models.AuditHead)
ROW_DIGESTS = _table(models.RowDigest)
EVENT_LOG = _table(models.LoggedEventRow)
ANSWERS = _table(models.Answer)
TELECOMMANDS = _table(models.Telecommand)
COMMAND_COUNTERS = _table(models.CommandCounter)
WINDOWS = _table(models.Window)
BUILDS = _table(models.RegisteredBuild)
REGRESSION_ARCHIVES = _table(models.RegressionArchive)
REPLAYS = _table(models.Replay)
REGRESSIONS = _table(models.Regression)
SAMPLES: dict[str, Table] = {model.__tablename__: _table(model) for model in models.SAMPLE_TABLES}


def add(connection: Connection, table: Table, **values: Any) -> Any:
    """Insert one row; its primary key."""
    result = connection.execute(insert(table).values(**values))
    key = result.inserted_primary_key
    return key[0] if key is not None and len(key) == 1 else key


def add_new(connection: Connection, table: Table, **values: Any) -> Any | None:
    """Insert one row and return its primary key; None if a row with the same unique value exists already.

    The function waits for a concurrent insert of the same row by another process.
    """
    make = postgresql_insert if connection.dialect.name == "postgresql" else sqlite_insert
    key = next(iter(table.primary_key.columns))
    return connection.execute(make(table).values(**values).on_conflict_do_nothing().returning(key)).scalar()


def newest_report(connection: Connection, pass_id: int, *, other_than: str = "") -> Row | None:
    """Return the newest report of a pass, except one; None without any."""
    query = select(REPORTS).where(REPORTS.c.pass_id == pass_id, REPORTS.c.id != other_than)
    found = connection.execute(query.order_by(REPORTS.c.created_utc_ns.desc()).limit(1)).mappings().first()
    return None if found is None else dict(found)


def reports_of_pass(
    connection: Connection, pass_id: int, *, limit: int, offset: int
) -> tuple[list[Row], int]:
    """Return a page of the reports of a pass with their `mission_revision`, newest first, and their number."""
    mine = REPORTS.c.pass_id == pass_id
    query = (
        select(REPORTS, MISSIONS.c.revision.label("mission_revision"))
        .outerjoin(MISSIONS, MISSIONS.c.id == REPORTS.c.mission_id)
        .where(mine)
        .order_by(REPORTS.c.created_utc_ns.desc(), REPORTS.c.id)
        .limit(limit)
        .offset(offset)
    )
    total = connection.execute(select(func.count()).select_from(REPORTS).where(mine)).scalar_one()
    return [dict(row) for row in connection.execute(query).mappings()], total


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
    connection: Connection,
    table: Table,
    *,
    limit: int = 100,
    offset: int = 0,
    newest_first: bool = True,
    conditions: Sequence[Any] = (),
    **equal: Any,
) -> Page:
    """Rows of a table by primary key, a page of them, with the number of all."""
    query = _where(table, equal)
    if conditions:
        query = query.where(and_(*conditions))
    total = connection.execute(select(func.count()).select_from(query.subquery())).scalar_one()
    key = next(iter(table.primary_key.columns))
    if "created_utc_ns" in table.c:
        order = [table.c.created_utc_ns, key]
    else:
        order = [key]
    query = query.order_by(*(column.desc() if newest_first else column for column in order))
    rows = connection.execute(query.limit(limit).offset(offset)).mappings()
    return Page([dict(row) for row in rows], int(total))


def vehicle_id(connection: Connection, ccsds_id: int, instance: str) -> int:
    """Return the vehicle id of a spacecraft in one instance; create it if it is new.

    Raises
    ------
    InvalidInput
        If the id does not fit a transfer frame, or the instance is not a printable line.
    """
    if isinstance(ccsds_id, bool) or not 0 <= ccsds_id <= SPACECRAFT_ID_MAX:
        raise InvalidInput("spacecraft", "id", f"0 to {SPACECRAFT_ID_MAX}", str(ccsds_id)[:40])
    require_line(instance, "spacecraft", "instance")
    found = find(connection, VEHICLES, ccsds_id=ccsds_id, instance=instance)
    if found is not None:
        return int(found["id"])
    try:
        with connection.begin_nested():
            return int(add(connection, VEHICLES, ccsds_id=ccsds_id, instance=instance))
    except IntegrityError:
        again = find(connection, VEHICLES, ccsds_id=ccsds_id, instance=instance)
        if again is None:
            raise
        return int(again["id"])


def decoded_version(connection: Connection, vehicle: int, newest: int) -> int:
    """The dictionary version to read a vehicle in: the newest that all of its packets are decoded with."""
    found = connection.execute(select(VEHICLES.c.decoded_version).where(VEHICLES.c.id == vehicle)).scalar()
    return newest if found is None else int(found)


def register_file(connection: Connection, stored: StoredFile, kind: str, name: str, now_utc_ns: int) -> None:
    """Enter a file of the archive into the database; entering it again changes nothing."""
    if find(connection, FILES, sha256=stored.sha256) is not None:
        return
    try:
        with connection.begin_nested():
            add(
                connection,
                FILES,
                sha256=stored.sha256,
                kind=kind,
                name=name,
                octets=stored.octets,
                received_utc_ns=now_utc_ns,
            )
    except IntegrityError:
        pass  # another process entered the same octets at the same time


def covering_ephemerides(connection: Connection, start_utc_ns: int, stop_utc_ns: int) -> list[Row]:
    """Reference ephemerides that overlap an interval, the one to prefer first: precedence, then the newest."""
    query = (
        select(EPHEMERIDES)
        .where(EPHEMERIDES.c.start_utc_ns <= stop_utc_ns, EPHEMERIDES.c.stop_utc_ns >= start_utc_ns)
        .order_by(EPHEMERIDES.c.precedence.desc(), EPHEMERIDES.c.id.desc())
    )
    return [dict(row) for row in connection.execute(query).mappings()]


def packet_headers(
    connection: Connection, vehicle: int, start_ticks: int | None = None, stop_ticks: int | None = None
) -> dict[str, IntArray]:
    """APID, on-board time and sequence count of the stored packets of a vehicle, by APID and time."""
    query = select(PACKETS.c.apid, PACKETS.c.ticks, PACKETS.c.sequence_count).where(
        PACKETS.c.vehicle_id == vehicle
    )
    if start_ticks is not None:
        query = query.where(PACKETS.c.ticks >= start_ticks)
    if stop_ticks is not None:
        query = query.where(PACKETS.c.ticks <= stop_ticks)
    query = query.order_by(PACKETS.c.apid, PACKETS.c.ticks, PACKETS.c.sequence_count, PACKETS.c.digest)
    rows = np.array([tuple(row) for row in connection.execute(query)], dtype=np.int64).reshape(-1, 3)
    return {"apid": rows[:, 0], "ticks": rows[:, 1], "sequence_count": rows[:, 2]}


def packet_octets(
    connection: Connection, vehicle: int, apid: int, start_ticks: int, stop_ticks: int
) -> bytes:
    """The stored packets of one APID between two on-board times (both included), end to end in order of time."""
    query = (
        select(PACKETS.c.octets)
        .where(
            PACKETS.c.vehicle_id == vehicle,
            PACKETS.c.apid == apid,
            PACKETS.c.ticks >= start_ticks,
            PACKETS.c.ticks <= stop_ticks,
        )
        .order_by(PACKETS.c.ticks, PACKETS.c.sequence_count, PACKETS.c.digest)
    )
    return b"".join(bytes(octets) for (octets,) in connection.execute(query))


def samples(
    connection: Connection,
    kind: str,
    vehicle: int,
    start_ticks: int,
    stop_ticks: int,
    dictionary_version: int,
    columns: Sequence[str],
    **equal: int,
) -> dict[str, list[Any]]:
    """Columns of the samples of one kind between two on-board times (both included), in order of time.

    `equal` keeps only rows whose columns have these values.
    """
    query = _samples(kind, vehicle, start_ticks, stop_ticks, dictionary_version, columns, equal)
    rows = connection.execute(query).all()
    return {name: [row[i] for row in rows] for i, name in enumerate(columns)}


def sample_arrays(
    connection: Connection,
    kind: str,
    vehicle: int,
    start_ticks: int,
    stop_ticks: int,
    dictionary_version: int,
    columns: Sequence[str],
    **equal: int,
) -> dict[str, NDArray[Any]]:
    """As `samples`, as arrays: whole numbers as int64, all else as float64 with NaN for what is not known."""
    query = _samples(kind, vehicle, start_ticks, stop_ticks, dictionary_version, columns, equal)
    with connection.execute(query) as result:
        # Plain tuples of the driver: they need no translation, and rows as objects would take most of the time.
        rows = result.cursor.fetchall()
    # Whole numbers are below 2^53, so that float64 holds them.
    values = np.array(rows, dtype=np.float64).reshape(-1, len(columns))
    table = SAMPLES[kind]
    return {
        name: values[:, i].astype(np.int64 if table.c[name].type.python_type is int else np.float64)
        for i, name in enumerate(columns)
    }


def sample_aggregates(
    connection: Connection,
    kind: str,
    vehicle: int,
    start_ticks: int,
    stop_ticks: int,
    dictionary_version: int,
    name: str,
    width_ticks: int,
    **equal: int,
) -> NDArray[np.float64]:
    """One value of the samples, put together by the database in stretches of a length, in order of time (n, 7).

    First and last on-board time, samples, known ones among them, and the sum, the least and the greatest of those (NaN
    where there is none).
    """
    table = SAMPLES[kind]
    ticks, value = table.c.ticks, table.c[name]
    query = (
        _samples(kind, vehicle, start_ticks, stop_ticks, dictionary_version, (), equal)
        .with_only_columns(
            func.min(ticks),
            func.max(ticks),
            func.count(),
            func.count(value),
            func.sum(value),
            func.min(value),
            func.max(value),
        )
        .group_by(ticks // width_ticks)
        .order_by(None)
        .order_by(func.min(ticks))
    )
    rows = [tuple(row) for row in connection.execute(query)]
    return np.array(rows, dtype=np.float64).reshape(-1, 7)


def _samples(
    kind: str,
    vehicle: int,
    start_ticks: int,
    stop_ticks: int,
    dictionary_version: int,
    columns: Sequence[str],
    equal: dict[str, int],
) -> Select[Any]:
    table = SAMPLES[kind]
    return (
        select(*(table.c[name] for name in columns))
        .where(
            table.c.vehicle_id == vehicle,
            table.c.dictionary_version == dictionary_version,
            table.c.ticks >= start_ticks,
            table.c.ticks <= stop_ticks,
            *(table.c[name] == value for name, value in equal.items()),
        )
        .order_by(table.c.ticks, table.c.packet_id)
    )


def _where(table: Table, equal: dict[str, Any]) -> Select[Any]:
    query = select(table)
    for name, value in equal.items():
        query = query.where(table.c[name] == value)
    return query
