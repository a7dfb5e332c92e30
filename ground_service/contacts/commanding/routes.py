"""HTTP operations on telecommands and the uplink."""

import base64
from typing import Annotated, Any, Literal

from fastapi import Query, Response

from ground_service.access.security import Operator, Viewer, add_list, added_once, once
from ground_service.contacts.commanding import service as commanding
from ground_service.contacts.commanding import store
from ground_service.contacts.commanding.model import (
    CommandEntry,
    Handover,
    HandoverNote,
    Rejection,
    Telecommand,
    UplinkState,
)
from ground_service.http.common import GroundOf, Instance, OnceKey, RowId, SpacecraftId
from ground_service.http.requests import operations, problems
from ground_service.store.vehicles import FLOWN

telecommands = operations("telecommands")


add_list(telecommands, "/telecommands", commanding.list_telecommands)


@telecommands.post("/telecommands", status_code=201)
def enter_telecommand(
    ground: GroundOf, caller: Operator, given: CommandEntry, idempotency_key: OnceKey = None
) -> Telecommand:
    """Queue a telecommand; its name and arguments must agree with the dictionary."""

    def enter() -> Telecommand:
        command_id = commanding.enter_command(
            ground,
            given.name,
            given.arguments,
            spacecraft_id=given.spacecraft_id,
            instance=given.instance,
            timeout_s=given.timeout_s,
            actor=caller.name,
        )
        return commanding.get_command(ground, command_id).telecommand

    return added_once(ground, Telecommand, caller.name, idempotency_key, given, enter)


@telecommands.get("/telecommands/{command_id}")
def get_telecommand(ground: GroundOf, _: Viewer, command_id: RowId) -> Telecommand:
    """Show a telecommand with its verification."""
    return commanding.get_command(ground, command_id).telecommand


@telecommands.post("/telecommands/{command_id}/release", responses=problems(409))
def release_telecommand(ground: GroundOf, caller: Operator, command_id: RowId) -> Telecommand:
    """Release a queued telecommand; a critical one must be released by a second person."""
    commanding.release_command(ground, command_id, actor=caller.name)
    return commanding.get_command(ground, command_id).telecommand


@telecommands.post("/telecommands/{command_id}/reject", responses=problems(409))
def reject_telecommand(ground: GroundOf, caller: Operator, command_id: RowId, given: Rejection) -> Telecommand:
    """Reject a queued telecommand."""
    commanding.reject_command(ground, command_id, actor=caller.name, reason=given.reason)
    return commanding.get_command(ground, command_id).telecommand


@telecommands.get("/spacecraft/{spacecraft_id}/uplink")
def get_uplink_state(
    ground: GroundOf, _: Viewer, spacecraft_id: SpacecraftId, instance: Instance = FLOWN
) -> UplinkState:
    """Return the state of a telecommand receiver, from the control words of the newest telemetry."""
    return commanding.uplink_state(ground, spacecraft_id, instance)


add_list(telecommands, "/handovers", store.list_handovers)


@telecommands.put("/spacecraft/{spacecraft_id}/handover")
def change_handover(
    ground: GroundOf, caller: Operator, spacecraft_id: SpacecraftId, given: HandoverNote, instance: Instance = FLOWN
) -> Handover:
    """Change the note for the next shift."""
    return commanding.change_handover(ground, spacecraft_id, instance, given.note, actor=caller.name)


@telecommands.post("/spacecraft/{spacecraft_id}/hold", responses=problems(409))
def hold_spacecraft(
    ground: GroundOf, caller: Operator, spacecraft_id: SpacecraftId, given: Rejection, instance: Instance = FLOWN
) -> Handover:
    """Suppress release and transmission of telecommands of a spacecraft at once, automatic ones included."""
    return commanding.hold_spacecraft(ground, spacecraft_id, instance, reason=given.reason, actor=caller.name)


@telecommands.delete("/spacecraft/{spacecraft_id}/hold", responses=problems(409))
def resume_spacecraft(
    ground: GroundOf, caller: Operator, spacecraft_id: SpacecraftId, instance: Instance = FLOWN
) -> Handover:
    """End the hold of a spacecraft."""
    return commanding.resume_spacecraft(ground, spacecraft_id, instance, actor=caller.name)


@telecommands.post(
    "/uplink",
    response_class=Response,
    responses={200: {"content": {"application/octet-stream": {}}, "description": "Octets to radiate"}},
)
def take_uplink(
    ground: GroundOf,
    caller: Operator,
    spacecraft_id: Annotated[int, Query(ge=0, le=1023)],
    instance: Instance = FLOWN,
    format: Literal["cltu", "packets"] = "cltu",
    idempotency_key: OnceKey = None,
) -> Response:
    """Take all released telecommands as octets to radiate, and mark them as sent.

    With an Idempotency-Key, a response that was lost can be requested again.
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
