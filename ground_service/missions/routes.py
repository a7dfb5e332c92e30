"""HTTP operations on mission descriptions."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Body, Path

from ground_service.http.common import (
    API_PREFIX,
    PROBLEMS,
    GroundOf,
    Limit,
    Offset,
    Operator,
    Viewer,
    page_of,
)
from ground_service.http.requests import StrictRoute
from ground_service.http.schemas import PageOf
from ground_service.missions import service
from ground_service.missions.model import MissionDetail, MissionRevision

missions = APIRouter(route_class=StrictRoute, prefix=API_PREFIX, responses=PROBLEMS, tags=["missions"])

Text = Annotated[bytes, Body(media_type="text/plain", description="mission.toml")]
Revision = Annotated[str, Path(pattern=r"^[0-9a-f]{8,64}$", description="Hash or its first digits")]


@missions.get("/missions", response_model=PageOf[MissionRevision], operation_id="list_missions")
def list_missions(ground: GroundOf, _: Viewer, limit: Limit = 100, offset: Offset = 0) -> Any:
    """List the revisions of mission descriptions, newest first."""
    items, total = service.list_missions(ground, limit=limit, offset=offset)
    return page_of(items, total, limit, offset)


@missions.post("/missions", status_code=201, response_model=MissionDetail, operation_id="add_mission")
def add_mission(ground: GroundOf, caller: Operator, document: Text) -> Any:
    """Add a mission description (TOML) as a revision; the same content gives the same revision.

    Only an administrator may change which telecommands need a second person.
    """
    return service.add_mission(
        ground, document, source="body", actor=caller.name, may_change_approval=caller.role == "admin"
    )


@missions.get("/missions/{revision}", response_model=MissionDetail, operation_id="get_mission")
def get_mission(ground: GroundOf, _: Viewer, revision: Revision) -> Any:
    """Return a revision with its document."""
    return service.get_mission(ground, revision)
