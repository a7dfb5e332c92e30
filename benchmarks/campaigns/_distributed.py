"""The distributed ground service of a mission run: separate processes on PostgreSQL and Redis.

The run starts a database server, a broker, an API process, workers, a scheduler and a process for the links. Mission
time comes from the file of the spacecraft, so that all processes have the same.
"""

import contextlib
import signal
import sys
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from pydantic import SecretStr

from benchmarks._servers import PidFile, PostgresServer, RedisServer
from ground_service.access.service import add_token, add_user
from ground_service.client import Client
from ground_service.clock import ClockFile, set_mission_clock
from ground_service.contacts.links import service as links
from ground_service.errors import Conflict, GroundError
from ground_service.ground import Ground, open_ground
from ground_service.settings import Settings
from ground_service.store import leases
from ground_service.worker.app import worker_answers
from ground_service.worker.scheduler import LEASE
from lunar.datafolder import DataFolder
from studies.harness.parts import Part, answers_http, bare_environment, environment_with_data, free_port, runs
from studies.mission_run.ground import FLIGHT_DYNAMICS, USER, MissionGround

WORKERS = 2
ANSWER_S = 1.0


class DistributedGround(MissionGround):
    """The service as separate processes, `parts` by name."""

    def __init__(self, folder: Path, data: DataFolder, clock_file: Path) -> None:
        self.while_waiting: Callable[[], object] = lambda: None
        self.parts: dict[str, Part] = {}
        self.pids = PidFile(folder / "processes.json")
        self.pids.end_left_over()
        self._postgres: PostgresServer | None = None
        self._clients: list[Client] = []
        try:
            settings = self._start_servers(folder, data, clock_file)
            set_mission_clock(ClockFile(clock_file).read)
            self.ground = open_ground(settings.home, data, database_url=settings.resolved_database_url())
            self._start_service(folder, settings)
            self.note_processes()
        except BaseException:
            self.close()
            raise

    def _holds(self, is_done: Callable[[], bool]) -> bool:
        # An error ends the wait, as the end of the spacecraft with its stations does.
        self.while_waiting()
        return super()._holds(is_done)

    def note_processes(self) -> None:
        """Record the processes, so that a later run can end them if this one is killed."""
        self.pids.note({name: part.pid for name, part in self.parts.items()})

    def close(self, *, is_finished: bool = False) -> None:
        """Stop all processes; the files of the database server of a run that is finished are removed."""
        for client in self._clients:
            client.close()
        for name, part in reversed(self.parts.items()):
            part.end(signal.SIGINT if name == "database" else signal.SIGTERM)
        if hasattr(self, "ground"):
            self.ground.close()
        set_mission_clock()
        if is_finished and self._postgres is not None:
            self._postgres.remove()

    def _start_servers(self, folder: Path, data: DataFolder, clock_file: Path) -> Settings:
        self._postgres = PostgresServer(folder)
        self.parts["database"] = self._postgres.part
        url = self._postgres.prepare_service()
        redis = RedisServer(folder)
        self.parts["broker"], broker = redis.part, redis.url
        given = {
            "LINNA_HOME": str(folder / "ground"),
            "LINNA_DATABASE_URL": url,
            "LINNA_BROKER_URL": broker,
            "LINNA_CLOCK_FILE": str(clock_file.absolute()),
            "LINNA_LINKS": "false",
            "LINNA_PLAN_HOURLY": "false",
        }
        self._environment = environment_with_data(bare_environment(**given), data.root)
        return Settings(
            home=folder / "ground", database_url=SecretStr(url), broker_url=SecretStr(broker), data=data.root
        )

    def _start_service(self, folder: Path, settings: Settings) -> None:
        port = free_port()
        address = f"http://127.0.0.1:{port}"
        tokens = {name: _token(self.ground, name) for name in (USER, FLIGHT_DYNAMICS)}
        commands: Mapping[str, tuple[list[str], Callable[[], bool]]] = {
            "api": (["serve", "--port", str(port)], partial(answers_http, f"{address}/readyz")),
            "worker": (
                ["worker", "--concurrency", str(WORKERS)],
                partial(worker_answers, settings, timeout_s=ANSWER_S),
            ),
            "scheduler": (["scheduler"], self._has_scheduler),
            "link": (["link", "run"], lambda: all(map(_is_here, links.owners(self.ground).values()))),
        }
        for name, (words, ready) in commands.items():
            command = [sys.executable, "-m", "linna", *words]
            self.parts[name] = Part(command, folder / f"{name}.log", _safely(ready), env=self._environment)
            self.parts[name].start()
        self.client = Client(address, tokens[USER])
        self.flight_dynamics = Client(address, tokens[FLIGHT_DYNAMICS])
        self._clients = [self.client, self.flight_dynamics]

    def _has_scheduler(self) -> bool:
        with self.ground.database.reading() as connection:
            return _is_here(leases.owner_of(connection, LEASE))


def _is_here(owner: str | None) -> bool:
    """Return whether the owner of a lease, ``HOST:PID:ID``, is a process of this machine that runs."""
    return owner is not None and runs(int(owner.split(":")[-2]))


def _safely(ready: Callable[[], bool]) -> Callable[[], bool]:
    def is_ready() -> bool:
        with contextlib.suppress(GroundError, OSError):
            return ready()
        return False

    return is_ready


def _token(ground: Ground, name: str) -> str:
    try:
        return add_user(ground, name, "admin")
    except Conflict:
        return add_token(ground, name, revoke_others=True)
