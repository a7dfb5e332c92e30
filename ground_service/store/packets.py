"""Storing batches of packets: each packet once by content, its decoded rows with it, in one transaction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, bindparam, func, select, text

from ground_service.store.bulk import insert_columns
from ground_service.store.codec import pack_detections, pack_identifications
from ground_service.store.models import SAMPLE_TABLES, Packet, Vehicle
from ground_service.store.rollups import add_to_rollups

IntArray = NDArray[np.int64]

RANGE_GAP_TICKS = 600 << 16
"""Stored packets are looked up by ranges of on-board time; a silence of ten minutes splits a range, so that a batch
with one stray packet of another year does not read the years between."""

_TABLES = {table.__tablename__: table.__table__ for table in SAMPLE_TABLES}
_PACKETS: Any = Packet.__table__

_PACKED = {"detections": pack_detections, "identifications": pack_identifications}

_IN_RANGE = select(_PACKETS.c.digest).where(
    _PACKETS.c.vehicle_id == bindparam("vehicle_id"),
    _PACKETS.c.apid == bindparam("apid"),
    _PACKETS.c.ticks.between(bindparam("first"), bindparam("last")),
)


class Batch(Protocol):
    """What is stored: see `ground_service.link.packets.PacketBatch`."""

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


@dataclass(frozen=True, slots=True)
class Stored:
    """What storing a batch changed."""

    new: int
    repeated: int
    samples: int


def store_batch(connection: Connection, vehicle_id: int, batch: Batch) -> Stored:
    """Store what of the batch is not stored yet, inside the caller's write transaction.

    Storing the same packets again, in other batches or in another order, changes nothing: a packet is known by its
    vehicle and its octets.
    """
    count = len(batch.octets)
    if count == 0:
        return Stored(0, 0, 0)
    connection.execute(select(Vehicle.id).where(Vehicle.id == vehicle_id).with_for_update())
    new = _new_packets(connection, vehicle_id, batch)
    ids = np.zeros(count, dtype=np.int64)
    ids[new] = _reserve_ids(connection, len(new))
    chosen = new.tolist()
    insert_columns(
        connection,
        _PACKETS,
        {
            "id": ids[new],
            "vehicle_id": np.full(len(new), vehicle_id),
            "apid": batch.apid[new],
            "sequence_count": batch.sequence_count[new],
            "ticks": batch.ticks[new],
            "digest": [batch.digest[i] for i in chosen],
            "octets": [batch.octets[i] for i in chosen],
        },
    )
    samples = store_samples(connection, vehicle_id, batch.dictionary_version, batch.rows, ids)
    return Stored(len(new), count - len(new), samples)


def store_samples(
    connection: Connection,
    vehicle_id: int,
    dictionary_version: int,
    rows: Mapping[str, Mapping[str, Any]],
    packet_ids: IntArray,
) -> int:
    """Insert decoded rows whose packet has an id in `packet_ids` (n,), 0 meaning: leave its rows out."""
    stored = 0
    for kind, columns in rows.items():
        owner = packet_ids[columns["packet"]]
        keep = np.flatnonzero(owner > 0)
        if len(keep) == 0:
            continue
        keep = keep[np.lexsort((owner[keep], columns["ticks"][keep]))]
        chosen = {
            name: column[keep]
            for name, column in columns.items()
            if name not in ("packet", "items", "offsets")
        }
        if kind in _PACKED:
            packed = _PACKED[kind](columns["items"], columns["offsets"])
            chosen["items"] = [packed[i] for i in keep.tolist()]
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
        add_to_rollups(connection, vehicle_id, dictionary_version, kind, chosen)
    return stored


def _new_packets(connection: Connection, vehicle_id: int, batch: Batch) -> IntArray:
    """Indices of packets that are neither stored nor earlier in the same batch, in order of time."""
    stored: set[bytes] = set()
    for apid, first, last in _time_ranges(batch.apid, batch.ticks):
        found = connection.execute(
            _IN_RANGE, {"vehicle_id": vehicle_id, "apid": apid, "first": first, "last": last}
        )
        stored.update(found.scalars())
    fresh = []
    seen = stored
    digests: Sequence[bytes] = batch.digest
    for index in np.lexsort((batch.sequence_count, batch.apid, batch.ticks)).tolist():
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


def _reserve_ids(connection: Connection, count: int) -> IntArray:
    """Ids for `count` new packets, taken for good within this transaction."""
    if count == 0:
        return np.zeros(0, dtype=np.int64)
    if connection.dialect.name == "postgresql":
        values = connection.execute(
            text("SELECT nextval('packets_id_seq') FROM generate_series(1, :count)"), {"count": count}
        )
        return np.fromiter(values.scalars(), dtype=np.int64, count=count)
    highest = connection.execute(select(func.max(_PACKETS.c.id))).scalar() or 0
    return np.arange(highest + 1, highest + 1 + count, dtype=np.int64)
