"""Operations on telecommands and the uplink."""

from __future__ import annotations

import base64
from typing import Annotated, Any

from fastapi import APIRouter, Query, Response

from ground_service.access.idempotency import once
from ground_service.commanding import service as commanding
from ground_service.commanding.receiver import uplink_state
from ground_service.http import schemas
from ground_service.http.common import (
    API_PREFIX,
    PROBLEMS,
    GroundOf,
    Instance,
    Limit,
    Offset,
    OnceKey,
    Operator,
    RowId,
    SpacecraftId,
    Viewer,
    page_of,
)
from ground_service.http.requests import StrictRoute
from ground_service.http.views import telecommand_view
from ground_service.ingest.service import FLOWN

telecommands = APIRouter(
    route_class=StrictRoute, prefix=API_PREFIX, responses=PROBLEMS, tags=["telecommands"]
)


@telecommands.get("/telecommands", response_model=schemas.PageOf[schemas.Telecommand])
def list_telecommands(
    ground: GroundOf,
    _: Viewer,
    state: Annotated[str | None, Query(pattern="^(queued|released|rejected|sent)$")] = None,
    limit: Limit = 100,
    offset: Offset = 0,
) -> Any:
    """Telecommands with their verification, the newest first."""
    views, total = commanding.list_commands(ground, state=state, limit=limit, offset=offset)
    return page_of([telecommand_view(view) for view in views], total, limit, offset)


@telecommands.post("/telecommands", status_code=201, response_model=schemas.Telecommand)
def entertelecommand_view(
    ground: GroundOf, caller: Operator, given: schemas.CommandEntry, idempotency_key: OnceKey = None
) -> Any:
    """Queue a telecommand; the dictionary has to accept it."""

    def enter() -> dict[str, Any]:
        command_id = commanding.enter_command(
            ground,
            given.name,
            given.arguments,
            spacecraft_id=given.spacecraft_id,
            instance=given.instance,
            timeout_s=given.timeout_s,
            actor=caller.name,
        )
        return telecommand_view(commanding.get_command(ground, command_id))

    return once(
        ground,
        actor=caller.name,
        operation="telecommand",
        key=idempotency_key,
        request=given.model_dump(mode="json"),
        work=enter,
    )


@telecommands.get("/telecommands/{command_id}", response_model=schemas.Telecommand)
def gettelecommand_view(ground: GroundOf, _: Viewer, command_id: RowId) -> Any:
    """One telecommand with its verification."""
    return telecommand_view(commanding.get_command(ground, command_id))


@telecommands.post("/telecommands/{command_id}/release", response_model=schemas.Telecommand)
def releasetelecommand_view(ground: GroundOf, caller: Operator, command_id: RowId) -> Any:
    """Release a queued telecommand; a critical one by another person than who entered it."""
    commanding.release_command(ground, command_id, actor=caller.name)
    return telecommand_view(commanding.get_command(ground, command_id))


@telecommands.post("/telecommands/{command_id}/reject", response_model=schemas.Telecommand)
def rejecttelecommand_view(
    ground: GroundOf, caller: Operator, command_id: RowId, given: schemas.Rejection
) -> Any:
    """Take a queued telecommand out of the queue."""
    commanding.reject_command(ground, command_id, actor=caller.name, reason=given.reason)
    return telecommand_view(commanding.get_command(ground, command_id))


@telecommands.get("/spacecraft/{spacecraft_id}/uplink", response_model=schemas.UplinkState)
def get_uplink_state(
    ground: GroundOf, _: Viewer, spacecraft_id: SpacecraftId, instance: Instance = FLOWN
) -> Any:
    """The state of a spacecraft's telecommand receiver, by the control words of its newest telemetry."""
    return uplink_state(ground, spacecraft_id, instance)


@telecommands.post(
    "/uplink",
    response_class=Response,
    responses={200: {"content": {"application/octet-stream": {}}, "description": "What is to be sent now"}},
)
def take_uplink(
    ground: GroundOf,
    caller: Operator,
    spacecraft_id: Annotated[int, Query(ge=0, le=1023)],
    instance: Instance = FLOWN,
    format: Annotated[str, Query(pattern="^(cltu|packets)$")] = "cltu",
    idempotency_key: OnceKey = None,
) -> Response:
    """Take all released telecommands as octets to radiate; they count as sent from then on.

    With an idempotency key, an answer that was lost on its way can be asked for again.
    """

    def take() -> dict[str, Any]:
        stream, ids = commanding.take_uplink(
            ground, spacecraft_id=spacecraft_id, instance=instance, framed=format == "cltu", actor=caller.name
        )
        return {"octets": base64.b64encode(stream).decode(), "telecommands": ids}

    taken = once(
        ground,
        actor=caller.name,
        operation="uplink",
        key=idempotency_key,
        request={"spacecraft_id": spacecraft_id, "instance": instance, "format": format},
        work=take,
    )
    return Response(
        base64.b64decode(taken["octets"]),
        media_type="application/octet-stream",
        headers={"X-Telecommands": ",".join(str(number) for number in taken["telecommands"])},
    )
