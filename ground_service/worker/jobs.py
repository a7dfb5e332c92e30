"""Jobs: named pieces of work that can be asked for, watched and done again without harm.

A job is a row before it is anything else, so it is visible from the moment of the request, whether it runs in this
process, a thread of the server, or a worker on another machine. Doing a finished job again does nothing.
"""

import logging
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from typing import Any

from ground_service.clock import utc_now_ns
from ground_service.errors import PASSING, GroundError, StateConflict, public_text, storage_error
from ground_service.evaluation.service import make_report, reevaluate
from ground_service.ground import Ground
from ground_service.ingest.service import apply_definition, derive_without, run_ingest
from ground_service.jobs import service
from ground_service.jobs.service import FINISHED, Job, enter_job
from ground_service.logs import span
from ground_service.passes.archive_import import import_zip
from ground_service.planning.standing import plan_tick
from ground_service.regression.jobs import analysis_job, regression_job, rendering_job, replay_job
from ground_service.store.event_kinds import JobChanged, publish
from ground_service.telemetry.decoding import catch_up, redecode_job_id, vehicles_behind
from ground_service.worker.actions import run_steps, send_messages
from ground_service.worker.upkeep import nightly
from kernels.memory import give_back
from lunar.errors import LunarError
from reports.errors import ReportError
from tmtc.errors import TmtcError

log = logging.getLogger(__name__)

ATTEMPTS_LIMIT = 25
"""A job that ended with its process this often (for want of memory, say) is not tried again."""

PROGRESS_STEP = 0.02

Work = Callable[[Ground, Mapping[str, Any], str], dict[str, Any]]


def _report(ground: Ground, arguments: Mapping[str, Any], job_id: str) -> dict[str, Any]:
    with span("report", attributes={"linna.pass": int(arguments["pass_id"])}):
        made = make_report(ground, int(arguments["pass_id"]), report_id=job_id)
    return {"report_id": made.report_id, "pass_id": made.pass_id}


def _reevaluate(ground: Ground, arguments: Mapping[str, Any], job_id: str) -> dict[str, Any]:
    """Evaluate a pass again because of an event, and make a report if anything in it differs."""
    pass_id, event = int(arguments["pass_id"]), int(arguments["event"])
    with span("report", attributes={"linna.pass": pass_id}):
        made = reevaluate(ground, pass_id, report_id=job_id, event=event)
    return {"report_id": None if made is None else made.report_id, "pass_id": pass_id, "event": event}


def _plan(ground: Ground, arguments: Mapping[str, Any], _job_id: str) -> dict[str, Any]:
    """Bring the plan of standing requests up to date."""
    return dict(plan_tick(ground, vehicle_id=arguments.get("vehicle_id")))


def _ingest(ground: Ground, arguments: Mapping[str, Any], job_id: str) -> dict[str, Any]:
    result = run_ingest(ground, int(arguments["ingest_id"]), progress=_progress_of(ground, job_id))
    return {"ingest_id": result.ingest_id, "packets": result.packets, "packets_new": result.packets_new}


def _archive(ground: Ground, arguments: Mapping[str, Any], _job_id: str) -> dict[str, Any]:
    path = ground.files.path(str(arguments["sha256"]))
    return {"pass_id": import_zip(ground, path, str(arguments["name"]))}


def _redecode(ground: Ground, arguments: Mapping[str, Any], _job_id: str) -> dict[str, Any]:
    vehicle = int(arguments["vehicle_id"])
    return {"rows": catch_up(ground, vehicle) + apply_definition(ground, vehicle)}


def _withdraw(ground: Ground, arguments: Mapping[str, Any], _job_id: str) -> dict[str, Any]:
    return {"ingests": derive_without(ground, int(arguments["ingest_id"]))}


WORK: dict[str, Work] = {
    "report": _report,
    "ingest": _ingest,
    "archive": _archive,
    "replay": replay_job,
    "rendering": rendering_job,
    "regression": regression_job,
    "analysis": analysis_job,
    "nightly": nightly,
    "plan": _plan,
    "redecode": _redecode,
    "withdrawal": _withdraw,
    "re-evaluation": _reevaluate,
    "automation": lambda ground, arguments, _job_id: run_steps(ground, int(arguments["event"])),
    "notification": lambda ground, arguments, _job_id: send_messages(ground, int(arguments["event"])),
}
"""Functions of the jobs by kind (`jobs.KINDS`). Each may be run twice with the same arguments and job without harm."""


def enter_redecoding(ground: Ground) -> list[str]:
    """Enter a job for every vehicle that an older dictionary decoded; their ids. Once each, however often asked."""
    return [
        enter_job(ground, "redecode", {"vehicle_id": vehicle}, job_id=redecode_job_id(vehicle))
        for vehicle in vehicles_behind(ground)
    ]


def run_job(ground: Ground, job_id: str) -> Job:
    """Run a job and return it as it is afterwards. A failed job records the reason and is not repeated.

    A job that is already running, here or in another process, is not started.

    Raises
    ------
    DatabaseUnavailable, StorageFull, StorageReadOnly
        If the database is unavailable, or nothing can be written: the job has not finished and will run again.
    """
    with _alone_here(job_id) as here, ground.database.alone(job_id) as alone:
        if not (here and alone):
            return ground.read(service.get_job, job_id)
        return _run_alone(ground, job_id)


def _run_alone(ground: Ground, job_id: str) -> Job:
    job = ground.read(service.get_job, job_id)
    if job.state in FINISHED:
        return job
    with span(f"job {job.kind}", parent=job.traceparent, attributes={"linna.job": job_id}) as further:
        try:
            done = _attempt(ground, job_id)
        finally:
            give_back()
        further["linna.state"] = done.state
        return done


def _attempt(ground: Ground, job_id: str) -> Job:
    with ground.database.writing() as connection:
        job = service.get_job(connection, job_id)
        if job.state in FINISHED:
            return job
        try:
            attempt = service.start_attempt(connection, job, utc_now_ns())
        except StateConflict:  # another process has started the job since it was read
            return service.get_job(connection, job_id)
        publish(connection, JobChanged(id=job_id, kind=job.kind, state="running"))
    if attempt > ATTEMPTS_LIMIT:
        error = f"given up after {ATTEMPTS_LIMIT} attempts that did not finish"
        return _finish(ground, job_id, attempt, error=error)
    log.info("job %s (%s) begins", job_id, job.kind, extra={"job": job_id, "kind": job.kind})
    try:
        return _finish(ground, job_id, attempt, result=WORK[job.kind](ground, job.arguments, job_id))
    except PASSING as error:
        log.info("job %s (%s) will run again: %s", job_id, job.kind, error)
        _put_back(ground, job_id, attempt)
        raise
    except (GroundError, TmtcError, LunarError, ReportError) as error:
        log.warning("job %s (%s) failed: %s", job_id, job.kind, error)
        return _finish(ground, job_id, attempt, error=public_text(error))
    except Exception as error:  # any error ends the job, which records it
        translated = storage_error(error, "archive") if isinstance(error, OSError) else None
        if isinstance(translated, PASSING):
            log.info("job %s (%s) will run again: %s", job_id, job.kind, error)
            _put_back(ground, job_id, attempt)
            raise translated from error
        log.exception("job %s (%s): unexpected error", job_id, job.kind, extra={"job": job_id})
        return _finish(ground, job_id, attempt, error=public_text(error))


def _put_back(ground: Ground, job_id: str, attempt: int) -> None:
    """Queue a job again that something else broke off; that is no attempt of its own. Not being able to is no harm."""
    with suppress(*PASSING, StateConflict), ground.database.writing() as connection:
        service.requeue(connection, job_id, attempt)


def _progress_of(ground: Ground, job_id: str) -> Callable[[float], None]:
    """Progress of a job, stored in its row in steps with negligible cost."""
    kept = 0.0

    def keep(share: float) -> None:
        nonlocal kept
        if share - kept >= PROGRESS_STEP and share < 1.0:
            kept = share
            ground.write(service.set_progress, job_id, share)

    return keep


@contextmanager
def _alone_here(job_id: str) -> Iterator[bool]:
    """Return whether no other thread of this process does the job."""
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


def _finish(
    ground: Ground, job_id: str, attempt: int, *, result: Mapping[str, Any] | None = None, error: str | None = None
) -> Job:
    """End the attempt of a job, unless another process has started a new attempt meanwhile."""
    with ground.database.writing() as connection:
        finished = utc_now_ns()
        try:
            service.end_attempt(connection, job_id, attempt, finished, result=result, error=error)
        except StateConflict as conflict:
            log.warning("job %s: attempt %d ended after another one had started: %s", job_id, attempt, conflict)
            return service.get_job(connection, job_id)
        job = service.get_job(connection, job_id)
        publish(connection, JobChanged(id=job_id, kind=job.kind, state=job.state, result=job.result))
    took_s = 0.0 if job.started is None else (finished - job.started.utc_ns) / 1e9
    fields = {"job": job_id, "kind": job.kind, "state": job.state, "seconds": round(took_s, 3)}
    log.info("job %s (%s) is %s after %.1f s", job_id, job.kind, job.state, took_s, extra=fields)
    return job
