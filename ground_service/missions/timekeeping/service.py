"""Time correlations of a vehicle: fitted per run of its clock, versioned, in force at once for everything derived.

Samples keep their on-board ticks and are given UTC when they are read, so a new correlation needs no rewriting, and
late data are correlated like any others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ground_service.access.service import audit
from ground_service.clock import utc_now_ns
from ground_service.errors import Conflict, InvalidInput
from ground_service.events import CorrelationChanged, publish
from ground_service.ground import Ground
from ground_service.missions.timekeeping import store
from ground_service.missions.timekeeping.core import CorrelationFit, fit_correlation
from ground_service.missions.timekeeping.model import Correlation, TimeReport
from ground_service.missions.timekeeping.recorrelation import recorrelate, residuals
from ground_service.store.vehicles import find_vehicle, lock_vehicle

MANUAL = "least squares of time reports"
"""Method of correlations that an operator entered."""


@dataclass(frozen=True, slots=True)
class TimePoint:
    """A time report as received: what the clock showed, when that reached the Earth, the light time, the boot."""

    ticks: int
    earth_utc_ns: int
    light_time_ns: int
    boot_count: int = 0


def correlate(
    ground: Ground, vehicle: int, points: Sequence[TimePoint], *, actor: str = "local"
) -> list[CorrelationFit]:
    """Fit a correlation for every boot among the points; they replace those in force, which stay on record.

    Raises
    ------
    InvalidInput
        If there are no points.
    """
    if not points:
        raise InvalidInput("time correlation", "points", "at least one time report", "none")
    fits: dict[int, CorrelationFit] = {}
    for boot in sorted({point.boot_count for point in points}):
        mine = [point for point in points if point.boot_count == boot]
        fits[boot] = fit_correlation(
            np.array([point.ticks for point in mine], dtype=np.int64),
            np.array([point.earth_utc_ns for point in mine], dtype=np.int64),
            np.array([point.light_time_ns for point in mine], dtype=np.int64),
        )
    with ground.database.writing() as connection:
        lock_vehicle(connection, vehicle)
        store.replace_correlations(connection, vehicle, fits.items(), method=MANUAL, now_utc_ns=utc_now_ns())
        audit(connection, actor, "correlate time", str(vehicle), {"boots": len(fits), "points": len(points)})
        publish(connection, CorrelationChanged(vehicle_id=vehicle, segments=len(fits)))
    return list(fits.values())


def correlate_spacecraft(
    ground: Ground, spacecraft_id: int, instance: str, points: Sequence[TimePoint], *, actor: str
) -> list[Correlation]:
    """As `correlate`, of a spacecraft by its number; the correlations now in force."""
    vehicle = _vehicle(ground, spacecraft_id, instance)
    correlate(ground, vehicle, points, actor=actor)
    return [one for one in ground.read(store.correlations_on_record, vehicle) if one.in_force]


def spacecraft_correlations(ground: Ground, spacecraft_id: int, instance: str) -> list[Correlation]:
    """All correlations that a spacecraft ever had, the newest first."""
    return ground.read(store.correlations_on_record, _vehicle(ground, spacecraft_id, instance))


def correlate_again(ground: Ground, spacecraft_id: int, instance: str, *, actor: str) -> list[Correlation]:
    """Correlate a spacecraft from its received time reports, also over what was entered; the correlations in force."""
    vehicle = _vehicle(ground, spacecraft_id, instance)
    if recorrelate(ground, vehicle, over_manual=True):
        ground.write(audit, actor, "correlate time", str(vehicle), {"from": "time reports"})
    return ground.read(store.correlations_in_force, vehicle)


def withdraw_correlations(
    ground: Ground, spacecraft_id: int, instance: str, *, actor: str
) -> list[Correlation]:
    """Withdraw the correlations in force that a person entered, and correlate again; the correlations then in force.

    The withdrawn ones stay on record.

    Raises
    ------
    Conflict
        None in force was entered by a person.
    """
    vehicle = _vehicle(ground, spacecraft_id, instance)
    with ground.database.writing() as connection:
        lock_vehicle(connection, vehicle)
        entered = [one.id for one in store.correlations_in_force(connection, vehicle) if one.method == MANUAL]
        if not entered:
            raise Conflict(
                f"spacecraft {spacecraft_id}: expected correlations in force that a person entered, found none"
            )
        store.replace_correlations(connection, vehicle, (), method=MANUAL, now_utc_ns=utc_now_ns())
        audit(connection, actor, "withdraw correlations", str(vehicle), {"ids": entered})
        publish(connection, CorrelationChanged(vehicle_id=vehicle, segments=0))
    recorrelate(ground, vehicle)
    return ground.read(store.correlations_in_force, vehicle)


def spacecraft_time_reports(ground: Ground, spacecraft_id: int, instance: str) -> list[TimeReport]:
    """The received time reports of a spacecraft with what the correlations in force leave of them."""
    return residuals(ground, _vehicle(ground, spacecraft_id, instance))


def _vehicle(ground: Ground, spacecraft_id: int, instance: str) -> int:
    return ground.read(find_vehicle, spacecraft_id, instance).id
