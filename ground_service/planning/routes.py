"""HTTP operations on planned windows and standing requests."""

from typing import Annotated

from fastapi import Header, Query, Response

from ground_service.access.security import Operator, Viewer, add_list, added_once
from ground_service.contacts.commanding import service as commanding
from ground_service.contacts.commanding.model import Telecommand
from ground_service.http.common import API_PREFIX, IF_MATCH_HEADER, GroundOf, Instance, OnceKey, PassId
from ground_service.http.model import PageOf, RequestTime
from ground_service.http.problems import PreconditionFailed
from ground_service.http.requests import operations, problems
from ground_service.missions import service as missions
from ground_service.missions.model import MissionCheck
from ground_service.missions.routes import Text
from ground_service.planning import forecast, model, service, standing, store
from ground_service.planning.dry_run import rehearsed

planning = operations("planning")

IfMatch = Annotated[
    str | None, Header(alias=IF_MATCH_HEADER, max_length=200, description="ETag of the version to change")
]


@planning.post("/missions/check")
def check_mission(
    ground: GroundOf,
    caller: Operator,
    document: Text,
    plan: Annotated[bool, Query(description="Also make a dry run of the planner")] = False,
) -> MissionCheck:
    """Check a mission description and compare it with the revision in force of its spacecraft; add nothing."""
    checked = missions.check_mission(ground, document, caller=caller)
    if not plan or checked.faults:
        return checked
    flown = rehearsed(ground, document)
    windows = tuple((one.start, one.stop) for one in flown.windows)
    return checked.model_copy(update={"windows": windows, "contradictions": flown.faults})


@planning.post("/windows/search", responses=problems(404))
def search_windows(
    ground: GroundOf, _: Viewer, constraints: model.WindowSearch = model.WindowSearch()
) -> model.SearchResult:
    """Search candidate windows by constraints over a reference ephemeris."""
    return service.search_windows(ground, constraints)


add_list(planning, "/windows", store.list_windows)


@planning.post("/windows", status_code=201, responses=problems(404))
def add_window(
    response: Response, ground: GroundOf, caller: Operator, window: model.WindowIn, idempotency_key: OnceKey = None
) -> model.Window:
    """Add a window as a draft; 409 lists the conflicts with committed windows and resources."""

    def add() -> model.Window:
        return service.add_window(ground, window.entry(), actor=caller.name)

    added = added_once(ground, model.Window, caller.name, idempotency_key, window, add)
    response.headers["Location"] = f"{API_PREFIX}/windows/{added.id}"
    return _tagged(response, added)


@planning.get("/windows/{window_id}")
def get_window(response: Response, ground: GroundOf, _: Viewer, window_id: PassId) -> model.Window:
    """Show a planned window."""
    return _tagged(response, ground.read(store.get_window, window_id))


@planning.patch("/windows/{window_id}", responses=problems(409))
def change_window(
    response: Response,
    ground: GroundOf,
    caller: Operator,
    window_id: PassId,
    change: model.WindowChange,
    if_match: IfMatch = None,
) -> model.Window:
    """Change a draft, approve a window, make it a draft again, or declare it failed."""
    window = service.change_window(
        ground,
        window_id,
        actor=caller.name,
        changes=change.changes(),
        decision=change.state,
        reason=change.reason,
        expected=lambda found: _expect(found, if_match),
    )
    return _tagged(response, window)


@planning.delete("/windows/{window_id}", status_code=204, responses=problems(409))
def delete_window(ground: GroundOf, caller: Operator, window_id: PassId, if_match: IfMatch = None) -> Response:
    """Delete a window from the plan."""
    service.delete_window(ground, window_id, actor=caller.name, expected=lambda found: _expect(found, if_match))
    return Response(status_code=204)


@planning.post("/windows/{window_id}/uplink", responses=problems(409))
def uplink_window(ground: GroundOf, caller: Operator, window_id: PassId) -> PageOf[Telecommand]:
    """Release the time-tagged telecommands of an approved window; `POST uplink` then gives their octets."""
    ids = service.uplink_window(ground, window_id, actor=caller.name)
    return PageOf.all_of([commanding.get_command(ground, key).telecommand for key in ids])


@planning.get("/windows/{window_id}/telecommands")
def get_planned_telecommands(ground: GroundOf, _: Viewer, window_id: PassId) -> PageOf[model.PlannedTelecommand]:
    """Show the telecommands that an uplink of the window would release, with their times; nothing is released."""
    return PageOf.all_of(service.preview_window(ground, window_id))


@planning.get("/plan/forecast", responses=problems(404))
def get_forecast(
    ground: GroundOf,
    _: Viewer,
    spacecraft_id: Annotated[int, Query(ge=0, le=1023, examples=[76])],
    start: Annotated[RequestTime, Query(examples=["2029-08-07T00:00:00Z"])],
    stop: Annotated[RequestTime, Query(examples=["2029-08-08T00:00:00Z"], description="At most 8 days later")],
    instance: Instance = "flight",
    ephemeris_id: Annotated[int | None, Query(ge=1, le=2**31 - 1)] = None,
) -> model.PlanForecast:
    """Return Sun elevation, ground track, battery, storage and downlink of the plan, and its conflicts."""
    return forecast.get_forecast(
        ground,
        spacecraft_id=spacecraft_id,
        instance=instance,
        start_utc_ns=start.utc_ns,
        stop_utc_ns=stop.utc_ns,
        ephemeris_id=ephemeris_id,
    )


@planning.get("/plan/crater-density")
def get_crater_density(
    ground: GroundOf, _: Viewer, spacecraft_id: Annotated[int, Query(ge=0, le=1023, examples=[76])]
) -> model.CraterDensity:
    """Return the density of craters of 5 to 30 km in the catalogue of the mission description."""
    return forecast.crater_density(ground, spacecraft_id)


def _tag(window: model.Window) -> str:
    return f'"window-{window.id}-{window.version}-{window.state}"'


def _tagged(response: Response, window: model.Window) -> model.Window:
    response.headers["ETag"] = _tag(window)
    return window


def _expect(found: model.Window, if_match: str | None) -> None:
    if if_match is not None and if_match.strip() != "*" and _tag(found) not in if_match:
        raise PreconditionFailed(f"window {found.id}: expected {if_match[:80]}, found {_tag(found)}")


requests = operations("requests")


add_list(requests, "/requests", store.list_requests)


@requests.post("/requests", status_code=201)
def add_request(
    response: Response,
    ground: GroundOf,
    caller: Operator,
    request: model.StandingRequestIn,
    idempotency_key: OnceKey = None,
) -> model.StandingRequest:
    """Add a standing request; the planner fills the coming days from then on."""

    def add() -> model.StandingRequest:
        return standing.add_request(ground, request, actor=caller.name)

    added = added_once(ground, model.StandingRequest, caller.name, idempotency_key, request, add)
    response.headers["Location"] = f"{API_PREFIX}/requests/{added.id}"
    return added


@requests.get("/requests/{request_id}")
def get_request(ground: GroundOf, _: Viewer, request_id: PassId) -> model.StandingRequest:
    """Show a standing request with the numbers of its windows."""
    return ground.read(store.get_request, request_id)


@requests.patch("/requests/{request_id}", responses=problems(409))
def change_request(
    ground: GroundOf, caller: Operator, request_id: PassId, change: model.StandingRequestChange
) -> model.StandingRequest:
    """Pause or resume a standing request, or replace its terms; planned windows stay."""
    return standing.change_request(ground, request_id, change, actor=caller.name)


@requests.delete("/requests/{request_id}", status_code=204)
def delete_request(ground: GroundOf, caller: Operator, request_id: PassId) -> Response:
    """Delete a standing request; its windows stay in the plan."""
    standing.delete_request(ground, request_id, actor=caller.name)
    return Response(status_code=204)


@requests.get("/requests/{request_id}/plan")
def get_request_plan(ground: GroundOf, _: Viewer, request_id: PassId) -> model.RequestPlan:
    """Show the last plan: every candidate window, planned or rejected with the reason."""
    return ground.read(store.get_plan, request_id)
