"""HTTP operations on mission descriptions."""

from typing import Annotated

from fastapi import Body, Path, Query, Response

from ground_service.access.security import Operator, UploadOf, Viewer, add_list
from ground_service.http.common import API_PREFIX, GroundOf, Name, upload_body
from ground_service.http.requests import operations, problems
from ground_service.missions import catalogues, service, store
from ground_service.missions.model import HeldCatalogue, MissionDetail

UPLOAD_PATHS = (f"{API_PREFIX}/catalogues",)

missions = operations("missions")

Text = Annotated[bytes, Body(media_type="application/octet-stream", description="mission.toml")]
Revision = Annotated[str, Path(pattern=r"^[0-9a-f]{8,64}$", description="Hash or its first digits")]


add_list(missions, "/missions", store.list_missions)


@missions.post("/missions", status_code=201)
def add_mission(
    ground: GroundOf,
    caller: Operator,
    document: Text,
    name: Annotated[Name, Query(description="Name of the file in messages")] = "body",
) -> MissionDetail:
    """Add a mission description (TOML) as a revision; the same content gives the same revision.

    Only an administrator may change which telecommands need a second person.
    """
    return service.add_mission(ground, document, source=name, actor=caller.name, caller=caller)


@missions.get("/missions/{revision}")
def get_mission(ground: GroundOf, caller: Viewer, revision: Revision) -> MissionDetail:
    """Show a revision with its document; viewers see the hosts of webhooks only, not what may be a token."""
    found = ground.read(store.find_revision, revision)
    return found if caller.may("operator") else service.without_tokens(found)


add_list(missions, "/catalogues", store.list_catalogues)


@missions.delete("/catalogues/{sha256}", status_code=204, responses=problems(404, 409))
def withdraw_catalogue(
    ground: GroundOf, caller: Operator, sha256: Annotated[str, Path(pattern=r"^[0-9a-f]{64}$")]
) -> Response:
    """Withdraw a crater catalogue that no description in force names; its file and the audit entries are kept."""
    catalogues.withdraw_catalogue(ground, sha256, actor=caller.name)
    return Response(status_code=204)


@missions.post("/catalogues", status_code=201, openapi_extra=upload_body("Crater catalogue: CSV, plain or gzip"))
async def add_catalogue(
    upload: UploadOf, ground: GroundOf, caller: Operator, name: Name = "catalogue.csv"
) -> HeldCatalogue:
    """Add a crater catalogue, which a mission description names by its SHA-256 (catalogue.sha256)."""
    stored = await upload.stored()
    return await upload.run(lambda: catalogues.add_catalogue(ground, stored, name, actor=caller.name))
