"""HTTP operations on jobs."""

from __future__ import annotations

from typing import Annotated

from fastapi import Query

from ground_service.access.security import Viewer
from ground_service.http.common import GroundOf, Key, PagingOf
from ground_service.http.model import PageOf
from ground_service.http.requests import operations
from ground_service.jobs import service
from ground_service.jobs.model import Job

jobs = operations("jobs")


@jobs.get("/jobs")
def list_jobs(
    ground: GroundOf,
    _: Viewer,
    paging: PagingOf,
    kind: Annotated[str | None, Query(max_length=40, examples=["regression"])] = None,
) -> PageOf[Job]:
    """List the jobs, newest first; `kind` selects jobs of one kind."""
    items, total = service.list_jobs(ground, kind=kind, limit=paging.limit, offset=paging.offset)
    return paging.page(items, total)


@jobs.get("/jobs/{job_id}")
def get_job(ground: GroundOf, _: Viewer, job_id: Key) -> Job:
    """Show a job: its state, and its result when it is done."""
    return service.get_job(ground, job_id)
