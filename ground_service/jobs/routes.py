"""HTTP operations on jobs."""

from fastapi import Response

from ground_service.access.security import Operator, Viewer, add_list
from ground_service.access.service import audit
from ground_service.http.common import GroundOf, Key
from ground_service.http.requests import operations, problems
from ground_service.jobs import service
from ground_service.jobs.service import DispatcherOf, Job

jobs = operations("jobs")


add_list(jobs, "/jobs", service.list_jobs)


@jobs.get("/jobs/{job_id}")
def get_job(ground: GroundOf, _: Viewer, job_id: Key) -> Job:
    """Show a job: its state, and its result when it is done."""
    return ground.read(service.get_job, job_id)


@jobs.post("/jobs/{job_id}/repeat", responses=problems(404, 409))
def repeat_job(ground: GroundOf, caller: Operator, dispatcher: DispatcherOf, job_id: Key) -> Job:
    """Queue a failed job again, which changes nothing that is done already."""
    with ground.database.writing() as connection:
        service.repeat_job(connection, job_id)
        audit(connection, caller.name, "repeat job", job_id, {})
    dispatcher.start(job_id)
    return ground.read(service.get_job, job_id)


@jobs.delete("/jobs/{job_id}", status_code=204, responses=problems(404, 409))
def delete_job(ground: GroundOf, caller: Operator, job_id: Key) -> Response:
    """Delete a failed job, such as the ingest of a file that is no downlink; what it has stored is kept."""
    with ground.database.writing() as connection:
        found = service.delete_failed(connection, job_id)
        audit(connection, caller.name, "dismiss job", job_id, {"kind": found.kind, "error": found.error})
    return Response(status_code=204)
