"""The service as separate processes on private ports, each of which can be killed and started again."""

from __future__ import annotations

import functools
import sys
from collections.abc import Mapping
from pathlib import Path

from benchmarks._servers import PostgresServer, RedisServer
from studies.harness.parts import Part, bare_environment, free_port, listens


def service_environment(**settings: str) -> dict[str, str]:
    """Return the environment of a service whose role owns the database."""
    return bare_environment(LINNA_ALLOW_DATABASE_OWNER="true", **settings)


class Laptop:
    """The API alone, which does its jobs itself, on SQLite."""

    def __init__(self, folder: Path, **settings: str) -> None:
        port = free_port()
        self.api = f"http://127.0.0.1:{port}"
        self.apis = (self.api,)
        self.home = folder / "home"
        self.url: str | None = None
        command = [sys.executable, "-m", "linna", "serve", "--port", str(port)]
        environment = service_environment(LINNA_HOME=str(self.home), **settings)
        self.parts = {"api": Part(command, folder / "api.log", lambda: listens(port), env=environment)}
        self.parts["api"].start()

    def stop(self) -> None:
        for part in self.parts.values():
            part.end()


class Deployment:
    """Deployment of PostgreSQL, Redis, API processes and two workers, with a database role that owns nothing.

    Parameters
    ----------
    database_settings
        Settings of the database server.
    """

    def __init__(
        self,
        folder: Path,
        apis: int = 1,
        *,
        database_settings: Mapping[str, str] | None = None,
        **settings: str,
    ) -> None:
        self.parts: dict[str, Part] = {}
        self._database = PostgresServer(folder, **(database_settings or {}))
        self.parts["database"] = self._database.part
        self.url = self._database.prepare_service()
        self.home = folder / "home"
        broker = RedisServer(folder)
        self.parts["broker"] = broker.part
        environment = bare_environment(
            LINNA_HOME=str(self.home),
            LINNA_DATABASE_URL=self.url,
            LINNA_BROKER_URL=broker.url,
            **settings,
        )
        linna = [sys.executable, "-m", "linna"]
        addresses = []
        try:
            for number in range(1, apis + 1):
                port = free_port()
                addresses.append(f"http://127.0.0.1:{port}")
                serve = [*linna, "serve", "--port", str(port)]
                ready = functools.partial(listens, port)
                self._add(f"api {number}", Part(serve, folder / f"api{number}.log", ready, env=environment))
            for number in (1, 2):
                log = folder / f"worker{number}.log"
                self._add(f"worker {number}", Part([*linna, "worker"], log, lambda: True, env=environment))
        except BaseException:
            self.stop()
            raise
        self.apis = tuple(addresses)
        self.api = self.apis[0]

    def _add(self, name: str, part: Part) -> None:
        part.start()
        self.parts[name] = part

    def stop(self) -> None:
        for part in self.parts.values():
            part.end()
        self._database.remove()


class ManyApis:
    """Several API processes with one database and one broker, without workers: jobs are added but not run."""

    def __init__(self, folder: Path, url: str, count: int = 2, **settings: str) -> None:
        self.url = url
        self.home = folder / "home"
        broker, ports = RedisServer(folder), [free_port() for _ in range(count)]
        self.parts = {"broker": broker.part}
        self.ports = tuple(ports)
        self.broker_url = broker.url
        environment = service_environment(
            **{
                "LINNA_HOME": str(self.home),
                "LINNA_DATABASE_URL": url,
                "LINNA_BROKER_URL": self.broker_url,
            }
            | settings
        )
        try:
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
