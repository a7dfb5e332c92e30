"""Operations on time: correlations of a spacecraft's clock and the time reports that they rest on."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter

from ground_service.http import schemas
from ground_service.http.common import (
    API_PREFIX,
    PROBLEMS,
    GroundOf,
    Instance,
    Operator,
    SpacecraftId,
    Viewer,
    page_of,
)
from ground_service.http.requests import StrictRoute
from ground_service.http.views import correlation_view, time_report_view
from ground_service.ingest.service import FLOWN
from ground_service.timekeeping.recorrelation import enter_receptions, received_reports
from ground_service.timekeeping.service import (
    correlate_again,
    correlate_spacecraft,
    spacecraft_correlations,
    spacecraft_time_reports,
    time_points,
)

timekeeping = APIRouter(route_class=StrictRoute, prefix=API_PREFIX, responses=PROBLEMS)


@timekeeping.get(
    "/spacecraft/{spacecraft_id}/correlations", response_model=schemas.PageOf[schemas.Correlation]
)
def list_correlations(
    ground: GroundOf, _: Viewer, spacecraft_id: SpacecraftId, instance: Instance = FLOWN
) -> Any:
    """Time correlations that a spacecraft ever had, the newest first."""
    rows = spacecraft_correlations(ground, spacecraft_id, instance)
    return page_of([correlation_view(row) for row in rows], len(rows), max(len(rows), 1), 0)


@timekeeping.post(
    "/spacecraft/{spacecraft_id}/correlations",
    status_code=201,
    response_model=schemas.PageOf[schemas.Correlation],
)
def add_correlations(
    ground: GroundOf,
    caller: Operator,
    spacecraft_id: SpacecraftId,
    given: schemas.TimePoints,
    instance: Instance = FLOWN,
) -> Any:
    """Correlate on-board time with UTC from time reports; what is derived from ticks follows at once."""
    points = time_points([point.model_dump() for point in given.points])
    rows = correlate_spacecraft(ground, spacecraft_id, instance, points, actor=caller.name)
    return page_of([correlation_view(row) for row in rows], len(rows), max(len(rows), 1), 0)


@timekeeping.post(
    "/spacecraft/{spacecraft_id}/correlations/run", response_model=schemas.PageOf[schemas.Correlation]
)
def run_correlation(
    ground: GroundOf, caller: Operator, spacecraft_id: SpacecraftId, instance: Instance = FLOWN
) -> Any:
    """Correlate from the received time reports now, also over what was entered by hand; what is then in force.

    New telemetry, receptions and ephemerides do that by themselves.
    """
    rows = correlate_again(ground, spacecraft_id, instance, actor=caller.name)
    return page_of([correlation_view(row) for row in rows], len(rows), max(len(rows), 1), 0)


@timekeeping.post(
    "/spacecraft/{spacecraft_id}/receptions",
    status_code=201,
    response_model=schemas.PageOf[schemas.Correlation],
)
def add_receptions(
    ground: GroundOf,
    caller: Operator,
    spacecraft_id: SpacecraftId,
    given: schemas.Receptions,
    instance: Instance = FLOWN,
) -> Any:
    """Tell when time reports were received on the Earth; the correlations then in force."""
    reports = received_reports([one.model_dump() for one in given.receptions])
    rows = enter_receptions(ground, spacecraft_id, instance, reports, actor=caller.name)
    return page_of([correlation_view(row) for row in rows], len(rows), max(len(rows), 1), 0)


@timekeeping.get(
    "/spacecraft/{spacecraft_id}/time-reports", response_model=schemas.PageOf[schemas.TimeReportItem]
)
def list_time_reports(
    ground: GroundOf, _: Viewer, spacecraft_id: SpacecraftId, instance: Instance = FLOWN
) -> Any:
    """Received time reports with their light time and what the correlations in force leave of them."""
    rows = spacecraft_time_reports(ground, spacecraft_id, instance)
    return page_of([time_report_view(row) for row in rows], len(rows), max(len(rows), 1), 0)
