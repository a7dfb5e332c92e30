"""Upgrade under load: python -m benchmarks.upgrade [--drain 8] [--clients 4] [--kill].

Two API processes behind the reverse proxy of the compose file, a worker, PostgreSQL and Redis run this version. A copy
of the program with one more migration, which expands the schema, is the next version. While clients read and upload
through the proxy, the schema is upgraded, then the API processes and the worker are replaced one after the other. Every
answer that is not a success and every broken connection counts as an error; clients repeat nothing. At the end every
acknowledged upload must have been ingested in one attempt. The time from the start of a process to its first successful
`/readyz` is measured as well.

`--drain 0` and `--kill` show what the draining and the orderly end prevent: with the first, API processes end without
draining, with the second, processes are killed (SIGKILL). Then errors are expected.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import json
import os
import random
import shutil
import ssl
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections import Counter
from pathlib import Path
from typing import Any

import httpx

from benchmarks.campaigns._clients import Session, cut_pieces
from benchmarks.campaigns._deployment import wait_until
from benchmarks.campaigns.kill import ends_of
from benchmarks.ground import mixed_downlink
from ground_service.access.service import add_user
from ground_service.ground import open_ground
from ground_service.store.database import known_revisions, schema_revisions
from studies.harness.parts import Part, PostgresServer, bare_environment, free_port, listens

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("kernels", "lunar", "tmtc", "reports", "payload_emulator", "studies", "linna", "scenarios")
REVISION = f"9.9_works_with_{known_revisions()[0]}"
MIGRATION = f'''
import sqlalchemy as sa
from alembic import op

revision = "{REVISION}"
down_revision = "{{previous}}"


def upgrade() -> None:
    op.add_column("passes", sa.Column("remark", sa.Text(), nullable=True))
    op.create_index("ix_passes_remark", "passes", ["remark"])
    op.create_table("remarks", sa.Column("id", sa.Integer(), primary_key=True), sa.Column("text", sa.Text()))
'''
UPLOAD_EVERY = 4
READS = ("/passes", "/jobs", "/ingests", "/spacecraft", "/session")


def next_version(folder: Path) -> Path:
    """Return a copy of the program with one more migration."""
    made = folder / "next"
    made.mkdir()
    for name in PACKAGES:
        (made / name).symlink_to(ROOT / name)
    ignore = shutil.ignore_patterns("__pycache__")
    for name in ("ground_service", "db"):
        shutil.copytree(ROOT / name, made / name, ignore=ignore)
    script = made / "db/migrations/versions/9999_expand.py"
    script.write_text(MIGRATION.format(previous=known_revisions()[0]))
    return made


class Rolling:
    """Deployment of which each process can be replaced by one of another version."""

    def __init__(self, folder: Path, drain_s: float, kill: bool) -> None:
        self._folder, self._kill = folder, kill
        self.database = PostgresServer(folder)
        self.parts: dict[str, Part] = {"database": self.database.part}
        self._ports = {f"api {number}": free_port() for number in (1, 2)}
        self.apis = tuple(f"http://127.0.0.1:{port}" for port in self._ports.values())
        self.home = folder / "home"
        self.service_url = self.database.prepare_service()
        broker, proxy = free_port(), free_port()
        self.url = f"https://127.0.0.1:{proxy}"
        self._settings = {
            "LINNA_HOME": str(self.home),
            "LINNA_DATABASE_URL": self.service_url,
            "LINNA_MIGRATION_DATABASE_URL": self.database.url,
            "LINNA_BROKER_URL": f"redis://127.0.0.1:{broker}/0",
            "LINNA_TRUSTED_PROXIES": "127.0.0.1/32",
            "LINNA_DRAIN_S": str(drain_s),
        }
        redis = [
            "redis-server",
            "--port",
            str(broker),
            "--bind",
            "127.0.0.1",
            "--save",
            "",
            "--dir",
            str(folder),
        ]
        try:
            self._start("broker", Part(redis, folder / "redis.log", lambda: listens(broker)))
            self.ready_s = [self.replace(name, ROOT) for name in self._ports]
            self.replace("worker", ROOT)
            configuration = self._proxy_configuration(proxy, drain_s)
            nginx = ["nginx", "-c", str(configuration), "-g", "daemon off;"]
            self._start("proxy", Part(nginx, folder / "nginx.log", lambda: listens(proxy)))
        except BaseException:
            self.stop()
            raise

    def _start(self, name: str, part: Part) -> None:
        self.parts[name] = part
        part.start()

    def _proxy_configuration(self, port: int, drain_s: float) -> Path:
        secrets = self._folder / "secrets"
        environment = {"PATH": os.environ["PATH"], "LINNA_SECRETS_DIR": str(secrets)}
        script = ["sh", str(ROOT / "deploy/secrets.sh")]
        subprocess.run(script, check=True, env=environment, stdout=subprocess.DEVNULL)
        text = (ROOT / "deploy/nginx.conf").read_text()
        first, second = self._ports.values()
        # Shorter than the draining; without one, as in the file.
        kept_s = min(max(drain_s - 1.0, 1.0), 5.0) if drain_s else 5.0
        for old, new in (
            (" /tmp/", f" {self._folder}/"),
            ("worker_processes 2;", "worker_processes 1;" + ("user root;" if os.geteuid() == 0 else "")),
            ("server api:8042", f"server 127.0.0.1:{first}"),
            ("server api2:8042", f"server 127.0.0.1:{second}"),
            ("listen 8443 ssl;", f"listen 127.0.0.1:{port} ssl;"),
            ("/run/tls/", f"{secrets}/tls/"),
            ("error_log /dev/stderr", f"error_log {self._folder}/nginx-errors.log"),
            ("rate=100r/s", "rate=10000r/s"),
            ("keepalive_timeout 5s;", f"keepalive_timeout {kept_s:.0f}s;"),
        ):
            if old not in text:
                raise SystemExit(f"deploy/nginx.conf: expected {old!r}, found no such text")
            text = text.replace(old, new)
        made = self._folder / "nginx.conf"
        made.write_text(text)
        return made

    def replace(self, name: str, tree: Path) -> float:
        """Stop a process as a supervisor would, start it from another tree; return the time to ready, s."""
        if name in self.parts:
            if self._kill:
                self.parts[name].kill()
            else:
                self.parts[name].finish()
        port = self._ports.get(name)
        words = ["worker"] if port is None else ["serve", "--port", str(port)]
        ready = (lambda: True) if port is None else functools.partial(is_ready, port)
        environment = {**bare_environment(**self._settings), "PYTHONPATH": str(tree)}
        log = self._folder / f"{name.replace(' ', '')}.log"
        began = time.monotonic()
        command = [sys.executable, "-m", "linna", *words]
        self._start(name, Part(command, log, ready, env=environment, cwd=tree))
        return time.monotonic() - began

    def upgrade_schema(self, tree: Path) -> None:
        """Run `linna db upgrade` of a version."""
        environment = {**bare_environment(**self._settings), "PYTHONPATH": str(tree)}
        command = [sys.executable, "-m", "linna", "db", "upgrade"]
        subprocess.run(command, check=True, env=environment, cwd=tree, stdout=subprocess.DEVNULL)

    def stop(self) -> None:
        """Kill everything."""
        for part in self.parts.values():
            part.end()


def is_ready(port: int) -> bool:
    """Return whether a process answers that it is ready."""
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/readyz", timeout=5) as answer:
            return bool(answer.status == 200)
    except OSError:
        return False


class Load:
    """Clients that read and upload without repeating anything."""

    def __init__(self, url: str, token: str, certificate: Path, clients: int, pause_s: float) -> None:
        self._pause_s = pause_s
        self.answers: Counter[int] = Counter()
        self.errors: list[str] = []
        self.jobs: list[str] = []
        self.slowest_s = 0.0
        self._over = threading.Event()
        self._lock = threading.Lock()
        pieces = cut_pieces(mixed_downlink(2_000), 400, random.Random(3), "piece")
        self._pieces = itertools.cycle(pieces)
        self._client = functools.partial(
            httpx.Client,
            base_url=f"{url}/api/v1",
            verify=ssl.create_default_context(cafile=str(certificate)),
            headers={"Authorization": f"Bearer {token}"},
            timeout=60.0,
        )
        # Half of the clients keep their connections.
        self._threads = [
            threading.Thread(target=self._ask, args=(number, number % 2 == 0)) for number in range(clients)
        ]

    def __enter__(self) -> Load:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        for thread in self._threads:
            thread.join()

    def _ask(self, number: int, keep: bool) -> None:
        client = self._client()
        for turn in itertools.count(number):
            if self._over.wait(self._pause_s):
                break
            if not keep:
                client.close()
                client = self._client()
            began = time.monotonic()
            try:
                if turn % UPLOAD_EVERY:
                    answer = client.get(READS[turn % len(READS)])
                else:
                    with self._lock:
                        piece = next(self._pieces)
                    path = f"/telemetry?spacecraft_id=76&{piece.place}"
                    answer = client.post(path, content=piece.octets)
            except httpx.HTTPError as error:
                with self._lock:
                    self.errors.append(f"turn {turn}: {error!r}")
                continue
            with self._lock:
                self.slowest_s = max(self.slowest_s, time.monotonic() - began)
                self.answers[answer.status_code] += 1
                if answer.is_error:
                    self.errors.append(f"{answer.request.method} {answer.url.path}: {answer.status_code}")
                elif answer.status_code == 202:
                    self.jobs.append(answer.json()["job_id"])
        client.close()


def roll(
    folder: Path,
    drain_s: float,
    clients: int,
    pause_s: float = 0.02,
    replaced: tuple[str, ...] = ("api 1", "api 2", "worker"),
    *,
    kill: bool = False,
) -> dict[str, Any]:
    """Upgrade a deployment under load, with these processes replaced; return the figures."""
    new = next_version(folder)
    rolling = Rolling(folder, drain_s, kill)
    try:
        with open_ground(rolling.home, database_url=rolling.service_url) as ground:
            token = add_user(ground, "ann", "operator")
        ready_s = list(rolling.ready_s)
        with Load(rolling.url, token, folder / "secrets/tls/certificate", clients, pause_s) as load:
            wait_until(lambda: len(load.jobs) >= 4, "first uploads")
            before = sum(load.answers.values())
            rolling.upgrade_schema(new)
            for name in replaced:
                took_s = rolling.replace(name, new)
                if name != "worker":
                    ready_s.append(took_s)
            known = len(load.jobs)
            wait_until(lambda: len(load.jobs) >= known + 4, "uploads after the upgrade")
            during = sum(load.answers.values()) - before
        session = Session(rolling.apis, token)
        states, attempts = ends_of(session, load.jobs)
        with open_ground(rolling.home, database_url=rolling.service_url) as ground:
            revision = schema_revisions(ground.database)[0]
    finally:
        rolling.stop()
    return {
        "drain_s": drain_s,
        "killed": kill,
        "clients": clients,
        "requests": sum(load.answers.values()),
        "requests_during_upgrade": during,
        "errors": load.errors,
        "answers": dict(sorted(load.answers.items())),
        "slowest_answer_s": round(load.slowest_s, 2),
        "uploads": len(load.jobs),
        "jobs": dict(states),
        "attempts": attempts,
        "start_to_ready_s": [round(one, 1) for one in ready_s],
        "revision": revision,
        "load_average": os.getloadavg()[0],
    }


def main() -> int:
    """Measure and print; 1 if there was an error response."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--drain", type=float, default=8.0, help="LINNA_DRAIN_S of the API processes")
    parser.add_argument("--clients", type=int, default=4)
    parser.add_argument("--kill", action="store_true", help="kill the processes instead of ending them")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        figures = roll(Path(name), given.drain, given.clients, kill=given.kill)
    print(json.dumps({"upgrade": figures}, indent=1))
    return 1 if figures["errors"] or set(figures["jobs"]) != {"done"} else 0


if __name__ == "__main__":
    raise SystemExit(main())
