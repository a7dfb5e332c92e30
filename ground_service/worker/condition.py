"""Condition of a deployment: processes, waiting work, disk, backups, time correlations, scheduler."""

import contextlib
import hashlib
import json
import logging
import os
import secrets
import shutil
import socket
import threading
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Self
from urllib.parse import urlsplit

from pydantic import Field
from sqlalchemy import ColumnElement, Connection, exists, func, select

from ground_service.clock import mission_now_ns, utc_now_ns
from ground_service.errors import GroundError, ServerError
from ground_service.ground import Ground
from ground_service.http.model import Entity, UtcTime
from ground_service.settings import Settings
from ground_service.store import leases, repository
from ground_service.store.database import Database, open_database
from ground_service.worker.backup import MANIFEST
from ground_service.worker.scheduler import LEASE
from lunar.timescales import parse_utc


@dataclass(frozen=True, slots=True)
class WorkCounts:
    """Jobs by kind and state, ingests by state, and passes; the oldest waiting job and the oldest unfinished ingest."""

    jobs: dict[tuple[str, str], int]
    ingests: dict[str, int]
    passes: int
    oldest_job_utc_ns: int | None
    oldest_ingest_utc_ns: int | None


def count_work(connection: Connection) -> WorkCounts:
    """Return the present counts."""
    jobs, ingests, passes = repository.JOBS.c, repository.INGESTS.c, repository.PASSES

    def oldest(column: ColumnElement[int], condition: ColumnElement[bool]) -> int | None:
        found = connection.execute(select(func.min(column)).where(condition)).scalar()
        return None if found is None else int(found)

    by_job = connection.execute(select(jobs.kind, jobs.state, func.count()).group_by(jobs.kind, jobs.state))
    by_ingest = connection.execute(select(ingests.state, func.count()).group_by(ingests.state))
    return WorkCounts(
        {(kind, state): int(count) for kind, state, count in by_job},
        {state: int(count) for state, count in by_ingest},
        int(connection.execute(select(func.count()).select_from(passes)).scalar_one()),
        # The work of regressions is planned: a verdict waits for its replays.
        oldest(
            jobs.created_utc_ns,
            (jobs.state == "queued") & jobs.kind.not_in(("regression", "analysis", "replay", "rendering")),
        ),
        oldest(ingests.received_utc_ns, ingests.state.not_in(("done", "failed", "withdrawn"))),
    )


def vehicles_received(connection: Connection, instance: str) -> list[int]:
    """Return the numbers of the spacecraft from which telemetry was received in an instance."""
    vehicles, packets = repository.VEHICLES.c, repository.PACKETS.c
    received = exists().where(packets.vehicle_id == vehicles.id)
    query = select(vehicles.ccsds_id).where(vehicles.instance == instance, received)
    return [int(one) for one in connection.execute(query.order_by(vehicles.ccsds_id)).scalars()]


def newest_correlations(connection: Connection) -> dict[tuple[int, str], int]:
    """Return when the newest time correlation of each vehicle was made (UTC, ns), by spacecraft number and instance."""
    vehicles, made = repository.VEHICLES.c, repository.CORRELATIONS.c
    query = (
        select(vehicles.ccsds_id, vehicles.instance, func.max(made.created_utc_ns))
        .join_from(repository.VEHICLES, repository.CORRELATIONS, made.vehicle_id == vehicles.id)
        .group_by(vehicles.ccsds_id, vehicles.instance)
    )
    return {(int(number), instance): int(utc_ns) for number, instance, utc_ns in connection.execute(query)}


log = logging.getLogger(__name__)

BEAT_S = 5.0
LEASE_NS = 20_000_000_000
CLOCK_LIMIT_MS = 2000
PREFIX = "process "
STORE_ID = "store-id"
"""File under the home folder with a random name of it, by which processes see whether they share the folder."""

DIGITS = 8
OWN = frozenset(
    {
        *("home", "database_url", "migration_database_url", "backup_role", "allow_database_owner", "broker_url"),
        *("host", "port", "openmct", "live_console", "links", "backups", "log_format", "traces", "data"),
        *("allowed_hosts", "trusted_proxies", "sockets", "sockets_per_user"),
        *("drain_s", "objects_secret_key", "objects_cache_gib", "runner_exchange"),
    }
)
"""Settings that may differ between processes, or that other words of a statement cover."""

GROUPS = ("files", "broker", "provider", "data", "settings")


@dataclass(frozen=True, slots=True)
class Statement:
    """Shared settings of a process: version of the program, digests of `GROUPS`, and its clock minus the database's."""

    version: str
    digests: tuple[str, ...]
    clock_ms: int = 0
    runner: str = "-"
    """State of the runner of payload builds as a worker sees it: yes or no; - without an exchange folder."""

    def text(self) -> str:
        """Return the statement as one line."""
        return " ".join((self.version, *self.digests, str(self.clock_ms), self.runner))

    @classmethod
    def of_text(cls, text: str) -> Self | None:
        """Return the statement of a line; None for that of a version with other groups."""
        first, *digests, clock, runner = text.split(" ")
        return None if len(digests) != len(GROUPS) else cls(first, tuple(digests), int(clock), runner)


@dataclass(frozen=True, slots=True)
class Process:
    """Running process of the deployment."""

    kind: str
    name: str
    statement: Statement | None

    def __str__(self) -> str:
        return f"{self.kind} {self.name}"


def statement_of(ground: Ground, settings: Settings) -> Statement:
    """Return what a process with these settings works with."""
    broker = urlsplit(settings.resolved_broker_url() or "")
    shared = settings.model_dump(mode="json", exclude=set(OWN))
    provider = {name: value for name, value in shared.items() if name.startswith("oidc_")}
    objects = [settings.objects, settings.objects_endpoint, settings.objects_region]
    rest = {name: value for name, value in shared.items() if not name.startswith(("oidc_", "objects"))}
    return Statement(
        version("linna"),
        (
            _digest(objects if settings.objects is not None else _store_id(ground.home)),
            _digest([broker.scheme, broker.hostname, broker.port, broker.path]),
            _digest(provider),
            _digest(ground.data.names()),
            _digest([rest, settings.runner_exchange is not None]),
        ),
    )


def running_processes(database: Database) -> list[Process]:
    """Return the processes that run now, by kind and name."""
    with database.reading() as connection:
        owners = leases.owners(connection, PREFIX)
    found = []
    for name, owner in owners.items():
        kind, _, place = name.removeprefix(PREFIX).partition(" ")
        found.append(Process(kind, place, Statement.of_text(owner)))
    return sorted(found, key=str)


def disagreements(mine: Statement, processes: list[Process]) -> list[str]:
    """Return a line for each process and group in which it differs."""
    lines = []
    for one in processes:
        if one.statement is None:
            continue
        differing = zip(GROUPS, mine.digests, one.statement.digests, strict=True)
        lines += [f"{one}: other {group} than here" for group, own, other in differing if own != other]
    return lines


def all_disagreements(processes: list[Process]) -> list[str]:
    """Return a line for each group in which a process differs from the first one."""
    known = [one for one in processes if one.statement is not None]
    if not known or known[0].statement is None:
        return []
    found = disagreements(known[0].statement, known[1:])
    return [line.replace("than here", f"than {known[0]}") for line in found]


@contextlib.contextmanager
def present(ground: Ground, settings: Settings, kind: str) -> Iterator[None]:
    """State that this process runs, until the end of the block; a service with SQLite is one process and does not.

    Raises
    ------
    ServerError
        If a running process has other settings: a request or a job would have another result there.
    """
    if ground.database.dialect != "postgresql":
        yield
        return
    mine = statement_of(ground, settings)
    others = disagreements(mine, running_processes(ground.database))
    if others:
        raise ServerError(
            "processes of this deployment: expected the same settings and folders in all, found "
            f"{'; '.join(others)} (a process that was killed counts for {LEASE_NS // 1_000_000_000} s)"
        )
    beats = _Beats(settings.resolved_database_url(), kind, mine, ground.runner if kind == "worker" else None)
    beats.start()
    try:
        yield
    finally:
        beats.stop()


class _Beats:
    """Thread that renews the statement of this process, over connections of its own."""

    def __init__(self, database_url: str, kind: str, mine: Statement, runner: Path | None) -> None:
        self._url, self._mine, self._runner = database_url, mine, runner
        self._name = f"{PREFIX}{kind} {socket.gethostname()[:24]}:{os.getpid()}"
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="presence", daemon=True)

    def start(self) -> None:
        self._write()
        self._thread.start()

    def stop(self) -> None:
        self._stopping.set()
        self._thread.join()
        self._write(gone=True)

    def _run(self) -> None:
        while not self._stopping.wait(BEAT_S):
            self._write()

    def _write(self, *, gone: bool = False) -> None:
        # No connection stays open: a worker forks, and its children must not inherit one.
        database = None
        try:
            database = open_database(self._url)
            with database.writing() as connection:
                if gone:
                    leases.remove(connection, self._name)
                    return
                clock_ms = (utc_now_ns() - leases.database_now_ns(connection)) // 1_000_000
                mine = replace(self._mine, clock_ms=clock_ms, runner=_runner_word(self._runner))
                leases.state(connection, self._name, mine.text(), LEASE_NS)
                leases.remove_ended(connection, PREFIX)
        except GroundError as error:
            log.warning("the state of this process is not known to others: %s", error)
        finally:
            if database is not None:
                database.engine.dispose()


def _runner_word(exchange: Path | None) -> str:
    if exchange is None:
        return "-"
    from ground_service.regression.runner import alive

    return "yes" if alive(exchange) else "no"


def _store_id(home: Path) -> str:
    """Return the random name of a home folder, made with the first process."""
    path = home / STORE_ID
    with contextlib.suppress(FileExistsError), path.open("x", encoding="ascii") as stream:
        stream.write(secrets.token_hex(16))
    return path.read_text(encoding="ascii")


def _digest(value: object) -> str:
    return hashlib.sha256(repr(value).encode()).hexdigest()[:DIGITS]


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
    complaints: list[str] = Field(description="Conditions that need an operator; empty: none")
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
    """True if the broker answers; None: jobs run in the service."""
    processes: dict[str, int] = field(default_factory=dict)
    """Running processes by kind; empty with SQLite."""
    disagreements: tuple[str, ...] = ()
    runner: bool | None = None
    """True if a worker sees a runner; None: no worker has an exchange folder."""
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
