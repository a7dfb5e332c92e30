"""SQL of the job queue."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sqlalchemy import Connection, and_, delete, or_, select

from ground_service.errors import StateConflict
from ground_service.http.model import PageOf
from ground_service.jobs.model import Job, JobFilter
from ground_service.store import repository
from ground_service.store.states import JOB, change_if, move, move_all

JOBS = repository.JOBS

FINISHED = ("done", "failed")
REPEAT_NS = tuple(minutes * 60_000_000_000 for minutes in (1, 4, 16, 64))
"""Times from the failed attempts of a job of the kinds `REPEATED` to the next ones."""

REPEATED = ("ingest", "automation")


def add_job(
    connection: Connection,
    job_id: str,
    kind: str,
    arguments: Mapping[str, Any],
    now_utc_ns: int,
    traceparent: str | None,
) -> bool:
    """Add a queued job; return False if the id exists."""
    added = repository.add_new(
        connection,
        JOBS,
        id=job_id,
        kind=kind,
        state="queued",
        arguments=dict(arguments),
        progress=0.0,
        attempts=0,
        traceparent=traceparent,
        created_utc_ns=now_utc_ns,
    )
    return added is not None


def find_job(connection: Connection, job_id: str) -> Job | None:
    """Return a job; None if there is no such job."""
    row = repository.find(connection, JOBS, id=job_id)
    return None if row is None else Job.of(row)


def get_job(connection: Connection, job_id: str) -> Job:
    """Return a job."""
    return Job.of(repository.get(connection, JOBS, job_id, "job"))


def list_jobs(connection: Connection, asked: JobFilter) -> PageOf[Job]:
    """List the jobs, newest first; `kind` selects jobs of one kind."""
    rows, total = repository.newest(connection, JOBS, asked)
    return asked.page(map(Job.of, rows), total)


def unfinished_jobs(connection: Connection) -> list[str]:
    """Return the ids of unfinished jobs, oldest first."""
    query = select(JOBS.c.id).where(JOBS.c.state.not_in(FINISHED)).order_by(JOBS.c.created_utc_ns)
    return [str(key) for key in connection.execute(query).scalars()]


def queued_arguments(connection: Connection, kind: str) -> list[dict[str, Any]]:
    """Return the arguments of the queued jobs of a kind."""
    query = select(JOBS.c.arguments).where(JOBS.c.kind == kind, JOBS.c.state == "queued")
    return [dict(arguments) for arguments in connection.execute(query).scalars()]


def set_progress(connection: Connection, job_id: str, share: float) -> None:
    """Store the progress of a running job; a job in another state does not change."""
    change_if(connection, JOBS, job_id, {"state": "running"}, progress=share)


def start_attempt(connection: Connection, job: Job, now_utc_ns: int) -> int:
    """Start the next attempt of a job; return its number.

    Raises
    ------
    StateConflict
        Another process has started the job since it was read.
    """
    attempt = job.attempts + 1
    move(
        connection,
        JOB,
        job.id,
        "running",
        where={"attempts": job.attempts},
        attempts=attempt,
        started_utc_ns=now_utc_ns,
    )
    return attempt


def requeue(connection: Connection, job_id: str, attempt: int) -> None:
    """Queue an interrupted job again; the interrupted attempt does not count.

    Raises
    ------
    StateConflict
        Another process has started a new attempt.
    """
    where = {"attempts": attempt}
    move(
        connection,
        JOB,
        job_id,
        "queued",
        expected=("running",),
        where=where,
        attempts=attempt - 1,
        progress=0.0,
    )


def repeat_job(connection: Connection, job_id: str) -> None:
    """Queue a failed job again; its last error is kept until it ends.

    Raises
    ------
    StateConflict
        The job has not failed.
    """
    move(connection, JOB, job_id, "queued", expected=("failed",), progress=0.0)


def delete_failed(connection: Connection, job_id: str) -> Job:
    """Delete a failed job; return it.

    Raises
    ------
    StateConflict
        The job has not failed.
    """
    found = get_job(connection, job_id)
    if not connection.execute(delete(JOBS).where(JOBS.c.id == job_id, JOBS.c.state == "failed")).rowcount:
        raise StateConflict("job", job_id, "failed", found.state)
    return found


def repeat_failed(connection: Connection, now_utc_ns: int) -> None:
    """Queue the failed ingests and follow-up jobs again whose next attempt is due."""
    due = (
        and_(JOBS.c.attempts == k, JOBS.c.finished_utc_ns <= now_utc_ns - wait_ns)
        for k, wait_ns in enumerate(REPEAT_NS, 1)
    )
    move_all(
        connection,
        JOB,
        (JOBS.c.kind.in_(REPEATED), JOBS.c.state == "failed", or_(*due)),
        "queued",
        progress=0.0,
    )


def end_attempt(
    connection: Connection,
    job_id: str,
    attempt: int,
    now_utc_ns: int,
    *,
    result: Mapping[str, Any] | None = None,
    error: str | None = None,
) -> None:
    """End an attempt of a job: it has failed if there is an error, otherwise it is done.

    Raises
    ------
    StateConflict
        Another process has started a new attempt.
    """
    outcome: dict[str, Any] = (
        {"state": "failed", "error": error}
        if error is not None
        else {"state": "done", "error": None, "result": result, "progress": 1.0}
    )
    where = {"attempts": attempt}
    move(connection, JOB, job_id, where=where, finished_utc_ns=now_utc_ns, **outcome)


def delete_finished(connection: Connection, before_utc_ns: int) -> int:
    """Delete the jobs that finished before a time; return their number."""
    query = delete(JOBS).where(JOBS.c.finished_utc_ns < before_utc_ns, JOBS.c.state.in_(FINISHED))
    return int(connection.execute(query).rowcount)
