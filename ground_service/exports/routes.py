"""HTTP operations on exports."""

from fastapi import Response
from fastapi.responses import StreamingResponse

from ground_service.access.security import Viewer
from ground_service.exports import service
from ground_service.exports.model import ExportFormatInfo, ExportRequest
from ground_service.http.common import GroundOf
from ground_service.http.requests import operations

MEDIA = "application/octet-stream"

exports = operations("exports")


@exports.post(
    "/exports",
    response_class=Response,
    responses={200: {"content": {MEDIA: {}}, "description": "The file; formats of several files are a zip archive"}},
)
def export_pass(ground: GroundOf, _: Viewer, request: ExportRequest) -> Response:
    """Return a pass in a format of other tools."""
    found = service.export_pass(ground, request)
    return StreamingResponse(
        found.blocks(),
        media_type=MEDIA,
        headers={"Content-Disposition": f'attachment; filename="{found.name}"', "Content-Length": str(found.size)},
    )


@exports.get("/exports/formats")
def list_export_formats(_: Viewer) -> list[ExportFormatInfo]:
    """List the formats of exports."""
    return service.list_formats()
