"""HTTP operations on time correlations and time reports."""

from __future__ import annotations

from ground_service.access.security import Operator, Viewer
from ground_service.http.common import GroundOf, Instance, SpacecraftId
from ground_service.http.model import PageOf
from ground_service.http.requests import operations
from ground_service.ingest.service import FLOWN
from ground_service.timekeeping.model import Correlation, Receptions, TimePoints, TimeReport
from ground_service.timekeeping.recorrelation import enter_receptions, received_reports
from ground_service.timekeeping.service import (
    correlate_again,
    correlate_spacecraft,
    spacecraft_correlations,
    spacecraft_time_reports,
    time_points,
)
from ground_service.timekeeping.store import correlation_of

timekeeping = operations("time")


@timekeeping.get("/spacecraft/{spacecraft_id}/correlations")
def list_correlations(
    ground: GroundOf, _: Viewer, spacecraft_id: SpacecraftId, instance: Instance = FLOWN
) -> PageOf[Correlation]:
    """List all time correlations of a spacecraft, newest first."""
    rows = spacecraft_correlations(ground, spacecraft_id, instance)
    return PageOf.all_of([correlation_of(row) for row in rows])


@timekeeping.post("/spacecraft/{spacecraft_id}/correlations", status_code=201)
def add_correlations(
    ground: GroundOf,
    caller: Operator,
    spacecraft_id: SpacecraftId,
    given: TimePoints,
    instance: Instance = FLOWN,
) -> PageOf[Correlation]:
    """Add time reports and correlate on-board time with UTC from them; the correlations then in force."""
    points = time_points([vars(point) for point in given.points])
    rows = correlate_spacecraft(ground, spacecraft_id, instance, points, actor=caller.name)
    return PageOf.all_of([correlation_of(row) for row in rows])


@timekeeping.post("/spacecraft/{spacecraft_id}/correlations/run")
def run_correlation(
    ground: GroundOf, caller: Operator, spacecraft_id: SpacecraftId, instance: Instance = FLOWN
) -> PageOf[Correlation]:
    """Run the correlation from the received time reports; it also replaces correlations that were added by hand.

    It returns the correlations then in force. New telemetry, receptions and ephemerides are correlated automatically.
    """
    rows = correlate_again(ground, spacecraft_id, instance, actor=caller.name)
    return PageOf.all_of([correlation_of(row) for row in rows])


@timekeeping.post("/spacecraft/{spacecraft_id}/receptions", status_code=201)
def add_receptions(
    ground: GroundOf,
    caller: Operator,
    spacecraft_id: SpacecraftId,
    given: Receptions,
    instance: Instance = FLOWN,
) -> PageOf[Correlation]:
    """Add Earth reception times of time reports; the correlations then in force."""
    reports = received_reports([vars(one) for one in given.receptions])
    rows = enter_receptions(ground, spacecraft_id, instance, reports, actor=caller.name)
    return PageOf.all_of([correlation_of(row) for row in rows])


@timekeeping.get("/spacecraft/{spacecraft_id}/time-reports")
def list_time_reports(
    ground: GroundOf, _: Viewer, spacecraft_id: SpacecraftId, instance: Instance = FLOWN
) -> PageOf[TimeReport]:
    """List the received time reports with their light time and residuals."""
    rows = spacecraft_time_reports(ground, spacecraft_id, instance)
    return PageOf.all_of([TimeReport.of(row) for row in rows])
