"""What a deployment watches the service with."""

from __future__ import annotations

from fastapi import APIRouter, Request, Response

from ground_service.errors import Draining
from ground_service.http.common import GroundOf
from ground_service.jobs import service
from ground_service.jobs.model import JobFilter
from ground_service.worker.condition import Health

operations = APIRouter(include_in_schema=False)


@operations.get("/healthz")
async def healthz() -> Health:
    """Report that the process is alive."""
    return Health(status="ok")


@operations.get("/readyz")
def readyz(request: Request, ground: GroundOf) -> Health:
    """Report that the service can be used: its database and archive can be read and written, and it is not draining."""
    if request.app.state.draining:
        raise Draining
    ground.read(service.list_jobs, JobFilter(limit=1))
    ground.database.require_writable()
    ground.files.require_writable()
    return Health(status="ok")


@operations.get("/metrics")
def metrics(request: Request, ground: GroundOf) -> Response:
    """Figures for Prometheus."""
    answer: Response = request.app.state.metrics.answer(ground)
    return answer
