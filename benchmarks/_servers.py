"""The service on private ports of this machine: PostgreSQL, Redis, API processes and workers."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Mapping
from contextlib import ExitStack
from functools import partial
from pathlib import Path

from sqlalchemy import text

from ground_service.errors import GroundError
from ground_service.store.database import prepare_database
from ground_service.store.roles import grant_service
from studies.harness.parts import Part, bare_environment, free_port, kill_family, listens, started_ticks

SERVICE_ROLE = "service"


class PidFile:
    """Processes that a run has started, by name, so that the next run can end those that a killed run has left."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = threading.Lock()

    def note(self, pids: Mapping[str, int]) -> None:
        """Record the processes."""
        with self._lock:
            known = {name: [pid, started_ticks(pid)] for name, pid in pids.items()}
            new = self._path.with_name(self._path.name + ".new")
            new.write_text(json.dumps(known))
            new.replace(self._path)

    def end_left_over(self) -> None:
        """Kill the recorded processes that still run."""
        try:
            known = json.loads(self._path.read_text())
        except (OSError, ValueError):
            return
        for pid, started in known.values():
            if started is not None and started_ticks(pid) == started:
                kill_family(pid)
        self._path.unlink(missing_ok=True)


class PostgresServer:
    """A PostgreSQL server on a private port, with a database `linna` and its files under `folder`.

    Its own files are in a folder of the user `postgres` outside of `folder` if this process runs as root.

    Parameters
    ----------
    superuser
        Role that `initdb` makes and that owns the database.
    settings
        Settings of the server, such as `shared_buffers`.
    """

    def __init__(self, folder: Path, superuser: str = "linna", **settings: str) -> None:
        found = sorted(Path("/usr/lib/postgresql").glob("*/bin/postgres"))
        if not found:
            raise GroundError("expected PostgreSQL on this machine, found none under /usr/lib/postgresql")
        self._bin = found[-1].parent
        self._user = ["runuser", "-u", "postgres", "--"] if os.geteuid() == 0 else []
        self.port = free_port()
        self.url = f"postgresql+psycopg://linna@127.0.0.1:{self.port}/linna"
        note = folder / "postgres-folder"
        is_new = not note.exists()
        if is_new:
            self.place = Path(tempfile.mkdtemp(prefix="linna-postgres-", dir=None if self._user else folder))
            if self._user:
                shutil.chown(self.place, "postgres", "postgres")
            self.run("initdb", "-D", str(self.place / "data"), "-U", superuser, "-A", "trust", "--no-sync")
        else:
            self.place = Path(note.read_text())
        words = ["-p", str(self.port), "-k", str(self.place), "-h", "127.0.0.1", "-c", "fsync=off"]
        words += [word for name, value in settings.items() for word in ("-c", f"{name}={value}")]
        server = self.command("postgres", "-D", str(self.place / "data"), *words)
        self.part = Part(server, folder / "postgres.log", self._answers, cwd=self.place)
        self.part.start()
        if is_new:
            self.run("createdb", "-h", "127.0.0.1", "-p", str(self.port), "-U", superuser, "linna")
            note.write_text(str(self.place))

    def __enter__(self) -> PostgresServer:
        return self

    def __exit__(self, *_: object) -> None:
        self.part.end()
        self.remove()

    def prepare_service(self) -> str:
        """Create the schema as its owner and a role of the service that owns nothing; return the URL of the role."""
        database = prepare_database(self.url, upgrade=True)
        with database.writing() as connection:
            query = text("SELECT 1 FROM pg_roles WHERE rolname = :name")
            if connection.execute(query, {"name": SERVICE_ROLE}).first() is None:
                connection.execute(text(f"CREATE ROLE {SERVICE_ROLE} LOGIN"))
        grant_service(database, SERVICE_ROLE)
        database.engine.dispose()
        return self.url.replace("//linna@", f"//{SERVICE_ROLE}@")

    def remove(self) -> None:
        """Remove its files after its end."""
        shutil.rmtree(self.place, ignore_errors=True)

    def command(self, program: str, *arguments: str) -> list[str]:
        """Return the command of a program of PostgreSQL, as the user of the server."""
        return [*self._user, str(self._bin / program), *arguments]

    def run(self, program: str, *arguments: str) -> None:
        """Run a program of PostgreSQL in the folder of the server."""
        command = self.command(program, *arguments)
        subprocess.run(command, check=True, cwd=self.place, stdout=subprocess.DEVNULL)

    def _answers(self) -> bool:
        ask = [str(self._bin / "pg_isready"), "-h", "127.0.0.1", "-p", str(self.port), "-q"]
        return subprocess.run(ask, check=False).returncode == 0


class RedisServer:
    """A Redis server on a private port that keeps nothing on disk: after a kill its queue is empty."""

    def __init__(self, folder: Path) -> None:
        program = shutil.which("redis-server")
        if program is None:
            raise GroundError("expected redis-server on this machine, found none")
        port = free_port()
        self.url = f"redis://127.0.0.1:{port}/0"
        words = ["--port", str(port), "--bind", "127.0.0.1", "--dir", str(folder)]
        words += ["--save", "", "--appendonly", "no"]
        self.part = Part([program, *words], folder / "redis.log", lambda: _answers_ping(port))
        self.part.start()


def _answers_ping(port: int) -> bool:
    """Return whether a Redis server answers on a port, without its client library."""
    try:
        with socket.create_connection(("127.0.0.1", port), timeout=2.0) as connection:
            connection.sendall(b"PING\r\n")
            return connection.recv(16).startswith(b"+PONG")
    except OSError:
        return False


class Deployment:
    """Processes of the service, `parts` by name, each of which can be killed and started again.

    With workers: PostgreSQL, Redis, API processes and workers, with a database role that owns nothing. Without: API
    processes alone, with Redis on the PostgreSQL database `url`, where jobs are added but not run, or on SQLite.
    """

    def __init__(self, folder: Path, apis: int = 1, workers: int = 0, url: str | None = None, **settings: str) -> None:
        self.home, self.url = folder / "home", url
        self.ports = tuple(free_port() for _ in range(apis))
        self.apis = tuple(f"http://127.0.0.1:{port}" for port in self.ports)
        self.parts: dict[str, Part] = {}
        self._ended = ExitStack()
        given = {"LINNA_HOME": str(self.home)}
        try:
            if workers:
                database = self._ended.enter_context(PostgresServer(folder))
                self.parts["database"], self.url = database.part, database.prepare_service()
            else:
                given["LINNA_ALLOW_DATABASE_OWNER"] = "true"
            if self.url:
                broker = RedisServer(folder)
                self.parts["broker"], self.broker_url = broker.part, broker.url
                given |= {"LINNA_DATABASE_URL": self.url, "LINNA_BROKER_URL": broker.url}
            environment = bare_environment(**given | settings)
            commands = {f"api {k}": ["serve", "--port", str(port)] for k, port in enumerate(self.ports, 1)}
            commands |= {f"worker {k}": ["worker"] for k in range(1, workers + 1)}
            for name, words in commands.items():
                ready = partial(listens, int(words[2])) if len(words) > 1 else lambda: True
                command, log = ([sys.executable, "-m", "linna", *words], folder / f"{name.replace(' ', '')}.log")
                self.parts[name] = Part(command, log, ready, env=environment)
                self.parts[name].start()
        except BaseException:
            self.stop()
            raise

    def __enter__(self) -> Deployment:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def stop(self) -> None:
        """End all processes, and remove the files of the database server."""
        for part in self.parts.values():
            part.end()
        self._ended.close()
