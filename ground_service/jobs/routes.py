"""HTTP operations on jobs."""

from __future__ import annotations

from ground_service.access.security import Viewer, add_list
from ground_service.http.common import GroundOf, Key
from ground_service.http.requests import operations
from ground_service.jobs import store
from ground_service.jobs.model import Job

jobs = operations("jobs")


add_list(jobs, "/jobs", store.list_jobs)


@jobs.get("/jobs/{job_id}")
def get_job(ground: GroundOf, _: Viewer, job_id: Key) -> Job:
    """Show a job: its state, and its result when it is done."""
    return ground.read(store.get_job, job_id)
