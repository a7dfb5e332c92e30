"""Condition of a deployment: waiting work, disk, backups, time correlations, scheduler."""

from __future__ import annotations

import json
import shutil
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from pydantic import Field

from ground_service.clock import mission_now_ns, utc_now_ns
from ground_service.ground import Ground
from ground_service.http.model import Entity, UtcTime
from ground_service.store import leases
from ground_service.worker.backup import MANIFEST
from ground_service.worker.presence import Process, all_disagreements, running_processes
from ground_service.worker.scheduler import LEASE
from ground_service.worker.store import WorkCounts, count_work, newest_correlations, vehicles_received
from lunar.timescales import parse_utc


class Health(Entity):
    """State of the service."""

    status: str = Field(examples=["ok"])


class CorrelationAge(Entity):
    """Age of the newest time correlation of a spacecraft in one instance."""

    spacecraft_id: int = Field(examples=[76])
    instance: str = Field(examples=["flight"])
    age_s: float = Field(description="Time since it was made, s")


class ServiceStatus(Entity):
    """Condition of the deployment: waiting work, disk, backups, time correlations, scheduler."""

    time: UtcTime = Field(description="Time of day, as in records and logs")
    mission_time: UtcTime = Field(description="Time of operations: contacts, windows and shelved alarms")
    complaints: list[str] = Field(description="What an operator has to look after; empty: nothing")
    jobs: dict[str, int] = Field(description="Number of jobs by state", examples=[{"done": 12, "queued": 1}])
    ingests: dict[str, int] = Field(description="Number of ingests by state", examples=[{"done": 3}])
    queue_age_s: float = Field(description="Age of the oldest job that waits, s; 0: none waits")
    ingest_lag_s: float = Field(description="Age of the oldest unfinished ingest, s; 0: none")
    disk_free_octets: int
    disk_octets: int
    backup_age_s: float | None = Field(description="Age of the newest backup, s; null: unknown")
    scheduler: str | None = Field(description="Process that does the recurring work; null: none")
    processes: dict[str, int] = Field(
        description="Running processes by kind; empty: the service is one process", examples=[{"api": 2}]
    )
    correlations: list[CorrelationAge]


QUEUE_AGE_LIMIT_S = 900.0
INGEST_LAG_LIMIT_S = 600.0
DISK_FREE_LIMIT = 0.1
BACKUP_AGE_LIMIT_S = 93_600.0
CORRELATION_AGE_LIMIT_S = 172_800.0
"""Limits above (share of free disk: below) which somebody has to act, as in deploy/prometheus/linna.rules.yml."""

BROKER_S = 1.0

FLIGHT = "flight"
"""Instance of a spacecraft whose time correlation has to be kept; others are simulations and replays."""


@dataclass(frozen=True, slots=True)
class Condition:
    """Condition of a deployment now; ages in seconds, sizes in octets."""

    counts: WorkCounts
    queue_age_s: float
    ingest_lag_s: float
    disk_free: int
    disk_size: int
    backup_age_s: float | None
    correlation_ages_s: dict[tuple[int, str], float]
    scheduler: str | None
    broker: bool | None = None
    """Whether the broker answers; None: jobs run in the service."""
    processes: dict[str, int] = field(default_factory=dict)
    """Running processes by kind; empty with SQLite."""
    disagreements: tuple[str, ...] = ()
    runner: bool | None = None
    """Whether a worker sees a runner; None: no worker has an exchange folder."""
    backup_missing: bool = False
    """A folder of backups is set, and no complete backup is in it."""
    uncorrelated: tuple[int, ...] = ()
    """Flown spacecraft with received telemetry and without any time correlation."""


def read_condition(ground: Ground, backups: Path | None, broker_url: str | None = None) -> Condition:
    """Return the condition of a deployment; the age of its newest backup is unknown without a folder of backups."""
    processes: list[Process] = []
    if ground.database.dialect == "postgresql":
        processes = running_processes(ground.database)
    with ground.database.reading() as connection:
        counts = count_work(connection)
        correlations = newest_correlations(connection)
        received = vehicles_received(connection, FLIGHT)
        scheduler = leases.owner_of(connection, LEASE)
    now = utc_now_ns()
    disk = shutil.disk_usage(ground.home)

    def age_s(utc_ns: int | None) -> float:
        return 0.0 if utc_ns is None else max((now - utc_ns) / 1e9, 0.0)

    newest = None if backups is None else newest_backup_utc_ns(backups)
    return Condition(
        counts,
        age_s(counts.oldest_job_utc_ns),
        age_s(counts.oldest_ingest_utc_ns),
        disk.free,
        disk.total,
        None if newest is None else age_s(newest),
        {vehicle: age_s(utc_ns) for vehicle, utc_ns in correlations.items()},
        scheduler,
        broker=None if broker_url is None else broker_answers(broker_url),
        processes=_kinds(processes, broker_url),
        disagreements=tuple(all_disagreements(processes)),
        runner=_runner(processes),
        backup_missing=backups is not None and newest is None,
        uncorrelated=tuple(one for one in received if (one, FLIGHT) not in correlations),
    )


def broker_answers(url: str) -> bool:
    """Return whether a Redis broker answers."""
    import redis

    try:
        with redis.Redis.from_url(url, socket_timeout=BROKER_S, socket_connect_timeout=BROKER_S) as client:
            return bool(client.ping())
    except (redis.exceptions.RedisError, OSError):
        return False


def _kinds(processes: list[Process], broker_url: str | None) -> dict[str, int]:
    """Return the number of processes by kind; 0 for workers that a broker needs."""
    counts = Counter(one.kind for one in processes)
    return dict(counts) if broker_url is None or not processes else {"worker": 0, **counts}


def _runner(processes: list[Process]) -> bool | None:
    words = {one.statement.runner for one in processes if one.statement is not None} - {"-"}
    return "yes" in words if words else None


def complaints(found: Condition) -> list[str]:
    """Return what an operator has to look after, in plain sentences."""
    said = []
    if found.scheduler is None:
        said.append("No process does the recurring work.")
    if found.broker is False:
        said.append("The broker does not answer.")
    if found.processes.get("worker") == 0:
        said.append("No worker does jobs.")
    if found.runner is False:
        said.append("No runner of payload builds responds.")
    if found.disagreements:
        said.append(f"Processes disagree: {'; '.join(found.disagreements)}.")
    if found.queue_age_s > QUEUE_AGE_LIMIT_S:
        said.append(f"A job has waited for {found.queue_age_s:.0f} s.")
    if found.ingest_lag_s > INGEST_LAG_LIMIT_S:
        said.append(f"An ingest has been unfinished for {found.ingest_lag_s:.0f} s.")
    if failed := found.counts.jobs.get(("ingest", "failed")):
        said.append(f"{failed} ingests have failed; repeat or dismiss them on the page Shift.")
    if found.disk_free < DISK_FREE_LIMIT * found.disk_size:
        said.append(f"{found.disk_free / found.disk_size:.0%} of the disk of the archive are free.")
    if found.backup_missing:
        said.append("No backup was found.")
    if found.backup_age_s is not None and found.backup_age_s > BACKUP_AGE_LIMIT_S:
        said.append(f"The newest backup is {found.backup_age_s / 3600.0:.0f} h old.")
    said += [f"Spacecraft {number} has no time correlation." for number in found.uncorrelated]
    for (number, instance), age_s in sorted(found.correlation_ages_s.items()):
        if instance == FLIGHT and age_s > CORRELATION_AGE_LIMIT_S:
            said.append(f"The time correlation of spacecraft {number} is {age_s / 3600.0:.0f} h old.")
    return said


def service_status(ground: Ground, backups: Path | None, broker_url: str | None = None) -> ServiceStatus:
    """Return the condition of the deployment for pages and programs."""
    found = read_condition(ground, backups, broker_url)
    jobs: Counter[str] = Counter()
    for (_, state), count in found.counts.jobs.items():
        jobs[state] += count
    return ServiceStatus(
        time=UtcTime(utc_now_ns()),
        mission_time=UtcTime(mission_now_ns()),
        complaints=complaints(found),
        jobs=dict(jobs),
        ingests=found.counts.ingests,
        queue_age_s=found.queue_age_s,
        ingest_lag_s=found.ingest_lag_s,
        disk_free_octets=found.disk_free,
        disk_octets=found.disk_size,
        backup_age_s=found.backup_age_s,
        scheduler=found.scheduler,
        processes=found.processes,
        correlations=[
            CorrelationAge(spacecraft_id=number, instance=instance, age_s=age_s)
            for (number, instance), age_s in sorted(found.correlation_ages_s.items())
        ],
    )


def newest_backup_utc_ns(folder: Path) -> int | None:
    """Return when the newest complete backup in a folder was made; None without any."""
    made = []
    for manifest in folder.glob(f"*/{MANIFEST}"):
        try:
            made.append(parse_utc(json.loads(manifest.read_text(encoding="utf-8"))["made_utc"]))
        except (OSError, ValueError, KeyError, TypeError):
            continue  # not a backup, or one that is being deleted
    return max(made, default=None)
