"""HTTP operations on telemetry uploads and ingests."""

from typing import Annotated

from fastapi import Query, Response

from ground_service.access.security import Operator, UploadOf, Viewer, add_list, idempotent_id
from ground_service.errors import InvalidInput
from ground_service.http.common import API_PREFIX, GroundOf, IdempotencyKey, Instance, Name, RowId, upload_body
from ground_service.http.requests import operations, problems
from ground_service.ingest import doubt_store, service, store
from ground_service.ingest.model import Ingest, IngestAccepted, Withdrawal
from ground_service.ingest.service import PiecePosition, enter_ingest
from ground_service.jobs.service import DispatcherOf
from ground_service.store.vehicles import FLOWN

UPLOAD_PATHS = (f"{API_PREFIX}/telemetry",)

ingests = operations("telemetry")


@ingests.post("/telemetry", status_code=202, openapi_extra=upload_body("CADUs or space packets"))
async def upload_telemetry(
    response: Response,
    upload: UploadOf,
    ground: GroundOf,
    caller: Operator,
    dispatcher: DispatcherOf,
    spacecraft_id: Annotated[int | None, Query(ge=0, le=1023, description="Needed for bare packets")] = None,
    instance: Instance = FLOWN,
    name: Name = "upload",
    stream: Annotated[
        str | None,
        Query(
            min_length=1,
            max_length=200,
            pattern=r"^[^\x00-\x1f\x7f]*$",
            description="Recording to which the octets belong; requires `offset`",
        ),
    ] = None,
    offset: Annotated[
        int | None, Query(ge=0, lt=1 << 62, description="Offset of the piece in `stream`, in octets")
    ] = None,
    station: Annotated[
        str,
        Query(
            max_length=64,
            pattern=r"^[^\x00-\x1f\x7f]*$",
            description="Station that received the octets, as named in the mission description",
        ),
    ] = "",
    link: Annotated[
        str | None,
        Query(
            max_length=200,
            description="Link settings, used without evidence, such as `frame_length=1115,coding=rs,checksum=true`",
        ),
    ] = None,
    idempotency_key: IdempotencyKey = None,
) -> IngestAccepted:
    """Ingest a downlink, or a piece of one cut at any octet.

    A downlink is a stream of CADUs or of space packets. A piece states its recording, one reception of one station, as
    `stream`, and its `offset` in it; octets without them are a whole recording.
    """
    if (stream is None) != (offset is None):
        raise InvalidInput("telemetry", "stream, offset", "both or neither", "one of them")
    place = None if stream is None or offset is None else PiecePosition(stream, offset)
    stored = await upload.stored()
    if stored.octets == 0:
        raise InvalidInput("body", "", "the octets of a downlink", "nothing")
    job_id = idempotent_id("ingest", caller, idempotency_key)

    def enter() -> tuple[int, str]:
        ingest_id, job = enter_ingest(
            ground,
            stored,
            name,
            spacecraft_id=spacecraft_id,
            instance=instance,
            place=place,
            station=station,
            link=link,
            job_id=job_id,
        )
        dispatcher.start(job)
        return ingest_id, job

    ingest_id, job = await upload.run(enter)
    response.headers["Location"] = f"{API_PREFIX}/ingests/{ingest_id}"
    return IngestAccepted(ingest_id=ingest_id, job_id=job, sha256=stored.sha256, octets=stored.octets)


add_list(ingests, "/ingests", store.list_ingests)


add_list(ingests, "/implausible-packets", doubt_store.list_implausible)


@ingests.post("/ingests/{ingest_id}/withdraw", responses=problems(409))
def withdraw_ingest(
    ground: GroundOf, caller: Operator, dispatcher: DispatcherOf, ingest_id: RowId, given: Withdrawal
) -> Ingest:
    """Withdraw an ingest: everything is derived again without it; its file and the audit entry stay."""
    dispatcher.start(service.withdraw_ingest(ground, ingest_id, reason=given.reason, actor=caller.name))
    return ground.read(store.get_ingest, ingest_id)


@ingests.get("/ingests/{ingest_id}")
def get_ingest(ground: GroundOf, _: Viewer, ingest_id: RowId) -> Ingest:
    """Show an ingest: its state and the accounting of the file."""
    return ground.read(store.get_ingest, ingest_id)
