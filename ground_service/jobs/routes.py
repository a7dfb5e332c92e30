"""HTTP operations on jobs."""

from __future__ import annotations

from typing import Annotated

from fastapi import Query, Request

from ground_service.access.security import Viewer
from ground_service.http.common import GroundOf, Key, linked
from ground_service.http.model import PageOf
from ground_service.http.requests import operations
from ground_service.jobs import store
from ground_service.jobs.model import Job, JobFilter

jobs = operations("jobs")


@jobs.get("/jobs")
def list_jobs(
    ground: GroundOf,
    _: Viewer,
    request: Request,
    asked: Annotated[JobFilter, Query()],
) -> PageOf[Job]:
    """List the jobs, newest first; `kind` selects jobs of one kind."""
    return linked(request, ground.read(store.list_jobs, asked))


@jobs.get("/jobs/{job_id}")
def get_job(ground: GroundOf, _: Viewer, job_id: Key) -> Job:
    """Show a job: its state, and its result when it is done."""
    return ground.read(store.get_job, job_id)
