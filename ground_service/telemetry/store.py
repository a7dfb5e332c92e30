"""SQL and codec of stored packets and of the samples that the dictionary decodes from them."""

from collections.abc import Collection, Sequence
from functools import lru_cache
from itertools import chain, pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, bindparam, func, select
from sqlalchemy.sql import Select

from ground_service.store.repository import IMPLAUSIBLE_PACKETS, PACKETS, SAMPLES, within
from lunar.arrays import IntArray
from tmtc.dictionary.payload import DICTIONARY


def packet_headers(connection: Connection, vehicle: int, start_ticks: int, stop_ticks: int) -> dict[str, IntArray]:
    """APID, on-board time and sequence count of the stored packets of a vehicle between two times, by APID and time."""
    # With its APIDs stated, the index is read only between the times.
    query = select(PACKETS.c.apid, PACKETS.c.ticks, PACKETS.c.sequence_count).where(
        PACKETS.c.vehicle_id == vehicle,
        PACKETS.c.apid.in_(_apids(connection, vehicle)),
        PACKETS.c.ticks.between(start_ticks, stop_ticks),
    )
    query = query.order_by(PACKETS.c.apid, PACKETS.c.ticks, PACKETS.c.sequence_count, PACKETS.c.digest)
    rows = whole_numbers(connection, query)
    return {"apid": rows[:, 0], "ticks": rows[:, 1], "sequence_count": rows[:, 2]}


def count_packets(connection: Connection, vehicle: int) -> int:
    """Return the number of stored packets of a vehicle."""
    return int(connection.execute(select(func.count()).where(PACKETS.c.vehicle_id == vehicle)).scalar_one())


def whole_numbers(connection: Connection, query: Select[Any]) -> IntArray:
    """Return the rows of a query of whole numbers (n, columns).

    Plain tuples of the driver need no translation; rows as objects take most of the time.
    """
    with connection.execute(query) as result:
        rows = result.cursor.fetchall()
    return np.array(rows, dtype=np.int64).reshape(-1, len(query.selected_columns))


def _apids(connection: Connection, vehicle: int) -> list[int]:
    """Return the APIDs of the stored packets of a vehicle, each found by one step in the index."""
    found: list[int] = []
    least = select(func.min(PACKETS.c.apid)).where(PACKETS.c.vehicle_id == vehicle)
    while (apid := connection.execute(least.where(PACKETS.c.apid > (found or [-1])[-1])).scalar()) is not None:
        found.append(int(apid))
    return found


def newest_ticks(connection: Connection, vehicle: int, apids: IntArray | None = None) -> int | None:
    """Return the greatest on-board time of the stored packets of a vehicle; None without any.

    `apids` are those of packets that the dictionary does not have; None: they are looked up.
    """
    return newest_and_doubted(connection, vehicle, _apids(connection, vehicle) if apids is None else apids)[0]


def newest_and_doubted(
    connection: Connection, vehicle: int, apids: Collection[int] | IntArray = ()
) -> tuple[int | None, bool]:
    """Return the newest time as `newest_ticks` does, and whether packets of the vehicle are kept apart."""
    query = _newest_query(tuple(sorted({*_APIDS, *np.unique(np.asarray(apids)).tolist()})))
    *row, doubted = connection.execute(query, {"vehicle_id": vehicle}).one()
    return max((int(ticks) for ticks in row if ticks is not None and ticks >= 0), default=None), bool(doubted)


_APIDS = frozenset(definition.apid for definition in DICTIONARY.telemetry)


@lru_cache(maxsize=16)
def _newest_query(apids: tuple[int, ...]) -> Any:
    """Return the query of the greatest on-board time of each APID, which the index has."""
    mine = select(func.max(PACKETS.c.ticks)).where(PACKETS.c.vehicle_id == bindparam("vehicle_id"))
    doubted = select(func.min(IMPLAUSIBLE_PACKETS.c.id)).where(
        IMPLAUSIBLE_PACKETS.c.vehicle_id == bindparam("vehicle_id")
    )
    newest = (mine.where(PACKETS.c.apid == apid).scalar_subquery() for apid in apids)
    return select(*newest, doubted.scalar_subquery())


def last_packets(connection: Connection, vehicle: int, count: int) -> IntArray:
    """Return on-board time and id (n, 2) of at least the last `count` packets of a vehicle, newest first."""
    found = []
    for apid in _apids(connection, vehicle):
        mine = PACKETS.c.vehicle_id == vehicle, PACKETS.c.apid == apid, PACKETS.c.ticks >= 0
        query = select(PACKETS.c.ticks, PACKETS.c.id).where(*mine).order_by(PACKETS.c.ticks.desc())
        found += [tuple(row) for row in connection.execute(query.limit(count))]
    return np.array(sorted(found, reverse=True), dtype=np.int64).reshape(-1, 2)


def packets_before(connection: Connection, vehicle: int, ticks: int, first: int = 0) -> list[int]:
    """Return the ids of the packets of a vehicle with an on-board time from `first` until before `ticks`."""
    mine = PACKETS.c.vehicle_id == vehicle, PACKETS.c.apid.in_(_apids(connection, vehicle))
    query = select(PACKETS.c.id).where(*mine, PACKETS.c.ticks >= first, PACKETS.c.ticks < ticks)
    return [int(key) for key in connection.execute(query).scalars()]


def packet_octets(connection: Connection, vehicle: int, apid: int, start_ticks: int, stop_ticks: int) -> bytes:
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


def newest_packet(connection: Connection, vehicle: int, apid: int) -> bytes | None:
    """Return the packet of an APID with the latest on-board time, None without any."""
    query = (
        select(PACKETS.c.octets)
        .where(PACKETS.c.vehicle_id == vehicle, PACKETS.c.apid == apid)
        .order_by(PACKETS.c.ticks.desc(), PACKETS.c.sequence_count.desc(), PACKETS.c.digest.desc())
        .limit(1)
    )
    found = connection.execute(query).scalar()
    return None if found is None else bytes(found)


Where = tuple[int, int, int, int]
"""Vehicle, first and last on-board time (both included), and dictionary version of samples."""


def samples(
    connection: Connection, kind: str, where: Where, columns: Sequence[str], **equal: int
) -> dict[str, list[Any]]:
    """Return columns of the samples of one kind, in order of time; `equal` keeps rows with these values."""
    rows = connection.execute(_samples(kind, where, columns, equal)).all()
    return {name: [row[i] for row in rows] for i, name in enumerate(columns)}


def sample_arrays(
    connection: Connection, kind: str, where: Where, columns: Sequence[str], **equal: int
) -> dict[str, NDArray[Any]]:
    """As `samples`, as arrays: whole numbers as int64, all else as float64 with NaN for what is not known."""
    with connection.execute(_samples(kind, where, columns, equal)) as result:
        # Plain tuples of the driver: they need no translation, and rows as objects would take most of the time.
        cells = chain.from_iterable(result.cursor.fetchall())
        values = np.fromiter(cells, np.float64).reshape(-1, len(columns))  # whole numbers are below 2^53
    table = SAMPLES[kind]
    return {
        name: values[:, i].astype(np.int64 if table.c[name].type.python_type is int else np.float64)
        for i, name in enumerate(columns)
    }


def _samples(kind: str, where: Where, columns: Sequence[str], equal: dict[str, int]) -> Select[Any]:
    table = SAMPLES[kind]
    return (
        select(*(table.c[name] for name in columns))
        .where(within(table, where), *(table.c[name] == value for name, value in equal.items()))
        .order_by(table.c.ticks, table.c.packet_id)
    )


DETECTION_ITEM = np.dtype(
    [
        ("u_px", "<f4"),
        ("v_px", "<f4"),
        ("diameter_px", "<f4"),
        ("score", "<f4"),
        ("sigma_px", "<f4"),
        ("size_class", "<i1"),
    ]
)
"""Steps of 1/64 px and 1/255 are far coarser than float32 here (2^-15 px at 512 px), so nothing is lost."""


IDENTIFICATION_ITEM = np.dtype([("detection", "<u2"), ("crater_id", "<u4")])


def pack_detections(items: dict[str, NDArray[np.float64]], offsets: NDArray[np.int64]) -> list[bytes]:
    """One octet string per frame of all items (n,), frame i holding rows ``offsets[i]`` to ``offsets[i + 1]``."""
    return _pack(items, offsets, DETECTION_ITEM)


def pack_identifications(items: dict[str, NDArray[np.int64]], offsets: NDArray[np.int64]) -> list[bytes]:
    """As `pack_detections`, of pairs of detection and crater."""
    return _pack(items, offsets, IDENTIFICATION_ITEM)


def _pack(items: dict[str, NDArray[Any]], offsets: NDArray[np.int64], kind: np.dtype[Any]) -> list[bytes]:
    names = kind.names or ()
    records = np.empty(len(items[names[0]]), dtype=kind)
    for name in names:
        records[name] = items[name]
    octets = records.tobytes()
    ends = (offsets * kind.itemsize).tolist()
    return [octets[start:stop] for start, stop in pairwise(ends)]


def unpack_detections(columns: Sequence[bytes]) -> tuple[NDArray[np.void], NDArray[np.int64]]:
    """The records of all frames one after another, and where each frame begins (f + 1,)."""
    return _unpack(columns, DETECTION_ITEM)


def unpack_identifications(columns: Sequence[bytes]) -> tuple[NDArray[np.void], NDArray[np.int64]]:
    """As `unpack_detections`, of pairs of detection and crater."""
    return _unpack(columns, IDENTIFICATION_ITEM)


def pack_filter_states(state: NDArray[np.float64], covariance: NDArray[np.float64]) -> list[bytes]:
    """Pack each state (n, k) and the lower triangle of its covariance (n, k, k) into an octet string of float64."""
    rows, columns = np.tril_indices(state.shape[1])
    packed = np.concatenate([state, covariance[:, rows, columns]], axis=1).astype("<f8")
    return [row.tobytes() for row in packed]


def unpack_filter_states(columns: Sequence[bytes], size: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return states (n, size) and covariances (n, size, size) from packed octet strings."""
    rows, places = np.tril_indices(size)
    values = np.frombuffer(b"".join(columns), dtype="<f8").reshape(len(columns), size + len(rows))
    covariance = np.zeros((len(columns), size, size))
    covariance[:, rows, places] = covariance[:, places, rows] = values[:, size:]
    return values[:, :size].astype(np.float64), covariance


def _unpack(columns: Sequence[bytes], kind: np.dtype[Any]) -> tuple[NDArray[np.void], NDArray[np.int64]]:
    lengths = np.fromiter((len(c) for c in columns), dtype=np.int64, count=len(columns))
    offsets = np.concatenate(([0], np.cumsum(lengths // kind.itemsize))).astype(np.int64)
    return np.frombuffer(b"".join(columns), dtype=kind), offsets
