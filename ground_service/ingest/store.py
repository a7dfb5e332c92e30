"""Storing batches of packets: each packet once by content, its decoded rows with it, in one transaction."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from sqlalchemy import Connection, bindparam, func, select

from ground_service.events import TelemetryReceived, publish
from ground_service.store.bulk import insert_columns
from ground_service.store.codec import pack_detections, pack_filter_states, pack_identifications
from ground_service.store.models import NO_TICKS, SAMPLE_TABLES, Packet, Vehicle
from ground_service.store.rollups import add_to_rollups
from lunar.arrays import IntArray

RANGE_GAP_TICKS = 600 << 16
"""Stored packets are looked up by ranges of on-board time; a silence of ten minutes splits a range, so that a batch
with one stray packet of another year does not read the years between."""

_TABLES: dict[str, Any] = {table.__tablename__: table.__table__ for table in SAMPLE_TABLES}
_PACKETS: Any = Packet.__table__

_PACKED: dict[str, Callable[..., list[bytes]]] = {
    "detections": pack_detections,
    "identifications": pack_identifications,
}

_IN_RANGE = select(_PACKETS.c.digest).where(
    _PACKETS.c.vehicle_id == bindparam("vehicle_id"),
    _PACKETS.c.apid == bindparam("apid"),
    _PACKETS.c.ticks.between(bindparam("first"), bindparam("last")),
)


class Batch(Protocol):
    """What is stored: see `ground_service.ingest.packets.PacketBatch`."""

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
    select(Vehicle.id).where(Vehicle.id == bindparam("vehicle_id")).with_for_update(read=True, key_share=True)
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
    """What storing a batch changed."""

    new: int
    repeated: int
    samples: int


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
        ticks = batch.ticks[(ids > 0) & (batch.ticks != NO_TICKS)]
        first, last = (int(ticks.min()), int(ticks.max())) if ticks.size else (None, None)
        publish(
            connection,
            TelemetryReceived(vehicle_id=vehicle_id, packets=added, first_ticks=first, last_ticks=last),
        )
    return Stored(added, count - added, samples)


def store_samples(
    connection: Connection,
    vehicle_id: int,
    dictionary_version: int,
    rows: Mapping[str, Mapping[str, Any]],
    packet_ids: IntArray,
) -> int:
    """Insert decoded rows whose packet has an id in `packet_ids` (n,), 0 meaning: leave its rows out."""
    stored = 0
    counted: list[tuple[str, dict[str, Any]]] = []
    for kind, columns in rows.items():
        owner = packet_ids[columns["packet"]]
        keep = np.flatnonzero(owner > 0)
        if len(keep) == 0:
            continue
        keep = keep[np.lexsort((owner[keep], columns["ticks"][keep]))]
        chosen = {
            name: column[keep]
            for name, column in columns.items()
            if name not in ("packet", "items", "offsets", "state", "covariance")
        }
        if kind in _PACKED:
            packed = _PACKED[kind](columns["items"], columns["offsets"])
            chosen["items"] = [packed[i] for i in keep.tolist()]
        if kind == "filter_states":
            chosen["values"] = pack_filter_states(columns["state"][keep], columns["covariance"][keep])
        stored += insert_columns(
            connection,
            _TABLES[kind],
            {
                "vehicle_id": np.full(len(keep), vehicle_id),
                "dictionary_version": np.full(len(keep), dictionary_version),
                "packet_id": owner[keep],
                **chosen,
            },
        )
        counted.append((kind, chosen))
    for kind, chosen in counted:
        add_to_rollups(connection, vehicle_id, dictionary_version, kind, chosen)
    return stored


def _new_packets(connection: Connection, vehicle_id: int, batch: Batch) -> IntArray:
    """Indices of packets that are neither stored nor earlier in the same batch, in the order of their key."""
    stored: set[bytes] = set()
    for apid, first, last in _time_ranges(batch.apid, batch.ticks):
        found = connection.execute(
            _IN_RANGE, {"vehicle_id": vehicle_id, "apid": apid, "first": first, "last": last}
        )
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
    insert_columns(
        connection, _PACKETS, {"id": found, "vehicle_id": np.full(len(chosen), vehicle_id), **columns}
    )
    return found
