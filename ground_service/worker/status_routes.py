"""HTTP operation on the condition of the deployment."""

from __future__ import annotations

from fastapi import Request

from ground_service.access.security import Viewer
from ground_service.http.common import GroundOf
from ground_service.http.requests import operations
from ground_service.worker.condition import ServiceStatus, service_status

status = operations("status")


@status.get("/status")
def get_status(request: Request, ground: GroundOf, _: Viewer) -> ServiceStatus:
    """Show the condition of the deployment: waiting work, disk, backups, time correlations, scheduler."""
    return service_status(ground, request.app.state.backups, request.app.state.broker)
