"""Nightly job: removal of what is no longer needed, trends with limit checks, reports of the last complete month.

The raw telemetry, what is decoded from it, reports and the audit log are kept for good. What is watched and forgotten
(the feed, finished jobs, answers to idempotency keys, what broken uploads left) goes after `retention_days`, tokens of
expired browser sessions at once. Regression archives go by their age since the last use and by their total size, if the
settings say so; the audit log has a record of each.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ground_service.access.audit_log import audit_head, parse_head
from ground_service.access.store import delete_answers, delete_ended_sessions
from ground_service.clock import utc_now_ns
from ground_service.errors import InvalidInput
from ground_service.evaluation.performance.service import make_due_reports
from ground_service.events import LimitsBroken, publish
from ground_service.ground import Ground
from ground_service.jobs.store import delete_finished
from ground_service.passes.service import vehicle_trends
from ground_service.regression.archives import let_go, remove_unfinished
from ground_service.store import audit, events
from ground_service.store.files import UNPACKING, remove_leftovers
from ground_service.store.vehicles import all_vehicles, get_vehicle
from ground_service.worker.notifications import key_of, signature
from lunar.timescales import format_utc

RETENTION_DAYS = 90
DAY_NS = 86_400_000_000_000


def nightly_job_id(utc_ns: int) -> str:
    """Return the id of the nightly job of a day, which makes repeated additions the same job."""
    return hashlib.sha256(f"nightly {format_utc(utc_ns)[:10]}".encode()).hexdigest()[:32]


def plan_job_id(utc_ns: int) -> str:
    """Return the id of the job that plans in an hour of mission time."""
    return hashlib.sha256(f"plan {format_utc(utc_ns)[:13]}".encode()).hexdigest()[:32]


def nightly(ground: Ground, arguments: Mapping[str, Any], _job_id: str = "") -> dict[str, Any]:
    """What was taken away, and trends and due reports of every spacecraft.

    The removal is first, so that a failure of the rest does not make the archive grow.
    """
    removed = tidy(ground, int(arguments.get("retention_days", RETENTION_DAYS)))
    removed["archives"] = remove_archives(
        ground, int(arguments.get("archive_days", 0)), int(arguments.get("archive_limit_mib", 0))
    )
    if arguments.get("audit_heads"):
        keep_head(ground, Path(arguments["audit_heads"]))
    with ground.database.reading() as connection:
        vehicles = all_vehicles(connection)
    found: list[dict[str, Any]] = []
    for vehicle in vehicles:
        trends = vehicle_trends(ground, vehicle.id)
        if trends:
            found.append(
                {
                    "spacecraft_id": vehicle.ccsds_id,
                    "instance": vehicle.instance,
                    "trends": [trend.model_dump(mode="json") for trend in trends],
                }
            )
    broken = [one for vehicle in vehicles for one in broken_limits(ground, vehicle.id)]
    if broken:
        with ground.database.writing() as connection:
            publish(connection, LimitsBroken(broken=broken))
    monthly, failed = make_due_reports(ground)
    return {
        "spacecraft": found,
        "limits_broken": broken,
        "monthly_reports": monthly,
        "monthly_reports_failed": failed,
        "removed": removed,
    }


def remove_archives(ground: Ground, days: int, limit_mib: int) -> int:
    """Remove the regression archives above an age or a total size, 0: none; return their number."""
    removed = let_go(
        ground,
        unused_for_ns=days * DAY_NS if days else None,
        limit_octets=limit_mib << 20 if limit_mib else None,
    )
    return len(removed)


def broken_limits(ground: Ground, vehicle: int) -> list[dict[str, Any]]:
    """Return the housekeeping parameters of a vehicle whose trends are outside their limits."""
    with ground.database.reading() as connection:
        found = get_vehicle(connection, vehicle)
    return [
        {
            "spacecraft_id": found.ccsds_id,
            "instance": found.instance,
            "parameter": trend.parameter,
            "limit_state": trend.limit_state,
        }
        for trend in vehicle_trends(ground, vehicle)
        if trend.limit_state != "within"
    ]


def tidy(ground: Ground, retention_days: int) -> dict[str, int]:
    """Take away what is older than it is kept; how much of each kind that was."""
    now = utc_now_ns()
    before = now - retention_days * DAY_NS
    with ground.database.writing() as connection:
        removed = {
            "events": events.delete_before(connection, before),
            "jobs": delete_finished(connection, before),
            "answers": delete_answers(connection, before),
            "sessions": delete_ended_sessions(connection, now),
        }
    removed["files"] = (
        ground.files.remove_leftovers() + remove_leftovers(ground.home, UNPACKING) + remove_unfinished(ground)
    )
    return removed


def keep_head(ground: Ground, folder: Path) -> None:
    """Write the signed head of the audit chain into a file of today; later ones of the day are further lines."""
    head = audit_head(ground)
    line = f"{head.number}:{head.sha256}"
    with (folder / f"{format_utc(utc_now_ns())[:10]}.head").open("a") as stream:
        stream.write(f"{line} {signature(key_of(ground.home, 'audit'), line.encode())}\n")


def kept_heads(ground: Ground, given: str) -> list[audit.Head]:
    """Return the head that is given as NUMBER:SHA256, or the heads in a folder of `keep_head`.

    Raises
    ------
    InvalidInput
        There is none, or one was not signed with the key of this service.
    """
    folder = Path(given)
    if not folder.is_dir():
        return [parse_head(given)]
    key = key_of(ground.home, "audit")
    lines = [line.split() for path in folder.glob("*.head") for line in path.read_text().splitlines()]
    if not lines or any([signature(key, head.encode())] != signed for head, *signed in lines):
        raise InvalidInput(given, "", "heads signed with the key of this service", "others or none")
    return [parse_head(head) for head, _ in lines]
