"""Time correlations of a vehicle: fitted per run of its clock, versioned, in force at once for everything derived.

Samples keep their on-board ticks and are given UTC when they are read, so a new correlation needs no rewriting, and
late data are correlated like any others.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from sqlalchemy import select, update

from ground_service.access.service import audit
from ground_service.clock import utc_now_ns
from ground_service.errors import InvalidInput, NotFound
from ground_service.events import CorrelationChanged, publish
from ground_service.ground import Ground
from ground_service.http.times import time_of
from ground_service.store import repository
from ground_service.timekeeping.core import CorrelationFit, fit_correlation
from ground_service.timekeeping.recorrelation import in_force, lock_vehicle, recorrelate, residuals
from lunar.errors import LunarError


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
    table = repository.CORRELATIONS
    now = utc_now_ns()
    with ground.database.writing() as connection:
        repository.get(connection, repository.VEHICLES, vehicle, "vehicle")
        lock_vehicle(connection, vehicle)
        connection.execute(
            update(table).where(table.c.vehicle_id == vehicle, table.c.superseded == 0).values(superseded=1)
        )
        for boot, fit in fits.items():
            repository.add(
                connection,
                table,
                vehicle_id=vehicle,
                method="least squares of time reports",
                boot_count=boot,
                start_ticks=fit.start_ticks,
                stop_ticks=fit.stop_ticks,
                reference_ticks=fit.reference_ticks,
                reference_utc_ns=fit.reference_utc_ns,
                drift_ppb=fit.drift_ppb,
                residual_rms_ns=fit.residual_rms_ns,
                residual_max_ns=fit.residual_max_ns,
                points=fit.points,
                rejected=fit.rejected,
                superseded=0,
                created_utc_ns=now,
            )
        audit(connection, actor, "correlate time", str(vehicle), {"boots": len(fits), "points": len(points)})
        publish(connection, CorrelationChanged(vehicle_id=vehicle, segments=len(fits)))
    return list(fits.values())


def correlations_on_record(ground: Ground, vehicle: int) -> list[repository.Row]:
    """All correlations that a vehicle ever had, the newest first."""
    table = repository.CORRELATIONS
    with ground.database.reading() as connection:
        rows = connection.execute(
            select(table).where(table.c.vehicle_id == vehicle).order_by(table.c.id.desc())
        ).mappings()
        return [dict(row) for row in rows]


def correlate_spacecraft(
    ground: Ground, spacecraft_id: int, instance: str, points: Sequence[TimePoint], *, actor: str
) -> list[repository.Row]:
    """As `correlate`, of a spacecraft by its number; the correlations now in force."""
    vehicle = _vehicle(ground, spacecraft_id, instance)
    correlate(ground, vehicle, points, actor=actor)
    return [row for row in correlations_on_record(ground, vehicle) if not row["superseded"]]


def spacecraft_correlations(ground: Ground, spacecraft_id: int, instance: str) -> list[repository.Row]:
    """All correlations that a spacecraft ever had, the newest first."""
    return correlations_on_record(ground, _vehicle(ground, spacecraft_id, instance))


def correlate_again(ground: Ground, spacecraft_id: int, instance: str, *, actor: str) -> list[repository.Row]:
    """Correlate a spacecraft from its received time reports, also over what was entered; the correlations in force."""
    vehicle = _vehicle(ground, spacecraft_id, instance)
    if recorrelate(ground, vehicle, over_manual=True):
        with ground.database.writing() as connection:
            audit(connection, actor, "correlate time", str(vehicle), {"from": "time reports"})
    return in_force(ground, vehicle)


def spacecraft_time_reports(ground: Ground, spacecraft_id: int, instance: str) -> list[dict[str, Any]]:
    """The received time reports of a spacecraft with what the correlations in force leave of them."""
    return residuals(ground, _vehicle(ground, spacecraft_id, instance))


def time_points(given: Sequence[Mapping[str, Any]]) -> list[TimePoint]:
    """Time reports out of plain values: ticks, received (UTC text), light_time_s, boot_count.

    Raises
    ------
    InvalidInput
        If a value is missing or cannot be read.
    """
    points = []
    for number, one in enumerate(given):
        try:
            points.append(
                TimePoint(
                    ticks=int(one["ticks"]),
                    earth_utc_ns=time_of(one["received"], f"points.{number}.received"),
                    light_time_ns=round(float(one["light_time_s"]) * 1e9),
                    boot_count=int(one.get("boot_count") or 0),
                )
            )
        except (KeyError, TypeError, ValueError, LunarError) as error:
            raise InvalidInput(
                "time report", f"points.{number}", "ticks, received and light_time_s", str(error)[:120]
            ) from None
    return points


def _vehicle(ground: Ground, spacecraft_id: int, instance: str) -> int:
    with ground.database.reading() as connection:
        row = repository.find(connection, repository.VEHICLES, ccsds_id=spacecraft_id, instance=instance)
    if row is None:
        raise NotFound("spacecraft", f"{spacecraft_id} ({instance})")
    return int(row["id"])
