"""Job queue: rows, use cases and dispatcher of named work, added by any capability and run by `worker`.

A job is a row, so it is visible from the request on, whether it runs in this process, in a thread of the server or in a
worker on another machine.
"""

import hashlib
import uuid
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Annotated, Any

from fastapi import Depends, Request
from pydantic import Field
from sqlalchemy import Connection, and_, delete, or_, select

from ground_service import logs
from ground_service.clock import utc_now_ns
from ground_service.errors import Conflict, InvalidInput, StateConflict
from ground_service.ground import Ground
from ground_service.http.model import Entity, PageOf, Paging, UtcTime
from ground_service.store import repository
from ground_service.store.event_kinds import JobChanged, publish
from ground_service.store.states import JOB, change_if, move, move_all
from ground_service.store.vehicles import hold


class Job(Entity):
    """A background job."""

    id: str
    kind: str = Field(examples=["report"])
    state: str = Field(examples=["done"], description="queued, running, done or failed")
    progress: float = Field(ge=0.0, le=1.0)
    attempts: int
    arguments: dict[str, Any]
    result: dict[str, Any] | None
    error: str | None
    traceparent: str | None = Field(description="W3C trace context of the step that entered it")
    created: UtcTime
    started: UtcTime | None
    finished: UtcTime | None


class JobFilter(Paging):
    """Jobs to list."""

    kind: str | None = Field(default=None, max_length=40, examples=["regression"])


JOBS = repository.JOBS

FINISHED = ("done", "failed")
REPEAT_NS = tuple(minutes * 60_000_000_000 for minutes in (1, 4, 16, 64))
"""Times from the failed attempts of a job of the kinds `REPEATED` to the next ones."""

REPEATED = ("ingest", "automation")


def insert_job(
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
    move(connection, JOB, job_id, "queued", expected=("running",), where=where, attempts=attempt - 1, progress=0.0)


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
    move_all(connection, JOB, (JOBS.c.kind.in_(REPEATED), JOBS.c.state == "failed", or_(*due)), "queued", progress=0.0)


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


KINDS = (
    "report",
    "ingest",
    "archive",
    "replay",
    "rendering",
    "regression",
    "analysis",
    "nightly",
    "plan",
    "redecode",
    "withdrawal",
    "re-evaluation",
    "automation",
    "notification",
)
"""Kinds of jobs; `worker.jobs` has a function for each."""

IDENTITY = {
    "report": ("pass_id",),
    "archive": ("sha256",),
    "replay": ("archive", "build"),
    "rendering": ("digest",),
    "regression": ("candidate", "baseline"),
    "analysis": ("candidate", "baseline"),
    "redecode": ("vehicle_id",),
    "re-evaluation": ("pass_id",),
    "automation": ("event",),
    "notification": ("event",),
}
"""Arguments that must be equal for two requests with the same job id to be the same request."""

OTHER_REQUEST = "Idempotency-Key: expected the request that it was first sent with, found another"


def enter_job(ground: Ground, kind: str, arguments: Mapping[str, Any], *, job_id: str | None = None) -> str:
    """Enter a job to be done; its id. Entering the same id again changes nothing."""
    return ground.write(add_job, kind, arguments, job_id=job_id)


def add_job(connection: Connection, kind: str, arguments: Mapping[str, Any], *, job_id: str | None = None) -> str:
    """Add a job as `enter_job` does, within the caller's transaction.

    Raises
    ------
    Conflict
        If the id belongs to a different job.
    """
    if kind not in KINDS:
        raise InvalidInput("job", "kind", " or ".join(KINDS), kind)
    identity = job_id or uuid.uuid4().hex
    if insert_job(connection, identity, kind, arguments, utc_now_ns(), logs.current()):
        publish(connection, JobChanged(id=identity, kind=kind, state="queued"))
    else:
        known = get_job(connection, identity)
        if known.kind != kind or any(
            known.arguments.get(name) != arguments.get(name) for name in IDENTITY.get(kind, ())
        ):
            raise Conflict(OTHER_REQUEST)
    return identity


def enter_jobs(
    ground: Ground, first: Mapping[str, Mapping[str, Any]], kind: str, arguments: Mapping[str, Any], job_id: str
) -> list[str]:
    """Add a job and the replays that it needs first in one transaction; return the ids to start, in order.

    If the job exists already, nothing is added and only the job is started.

    Parameters
    ----------
    first
        Arguments of the replays by their names within the job.

    Raises
    ------
    Conflict
        If the id belongs to a different job.
    """
    with ground.database.writing() as connection:
        hold(connection, f"job {job_id}")
        new = find_job(connection, job_id) is None
        before = [
            add_job(
                connection,
                "replay",
                given,
                job_id=hashlib.blake2b(f"{job_id} {name}".encode(), digest_size=16).hexdigest(),
            )
            for name, given in first.items()
            if new
        ]
        return [*before, add_job(connection, kind, arguments, job_id=job_id)]


class Dispatcher(ABC):
    """Receives jobs and has them done, in this process or by workers."""

    def __init__(self, ground: Ground) -> None:
        self._ground = ground

    def submit(self, kind: str, arguments: Mapping[str, Any], *, job_id: str | None = None) -> str:
        """Enter a job and have it done; return its id."""
        identity = enter_job(self._ground, kind, arguments, job_id=job_id)
        self.start(identity)
        return identity

    @abstractmethod
    def start(self, job_id: str) -> None:
        """Have an entered job done."""

    @abstractmethod
    def resume(self) -> None:
        """Start unfinished jobs of ended processes again; may be called repeatedly."""

    @abstractmethod
    def close(self) -> None:
        """End running jobs: interruptible jobs continue at the next start, others finish."""


async def dispatcher_of(request: Request) -> Dispatcher:
    """Return the dispatcher of the application."""
    dispatcher: Dispatcher = request.app.state.dispatcher
    return dispatcher


DispatcherOf = Annotated[Dispatcher, Depends(dispatcher_of)]
