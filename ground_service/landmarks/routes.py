"""HTTP operations on landmarks learned from flight."""

from __future__ import annotations

from typing import Annotated

from fastapi import Query

from ground_service.access.security import Operator, Viewer
from ground_service.http.common import GroundOf, PagingOf, PassId, RowId
from ground_service.http.model import PageOf
from ground_service.http.requests import operations, problems
from ground_service.landmarks import service
from ground_service.landmarks.model import (
    Landmark,
    LandmarkDecision,
    LandmarkDetail,
    LandmarkState,
    LandmarkUpdate,
)

landmarks = operations("landmarks")


@landmarks.get("/landmarks")
def list_landmarks(
    ground: GroundOf,
    _: Viewer,
    paging: PagingOf,
    spacecraft_id: Annotated[int | None, Query(ge=0, le=1023)] = None,
    state: Annotated[LandmarkState | None, Query()] = None,
) -> PageOf[Landmark]:
    """List the landmarks learned from flight, most passes first."""
    items, total = service.list_landmarks(
        ground, spacecraft_id=spacecraft_id, state=state, limit=paging.limit, offset=paging.offset
    )
    return paging.page(items, total)


@landmarks.get("/landmarks/{landmark_id}", responses=problems(404))
def get_landmark(ground: GroundOf, _: Viewer, landmark_id: RowId) -> LandmarkDetail:
    """Return a landmark with its sightings and their images."""
    return service.get_landmark(ground, landmark_id)


@landmarks.post("/landmarks/{landmark_id}/accept", responses=problems(404, 409))
def accept_landmark(
    ground: GroundOf, caller: Operator, landmark_id: RowId, decision: LandmarkDecision
) -> LandmarkDetail:
    """Accept a proposed landmark as a crater of the next anchoring catalogue."""
    return service.decide_landmark(
        ground, landmark_id, accept=True, reason=decision.reason, actor=caller.name
    )


@landmarks.post("/landmarks/{landmark_id}/reject", responses=problems(404, 409))
def reject_landmark(
    ground: GroundOf, caller: Operator, landmark_id: RowId, decision: LandmarkDecision
) -> LandmarkDetail:
    """Reject a proposed landmark."""
    return service.decide_landmark(
        ground, landmark_id, accept=False, reason=decision.reason, actor=caller.name
    )


@landmarks.post("/passes/{pass_id}/landmarks", responses=problems(404, 409))
def find_landmarks(ground: GroundOf, caller: Operator, pass_id: PassId) -> LandmarkUpdate:
    """Search a pass for landmarks and enter them; what the pass said before is replaced."""
    return service.update_landmarks(ground, pass_id)
