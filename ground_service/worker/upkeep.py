"""Nightly job: removal of what is no longer needed, trends with limit checks, reports of the last complete month.

Raw and decoded telemetry, reports and the audit log are kept without limit. Data of the operation
(the feed, finished jobs, answers to idempotency keys, what broken uploads left) goes after `retention_days`, tokens of
expired browser sessions at once. Regression archives go by their age since the last use and by their total size, if the
settings say so; the audit log has a record of each.
"""

import hashlib
import logging
import re
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from ground_service.access.store import audit_head, delete_answers, delete_ended_sessions
from ground_service.clock import utc_now_ns
from ground_service.errors import InvalidInput
from ground_service.evaluation.performance.service import make_due_reports
from ground_service.ground import Ground
from ground_service.jobs.service import delete_finished, find_job
from ground_service.missions.automation import Channel
from ground_service.missions.store import channels_in_force
from ground_service.passes.service import vehicle_trends
from ground_service.regression.archives import let_go, remove_unfinished
from ground_service.regression.service import condition_of_archive
from ground_service.store import audit, events
from ground_service.store.event_kinds import LimitsBroken, publish
from ground_service.store.files import UNPACKING, remove_leftovers
from ground_service.store.vehicles import all_vehicles, get_vehicle
from ground_service.worker.notifications import key_of, send, signature
from lunar.constants import DAY_NS
from lunar.timescales import format_utc

log = logging.getLogger(__name__)

RETENTION_DAYS = 90
CHANNEL = "channel:"
_HEAD = re.compile(r"\b([0-9]+):([0-9a-f]{64})\b(?:\W+(?:signature\W+)?([0-9a-f]{64})\b)?")
"""Number, hash and signature in a line of a file, a JSON document or an e-mail."""


def nightly_job_id(utc_ns: int, kind: str = "nightly") -> str:
    """Return the id of the nightly job of a day, which makes repeated additions the same job."""
    return hashlib.sha256(f"{kind} {format_utc(utc_ns)[:10]}".encode()).hexdigest()[:32]


def plan_job_id(utc_ns: int) -> str:
    """Return the id of the job that plans in an hour of mission time."""
    return hashlib.sha256(f"plan {format_utc(utc_ns)[:13]}".encode()).hexdigest()[:32]


def nightly(ground: Ground, arguments: Mapping[str, Any], _job_id: str = "") -> dict[str, Any]:
    """Remove expired rows; compute trends and due reports of every spacecraft.

    The removal is first, so that a failure of the rest does not make the archive grow. Without a nightly job of the day
    before, nothing is removed: a clock that has jumped ahead would make everything old.
    """
    removed: dict[str, int] = {}
    if ground.read(find_job, nightly_job_id(utc_now_ns() - DAY_NS)) is None:
        log.warning("no nightly job ran a day ago: nothing is removed, because the clock may have jumped")
    else:
        removed = tidy(ground, int(arguments.get("retention_days", RETENTION_DAYS)))
        removed["archives"] = remove_archives(
            ground, int(arguments.get("archive_days", 0)), int(arguments.get("archive_limit_mib", 0))
        )
    vehicles = ground.read(all_vehicles)
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
        ground.write(publish, LimitsBroken(broken=broken))
    monthly, failed = make_due_reports(ground)
    if arguments.get("audit_heads"):
        keep_head(ground, arguments["audit_heads"])
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
        condition=partial(condition_of_archive, ground),
    )
    return len(removed)


def broken_limits(ground: Ground, vehicle: int) -> list[dict[str, Any]]:
    """Return the housekeeping parameters of a vehicle whose trends are outside their limits."""
    found = ground.read(get_vehicle, vehicle)
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


def keep_head(ground: Ground, target: str) -> None:
    """Write the signed head of the audit chain into a file of today in a folder, or send it to `channel:NAME`."""
    head = audit_head(ground)
    line = f"{head.number}:{head.sha256}"
    signed = signature(key_of(ground.home, "audit"), line.encode())
    if not target.startswith(CHANNEL):
        with (Path(target) / f"{format_utc(utc_now_ns())[:10]}.head").open("a") as stream:
            stream.write(f"{line} {signed}\n")
        return
    identity, content = f"audit-{head.number}-{signed[:16]}", {"head": line, "signature": signed}
    channel = channel_of_heads(ground, target)
    send(ground.home, channel, identity, "LINNA: audit head", content, networks=ground.networks)


def channel_of_heads(ground: Ground, target: str) -> Channel:
    """Return the channel of `channel:NAME`.

    Raises
    ------
    InvalidInput
        If no mission description in force has it.
    """
    name = target.removeprefix(CHANNEL)
    for _, found, channel in ground.read(channels_in_force):
        if found == name:
            return channel
    raise InvalidInput("LINNA_AUDIT_HEADS", "", "a channel of a mission description in force", name)


def kept_heads(ground: Ground, given: str) -> list[audit.Head]:
    """Return the head that is given as NUMBER:SHA256, or those of `keep_head` in a file or the files of a folder.

    Raises
    ------
    InvalidInput
        There is none, or one was not signed with the key of this service.
    """
    place = Path(given)
    if not place.exists():
        match = _HEAD.fullmatch(given.strip())
        if match is None or match[3]:
            expected = "NUMBER:SHA256 as 'linna audit head' prints it, or a file or folder of signed heads"
            raise InvalidInput("audit head", "", expected, repr(given)[:100])
        return [audit.Head(int(match[1]), match[2])]
    files = sorted(place.iterdir()) if place.is_dir() else [place]
    found = [one for path in files for one in _HEAD.findall(path.read_text(errors="replace"))]
    key = key_of(ground.home, "audit")
    if not found or any(signature(key, f"{n}:{sha256}".encode()) != signed for n, sha256, signed in found):
        raise InvalidInput(given, "", "heads signed with the key of this service", "others or none")
    return [audit.Head(int(number), sha256) for number, sha256, _ in found]
