"""HTTP operations on time correlations and time reports."""

from ground_service.access.security import Operator, Viewer
from ground_service.http.common import GroundOf, Instance, SpacecraftId
from ground_service.http.model import PageOf
from ground_service.http.requests import operations, problems
from ground_service.missions.timekeeping import recorrelation
from ground_service.missions.timekeeping.model import Correlation, Receptions, TimePoints, TimeReport
from ground_service.missions.timekeeping.recorrelation import (
    TimePoint,
    correlate_again,
    correlate_spacecraft,
    enter_receptions,
    received_reports,
    spacecraft_correlations,
    spacecraft_time_reports,
)
from ground_service.store.vehicles import FLOWN

timekeeping = operations("time")


@timekeeping.get("/spacecraft/{spacecraft_id}/correlations")
def list_correlations(
    ground: GroundOf, _: Viewer, spacecraft_id: SpacecraftId, instance: Instance = FLOWN
) -> PageOf[Correlation]:
    """List all time correlations of a spacecraft, newest first."""
    return PageOf.all_of(spacecraft_correlations(ground, spacecraft_id, instance))


@timekeeping.post("/spacecraft/{spacecraft_id}/correlations", status_code=201)
def add_correlations(
    ground: GroundOf, caller: Operator, spacecraft_id: SpacecraftId, given: TimePoints, instance: Instance = FLOWN
) -> PageOf[Correlation]:
    """Add time reports and correlate on-board time with UTC from them; the correlations then in force."""
    points = [
        TimePoint(one.ticks, one.received.utc_ns, round(one.light_time_s * 1e9), one.boot_count) for one in given.points
    ]
    return PageOf.all_of(correlate_spacecraft(ground, spacecraft_id, instance, points, actor=caller.name))


@timekeeping.delete("/spacecraft/{spacecraft_id}/correlations", responses=problems(409))
def withdraw_correlations(
    ground: GroundOf, caller: Operator, spacecraft_id: SpacecraftId, instance: Instance = FLOWN
) -> PageOf[Correlation]:
    """Withdraw correlations that were added by hand: those of the received time reports are in force again.

    The withdrawn ones stay in the list.
    """
    found = recorrelation.withdraw_correlations(ground, spacecraft_id, instance, actor=caller.name)
    return PageOf.all_of(found)


@timekeeping.post("/spacecraft/{spacecraft_id}/correlations/run")
def run_correlation(
    ground: GroundOf, caller: Operator, spacecraft_id: SpacecraftId, instance: Instance = FLOWN
) -> PageOf[Correlation]:
    """Run the correlation from the received time reports; it also replaces correlations that were added by hand.

    It returns the correlations then in force. New telemetry, receptions and ephemerides are correlated automatically.
    """
    return PageOf.all_of(correlate_again(ground, spacecraft_id, instance, actor=caller.name))


@timekeeping.post("/spacecraft/{spacecraft_id}/receptions", status_code=201)
def add_receptions(
    ground: GroundOf, caller: Operator, spacecraft_id: SpacecraftId, given: Receptions, instance: Instance = FLOWN
) -> PageOf[Correlation]:
    """Add Earth reception times of time reports; the correlations then in force."""
    reports = received_reports([vars(one) for one in given.receptions])
    return PageOf.all_of(enter_receptions(ground, spacecraft_id, instance, reports, actor=caller.name))


@timekeeping.get("/spacecraft/{spacecraft_id}/time-reports")
def list_time_reports(
    ground: GroundOf, _: Viewer, spacecraft_id: SpacecraftId, instance: Instance = FLOWN
) -> PageOf[TimeReport]:
    """List the received time reports with their light time and residuals."""
    return PageOf.all_of(spacecraft_time_reports(ground, spacecraft_id, instance))
