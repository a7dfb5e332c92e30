"""Jobs: named pieces of work that can be asked for, watched and done again without harm.

A job is a row before it is anything else, so it is visible from the moment of the request, whether it runs in this
process, a thread of the server, or a worker on another machine. Doing a finished job again does nothing.
"""

from __future__ import annotations

import hashlib
import logging
import threading
import uuid
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import Any

from sqlalchemy import Connection, select

from ground_service.clock import utc_now_ns
from ground_service.errors import (
    PASSING,
    Conflict,
    GroundError,
    InvalidInput,
    StateConflict,
    public_text,
    storage_error,
)
from ground_service.evaluation.service import make_report
from ground_service.feed import publish
from ground_service.ground import Ground
from ground_service.ingest.redecode import catch_up, redecode_job_id, vehicles_behind
from ground_service.ingest.service import Place, add_ingest, run_ingest
from ground_service.passes.archive_zip import import_zip
from ground_service.store import repository
from ground_service.store.counters import hold
from ground_service.store.files import StoredFile
from ground_service.store.states import JOB, change_if, move
from ground_service.worker.upkeep import nightly
from lunar.errors import LunarError
from reports.errors import ReportError
from tmtc.errors import TmtcError

log = logging.getLogger(__name__)

FINISHED = ("done", "failed")

ATTEMPTS_LIMIT = 25
"""A job that ended with its process this often (for want of memory, say) is not tried again."""

PROGRESS_STEP = 0.02

Work = Callable[[Ground, Mapping[str, Any], str], dict[str, Any]]


def _report(ground: Ground, arguments: Mapping[str, Any], job_id: str) -> dict[str, Any]:
    made = make_report(ground, int(arguments["pass_id"]), report_id=job_id, pdf=True)
    return {"report_id": made.report_id, "pass_id": made.pass_id}


def _ingest(ground: Ground, arguments: Mapping[str, Any], job_id: str) -> dict[str, Any]:
    result = run_ingest(ground, int(arguments["ingest_id"]), progress=_progress_of(ground, job_id))
    return {"ingest_id": result.ingest_id, "packets": result.packets, "packets_new": result.packets_new}


def _archive(ground: Ground, arguments: Mapping[str, Any], _job_id: str) -> dict[str, Any]:
    path = ground.files.path(str(arguments["sha256"]))
    return {"pass_id": import_zip(ground, path, str(arguments["name"]))}


def _redecode(ground: Ground, arguments: Mapping[str, Any], _job_id: str) -> dict[str, Any]:
    return {"rows": catch_up(ground, int(arguments["vehicle_id"]))}


def _replay(ground: Ground, arguments: Mapping[str, Any], job_id: str) -> dict[str, Any]:
    from ground_service.regression.jobs import replay_job

    return replay_job(ground, arguments, job_id)


def _regression(ground: Ground, arguments: Mapping[str, Any], job_id: str) -> dict[str, Any]:
    from ground_service.regression.jobs import regression_job

    return regression_job(ground, arguments, job_id)


WORK: dict[str, Work] = {
    "report": _report,
    "ingest": _ingest,
    "archive": _archive,
    "replay": _replay,
    "regression": _regression,
    "nightly": nightly,
    "redecode": _redecode,
}
"""What can be asked for, by kind. Each may be run twice with the same arguments and job without harm."""

IDENTITY = {
    "report": ("pass_id",),
    "archive": ("sha256",),
    "replay": ("archive", "build"),
    "regression": ("candidate", "baseline"),
    "redecode": ("vehicle_id",),
}
"""Arguments that must be equal for two requests with the same job id to be the same request."""

_OTHER_REQUEST = "Idempotency-Key: expected the request that it was first sent with, found another"


def enter_job(ground: Ground, kind: str, arguments: Mapping[str, Any], *, job_id: str | None = None) -> str:
    """Enter a job to be done; its id. Entering the same id again changes nothing."""
    with ground.database.writing() as connection:
        return add_job(connection, kind, arguments, job_id=job_id)


def add_job(
    connection: Connection, kind: str, arguments: Mapping[str, Any], *, job_id: str | None = None
) -> str:
    """Add a job as `enter_job` does, within the caller's transaction.

    Raises
    ------
    Conflict
        If the id stands for a job that does something else.
    """
    if kind not in WORK:
        raise InvalidInput("job", "kind", " or ".join(WORK), kind)
    identity = job_id or uuid.uuid4().hex
    added = repository.add_new(
        connection,
        repository.JOBS,
        id=identity,
        kind=kind,
        state="queued",
        arguments=dict(arguments),
        progress=0.0,
        attempts=0,
        created_utc_ns=utc_now_ns(),
    )
    if added:
        publish(connection, "job", {"id": identity, "kind": kind, "state": "queued"})
    else:
        known = repository.get(connection, repository.JOBS, identity, "job")
        if known["kind"] != kind or any(
            known["arguments"].get(name) != arguments.get(name) for name in IDENTITY.get(kind, ())
        ):
            raise Conflict(_OTHER_REQUEST)
    return identity


def enter_jobs(
    ground: Ground,
    first: Mapping[str, Mapping[str, Any]],
    kind: str,
    arguments: Mapping[str, Any],
    job_id: str,
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
        If the id stands for a job that does something else.
    """
    with ground.database.writing() as connection:
        hold(connection, f"job {job_id}")
        new = repository.find(connection, repository.JOBS, id=job_id) is None
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


def enter_ingest(
    ground: Ground,
    stored: StoredFile,
    name: str,
    *,
    spacecraft_id: int | None,
    instance: str,
    place: Place | None = None,
    job_id: str | None = None,
) -> tuple[int, str]:
    """Add an archived file and the job that ingests it in one transaction; return their ids, also if the job exists.

    Raises
    ------
    Conflict
        If the id belongs to another ingest.
    """
    with ground.database.writing() as connection:
        if job_id is not None:
            hold(connection, f"job {job_id}")
            known = repository.find(connection, repository.JOBS, id=job_id)
            if known is not None:
                return _known_ingest(connection, known, stored, spacecraft_id, instance), job_id
        ingest_id = add_ingest(
            connection, stored, name, spacecraft_id=spacecraft_id, instance=instance, place=place
        )
        arguments = {"ingest_id": ingest_id, "spacecraft_id": spacecraft_id, "instance": instance}
        return ingest_id, add_job(connection, "ingest", arguments, job_id=job_id)


def _known_ingest(
    connection: Connection,
    job: Mapping[str, Any],
    stored: StoredFile,
    spacecraft_id: int | None,
    instance: str,
) -> int:
    """Return the ingest of an existing job with the same file and the same spacecraft."""
    asked = {"spacecraft_id": spacecraft_id, "instance": instance}
    if job["kind"] == "ingest" and asked.items() <= job["arguments"].items():
        ingest_id = int(job["arguments"]["ingest_id"])
        record = repository.get(connection, repository.INGESTS, ingest_id, "ingest")
        if record["file_sha256"] == stored.sha256:
            return ingest_id
    raise Conflict(_OTHER_REQUEST)


def enter_redecoding(ground: Ground) -> list[str]:
    """Enter a job for every vehicle that an older dictionary decoded; their ids. Once each, however often asked."""
    return [
        enter_job(ground, "redecode", {"vehicle_id": vehicle}, job_id=redecode_job_id(vehicle))
        for vehicle in vehicles_behind(ground)
    ]


def run_job(ground: Ground, job_id: str) -> dict[str, Any]:
    """Run a job and return its row afterwards. A failed job records the reason and is not repeated.

    A job that is already running, here or in another process, is not started.

    Raises
    ------
    DatabaseUnavailable, StorageFull, StorageReadOnly
        If the database is unavailable, or nothing can be written: the job has not finished and will run again.
    """
    with _alone_here(job_id) as here, ground.database.alone(_lock_key(job_id)) as alone:
        if not (here and alone):
            with ground.database.reading() as connection:
                return repository.get(connection, repository.JOBS, job_id, "job")
        return _run_alone(ground, job_id)


def _run_alone(ground: Ground, job_id: str) -> dict[str, Any]:
    with ground.database.writing() as connection:
        job = repository.get(connection, repository.JOBS, job_id, JOB.kind)
        if job["state"] in FINISHED:
            return job
        attempt = int(job["attempts"]) + 1
        try:
            move(
                connection,
                JOB,
                job_id,
                "running",
                where={"attempts": job["attempts"]},
                attempts=attempt,
                started_utc_ns=utc_now_ns(),
            )
        except StateConflict:  # another process has started the job since it was read
            return repository.get(connection, repository.JOBS, job_id, JOB.kind)
        publish(connection, "job", {"id": job_id, "kind": job["kind"], "state": "running"})
    if attempt > ATTEMPTS_LIMIT:
        error = f"given up after {ATTEMPTS_LIMIT} attempts that did not come to an end"
        return _finish(ground, job_id, attempt, state="failed", error=error)
    log.info("job %s (%s) begins", job_id, job["kind"], extra={"job": job_id, "kind": job["kind"]})
    try:
        result = WORK[job["kind"]](ground, job["arguments"], job_id)
        return _finish(ground, job_id, attempt, state="done", result=result, progress=1.0, error=None)
    except PASSING as error:
        log.info("job %s (%s) will run again: %s", job_id, job["kind"], error)
        _put_back(ground, job_id, attempt)
        raise
    except (GroundError, TmtcError, LunarError, ReportError) as error:
        log.warning("job %s (%s) failed: %s", job_id, job["kind"], error)
        return _finish(ground, job_id, attempt, state="failed", error=public_text(error))
    except Exception as error:  # any error ends the job, which records it
        translated = storage_error(error, "archive") if isinstance(error, OSError) else None
        if isinstance(translated, PASSING):
            log.info("job %s (%s) will run again: %s", job_id, job["kind"], error)
            _put_back(ground, job_id, attempt)
            raise translated from error
        log.exception("job %s (%s): unexpected error", job_id, job["kind"], extra={"job": job_id})
        return _finish(ground, job_id, attempt, state="failed", error=public_text(error))


def _put_back(ground: Ground, job_id: str, attempt: int) -> None:
    """Queue a job again that something else broke off; that is no attempt of its own. Not being able to is no harm."""
    with suppress(*PASSING, StateConflict), ground.database.writing() as connection:
        move(
            connection,
            JOB,
            job_id,
            "queued",
            where={"attempts": attempt},
            attempts=attempt - 1,
            progress=0.0,
        )


def _progress_of(ground: Ground, job_id: str) -> Callable[[float], None]:
    """Progress of a job, stored in its row in steps with negligible cost."""
    kept = 0.0

    def keep(share: float) -> None:
        nonlocal kept
        if share - kept >= PROGRESS_STEP and share < 1.0:
            kept = share
            with ground.database.writing() as connection:
                change_if(connection, repository.JOBS, job_id, {"state": "running"}, progress=share)

    return keep


@contextmanager
def _alone_here(job_id: str) -> Iterator[bool]:
    """Whether no other thread of this process does the job."""
    with _doing_lock:
        alone = job_id not in _doing
        _doing.add(job_id)
    try:
        yield alone
    finally:
        if alone:
            with _doing_lock:
                _doing.discard(job_id)


_doing: set[str] = set()
_doing_lock = threading.Lock()


def _lock_key(job_id: str) -> int:
    return int.from_bytes(hashlib.blake2b(job_id.encode(), digest_size=8).digest(), "big", signed=True)


def _finish(ground: Ground, job_id: str, attempt: int, *, state: str, **values: Any) -> dict[str, Any]:
    """End the attempt of a job, unless another process has started a new attempt meanwhile."""
    with ground.database.writing() as connection:
        try:
            move(
                connection,
                JOB,
                job_id,
                state,
                where={"attempts": attempt},
                finished_utc_ns=utc_now_ns(),
                **values,
            )
        except StateConflict as error:
            log.warning("job %s: attempt %d ended after another one had started: %s", job_id, attempt, error)
            return repository.get(connection, repository.JOBS, job_id, JOB.kind)
        job = repository.get(connection, repository.JOBS, job_id, JOB.kind)
        publish(
            connection,
            "job",
            {"id": job_id, "kind": job["kind"], "state": job["state"], "result": job["result"]},
        )
    took_s = (job["finished_utc_ns"] - job["started_utc_ns"]) / 1e9
    told = {"job": job_id, "kind": job["kind"], "state": job["state"], "seconds": round(took_s, 3)}
    log.info("job %s (%s) is %s after %.1f s", job_id, job["kind"], job["state"], took_s, extra=told)
    return job


def unfinished_jobs(ground: Ground) -> list[str]:
    """Jobs that were entered and have not come to an end, the oldest first."""
    table = repository.JOBS
    with ground.database.reading() as connection:
        rows = connection.execute(
            select(table.c.id).where(table.c.state.not_in(FINISHED)).order_by(table.c.created_utc_ns)
        )
        return [str(row[0]) for row in rows]
