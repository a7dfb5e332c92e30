"""HTTP operations on reference ephemerides."""

from typing import Annotated

from fastapi import Query, Response

from ground_service.access.security import Operator, UploadOf, add_list
from ground_service.http.common import API_PREFIX, GroundOf, Name, RowId, upload_body
from ground_service.http.requests import operations, problems
from ground_service.missions.ephemerides import service
from ground_service.missions.ephemerides.model import Ephemeris

EPHEMERIS_FILE = "CCSDS OEM (text or XML), STK .e or Horizons CSV file; also as .gz or .zip"
UPLOAD_PATHS = (f"{API_PREFIX}/ephemerides",)

ephemerides = operations("ephemerides")


@ephemerides.post("/ephemerides", status_code=201, openapi_extra=upload_body(EPHEMERIS_FILE))
async def add_ephemeris(
    upload: UploadOf,
    ground: GroundOf,
    caller: Operator,
    name: Name = "reference",
    precedence: Annotated[int, Query(ge=-1000, le=1000)] = 0,
) -> Ephemeris:
    """Add a reference ephemeris: OEM (text or XML), STK .e or Horizons CSV as the body, also compressed."""
    stored = await upload.stored()

    def add() -> Ephemeris:
        return service.add_ephemeris(ground, stored, name=name, precedence=precedence, actor=caller.name, caller=caller)

    return await upload.run(add)


add_list(ephemerides, "/ephemerides", service.list_ephemerides)


@ephemerides.delete("/ephemerides/{ephemeris_id}", status_code=204, responses=problems(404))
def withdraw_ephemeris(ground: GroundOf, caller: Operator, ephemeris_id: RowId) -> Response:
    """Withdraw a reference ephemeris: passes and windows use others; its file and the audit entries are kept."""
    service.withdraw_ephemeris(ground, ephemeris_id, actor=caller.name, caller=caller)
    return Response(status_code=204)
