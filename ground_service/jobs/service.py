"""Job queue: named work in the database, added by any capability and run by `worker`.

A job is a row, so it is visible from the request on, whether it runs in this process, in a thread of the server or in a
worker on another machine.
"""

from __future__ import annotations

import hashlib
import uuid
from collections.abc import Mapping
from typing import Any

from sqlalchemy import Connection

from ground_service import tracing
from ground_service.clock import utc_now_ns
from ground_service.errors import Conflict, InvalidInput
from ground_service.events import JobChanged, publish
from ground_service.ground import Ground
from ground_service.jobs import store
from ground_service.store.vehicles import hold

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


def add_job(
    connection: Connection, kind: str, arguments: Mapping[str, Any], *, job_id: str | None = None
) -> str:
    """Add a job as `enter_job` does, within the caller's transaction.

    Raises
    ------
    Conflict
        If the id belongs to a different job.
    """
    if kind not in KINDS:
        raise InvalidInput("job", "kind", " or ".join(KINDS), kind)
    identity = job_id or uuid.uuid4().hex
    if store.add_job(connection, identity, kind, arguments, utc_now_ns(), tracing.current()):
        publish(connection, JobChanged(id=identity, kind=kind, state="queued"))
    else:
        known = store.get_job(connection, identity)
        if known.kind != kind or any(
            known.arguments.get(name) != arguments.get(name) for name in IDENTITY.get(kind, ())
        ):
            raise Conflict(OTHER_REQUEST)
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
        If the id belongs to a different job.
    """
    with ground.database.writing() as connection:
        hold(connection, f"job {job_id}")
        new = store.find_job(connection, job_id) is None
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
