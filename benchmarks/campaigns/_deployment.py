"""The service as separate processes on private ports, each of which can be killed and started again."""

from __future__ import annotations

import contextlib
import functools
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sqlalchemy import text

from ground_service.store.database import prepare_database
from ground_service.store.roles import grant_service

if TYPE_CHECKING:
    from benchmarks.campaigns._failover import DatabaseCluster


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def wait_until(ready: Callable[[], bool], what: str, seconds: float = 120.0) -> None:
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        if ready():
            return
        time.sleep(0.2)
    raise SystemExit(f"{what}: not ready within {seconds:.0f} s")


def listens(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def connected(port: int) -> bool:
    """Whether somebody is connected to a port of this machine, by what the kernel says."""
    rows = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    return any(row[1].endswith(f":{port:04X}") and row[3] == "01" for row in rows)


class Part:
    """A process of the deployment that can be killed with all its children and started again."""

    def __init__(self, command: list[str], log: Path, ready: Callable[[], bool], **options: Any) -> None:
        self._command, self._log, self._ready, self._options = command, log, ready, options
        self._process: subprocess.Popen[bytes] | None = None
        self._ended = False

    def start(self) -> None:
        """Start it, again when it gives up at once (what it was killed with may not be gone yet)."""
        until = time.monotonic() + 120.0
        while time.monotonic() < until and not self._ended:
            with self._log.open("ab") as log:
                self._process = subprocess.Popen(
                    self._command, stdout=log, stderr=log, start_new_session=True, **self._options
                )
            while time.monotonic() < until and self._process.poll() is None:
                if self._ready():
                    return
                time.sleep(0.1)
            time.sleep(0.5)
        if self._ended:
            return
        raise SystemExit(f"{' '.join(self._command[:4])}: did not start; {self._log.read_text()[-500:]}")

    def revive(self) -> None:
        """Start it where it has ended by itself, as a supervisor would."""
        if not self._ended and self._process is not None and self._process.poll() is not None:
            self.start()

    @property
    def pid(self) -> int:
        """Its process."""
        assert self._process is not None
        return self._process.pid

    def kill_child(self, module: str) -> bool:
        """Kill the child process that runs this module, which its parent restarts; return whether there was one."""
        for pid in descendants(self.pid):
            with contextlib.suppress(OSError):
                if module.encode() in Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0"):
                    os.kill(pid, signal.SIGKILL)
                    return True
        return False

    def end(self) -> None:
        """Kill it for good: it is not started again."""
        self._ended = True
        if self._process is not None:
            self.kill()

    def finish(self, seconds: float = 120.0) -> None:
        """Ask it to end (SIGTERM), as a supervisor would, and wait until it has."""
        assert self._process is not None
        self._process.terminate()
        self._process.wait(seconds)

    def kill(self) -> None:
        assert self._process is not None
        if self._process.poll() is not None:
            return  # its number may be somebody else's by now
        family = [self._process.pid, *descendants(self._process.pid)]
        for pid in family:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self._process.wait()
        until = time.monotonic() + 10.0
        while any(runs(pid) for pid in family) and time.monotonic() < until:
            time.sleep(0.05)


def bare_environment(**settings: str) -> dict[str, str]:
    """The environment with these settings of the service and none that it had before."""
    kept = {
        name: value
        for name, value in os.environ.items()
        if not name.startswith("LINNA_") or name == "LINNA_DATA"
    }
    return {**kept, **settings}


def service_environment(**settings: str) -> dict[str, str]:
    """Return the environment of a service whose role owns the database."""
    return bare_environment(LINNA_ALLOW_DATABASE_OWNER="true", **settings)


def runs(pid: int) -> bool:
    """Return whether a process exists and is not a zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


def descendants(pid: int) -> list[int]:
    """Processes below another, by what the kernel says."""
    found: list[int] = []
    for entry in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = entry.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[1]) == pid:
            child = int(entry.parent.name)
            found += [child, *descendants(child)]
    return found


class Laptop:
    """The API alone, which does its jobs itself, on SQLite."""

    def __init__(self, folder: Path, **settings: str) -> None:
        port = free_port()
        self.api = f"http://127.0.0.1:{port}"
        self.apis = (self.api,)
        self.home = folder / "home"
        self.url: str | None = None
        command = [sys.executable, "-m", "linna", "serve", "--port", str(port)]
        environment = service_environment(LINNA_HOME=str(self.home), LINNA_RATE_LIMIT_PER_S="0", **settings)
        self.parts = {"api": Part(command, folder / "api.log", lambda: listens(port), env=environment)}
        self.parts["api"].start()

    def stop(self) -> None:
        for part in self.parts.values():
            part.end()


class PostgresServer:
    """A PostgreSQL server on a private port, with an empty database and its files under `folder`."""

    def __init__(self, folder: Path) -> None:
        found = sorted(Path("/usr/lib/postgresql").glob("*/bin/postgres"))
        if not found:
            raise SystemExit("expected PostgreSQL on this machine, found none under /usr/lib/postgresql")
        self._bin = found[-1].parent
        user = ["runuser", "-u", "postgres", "--"] if os.geteuid() == 0 else []
        place = folder / "postgres"
        place.mkdir()
        if user:
            folder.chmod(0o755)
            shutil.chown(place, "postgres", "postgres")
        self._port = free_port()
        self.url = f"postgresql+psycopg://linna@127.0.0.1:{self._port}/linna"
        data = place / "data"
        subprocess.run(
            [*user, str(self._bin / "initdb"), "-D", str(data), "-U", "linna", "-A", "trust", "--no-sync"],
            check=True,
            cwd=place,
            stdout=subprocess.DEVNULL,
        )
        server = [
            str(self._bin / "postgres"),
            "-D",
            str(data),
            "-p",
            str(self._port),
            "-k",
            str(place),
            "-h",
            "127.0.0.1",
            "-c",
            "fsync=off",
        ]
        self.part = Part([*user, *server], folder / "postgres.log", self._answers, cwd=place)
        self.part.start()
        create = [
            str(self._bin / "createdb"),
            "-h",
            "127.0.0.1",
            "-p",
            str(self._port),
            "-U",
            "linna",
            "linna",
        ]
        subprocess.run(create, check=True)

    def __enter__(self) -> PostgresServer:
        return self

    def __exit__(self, *_: object) -> None:
        self.part.end()

    def _answers(self) -> bool:
        ask = [str(self._bin / "pg_isready"), "-h", "127.0.0.1", "-p", str(self._port), "-q"]
        return subprocess.run(ask, check=False).returncode == 0


SERVICE_ROLE = "service"


class Deployment:
    """Deployment of PostgreSQL, Redis, API processes and two workers, with a database role that owns nothing.

    Parameters
    ----------
    cluster
        Pair of database servers that the caller starts and stops; default: one server of this deployment.
    """

    def __init__(
        self,
        folder: Path,
        apis: int = 1,
        *,
        cluster: DatabaseCluster | None = None,
        schedulers: int = 0,
        **settings: str,
    ) -> None:
        if shutil.which("redis-server") is None:
            raise SystemExit("expected redis-server on this machine, found none")
        self.parts: dict[str, Part] = {}
        if cluster is None:
            database = PostgresServer(folder)
            self.parts["database"] = database.part
            self.url = database.url.replace("//linna@", f"//{SERVICE_ROLE}@")
        else:
            self.url = cluster.url
        self.home = folder / "home"
        broker = free_port()
        environment = bare_environment(
            LINNA_HOME=str(self.home),
            LINNA_DATABASE_URL=self.url,
            LINNA_BROKER_URL=f"redis://127.0.0.1:{broker}/0",
            LINNA_RATE_LIMIT_PER_S="0",
            **settings,
        )
        linna = [sys.executable, "-m", "linna"]
        redis = [
            "redis-server",
            "--port",
            str(broker),
            "--bind",
            "127.0.0.1",
            "--dir",
            str(folder),
            "--save",
            "",
            "--appendonly",
            "no",
        ]
        addresses = []
        try:
            if cluster is None:
                self.prepare(database.url)
            else:
                cluster.prepare()
            self._add("broker", Part(redis, folder / "redis.log", lambda: listens(broker)))
            for number in range(1, apis + 1):
                port = free_port()
                addresses.append(f"http://127.0.0.1:{port}")
                serve = [*linna, "serve", "--port", str(port)]
                ready = functools.partial(listens, port)
                self._add(f"api {number}", Part(serve, folder / f"api{number}.log", ready, env=environment))
            for number in (1, 2):
                log = folder / f"worker{number}.log"
                self._add(f"worker {number}", Part([*linna, "worker"], log, lambda: True, env=environment))
            for number in range(1, schedulers + 1):
                log = folder / f"scheduler{number}.log"
                part = Part([*linna, "scheduler"], log, lambda: True, env=environment)
                self._add(f"scheduler {number}", part)
        except BaseException:
            self.stop()
            raise
        self.apis = tuple(addresses)
        self.api = self.apis[0]

    @staticmethod
    def prepare(owner_url: str) -> None:
        """Create the schema as its owner, and the role of the service."""
        database = prepare_database(owner_url, upgrade=True)
        with database.writing() as connection:
            connection.execute(text(f"CREATE ROLE {SERVICE_ROLE} LOGIN"))
        grant_service(database, SERVICE_ROLE)
        database.engine.dispose()

    def _add(self, name: str, part: Part) -> None:
        part.start()
        self.parts[name] = part

    def stop(self) -> None:
        for part in self.parts.values():
            part.end()


class ManyApis:
    """Several API processes with one database and one broker, without workers: jobs are added but not run."""

    def __init__(self, folder: Path, url: str, count: int = 2, **settings: str) -> None:
        if shutil.which("redis-server") is None:
            raise SystemExit("expected redis-server on this machine, found none")
        self.url = url
        self.home = folder / "home"
        self.parts: dict[str, Part] = {}
        broker, ports = free_port(), [free_port() for _ in range(count)]
        self.ports = tuple(ports)
        self.broker_url = f"redis://127.0.0.1:{broker}/0"
        environment = service_environment(
            **{
                "LINNA_HOME": str(self.home),
                "LINNA_DATABASE_URL": url,
                "LINNA_BROKER_URL": self.broker_url,
                "LINNA_RATE_LIMIT_PER_S": "0",
            }
            | settings
        )
        redis = [
            "redis-server",
            "--port",
            str(broker),
            "--bind",
            "127.0.0.1",
            "--dir",
            str(folder),
            "--save",
            "",
            "--appendonly",
            "no",
        ]
        try:
            self._add("broker", Part(redis, folder / "redis.log", lambda: listens(broker)))
            for number, port in enumerate(ports, start=1):
                command = [sys.executable, "-m", "linna", "serve", "--port", str(port)]
                log = folder / f"api{number}.log"
                ready = functools.partial(listens, port)
                self._add(f"api {number}", Part(command, log, ready, env=environment))
        except BaseException:
            self.stop()
            raise

    def _add(self, name: str, part: Part) -> None:
        part.start()
        self.parts[name] = part

    def __enter__(self) -> ManyApis:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def stop(self) -> None:
        for part in self.parts.values():
            part.end()
