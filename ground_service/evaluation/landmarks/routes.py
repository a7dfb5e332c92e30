"""HTTP operations on landmarks learned from flight."""

from fastapi import Response

from ground_service.access.security import Operator, Viewer, add_list
from ground_service.evaluation.landmarks import service
from ground_service.evaluation.landmarks.model import LandmarkDecision, LandmarkDetail, LandmarkUpdate
from ground_service.http.common import GroundOf, PassId, RowId
from ground_service.http.requests import operations, problems

landmarks = operations("landmarks")


add_list(landmarks, "/landmarks", service.list_landmarks)


@landmarks.get("/landmarks/{landmark_id}", responses=problems(404))
def get_landmark(ground: GroundOf, _: Viewer, landmark_id: RowId) -> LandmarkDetail:
    """Return a landmark with its sightings and their images."""
    return service.get_landmark(ground, landmark_id)


@landmarks.post("/landmarks/{landmark_id}/accept", responses=problems(404, 409))
def accept_landmark(
    ground: GroundOf, caller: Operator, landmark_id: RowId, decision: LandmarkDecision = LandmarkDecision()
) -> LandmarkDetail:
    """Accept a proposed landmark as a crater of the next anchoring catalogue."""
    return service.decide_landmark(ground, landmark_id, accept=True, reason=decision.reason, actor=caller.name)


@landmarks.post("/landmarks/{landmark_id}/reject", responses=problems(404, 409))
def reject_landmark(
    ground: GroundOf, caller: Operator, landmark_id: RowId, decision: LandmarkDecision = LandmarkDecision()
) -> LandmarkDetail:
    """Reject a proposed landmark."""
    return service.decide_landmark(ground, landmark_id, accept=False, reason=decision.reason, actor=caller.name)


@landmarks.post("/passes/{pass_id}/landmarks", responses=problems(404, 409))
def find_landmarks(ground: GroundOf, caller: Operator, pass_id: PassId) -> LandmarkUpdate:
    """Search a pass for landmarks and enter them; what the pass said before is replaced."""
    return service.update_landmarks(ground, pass_id)


@landmarks.get(
    "/passes/{pass_id}/anchoring-table",
    response_class=Response,
    responses={200: {"content": {"application/octet-stream": {}}, "description": "The table"}},
)
def get_onboard_table(ground: GroundOf, _: Viewer, pass_id: PassId) -> Response:
    """Return the anchoring table that was on board at the end of a pass."""
    return Response(service.onboard_table(ground, pass_id), media_type="application/octet-stream")
