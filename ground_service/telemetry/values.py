"""Values of parameters of declared packets: stored, read, and forgotten with their definition."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from sqlalchemy import Connection, LargeBinary, delete, func, select, update

from ground_service.store import repository
from ground_service.store.repository import insert_columns
from ground_service.telemetry import rollups
from lunar.arrays import FloatArray, IntArray
from tmtc.packets.pus import NO_TICKS

_DEFINITIONS = repository.PACKET_DEFINITIONS
_DECODINGS = repository.PACKET_DECODINGS
_SAMPLES = repository.PARAMETER_SAMPLES
_PACKETS = repository.PACKETS

VALUE = np.dtype("<f8")
"""Form of a stored value."""


@dataclass(frozen=True, slots=True)
class Decoding:
    """Progress of a definition for a vehicle: see `models.PACKET_DECODINGS`."""

    definition_id: int
    decoded_to: int
    complete: bool
    counts: dict[str, dict[str, int]]


@dataclass(frozen=True, slots=True)
class StoredPackets:
    """Packets by their ids, in this order."""

    ids: list[int]
    apids: list[int]
    octets: list[bytes]


def definition_id(connection: Connection, digest: str, mission_id: int) -> int:
    """Return the id of a definition; add it if it is new."""
    found = repository.find(connection, _DEFINITIONS, digest=digest)
    if found is None:
        repository.add_new(connection, _DEFINITIONS, digest=digest, mission_id=mission_id)
        found = repository.find(connection, _DEFINITIONS, digest=digest)
        assert found is not None
    return int(found["id"])


def mission_of_definition(connection: Connection, definition: int) -> int:
    """Return the id of a mission revision that states a definition."""
    return int(repository.get(connection, _DEFINITIONS, definition, "packet definition")["mission_id"])


def decoding(connection: Connection, vehicle: int, definition: int) -> Decoding | None:
    """Return the progress of a definition, None if it has not begun."""
    row = repository.find(connection, _DECODINGS, vehicle_id=vehicle, definition_id=definition)
    return None if row is None else _decoding(row)


def readable_decoding(connection: Connection, vehicle: int) -> Decoding | None:
    """Return the definition that the values of a vehicle are read with, None if there is none yet."""
    row = repository.find(connection, _DECODINGS, vehicle_id=vehicle, complete=1)
    return None if row is None else _decoding(row)


def begin(connection: Connection, vehicle: int, definition: int, *, read_again: bool) -> Decoding:
    """Begin decoding with a definition; `read_again`: also read the raw files that came before it was stated."""
    ingests, missions = repository.INGESTS, repository.MISSIONS
    stated = select(missions.c.created_utc_ns).where(missions.c.id == mission_of_definition(connection, definition))
    last = select(func.max(ingests.c.id)).where(ingests.c.received_utc_ns < stated.scalar_subquery())
    repository.add(
        connection,
        _DECODINGS,
        vehicle_id=vehicle,
        definition_id=definition,
        decoded_to=0,
        complete=0,
        read_again_to=connection.execute(last).scalar() if read_again else None,
        counts={},
    )
    return Decoding(definition, 0, False, {})


def change(connection: Connection, vehicle: int, progress: Decoding) -> None:
    """Store the progress of a definition."""
    connection.execute(
        update(_DECODINGS)
        .where(_DECODINGS.c.vehicle_id == vehicle, _DECODINGS.c.definition_id == progress.definition_id)
        .values(decoded_to=progress.decoded_to, complete=int(progress.complete), counts=dict(progress.counts))
    )


def ingests_to_read(connection: Connection, vehicle: int) -> list[int]:
    """Return the ingests whose raw files have to be read again, oldest first."""
    last = connection.execute(
        select(func.max(_DECODINGS.c.read_again_to)).where(_DECODINGS.c.vehicle_id == vehicle)
    ).scalar()
    if last is None:
        return []
    ingests = repository.INGESTS
    query = (
        select(ingests.c.id)
        .where(
            ingests.c.id <= last,
            ingests.c.state.in_(("done", "failed")),
            (ingests.c.vehicle_id == vehicle) | ingests.c.vehicle_id.is_(None),
        )
        .order_by(ingests.c.id)
    )
    return [int(key) for key in connection.execute(query).scalars()]


def note_read(connection: Connection, vehicle: int) -> None:
    """Record that the raw files have been read again."""
    connection.execute(
        update(_DECODINGS)
        .where(_DECODINGS.c.vehicle_id == vehicle, _DECODINGS.c.read_again_to.is_not(None))
        .values(read_again_to=None)
    )


def is_decoded(connection: Connection, vehicle: int, digest: str) -> bool:
    """Return whether a vehicle is decoded with a definition (empty: with none), and only with it."""
    rows = connection.execute(
        select(_DEFINITIONS.c.digest, _DECODINGS.c.complete, _DECODINGS.c.read_again_to)
        .join(_DEFINITIONS, _DEFINITIONS.c.id == _DECODINGS.c.definition_id)
        .where(_DECODINGS.c.vehicle_id == vehicle)
    )
    return [tuple(row) for row in rows] == ([(digest, 1, None)] if digest else [])


def forget_others(connection: Connection, vehicle: int, definition: int | None) -> None:
    """Remove what other definitions than this one have decoded from the packets of a vehicle."""
    others = select(_DECODINGS.c.definition_id).where(_DECODINGS.c.vehicle_id == vehicle)
    if definition is not None:
        others = others.where(_DECODINGS.c.definition_id != definition)
    for other in connection.execute(others).scalars().all():
        mine = (_SAMPLES.c.vehicle_id == vehicle, _SAMPLES.c.definition_id == other)
        connection.execute(delete(_SAMPLES).where(*mine))
        rollups.forget_values(connection, vehicle, other, (rollups.PARAMETERS_CODE,))
        connection.execute(
            delete(_DECODINGS).where(_DECODINGS.c.vehicle_id == vehicle, _DECODINGS.c.definition_id == other)
        )


FEW_PACKETS = 20_000
"""Packets of all vehicles after a position, below which they are read by their ids."""


def packets_after(
    connection: Connection, vehicle: int, packet_id: int, apids: Collection[int], limit: int
) -> StoredPackets:
    """Return the next packets of these APIDs, in the order of their ids."""
    newest = connection.execute(select(func.max(_PACKETS.c.id))).scalar() or 0
    # The index of vehicles gives all packets of one so far, the ids those of all vehicles since. A sum uses no index.
    key = _PACKETS.c.vehicle_id + 0 if newest - packet_id < FEW_PACKETS else _PACKETS.c.vehicle_id
    query = (
        select(_PACKETS.c.id, _PACKETS.c.apid, _PACKETS.c.octets)
        .where(key == vehicle, _PACKETS.c.id > packet_id, _PACKETS.c.apid.in_(sorted(apids)))
        .order_by(_PACKETS.c.id)
        .limit(limit)
    )
    return _stored(connection.execute(query).all())


def last_packet(connection: Connection, vehicle: int) -> int:
    """Return the largest id of a packet of a vehicle, 0 without any."""
    query = select(func.max(_PACKETS.c.id)).where(_PACKETS.c.vehicle_id == vehicle)
    return int(connection.execute(query).scalar() or 0)


def store_values(
    connection: Connection, vehicle: int, definition: int, samples: Mapping[int, tuple[IntArray, IntArray, FloatArray]]
) -> int:
    """Store times (n,), packet ids (n,) and values (n, v) by container number; return the number of samples."""
    timed: dict[int, tuple[IntArray, FloatArray]] = {}
    stored = 0
    for container, (ticks, packet_ids, values) in sorted(samples.items()):
        order = np.lexsort((packet_ids, ticks))
        rows = np.ascontiguousarray(values[order], dtype=VALUE)
        stored += insert_columns(
            connection,
            _SAMPLES,
            {
                "vehicle_id": np.full(len(order), vehicle),
                "definition_id": np.full(len(order), definition),
                "container": np.full(len(order), container),
                "ticks": ticks[order],
                "packet_id": packet_ids[order],
                "values": [row.tobytes() for row in rows],
            },
        )
        known = np.flatnonzero(ticks != NO_TICKS)
        if known.size and values.shape[1]:
            timed[container] = (ticks[known], values[known])
    if timed:
        rollups.add_values(connection, vehicle, definition, rollups.PARAMETERS_CODE, timed)
    return stored


def read_values(
    connection: Connection,
    vehicle: int,
    definition: int,
    container: int,
    start_ticks: int,
    stop_ticks: int,
    indices: Sequence[int],
) -> tuple[IntArray, FloatArray]:
    """Return times (n,) and values (n, v) of some places of a container between two times (both included)."""
    size = VALUE.itemsize
    wanted = [func.substr(_SAMPLES.c["values"], index * size + 1, size, type_=LargeBinary) for index in indices]
    query = (
        select(_SAMPLES.c.ticks, *wanted)
        .where(*_between(vehicle, definition, container, start_ticks, stop_ticks))
        .order_by(_SAMPLES.c.ticks, _SAMPLES.c.packet_id)
    )
    rows = connection.execute(query).all()
    ticks = np.array([row[0] for row in rows], dtype=np.int64)
    octets = b"".join(bytes(value) for row in rows for value in row[1:])
    return ticks, np.frombuffer(octets, VALUE).reshape(len(rows), len(indices)).astype(np.float64)


def newest_values(
    connection: Connection, vehicle: int, definition: int, container: int
) -> tuple[int, FloatArray] | None:
    """Return time and values of the newest packet of a container that has a time; None without any."""
    query = (
        select(_SAMPLES.c.ticks, _SAMPLES.c["values"])
        .where(*_between(vehicle, definition, container, NO_TICKS + 1, 2**62))
        .order_by(_SAMPLES.c.ticks.desc(), _SAMPLES.c.packet_id.desc())
    )
    row = connection.execute(query.limit(1)).first()
    return None if row is None else (int(row[0]), np.frombuffer(bytes(row[1]), VALUE))


def newest_declared_ticks(
    connection: Connection, vehicle: int, definition: int | None = None, containers: Collection[int] = ()
) -> int | None:
    """Return the greatest time of the samples of a vehicle, or of some containers; None without any."""
    query = select(func.max(_SAMPLES.c.ticks)).where(_SAMPLES.c.vehicle_id == vehicle, _SAMPLES.c.ticks >= 0)
    if definition is None:
        return connection.execute(query).scalar()
    query = query.where(_SAMPLES.c.definition_id == definition)
    times = (connection.execute(query.where(_SAMPLES.c.container == one)).scalar() for one in containers)
    return max((time for time in times if time is not None), default=None)


def count_values(
    connection: Connection, vehicle: int, definition: int, container: int, start_ticks: int, stop_ticks: int
) -> int:
    """Return the number of packets of a container between two times."""
    where = _between(vehicle, definition, container, start_ticks, stop_ticks)
    return int(connection.execute(select(func.count()).select_from(_SAMPLES).where(*where)).scalar_one())


def packets_of_container(
    connection: Connection, vehicle: int, definition: int, container: int, start_ticks: int, stop_ticks: int, limit: int
) -> tuple[IntArray, StoredPackets]:
    """Return times (n,) and packets of a container between two times, in order of time."""
    query = (
        select(_SAMPLES.c.ticks, _PACKETS.c.id, _PACKETS.c.apid, _PACKETS.c.octets)
        .join(_PACKETS, _PACKETS.c.id == _SAMPLES.c.packet_id)
        .where(*_between(vehicle, definition, container, start_ticks, stop_ticks))
        .order_by(_SAMPLES.c.ticks, _SAMPLES.c.packet_id)
        .limit(limit)
    )
    rows = connection.execute(query).all()
    return np.array([row[0] for row in rows], dtype=np.int64), _stored([row[1:] for row in rows])


def _between(vehicle: int, definition: int, container: int, start_ticks: int, stop_ticks: int) -> tuple[Any, ...]:
    return (
        _SAMPLES.c.vehicle_id == vehicle,
        _SAMPLES.c.definition_id == definition,
        _SAMPLES.c.container == container,
        _SAMPLES.c.ticks.between(start_ticks, stop_ticks),
    )


def _decoding(row: repository.Row) -> Decoding:
    return Decoding(row["definition_id"], row["decoded_to"], bool(row["complete"]), row["counts"])


def _stored(rows: Sequence[Any]) -> StoredPackets:
    return StoredPackets([int(row[0]) for row in rows], [int(row[1]) for row in rows], [bytes(row[2]) for row in rows])
