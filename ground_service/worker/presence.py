"""Processes of a deployment: each states in the database, while it runs, what it works with.

A statement is a row of the table `leases` that its process renews; its owner column has the version of the program,
digests of the settings and folders that all processes must share, and the difference of the clocks. A process whose
statement differs from that of a running one is refused at its start, and `linna doctor` compares all.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import secrets
import socket
import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Self
from urllib.parse import urlsplit

from ground_service.clock import utc_now_ns
from ground_service.errors import GroundError, ServerError
from ground_service.ground import Ground
from ground_service.settings import Settings
from ground_service.store import leases
from ground_service.store.database import Database, open_database

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
        *(
            "home",
            "database_url",
            "migration_database_url",
            "backup_role",
            "allow_database_owner",
            "broker_url",
        ),
        *("host", "port", "openmct", "live_console", "links", "backups", "log_format", "traces", "data"),
        *(
            "allowed_hosts",
            "trusted_proxies",
            "sockets",
            "sockets_per_user",
        ),
        *("drain_s", "objects_secret_key", "objects_cache_gib", "runner_exchange"),
    }
)
"""Settings that may differ between processes, or that other words of a statement cover."""

GROUPS = ("files", "broker", "provider", "data", "settings")


@dataclass(frozen=True, slots=True)
class Statement:
    """What a process works with: version of the program, digests of `GROUPS`, and its clock minus the database's."""

    version: str
    digests: tuple[str, ...]
    clock_ms: int = 0
    runner: str = "-"
    """Whether a worker sees a runner of payload builds: yes or no; - without an exchange folder."""

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
