"""HTTP operations on the parameters of a pass and on its decoded packets."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Path, Query, Response

from ground_service.http.common import API_PREFIX, PROBLEMS, GroundOf, PassId, Viewer
from ground_service.http.requests import StrictRoute
from ground_service.passes import parameters
from ground_service.passes.parameters import ExportFormat, PassParameters

pass_parameters = APIRouter(route_class=StrictRoute, prefix=API_PREFIX, responses=PROBLEMS)

MEDIA_TYPES: dict[ExportFormat, str] = {
    "json": "application/json",
    "csv": "text/csv; charset=utf-8",
    "parquet": "application/vnd.apache.parquet",
}


@pass_parameters.get("/passes/{pass_id}/parameters", response_model=PassParameters)
def list_parameters(ground: GroundOf, _: Viewer, pass_id: PassId) -> Any:
    """Parameters with series: those of the payload, and those of packets that the mission description defines."""
    return parameters.pass_parameters(ground, pass_id)


@pass_parameters.get(
    "/passes/{pass_id}/packets/{packet}",
    response_class=Response,
    responses={200: {"content": {media: {} for media in MEDIA_TYPES.values()}}},
)
def get_packets(
    ground: GroundOf,
    _: Viewer,
    pass_id: PassId,
    packet: Annotated[str, Path(max_length=200, description="Packet of the dictionary, or XTCE container")],
    kind: Annotated[ExportFormat, Query(alias="format")] = "json",
) -> Response:
    """Decoded packets of one kind in a pass, in order of on-board time, with UTC."""
    octets = parameters.export_packets(ground, pass_id, packet, kind)
    return Response(octets, media_type=MEDIA_TYPES[kind])
