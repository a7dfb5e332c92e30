"""SQL of time correlations and of the reception of time reports."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from sqlalchemy import Connection, func, insert, select, update

from ground_service.missions.timekeeping.core import CorrelationFit, TimeCorrelation
from ground_service.missions.timekeeping.model import Correlation
from ground_service.store import repository
from lunar.arrays import IntArray
from tmtc.dictionary.payload import APID_TIME_REPORT

_CORRELATIONS = repository.CORRELATIONS
_RECEPTIONS = repository.RECEPTIONS

ReceptionKey = tuple[int, int, str]
"""On-board time, sequence count and station of a time report."""


def load_correlations(connection: Connection, vehicle: int) -> tuple[TimeCorrelation, ...]:
    """The time correlations of a vehicle that are in force, by on-board time."""
    names = TimeCorrelation.__slots__
    query = select(*(_CORRELATIONS.c[name] for name in names)).where(*_in_force(vehicle))
    rows = connection.execute(query.order_by(_CORRELATIONS.c.start_ticks))
    return tuple(TimeCorrelation(*row) for row in rows)


def correlations_in_force(connection: Connection, vehicle: int) -> list[Correlation]:
    """Return the correlations of a vehicle in force, by on-board time."""
    query = select(_CORRELATIONS).where(*_in_force(vehicle)).order_by(_CORRELATIONS.c.start_ticks)
    return [_correlation(row) for row in connection.execute(query).mappings()]


def correlations_on_record(connection: Connection, vehicle: int) -> list[Correlation]:
    """Return all correlations that a vehicle ever had, the newest first."""
    query = select(_CORRELATIONS).where(_CORRELATIONS.c.vehicle_id == vehicle)
    rows = connection.execute(query.order_by(_CORRELATIONS.c.id.desc())).mappings()
    return [_correlation(row) for row in rows]


def replace_correlations(
    connection: Connection, vehicle: int, fits: Iterable[tuple[int, CorrelationFit]], *, method: str, now_utc_ns: int
) -> None:
    """Supersede the correlations in force by the fits (boot, line) of a method."""
    connection.execute(update(_CORRELATIONS).where(*_in_force(vehicle)).values(superseded=1))
    for boot, fit in fits:
        repository.add(
            connection,
            _CORRELATIONS,
            vehicle_id=vehicle,
            method=method,
            boot_count=boot,
            superseded=0,
            created_utc_ns=now_utc_ns,
            **{name: getattr(fit, name) for name in fit.__slots__},
        )


def receptions(connection: Connection, vehicle: int) -> dict[ReceptionKey, int]:
    """Return the Earth reception times (UTC, ns) of the time reports of a vehicle."""
    columns = ("ticks", "sequence_count", "station", "earth_utc_ns")
    query = select(*(_RECEPTIONS.c[name] for name in columns)).where(_RECEPTIONS.c.vehicle_id == vehicle)
    return {(ticks, count, station): time for ticks, count, station, time in connection.execute(query)}


def add_receptions(connection: Connection, vehicle: int, new: Mapping[ReceptionKey, int]) -> None:
    """Add the reception times of time reports that have none."""
    rows = [
        {"vehicle_id": vehicle, "ticks": ticks, "sequence_count": count, "station": station, "earth_utc_ns": time}
        for (ticks, count, station), time in new.items()
    ]
    if rows:
        connection.execute(insert(_RECEPTIONS), rows)


def change_reception(connection: Connection, vehicle: int, key: ReceptionKey, earth_utc_ns: int) -> None:
    """Replace the reception time of a time report."""
    ticks, count, station = key
    connection.execute(
        update(_RECEPTIONS)
        .where(
            _RECEPTIONS.c.vehicle_id == vehicle,
            _RECEPTIONS.c.ticks == ticks,
            _RECEPTIONS.c.sequence_count == count,
            _RECEPTIONS.c.station == station,
        )
        .values(earth_utc_ns=earth_utc_ns)
    )


def has_receptions(connection: Connection, vehicle: int) -> bool:
    """Return whether the reception time of any time report of a vehicle is known."""
    query = select(_RECEPTIONS.c.ticks).where(_RECEPTIONS.c.vehicle_id == vehicle).limit(1)
    return connection.execute(query).first() is not None


def vehicles_with_receptions(connection: Connection, start_utc_ns: int, stop_utc_ns: int) -> list[int]:
    """Return the vehicles with time reports received in an interval of time."""
    query = select(_RECEPTIONS.c.vehicle_id).where(_RECEPTIONS.c.earth_utc_ns.between(start_utc_ns, stop_utc_ns))
    return [int(vehicle) for vehicle in connection.execute(query.distinct()).scalars()]


def received_time_reports(connection: Connection, vehicle: int) -> tuple[IntArray, tuple[str, ...]]:
    """Return the time reports in the archive whose reception is known, with the station of each.

    The columns (n, 4) are the on-board time and sequence count of the packet, the reported time, and the Earth
    reception time (UTC, ns).
    """
    table, packets = repository.SAMPLES["time_reports"], repository.PACKETS
    key = (_RECEPTIONS.c.ticks, _RECEPTIONS.c.sequence_count)
    # Every dictionary version tells the same of a report: one row each is enough.
    query = (
        select(*key, func.max(table.c.reported_ticks), _RECEPTIONS.c.earth_utc_ns, _RECEPTIONS.c.station)
        .join(
            packets,
            (packets.c.vehicle_id == _RECEPTIONS.c.vehicle_id)
            & (packets.c.apid == APID_TIME_REPORT)
            & (packets.c.ticks == _RECEPTIONS.c.ticks)
            & (packets.c.sequence_count == _RECEPTIONS.c.sequence_count),
        )
        .join(
            table,
            (table.c.vehicle_id == packets.c.vehicle_id)
            & (table.c.ticks == packets.c.ticks)
            & (table.c.packet_id == packets.c.id),
        )
        .where(_RECEPTIONS.c.vehicle_id == vehicle)
        .group_by(*key, _RECEPTIONS.c.earth_utc_ns, _RECEPTIONS.c.station)
        .order_by(*key, _RECEPTIONS.c.station)
    )
    rows = connection.execute(query).all()
    numbers = np.array([tuple(row)[:4] for row in rows], dtype=np.int64).reshape(-1, 4)
    return numbers, tuple(str(row[4]) for row in rows)


def boot_starts(connection: Connection, vehicle: int) -> IntArray:
    """Return the first on-board time of each boot, and its number, by time (n, 2), from the housekeeping."""
    table = repository.SAMPLES["housekeeping"]
    rows = connection.execute(
        select(func.min(table.c.ticks), table.c.boot_count)
        .where(table.c.vehicle_id == vehicle)
        .group_by(table.c.boot_count)
    )
    return np.array(sorted(tuple(row) for row in rows), dtype=np.int64).reshape(-1, 2)


def ephemerides_of_passes(connection: Connection, vehicle: int) -> set[int]:
    """Return the ids of the reference ephemerides of the passes of a vehicle."""
    passes = repository.PASSES
    query = select(passes.c.ephemeris_id).where(passes.c.vehicle_id == vehicle, passes.c.ephemeris_id.is_not(None))
    return {int(key) for key in connection.execute(query).scalars()}


def _in_force(vehicle: int) -> tuple[Any, Any]:
    return _CORRELATIONS.c.vehicle_id == vehicle, _CORRELATIONS.c.superseded == 0


def _correlation(row: Mapping[Any, Any]) -> Correlation:
    return Correlation.of(row, in_force=not row["superseded"], reference=row["reference_utc_ns"])
