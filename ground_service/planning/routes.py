"""Operations on planned windows."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Header, Query, Response

from ground_service.access.idempotency import once
from ground_service.commanding import service as commanding
from ground_service.http import schemas
from ground_service.http.common import (
    API_PREFIX,
    PROBLEMS,
    GroundOf,
    Limit,
    Offset,
    OnceKey,
    Operator,
    PassId,
    Viewer,
    page_of,
)
from ground_service.http.problems import PreconditionFailed
from ground_service.http.requests import StrictRoute
from ground_service.http.views import search_view, telecommand_view, window_view
from ground_service.planning import exchange as plan_exchange
from ground_service.planning import model as plan_schemas
from ground_service.planning import requests as plan_requests
from ground_service.planning import service as plan_service
from ground_service.store.repository import Row

planning = APIRouter(route_class=StrictRoute, prefix=API_PREFIX, responses=PROBLEMS, tags=["planning"])

IfMatch = Annotated[
    str | None, Header(alias="If-Match", max_length=200, description="Change only what was seen: its ETag")
]


@planning.post("/windows/search", response_model=plan_schemas.SearchOut)
def search_windows(ground: GroundOf, _: Viewer, given: plan_schemas.WindowSearch) -> Any:
    """Candidate windows by constraints over a reference ephemeris."""
    return search_view(*plan_requests.search(ground, given))


@planning.get("/windows", response_model=schemas.PageOf[plan_schemas.WindowOut])
def list_windows(
    ground: GroundOf,
    _: Viewer,
    state: Annotated[plan_schemas.WindowState | None, Query()] = None,
    limit: Limit = 100,
    offset: Offset = 0,
) -> Any:
    """Planned windows, the newest first."""
    rows, total = plan_service.list_windows(ground, state=state, limit=limit, offset=offset)
    return page_of([window_view(row) for row in rows], total, limit, offset)


@planning.post("/windows", status_code=201, response_model=plan_schemas.WindowOut)
def add_window(
    response: Response,
    ground: GroundOf,
    caller: Operator,
    given: plan_schemas.WindowIn,
    idempotency_key: OnceKey = None,
) -> Any:
    """Enter a window as a draft; conflicts with committed windows or with resources are answered with 409."""
    view = once(
        ground,
        actor=caller.name,
        operation="window",
        key=idempotency_key,
        request=given.model_dump(mode="json"),
        work=lambda: window_view(
            plan_service.add_window(ground, plan_requests.window_entry(given), actor=caller.name)
        ),
    )
    response.headers["Location"] = f"{API_PREFIX}/windows/{view['id']}"
    response.headers["ETag"] = _tag(view)
    return view


@planning.get("/windows/{window_id}", response_model=plan_schemas.WindowOut)
def get_window(response: Response, ground: GroundOf, _: Viewer, window_id: PassId) -> Any:
    """One planned window."""
    return _tagged(response, plan_service.get_window(ground, window_id))


@planning.patch("/windows/{window_id}", response_model=plan_schemas.WindowOut)
def change_window(
    response: Response,
    ground: GroundOf,
    caller: Operator,
    window_id: PassId,
    given: plan_schemas.WindowChange,
    if_match: IfMatch = None,
) -> Any:
    """Change a draft, or approve a window, make it a draft again, or declare it failed."""
    row = plan_service.change_window(
        ground,
        window_id,
        actor=caller.name,
        changes=plan_requests.window_changes(given),
        decision=given.state,
        reason=given.reason,
        expected=lambda row: _expect(row, if_match),
    )
    return _tagged(response, row)


@planning.delete("/windows/{window_id}", status_code=204)
def delete_window(
    ground: GroundOf, caller: Operator, window_id: PassId, if_match: IfMatch = None
) -> Response:
    """Take a window off the plan."""
    plan_service.delete_window(
        ground, window_id, actor=caller.name, expected=lambda row: _expect(row, if_match)
    )
    return Response(status_code=204)


@planning.post("/windows/{window_id}/uplink", response_model=schemas.PageOf[schemas.Telecommand])
def uplink_window(ground: GroundOf, caller: Operator, window_id: PassId) -> Any:
    """Release the time-tagged telecommands of an approved window; `POST uplink` then gives their octets."""
    ids = plan_service.uplink_window(ground, window_id, actor=caller.name)
    views = [telecommand_view(commanding.get_command(ground, key)) for key in ids]
    return page_of(views, len(views), max(len(views), 1), 0)


@planning.get("/plan", response_model=plan_schemas.Plan)
def export_plan(ground: GroundOf, _: Viewer) -> Any:
    """All windows that have not failed, as a plan that another service can take."""
    return plan_exchange.export_plan(ground)


@planning.post("/plan", status_code=201, response_model=plan_schemas.Imported)
def import_plan(ground: GroundOf, caller: Operator, given: plan_schemas.Plan) -> Any:
    """Enter all windows of a plan as drafts, or none of them; windows that are there already are left alone."""
    entries = plan_requests.plan_entries(given)
    return {"windows": plan_exchange.import_plan(ground, entries, actor=caller.name)}


def _tag(row: Row) -> str:
    return f'"window-{row["id"]}-{row["version"]}-{row["state"]}"'


def _tagged(response: Response, row: Row) -> Any:
    response.headers["ETag"] = _tag(row)
    return window_view(row)


def _expect(row: Row, if_match: str | None) -> None:
    if if_match is not None and if_match.strip() != "*" and _tag(row) not in if_match:
        raise PreconditionFailed(f"window {row['id']}: expected {if_match[:80]}, found {_tag(row)}")
