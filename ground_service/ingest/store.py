"""SQL of ingests, and of packets: each stored once by content, in one transaction with its decoded rows."""

from __future__ import annotations

import logging
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from pydantic import ValidationError
from sqlalchemy import ColumnElement, Connection, bindparam, case, delete, func, or_, select, update

from ground_service.http.model import PageOf, Paging
from ground_service.ingest.model import Ingest, IngestResult
from ground_service.missions.timekeeping.model import RECEPTIONS_LIMIT
from ground_service.store import repository
from ground_service.store.event_kinds import ReceptionsEntered, TelemetryReceived, publish
from ground_service.store.models import NO_TICKS, PACKETS, VEHICLES
from ground_service.store.repository import insert_columns, insert_of
from ground_service.store.states import change_if
from ground_service.telemetry.rollups import rebuild_rollups
from ground_service.telemetry.values import forget_others
from ground_service.telemetry.writing import TABLES, store_samples
from lunar.arrays import IntArray

RANGE_GAP_TICKS = 600 << 16
"""Stored packets are looked up by ranges of on-board time; a silence of ten minutes splits a range, so that a batch
with one stray packet of another year does not read the years between."""

FEW_PACKETS = 64
FORGOTTEN_PACKETS = 1000
"""Packets that one statement removes."""

_PACKETS: Any = PACKETS
_INGESTS = repository.INGESTS
_FILES = repository.FILES
_RECEPTIONS = repository.RECEPTIONS
_PIECES = repository.PIECES
_PLACE = (
    _PIECES.c.scope,
    func.coalesce(_PIECES.c.stream, "").label("stream"),
    func.coalesce(_PIECES.c.position, 0).label("position"),
    func.coalesce(_PIECES.c.station, "").label("station"),
)

log = logging.getLogger(__name__)


_IN_RANGE = select(_PACKETS.c.digest).where(
    _PACKETS.c.vehicle_id == bindparam("vehicle_id"),
    _PACKETS.c.apid == bindparam("apid"),
    _PACKETS.c.ticks.between(bindparam("first"), bindparam("last")),
)


class Batch(Protocol):
    """Batch to store: see `ground_service.telemetry.packets.PacketBatch`."""

    @property
    def apid(self) -> IntArray: ...
    @property
    def sequence_count(self) -> IntArray: ...
    @property
    def ticks(self) -> IntArray: ...
    @property
    def octets(self) -> list[bytes]: ...
    @property
    def digest(self) -> list[bytes]: ...
    @property
    def dictionary_version(self) -> int: ...
    @property
    def rows(self) -> Mapping[str, Mapping[str, Any]]: ...


_KEEP_VEHICLE = (
    select(VEHICLES.c.id).where(VEHICLES.c.id == bindparam("vehicle_id")).with_for_update(read=True, key_share=True)
)

_INSERT_POSTGRESQL = """
INSERT INTO packets (vehicle_id, apid, sequence_count, ticks, digest, octets)
SELECT %(vehicle_id)s, * FROM unnest(
    %(apid)b::int2[], %(sequence_count)b::int2[], %(ticks)b::int8[], %(digest)b::bytea[], %(octets)b::bytea[]
)
ON CONFLICT (vehicle_id, apid, ticks, sequence_count, digest) DO NOTHING
RETURNING id, digest
"""
"""Insert in the given order; the statement waits for a concurrent insert of the same row."""


@dataclass(frozen=True, slots=True)
class Stored:
    """Changes by the storage of a batch."""

    new: int
    repeated: int
    samples: int

    def __add__(self, other: Stored) -> Stored:
        return Stored(self.new + other.new, self.repeated + other.repeated, self.samples + other.samples)


def store_batch(connection: Connection, vehicle_id: int, batch: Batch) -> Stored:
    """Store the packets of a batch that are not stored yet, inside the caller's write transaction.

    Storing the same packets again, in other batches or in another order, changes nothing: a packet is identified by its
    vehicle and its octets. Several transactions may store at the same time. Packets are inserted in the order of their
    key, so that two transactions with the same packets do not deadlock. A shared lock on the row of the vehicle makes
    transactions that lock the vehicle wait until the packets are stored.
    """
    count = len(batch.octets)
    if count == 0:
        return Stored(0, 0, 0)
    connection.execute(_KEEP_VEHICLE, {"vehicle_id": vehicle_id})
    new = _new_packets(connection, vehicle_id, batch)
    ids = np.zeros(count, dtype=np.int64)
    ids[new] = _insert_packets(connection, vehicle_id, batch, new)
    added = int(np.count_nonzero(ids))
    samples = store_samples(connection, vehicle_id, batch.dictionary_version, batch.rows, ids)
    if added:
        publish(connection, _received(vehicle_id, batch, ids))
    return Stored(added, count - added, samples)


def _received(vehicle_id: int, batch: Batch, ids: IntArray) -> TelemetryReceived:
    """Return the event of the new packets of a batch, those with an id above 0."""
    ticks = batch.ticks[(ids > 0) & (batch.ticks != NO_TICKS)]
    first, last = (int(ticks.min()), int(ticks.max())) if ticks.size else (None, None)
    kinds: list[str] = []
    times: list[int] = []
    for kind, columns in batch.rows.items():
        sampled = columns["ticks"][ids[columns["packet"]] > 0]
        if sampled.size:
            kinds.append(kind)
            times += [int(sampled.min()), int(sampled.max())]
    earliest, latest = min(times, default=NO_TICKS), max(times, default=NO_TICKS)
    return TelemetryReceived(
        vehicle_id=vehicle_id,
        packets=int(np.count_nonzero(ids)),
        first_ticks=first,
        last_ticks=last,
        first_sample_ticks=earliest if times and first is not None and earliest < first else None,
        last_sample_ticks=latest if times and last is not None and latest > last else None,
        kinds=tuple(sorted(kinds)),
    )


def note_receptions(
    connection: Connection, vehicle_id: int, station: str, received: Mapping[tuple[int, int], int]
) -> None:
    """Note when a station received time reports (packet time, sequence count); the first reception counts.

    Nothing is noted beyond `RECEPTIONS_LIMIT` reports of a vehicle.
    """
    if not received:
        return
    count = select(func.count()).select_from(_RECEPTIONS).where(_RECEPTIONS.c.vehicle_id == vehicle_id)
    if connection.execute(count).scalar_one() + len(received) > RECEPTIONS_LIMIT:
        log.warning("vehicle %d: more than %d time reports, none noted", vehicle_id, RECEPTIONS_LIMIT)
        return
    changed = 0
    for (ticks, sequence_count), utc_ns in sorted(received.items()):
        statement = insert_of(connection)(_RECEPTIONS).values(
            vehicle_id=vehicle_id, ticks=ticks, sequence_count=sequence_count, station=station, earth_utc_ns=utc_ns
        )
        earlier = statement.excluded.earth_utc_ns
        statement = statement.on_conflict_do_update(
            index_elements=list(_RECEPTIONS.primary_key.columns),
            set_={"earth_utc_ns": earlier},
            where=earlier < _RECEPTIONS.c.earth_utc_ns,
        )
        changed += connection.execute(statement.returning(_RECEPTIONS.c.ticks)).first() is not None
    if changed:
        publish(connection, ReceptionsEntered(vehicle_id=vehicle_id, reports=changed))


def _new_packets(connection: Connection, vehicle_id: int, batch: Batch) -> IntArray:
    """Indices of packets that are neither stored nor earlier in the same batch, in the order of their key.

    Stored packets of a small batch are left to the insert of PostgreSQL, which skips them.
    """
    stored: set[bytes] = set()
    few = connection.dialect.name == "postgresql" and len(batch.octets) <= FEW_PACKETS
    for apid, first, last in () if few else _time_ranges(batch.apid, batch.ticks):
        found = connection.execute(_IN_RANGE, {"vehicle_id": vehicle_id, "apid": apid, "first": first, "last": last})
        stored.update(found.scalars())
    fresh = []
    seen = stored
    digests: Sequence[bytes] = batch.digest
    columns = (batch.ticks.tolist(), batch.apid.tolist(), batch.sequence_count.tolist(), digests)
    keys = list(zip(*columns, strict=True))
    for index in sorted(range(len(keys)), key=keys.__getitem__):
        digest = digests[index]
        if digest not in seen:
            seen.add(digest)
            fresh.append(index)
    return np.array(fresh, dtype=np.int64)


def _time_ranges(apid: IntArray, ticks: IntArray) -> list[tuple[int, int, int]]:
    """(APID, first, last) ranges of on-board time that cover every packet."""
    ranges = []
    for value in np.unique(apid).tolist():
        times = np.unique(ticks[apid == value])
        cuts = np.flatnonzero(np.diff(times) > RANGE_GAP_TICKS)
        first = times[np.concatenate(([0], cuts + 1))]
        last = times[np.concatenate((cuts, [len(times) - 1]))]
        ranges += [(value, int(a), int(b)) for a, b in zip(first, last, strict=True)]
    return ranges


def _insert_packets(connection: Connection, vehicle_id: int, batch: Batch, new: IntArray) -> IntArray:
    """Insert the packets at `new` (n,); return their ids (n,), 0 for packets that another transaction has stored."""
    if not len(new):
        return np.zeros(0, dtype=np.int64)
    chosen = new.tolist()
    columns = {
        "apid": batch.apid[new].tolist(),
        "sequence_count": batch.sequence_count[new].tolist(),
        "ticks": batch.ticks[new].tolist(),
        "digest": [batch.digest[i] for i in chosen],
        "octets": [batch.octets[i] for i in chosen],
    }
    if connection.dialect.name == "postgresql":
        driver: Any = connection.connection.driver_connection
        with driver.cursor() as cursor:
            cursor.execute(_INSERT_POSTGRESQL, {"vehicle_id": vehicle_id, **columns})
            ids = {bytes(digest): key for key, digest in cursor.fetchall()}
        return np.array([ids.get(digest, 0) for digest in columns["digest"]], dtype=np.int64)
    highest = connection.execute(select(func.max(_PACKETS.c.id))).scalar() or 0
    found = np.arange(highest + 1, highest + 1 + len(chosen), dtype=np.int64)
    insert_columns(connection, _PACKETS, {"id": found, "vehicle_id": np.full(len(chosen), vehicle_id), **columns})
    return found


def add_ingest(connection: Connection, sha256: str, *, state: str, dictionary_version: int, now_utc_ns: int) -> int:
    """Add an ingest of a file; return its id."""
    return int(
        repository.add(
            connection,
            _INGESTS,
            vehicle_id=None,
            file_sha256=sha256,
            state=state,
            dictionary_version=dictionary_version,
            received_utc_ns=now_utc_ns,
            accounting={},
        )
    )


def get_ingest(connection: Connection, ingest_id: int) -> Ingest:
    """Return an ingest.

    Raises
    ------
    NotFound
        There is no such ingest.
    """
    return _ingest(repository.get(connection, _INGESTS, ingest_id, "ingest"))


def list_ingests(connection: Connection, asked: Paging) -> PageOf[Ingest]:
    """List the ingests, newest first."""
    rows, total = repository.newest(connection, _INGESTS, asked)
    return asked.page(map(_ingest, rows), total)


def start_ingest(connection: Connection, ingest_id: int) -> None:
    """Record that an ingest runs."""
    repository.get(connection, _INGESTS, ingest_id, "ingest")
    repository.change(connection, _INGESTS, ingest_id, state="running")


def fail_ingest(connection: Connection, ingest_id: int, error: str, now_utc_ns: int) -> None:
    """Record why an ingest failed."""
    repository.change(connection, _INGESTS, ingest_id, state="failed", error=error, finished_utc_ns=now_utc_ns)


def finish_ingest(connection: Connection, result: IngestResult, now_utc_ns: int) -> None:
    """Record the result of an ingest that is done."""
    repository.change(
        connection,
        _INGESTS,
        result.ingest_id,
        state="done",
        error=None,
        vehicle_id=result.vehicle_id,
        finished_utc_ns=now_utc_ns,
        **_accounting(result),
    )


def _accounting(result: IngestResult) -> dict[str, Any]:
    times = {"first_ticks": result.first_ticks, "last_ticks": result.last_ticks}
    return {"accounting": result.model_dump(mode="json", exclude={"ingest_id"}), **times}


@dataclass(frozen=True, slots=True)
class Received:
    """A piece of a recording of a station with its result; `stream` is empty for a file that is a whole recording."""

    sha256: str
    octets: int
    stream: str
    position: int
    station: str
    result: IngestResult | None


def recordings_of_vehicle(
    connection: Connection, vehicle: int, start_ticks: int, stop_ticks: int
) -> list[list[Received]]:
    """Return the recordings that may have packets of a vehicle in a time: the different pieces of each, by position."""
    columns = _INGESTS.c.id, _INGESTS.c.file_sha256, _INGESTS.c.accounting, _FILES.c.octets, *_PLACE
    query = (
        select(*columns)
        .join(_FILES, _FILES.c.sha256 == _INGESTS.c.file_sha256)
        .outerjoin(_PIECES, _PIECES.c.ingest_id == _INGESTS.c.id)
        .order_by(_INGESTS.c.file_sha256, _INGESTS.c.id)
    )
    found: dict[tuple[str, str], dict[tuple[int, str], Received]] = {}
    streams = set()
    for row in connection.execute(query.where(*_may_have_packets(vehicle, start_ticks, stop_ticks))):
        result = _result(row.id, row.accounting)
        if result is not None and vehicle not in result.vehicle_ids:
            continue
        if row.stream:
            streams.add((row.scope, row.stream))
        else:
            one = Received(row.file_sha256, row.octets, "", 0, row.station, result)
            found["", row.file_sha256] = {(0, ""): one}
    for scope, stream in sorted(streams):
        pieces = found.setdefault((scope, stream), {})
        mine = query.where(_PIECES.c.scope == scope, _PIECES.c.stream == stream)
        for row in connection.execute(mine):
            result = _result(row.id, row.accounting)
            one = Received(row.file_sha256, row.octets, stream, row.position, row.station, result)
            pieces.setdefault((one.position, one.sha256), one)
    return [[one for _, one in sorted(pieces.items())] for _, pieces in sorted(found.items())]


def results_state(connection: Connection, vehicle: int, start_ticks: int, stop_ticks: int) -> Hashable:
    """Return a value that differs after another ingest of `recordings_of_vehicle`."""
    columns = func.count(), func.count(_INGESTS.c.last_ticks), func.max(_INGESTS.c.finished_utc_ns)
    query = select(*columns).where(*_may_have_packets(vehicle, start_ticks, stop_ticks))
    return tuple(connection.execute(query).one())


def _may_have_packets(vehicle: int, start_ticks: int, stop_ticks: int) -> tuple[ColumnElement[bool], ...]:
    """Return the conditions of ingests that are done and may have packets, or octets of them, in a time."""
    timeless = ("packets", "packets_joined", "crc_errors", "frames_bad", "octets_skipped", "octets_pending")
    return (
        or_(*(_INGESTS.c.accounting[name].as_integer() > 0 for name in timeless)) & _INGESTS.c.last_ticks.is_(None)
        | (_INGESTS.c.last_ticks >= start_ticks) & (_INGESTS.c.first_ticks <= stop_ticks),
        (_INGESTS.c.vehicle_id == vehicle) | _INGESTS.c.accounting["vehicle_ids"][1].as_integer().is_not(None),
        _INGESTS.c.state == "done",
    )


def forget_packets(connection: Connection, vehicle: int, ids: Sequence[int]) -> tuple[int, int]:
    """Remove packets of a vehicle and what was decoded from them; return the extent of their times.

    Declared packets have to be decoded again.
    """
    extent: list[int] = []
    for first in range(0, len(ids), FORGOTTEN_PACKETS):
        chosen = ids[first : first + FORGOTTEN_PACKETS]
        for kind, table in TABLES.items():
            mine = (table.c.vehicle_id == vehicle, table.c.packet_id.in_(chosen))
            gone = connection.execute(
                delete(table).where(*mine).returning(table.c.dictionary_version, table.c.ticks)
            ).all()
            for version in {row[0] for row in gone}:
                times = [row[1] for row in gone if row[0] == version]
                extent += times
                rebuild_rollups(connection, vehicle, version, kind, times)
        mine = (_PACKETS.c.vehicle_id == vehicle, _PACKETS.c.id.in_(chosen))
        extent += connection.execute(delete(_PACKETS).where(*mine).returning(_PACKETS.c.ticks)).scalars()
    forget_others(connection, vehicle, None)
    return min(extent, default=NO_TICKS), max(extent, default=NO_TICKS)


def limit_extents(connection: Connection, vehicle: int, newest_ticks: int | None) -> None:
    """Limit the extent of the ingests of a vehicle to the times of its packets."""
    later = (_INGESTS.c.vehicle_id == vehicle, _INGESTS.c.last_ticks > (newest_ticks or 0))
    connection.execute(update(_INGESTS).where(*later).values(last_ticks=newest_ticks))


def widen_extent(connection: Connection, ingest_id: int, ticks: int) -> None:
    """Extend the extent of an ingest to a time."""
    first, last = (func.coalesce(one, ticks) for one in (_INGESTS.c.first_ticks, _INGESTS.c.last_ticks))
    wider = {
        "first_ticks": case((first > ticks, ticks), else_=first),
        "last_ticks": case((last < ticks, ticks), else_=last),
    }
    connection.execute(update(_INGESTS).where(_INGESTS.c.id == ingest_id).values(**wider))


def change_ingest(connection: Connection, ingest_id: int, state: str, new: str) -> bool:
    """Change the state of an ingest if it is `state`; return whether it was."""
    return change_if(connection, _INGESTS, ingest_id, {"state": state}, state=new)


def ingests_of_vehicles(connection: Connection, vehicles: Sequence[int], but: int) -> list[int]:
    """Return the ingests, except one, that may have packets of these vehicles, oldest first."""
    mine = _INGESTS.c.vehicle_id.in_(vehicles) | _INGESTS.c.accounting["vehicle_ids"][1].as_integer().is_not(None)
    query = select(_INGESTS.c.id).where(mine, _INGESTS.c.state == "done", _INGESTS.c.id != but)
    return [int(key) for key in connection.execute(query.order_by(_INGESTS.c.id)).scalars()]


def forget_rest(connection: Connection, vehicle: int, ingest_id: int) -> None:
    """Remove what an ingest has left except packets of a vehicle: fragments, doubts, its place, and its marks.

    Telecommands that were sent after it are verified from where those before it were.
    """
    fragments, doubted, sent = repository.FRAGMENTS, repository.IMPLAUSIBLE_PACKETS, repository.TELECOMMANDS
    connection.execute(delete(fragments).where(fragments.c.vehicle_id == vehicle))
    connection.execute(delete(doubted).where(doubted.c.vehicle_id == vehicle))
    connection.execute(update(_PIECES).where(_PIECES.c.ingest_id == ingest_id).values(stream="", waits=None))
    mine = sent.c.vehicle_id == vehicle
    received = select(_INGESTS.c.received_utc_ns).where(_INGESTS.c.id == ingest_id).scalar_subquery()
    before = select(func.max(sent.c.sent_after_ticks)).where(mine, sent.c.sent_utc_ns < received)
    known = connection.execute(before).scalar()
    later = update(sent).where(mine, sent.c.sent_utc_ns >= received)
    connection.execute(later.values(sent_after_ticks=-1 if known is None else known))


def newest_ingest(connection: Connection, vehicle: int) -> int:
    """Return the id of the newest ingest with packets of a vehicle."""
    query = select(func.max(_INGESTS.c.id)).where(_INGESTS.c.vehicle_id == vehicle)
    return int(connection.execute(query).scalar_one())


def _ingest(row: Mapping[str, Any]) -> Ingest:
    return Ingest.of(row, sha256=row["file_sha256"], accounting=_result(row["id"], row["accounting"]))


def _result(ingest_id: int, accounting: dict[str, Any]) -> IngestResult | None:
    """Return a stored result; None without one, and for one of an earlier version."""
    try:
        return IngestResult.model_validate({**accounting, "ingest_id": ingest_id})
    except ValidationError:
        return None
