"""What the service does by itself every night: trends with limit checks, and taking away what is no longer needed.

The raw telemetry, what is decoded from it, reports and the audit log are kept for good. What is watched and forgotten
(the feed, finished jobs, answers to idempotency keys, what broken uploads left) goes after `retention_days`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from sqlalchemy import Connection, delete, select

from ground_service.clock import utc_now_ns
from ground_service.errors import NotFound
from ground_service.events import LimitsBroken, publish
from ground_service.ground import Ground
from ground_service.ingest.redecode import readable_version
from ground_service.passes.cache import remembered
from ground_service.passes.series import PARAMETERS, SeriesReading
from ground_service.passes.span import PassSpan
from ground_service.passes.trends import Trend, trend_of
from ground_service.store import events, repository, rollups
from ground_service.store.files import UNPACKING, remove_leftovers
from ground_service.timekeeping.store import load_correlations
from lunar.timescales import format_utc
from tmtc.dictionary import DICTIONARY

TREND_DAYS = 30
TREND_POINTS = 60
RETENTION_DAYS = 90
DAY_NS = 86_400_000_000_000
ABANDONED_S = 86_400.0
"""Age from which temporary files are leftovers."""


def nightly_job_id(utc_ns: int) -> str:
    """Return the id of the nightly job of a day, which makes repeated additions the same job."""
    return hashlib.sha256(f"nightly {format_utc(utc_ns)[:10]}".encode()).hexdigest()[:32]


def nightly(ground: Ground, arguments: Mapping[str, Any], _job_id: str = "") -> dict[str, Any]:
    """Trends of every spacecraft, and what was taken away."""
    with ground.database.reading() as connection:
        vehicles = [dict(row) for row in connection.execute(select(repository.VEHICLES)).mappings()]
    found = []
    for vehicle in vehicles:
        trends = vehicle_trends(ground, vehicle["id"])
        if trends:
            found.append(
                {
                    "spacecraft_id": vehicle["ccsds_id"],
                    "instance": vehicle["instance"],
                    "trends": [trend_view(trend) for trend in trends],
                }
            )
    broken = [
        {
            **{key: one[key] for key in ("spacecraft_id", "instance")},
            "parameter": trend["parameter"],
            "limit_state": trend["limit_state"],
        }
        for one in found
        for trend in one["trends"]
        if trend["limit_state"] != "within"
    ]
    if broken:
        with ground.database.writing() as connection:
            publish(connection, LimitsBroken(broken=broken))
    removed = tidy(ground, int(arguments.get("retention_days", RETENTION_DAYS)))
    return {"spacecraft": found, "limits_broken": broken, "removed": removed}


def spacecraft_trends(ground: Ground, spacecraft_id: int, instance: str) -> list[Trend]:
    """Trends of the last days of a spacecraft.

    Raises
    ------
    NotFound
        If nothing is known of it.
    """
    with ground.database.reading() as connection:
        row = repository.find(connection, repository.VEHICLES, ccsds_id=spacecraft_id, instance=instance)
    if row is None:
        raise NotFound("spacecraft", f"{spacecraft_id} ({instance})")
    return vehicle_trends(ground, row["id"])


def vehicle_trends(ground: Ground, vehicle: int) -> list[Trend]:
    """Trends of the last `TREND_DAYS` days of on-board time in which there is housekeeping."""
    with ground.database.reading() as connection:
        return remembered(ground, connection, ("trends", vehicle), lambda: _trends(connection, vehicle))


def _trends(connection: Connection, vehicle: int) -> list[Trend]:
    version = readable_version(connection, vehicle)
    _, _, last = rollups.rolled_extent(connection, "housekeeping", vehicle, version, 0, 0, (1 << 48) - 1)
    if last == 0:
        return []
    first = max(last - (TREND_DAYS * 86_400 << 16), 0)
    span = PassSpan(vehicle, first, last, load_correlations(connection, vehicle), version)
    reading = SeriesReading(connection, span, "housekeeping", 0, TREND_POINTS)
    definition = DICTIONARY.packet("housekeeping")
    read = reading.series({name: definition.field(name).unit for name in PARAMETERS})
    trends = (trend_of(definition.field(one.name), one.buckets) for one in read)
    return [trend for trend in trends if trend is not None]


def trend_view(trend: Trend) -> dict[str, Any]:
    """A trend as plain values; a slope that is not known as None."""
    values = asdict(trend)
    slope = values["slope_per_day"]
    return {**values, "slope_per_day": None if slope != slope else slope}


def tidy(ground: Ground, retention_days: int) -> dict[str, int]:
    """Take away what is older than it is kept; how much of each kind that was."""
    before = utc_now_ns() - retention_days * DAY_NS
    jobs, answers = repository.JOBS, repository.ANSWERS
    with ground.database.writing() as connection:
        removed = {
            "events": events.delete_before(connection, before),
            "jobs": connection.execute(
                delete(jobs).where(jobs.c.finished_utc_ns < before, jobs.c.state.in_(("done", "failed")))
            ).rowcount,
            "answers": connection.execute(delete(answers).where(answers.c.created_utc_ns < before)).rowcount,
        }
    removed["files"] = ground.files.remove_leftovers() + remove_leftovers(ground.home, UNPACKING)
    return removed
