"""HTTP operations on stored display objects."""

from __future__ import annotations

from typing import Annotated

from fastapi import Path, Response

from ground_service.access.security import Operator, Viewer, add_list
from ground_service.displays import service, store
from ground_service.displays.model import KEY_PATTERN, Display, DisplayIn
from ground_service.http.common import GroundOf
from ground_service.http.requests import operations, problems

DisplayKey = Annotated[str, Path(pattern=KEY_PATTERN)]

displays = operations("displays")


add_list(displays, "/displays", store.list_displays)


@displays.get("/displays/{key}")
def get_display(ground: GroundOf, _: Viewer, key: DisplayKey) -> Display:
    """Show a stored object of the telemetry displays."""
    return ground.read(store.get, key)


@displays.put("/displays/{key}", responses=problems(409))
def keep_display(ground: GroundOf, caller: Operator, key: DisplayKey, given: DisplayIn) -> Display:
    """Keep an object of the telemetry displays; it replaces the stated version only."""
    return service.keep_display(ground, key, given, actor=caller.name)


@displays.delete("/displays/{key}", status_code=204)
def delete_display(ground: GroundOf, caller: Operator, key: DisplayKey) -> Response:
    """Delete a stored object of the telemetry displays."""
    service.delete_display(ground, key, actor=caller.name)
    return Response(status_code=204)
