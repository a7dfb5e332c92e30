"""Jobs: named pieces of work that can be asked for, watched and done again without harm.

A job is a row before it is anything else, so it is visible from the moment it is asked for, whoever does it: this
process, a thread of the server, or a worker on another machine. Doing a finished job again does nothing.
"""

from __future__ import annotations

import logging
import uuid
from collections.abc import Callable, Mapping
from typing import Any

from sqlalchemy import select

from ground_service.clock import utc_now_ns
from ground_service.errors import GroundError, InvalidInput
from ground_service.services.archive_zip import import_zip
from ground_service.services.feed import publish
from ground_service.services.ground import Ground
from ground_service.services.ingest import run_ingest
from ground_service.services.reports import make_report
from ground_service.services.upkeep import nightly
from ground_service.store import repository
from lunar.errors import LunarError
from reports.errors import ReportError
from tmtc.errors import TmtcError

log = logging.getLogger(__name__)

FINISHED = ("done", "failed")

Work = Callable[[Ground, Mapping[str, Any], str], dict[str, Any]]


def _report(ground: Ground, arguments: Mapping[str, Any], job_id: str) -> dict[str, Any]:
    made = make_report(ground, int(arguments["pass_id"]), report_id=job_id, pdf=True)
    return {"report_id": made.report_id, "pass_id": made.pass_id}


def _ingest(ground: Ground, arguments: Mapping[str, Any], _job_id: str) -> dict[str, Any]:
    result = run_ingest(
        ground,
        int(arguments["ingest_id"]),
        spacecraft_id=arguments["spacecraft_id"],
        instance=str(arguments["instance"]),
    )
    return {"ingest_id": result.ingest_id, "packets": result.packets, "packets_new": result.packets_new}


def _archive(ground: Ground, arguments: Mapping[str, Any], _job_id: str) -> dict[str, Any]:
    path = ground.files.path(str(arguments["sha256"]))
    return {"pass_id": import_zip(ground, path, str(arguments["name"]))}


def _replay(ground: Ground, arguments: Mapping[str, Any], job_id: str) -> dict[str, Any]:
    from ground_service.services.regression_jobs import replay_job

    return replay_job(ground, arguments, job_id)


def _regression(ground: Ground, arguments: Mapping[str, Any], job_id: str) -> dict[str, Any]:
    from ground_service.services.regression_jobs import regression_job

    return regression_job(ground, arguments, job_id)


WORK: dict[str, Work] = {
    "report": _report,
    "ingest": _ingest,
    "archive": _archive,
    "replay": _replay,
    "regression": _regression,
    "nightly": nightly,
}
"""What can be asked for, by kind. Each may be run twice with the same arguments and job without harm."""


def enter_job(ground: Ground, kind: str, arguments: Mapping[str, Any], *, job_id: str | None = None) -> str:
    """Enter a job to be done; its id. Entering the same id again changes nothing."""
    if kind not in WORK:
        raise InvalidInput("job", "kind", " or ".join(WORK), kind)
    identity = job_id or uuid.uuid4().hex
    with ground.database.writing() as connection:
        if repository.find(connection, repository.JOBS, id=identity) is None:
            repository.add(
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
            publish(connection, "job", {"id": identity, "kind": kind, "state": "queued"})
    return identity


def run_job(ground: Ground, job_id: str) -> dict[str, Any]:
    """Do a job that was entered; its row afterwards. A job that fails for its input says why and is not repeated."""
    with ground.database.writing() as connection:
        job = repository.get(connection, repository.JOBS, job_id, "job")
        if job["state"] in FINISHED:
            return job
        repository.change(
            connection,
            repository.JOBS,
            job_id,
            state="running",
            attempts=job["attempts"] + 1,
            started_utc_ns=utc_now_ns(),
        )
        publish(connection, "job", {"id": job_id, "kind": job["kind"], "state": "running"})
    try:
        result = WORK[job["kind"]](ground, job["arguments"], job_id)
    except (GroundError, TmtcError, LunarError, ReportError) as error:
        log.warning("job %s (%s) failed: %s", job_id, job["kind"], error)
        return _finish(ground, job_id, state="failed", error=str(error))
    return _finish(ground, job_id, state="done", result=result, progress=1.0, error=None)


def _finish(ground: Ground, job_id: str, **values: Any) -> dict[str, Any]:
    with ground.database.writing() as connection:
        repository.change(connection, repository.JOBS, job_id, finished_utc_ns=utc_now_ns(), **values)
        job = repository.get(connection, repository.JOBS, job_id, "job")
        publish(
            connection,
            "job",
            {"id": job_id, "kind": job["kind"], "state": job["state"], "result": job["result"]},
        )
        return job


def unfinished_jobs(ground: Ground) -> list[str]:
    """Jobs that were entered and have not come to an end, the oldest first."""
    table = repository.JOBS
    with ground.database.reading() as connection:
        rows = connection.execute(
            select(table.c.id).where(table.c.state.not_in(FINISHED)).order_by(table.c.created_utc_ns)
        )
        return [str(row[0]) for row in rows]
