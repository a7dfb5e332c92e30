"""HTTP operations on standing requests."""

from __future__ import annotations

from fastapi import Response

from ground_service.access.idempotency import added_once
from ground_service.access.security import Operator, Viewer, add_list
from ground_service.http.common import API_PREFIX, GroundOf, OnceKey, PassId
from ground_service.http.requests import operations, problems
from ground_service.planning import request_store, standing
from ground_service.planning.model import (
    RequestPlan,
    StandingRequest,
    StandingRequestChange,
    StandingRequestIn,
)

requests = operations("requests")


add_list(requests, "/requests", request_store.list_requests)


@requests.post("/requests", status_code=201)
def add_request(
    response: Response,
    ground: GroundOf,
    caller: Operator,
    request: StandingRequestIn,
    idempotency_key: OnceKey = None,
) -> StandingRequest:
    """Add a standing request; the planner fills the coming days from then on."""

    def add() -> StandingRequest:
        return standing.add_request(ground, request, actor=caller.name)

    added = added_once(ground, StandingRequest, caller.name, idempotency_key, request, add)
    response.headers["Location"] = f"{API_PREFIX}/requests/{added.id}"
    return added


@requests.get("/requests/{request_id}")
def get_request(ground: GroundOf, _: Viewer, request_id: PassId) -> StandingRequest:
    """Show a standing request with the numbers of its windows."""
    return ground.read(request_store.get_request, request_id)


@requests.patch("/requests/{request_id}", responses=problems(409))
def change_request(
    ground: GroundOf, caller: Operator, request_id: PassId, change: StandingRequestChange
) -> StandingRequest:
    """Pause or resume a standing request, or replace its terms; planned windows stay."""
    return standing.change_request(ground, request_id, change, actor=caller.name)


@requests.delete("/requests/{request_id}", status_code=204)
def delete_request(ground: GroundOf, caller: Operator, request_id: PassId) -> Response:
    """Delete a standing request; its windows stay in the plan."""
    standing.delete_request(ground, request_id, actor=caller.name)
    return Response(status_code=204)


@requests.get("/requests/{request_id}/plan")
def get_request_plan(ground: GroundOf, _: Viewer, request_id: PassId) -> RequestPlan:
    """Show the last plan: every candidate window, planned or rejected with the reason."""
    return ground.read(request_store.get_plan, request_id)
