"""Pair of PostgreSQL servers with failover: the Patroni configuration of `deploy/failover` on private ports."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import urllib.request
from pathlib import Path
from typing import Any

from benchmarks.campaigns._deployment import wait_until
from ground_service.store.database import prepare_database
from ground_service.store.roles import grant_service
from studies.mission_run.parts import Part, free_port, listens, runs

DEPLOY = Path(__file__).resolve().parents[2] / "deploy"
PASSWORD = "rehearsal"
MEMBERS = ("db", "db2")
SECRETS = ("superuser_password", "replication_password", "owner_password", "password", "backup_password")


class Member:
    """One server with its Patroni."""

    def __init__(self, name: str, folder: Path, etcd: int, user: list[str], binaries: Path) -> None:
        self.name, self.port, self._api = name, free_port(), free_port()
        self._folder = folder / name
        self._data = self._folder / "data"
        subprocess.run([*user, "mkdir", "-m", "700", str(self._folder)], check=True)
        address = f"127.0.0.1:{self.port}"
        environment = {
            "PATH": f"{binaries}:/usr/sbin:/usr/bin:/sbin:/bin",
            "LINNA_SECRETS": str(folder / "secrets"),
            "LINNA_WAL": str(folder / "wal"),
            "LINNA_PATRONI_CONFIGURATION": str(self._folder / "patroni.yml"),
            "PATRONI_NAME": name,
            "PATRONI_ETCD3_HOSTS": f"127.0.0.1:{etcd}",
            "PATRONI_RESTAPI_LISTEN": f"127.0.0.1:{self._api}",
            "PATRONI_RESTAPI_CONNECT_ADDRESS": f"127.0.0.1:{self._api}",
            "PATRONI_POSTGRESQL_LISTEN": address,
            "PATRONI_POSTGRESQL_CONNECT_ADDRESS": address,
            "PATRONI_POSTGRESQL_DATA_DIR": str(self._data),
            "PATRONI_POSTGRESQL_BIN_DIR": str(binaries),
        }
        command = [*user, "sh", str(folder / "scripts/failover/patroni.sh")]
        self.part = Part(command, folder / f"{name}.log", lambda: True, cwd=folder, env=environment)

    def answers(self, path: str) -> dict[str, Any] | None:
        """Return the answer of Patroni to a health check; None if it does not apply to this member."""
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{self._api}/{path}", timeout=5) as answer:
                found: dict[str, Any] = json.load(answer)
                return found
        except (OSError, ValueError):
            return None

    def kill_server(self) -> None:
        """Kill PostgreSQL; its Patroni continues."""
        with contextlib.suppress(OSError, ValueError, IndexError):
            pid = int((self._data / "postmaster.pid").read_text().split()[0])
            os.kill(pid, signal.SIGKILL)
            wait_until(lambda: not runs(pid), f"end of PostgreSQL {self.name}")

    def kill(self) -> None:
        """Kill Patroni and PostgreSQL, as the loss of their host would."""
        self.part.kill()
        self.kill_server()


class DatabaseCluster:
    """Primary and synchronous standby, of which Patroni promotes the standby if the primary is lost."""

    def __init__(self, folder: Path) -> None:
        found = sorted(Path("/usr/lib/postgresql").glob("*/bin/postgres"))
        missing = [name for name in ("patroni", "etcd") if shutil.which(name) is None]
        if not found or missing:
            raise SystemExit(f"expected PostgreSQL, Patroni and etcd on this machine, found no {missing}")
        user = ["runuser", "-u", "postgres", "--"] if os.geteuid() == 0 else []
        place = folder / "cluster"
        place.mkdir()
        folder.chmod(0o755)
        shutil.copytree(DEPLOY, place / "scripts", ignore=shutil.ignore_patterns("node_modules", "openmct"))
        for name in ("secrets", "wal"):
            (place / name).mkdir()
        for name in SECRETS:
            (place / f"secrets/database_{name}").write_text(PASSWORD)
        if user:
            for path in (place, place / "wal"):
                shutil.chown(path, "postgres", "postgres")
        client, peer = free_port(), free_port()
        etcd = [
            "etcd", "--name", "one", "--data-dir", str(place / "etcd"), "--unsafe-no-fsync",
            "--listen-client-urls", f"http://127.0.0.1:{client}",
            "--advertise-client-urls", f"http://127.0.0.1:{client}",
            "--listen-peer-urls", f"http://127.0.0.1:{peer}",
            "--initial-advertise-peer-urls", f"http://127.0.0.1:{peer}",
            "--initial-cluster", f"one=http://127.0.0.1:{peer}",
        ]  # fmt: skip
        self.etcd = Part([*user, *etcd], place / "etcd.log", lambda: listens(client), cwd=place)
        self.members = {name: Member(name, place, client, user, found[-1].parent) for name in MEMBERS}
        hosts = "&".join(f"host=127.0.0.1:{one.port}" for one in self.members.values())
        self._place = f"@/linna?{hosts}&target_session_attrs=read-write"
        self.url, self.owner_url = self.url_of("linna"), self.url_of("linna_owner")
        try:
            self.etcd.start()
            for one in self.members.values():
                one.part.start()
            wait_until(self.is_redundant, "synchronous standby")
        except BaseException:
            self.stop()
            raise

    def url_of(self, role: str) -> str:
        """Return the URL of a role, with the addresses of all members."""
        return f"postgresql+psycopg://{role}:{PASSWORD}{self._place}"

    def __enter__(self) -> DatabaseCluster:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def prepare(self) -> None:
        """Create the schema as its owner, and grant the role of the service its rights."""
        database = prepare_database(self.owner_url, upgrade=True)
        grant_service(database, "linna")
        database.engine.dispose()

    def primary(self) -> str | None:
        """Return the name of the member that accepts writes; None if there is none now."""
        return next((name for name, one in self.members.items() if one.answers("primary")), None)

    def is_redundant(self) -> bool:
        """Return whether a running member other than the primary has every acknowledged commit."""
        primary = self.primary()
        if primary is None:
            return False
        standbys = [one for name, one in self.members.items() if name != primary]
        return any(one.answers("sync") for one in standbys) and self._waits_for_standby(primary)

    def _waits_for_standby(self, primary: str) -> bool:
        """Return whether the primary acknowledges commits only with the standby."""
        found = self.members[primary].answers("patroni") or {}
        return any(one.get("sync_state") == "sync" for one in found.get("replication", []))

    def stop(self) -> None:
        """Kill everything."""
        for one in self.members.values():
            one.part.end()
            one.kill_server()
        self.etcd.end()
