"""SQL that stores samples of packets with their roll-ups, and takes them away again."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from sqlalchemy import Connection, delete, select

from ground_service.store.models import PACKETS, SAMPLE_TABLES
from ground_service.store.repository import insert_columns
from ground_service.telemetry.rollups import add_to_rollups, forget_rollups
from ground_service.telemetry.store import pack_detections, pack_filter_states, pack_identifications
from lunar.arrays import IntArray

_PACKED: dict[str, Callable[..., list[bytes]]] = {
    "detections": pack_detections,
    "identifications": pack_identifications,
}


TABLES: dict[str, Any] = {table.name: table for table in SAMPLE_TABLES}


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
            TABLES[kind],
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


def forget_samples(connection: Connection, vehicle: int, dictionary_version: int) -> None:
    """Remove what a dictionary version has decoded from the packets of a vehicle."""
    for table in TABLES.values():
        connection.execute(
            delete(table).where(table.c.vehicle_id == vehicle, table.c.dictionary_version == dictionary_version)
        )
    forget_rollups(connection, vehicle, dictionary_version)


def packets_between(
    connection: Connection, vehicle: int, after: int, until: int, limit: int
) -> tuple[IntArray, list[bytes]]:
    """Return ids (n,) and octets of the packets with ids above `after`, up to `until`, in the order of their ids."""
    rows = connection.execute(
        select(PACKETS.c.id, PACKETS.c.octets)
        .where(PACKETS.c.vehicle_id == vehicle, PACKETS.c.id > after, PACKETS.c.id <= until)
        .order_by(PACKETS.c.id)
        .limit(limit)
    ).all()
    return np.array([row[0] for row in rows], dtype=np.int64), [bytes(row[1]) for row in rows]
