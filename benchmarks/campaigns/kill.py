"""Random kills of every part of the distributed service during ingest and reports.

    python -m benchmarks.campaigns.kill [--kills 500] [--seed N] [--pause S]

Starts PostgreSQL, Redis, the API and two workers on private ports, uploads pieces of one downlink in random order,
some of them twice, asks for reports, and meanwhile kills (SIGKILL) one part after another and starts it again. In the
end every job has to be at its end, every upload ingested, and the archive equal to that of the same downlink ingested
once, undisturbed, into SQLite. Exit status 1 where that does not hold.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import urllib.error
import urllib.request
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.ground import START, STEP_NS, mixed_downlink
from ground_service.services.ground import open_ground
from ground_service.services.ingest import ingest_file
from ground_service.store import repository
from ground_service.store.canonical import archive_hash
from ground_service.store.database import prepare_database
from lunar.timescales import format_utc

CADU_OCTETS = 1279
PATIENCE_S = 900.0


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


class Part:
    """A process of the deployment that can be killed with all its children and started again."""

    def __init__(self, command: list[str], log: Path, ready: Callable[[], bool], **options: Any) -> None:
        self._command, self._log, self._ready, self._options = command, log, ready, options
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start it, again when it gives up at once (what it was killed with may not be gone yet)."""
        until = time.monotonic() + 120.0
        while time.monotonic() < until:
            with self._log.open("ab") as log:
                self._process = subprocess.Popen(
                    self._command, stdout=log, stderr=log, start_new_session=True, **self._options
                )
            while time.monotonic() < until and self._process.poll() is None:
                if self._ready():
                    return
                time.sleep(0.1)
            time.sleep(0.5)
        raise SystemExit(f"{' '.join(self._command[:4])}: did not start; {self._log.read_text()[-500:]}")

    def kill(self) -> None:
        assert self._process is not None
        family = [self._process.pid, *descendants(self._process.pid)]
        for pid in family:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self._process.wait()
        until = time.monotonic() + 10.0
        while any(Path(f"/proc/{pid}").exists() for pid in family) and time.monotonic() < until:
            time.sleep(0.05)


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


class Deployment:
    """PostgreSQL, Redis, the API and two workers."""

    def __init__(self, folder: Path) -> None:
        binaries = sorted(Path("/usr/lib/postgresql").glob("*/bin/postgres"))
        if not binaries or shutil.which("redis-server") is None:
            raise SystemExit("the campaign needs PostgreSQL and redis-server on this machine")
        bin_ = binaries[-1].parent
        user = ["runuser", "-u", "postgres", "--"] if os.geteuid() == 0 else []
        database = folder / "postgres"
        database.mkdir()
        if user:
            folder.chmod(0o755)
            shutil.chown(database, "postgres", "postgres")
        ports = [free_port() for _ in range(3)]
        self.api = f"http://127.0.0.1:{ports[2]}"
        self.url = f"postgresql+psycopg://linna@127.0.0.1:{ports[0]}/linna"
        data = database / "data"
        subprocess.run(
            [*user, str(bin_ / "initdb"), "-D", str(data), "-U", "linna", "-A", "trust", "--no-sync"],
            check=True, cwd=database, stdout=subprocess.DEVNULL,
        )  # fmt: skip
        environment = {
            **os.environ,
            "LINNA_HOME": str(folder / "home"),
            "LINNA_DATABASE_URL": self.url,
            "LINNA_BROKER_URL": f"redis://127.0.0.1:{ports[1]}/0",
            "LINNA_RATE_LIMIT_PER_S": "0",
        }
        environment.pop("LINNA_DATA", None)
        linna = [sys.executable, "-m", "linna"]
        worker = {"env": environment}
        server = [
            str(bin_ / "postgres"), "-D", str(data), "-p", str(ports[0]), "-k", str(database), "-h", "127.0.0.1",
            "-c", "fsync=off",
        ]  # fmt: skip
        self.parts = {
            "database": Part(
                [*user, *server], folder / "postgres.log", lambda: self._answers(bin_, ports[0]), cwd=database
            ),
            "broker": Part(
                ["redis-server", "--port", str(ports[1]), "--bind", "127.0.0.1", "--dir", str(folder),
                 "--save", "", "--appendonly", "no"],
                folder / "redis.log", lambda: listens(ports[1]),
            ),
            "api": Part(
                [*linna, "serve", "--port", str(ports[2])], folder / "api.log", lambda: listens(ports[2]), **worker
            ),
            "worker 1": Part([*linna, "worker"], folder / "worker1.log", lambda: True, **worker),
            "worker 2": Part([*linna, "worker"], folder / "worker2.log", lambda: True, **worker),
        }  # fmt: skip
        for name in ("database", "broker"):
            self.parts[name].start()
        subprocess.run(
            [str(bin_ / "createdb"), "-h", "127.0.0.1", "-p", str(ports[0]), "-U", "linna", "linna"],
            check=True,
        )
        prepare_database(self.url, upgrade=True).engine.dispose()
        for name in ("api", "worker 1", "worker 2"):
            self.parts[name].start()

    @staticmethod
    def _answers(bin_: Path, port: int) -> bool:
        done = subprocess.run(
            [str(bin_ / "pg_isready"), "-h", "127.0.0.1", "-p", str(port), "-q"], check=False
        )
        return done.returncode == 0

    def stop(self) -> None:
        for part in self.parts.values():
            part.kill()


def ask(api: str, method: str, path: str, body: bytes | None = None, key: str = "") -> Any:
    """The answer as JSON; asked again until there is one that is not about something being away."""
    headers = {"Idempotency-Key": key, "Content-Type": "application/json"} if key else {}
    until = time.monotonic() + PATIENCE_S
    while True:
        request = urllib.request.Request(f"{api}/api/v1{path}", data=body, method=method, headers=headers)
        try:
            with urllib.request.urlopen(request, timeout=60) as answer:
                return json.loads(answer.read())
        except urllib.error.HTTPError as error:
            if error.code < 500:
                raise SystemExit(f"{method} {path}: {error.code} {error.read()[:300]!r}") from None
        except (OSError, ValueError):
            pass
        if time.monotonic() > until:
            raise SystemExit(f"{method} {path}: no answer within {PATIENCE_S:.0f} s")
        time.sleep(0.3)


def campaign(
    kills: int, seed: int, pause_s: float, packets: int, pieces: int, reports: int
) -> dict[str, Any]:
    """Run it; the figures."""
    rng = random.Random(seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        stream = mixed_downlink(packets)
        whole = folder / "whole.cadu"
        whole.write_bytes(stream)
        with open_ground(folder / "reference") as ground:
            ingest_file(ground, whole)
            with ground.database.reading() as connection:
                expected = archive_hash(connection, repository.vehicle_id(connection, 76, "flight"))
                stored = repository.page(connection, repository.PACKETS, limit=1).total
        cadus = len(stream) // CADU_OCTETS
        cuts = [round(k * cadus / pieces) * CADU_OCTETS for k in range(pieces + 1)]
        uploads = [(f"piece {k}", stream[cuts[k] : cuts[k + 1]]) for k in range(pieces)]
        uploads += [(f"again {k}", octets) for k, (_, octets) in enumerate(rng.sample(uploads, pieces // 3))]
        rng.shuffle(uploads)
        deployment = Deployment(folder)
        killed: Counter[str] = Counter()
        stop = threading.Event()

        broken: list[BaseException] = []

        def harass() -> None:
            try:
                kill_some()
            except BaseException as error:
                broken.append(error)

        def kill_some() -> None:
            while sum(killed.values()) < kills and not stop.is_set():
                time.sleep(rng.uniform(0.0, 2.0 * pause_s))
                part = rng.choice(list(deployment.parts))
                deployment.parts[part].kill()
                time.sleep(rng.uniform(0.0, pause_s))
                deployment.parts[part].start()
                killed[part] += 1

        thread = threading.Thread(target=harass)
        started = time.monotonic()
        thread.start()
        try:
            jobs = [ask(deployment.api, "POST", "/telemetry?spacecraft_id=76", octets, key)["job_id"]
                    for key, octets in uploads]  # fmt: skip
            definition = {
                "name": "all",
                "start": format_utc(START),
                "stop": format_utc(START + packets * STEP_NS // 4),
                "spacecraft_id": 76,
            }
            ask(deployment.api, "POST", "/passes", json.dumps(definition).encode(), "pass")
            pass_id = ask(deployment.api, "GET", "/passes")["items"][0]["id"]
            jobs += [ask(deployment.api, "POST", f"/passes/{pass_id}/reports", b"", f"report {k}")["id"]
                     for k in range(reports)]  # fmt: skip
            thread.join()
            if broken:
                raise broken[0]
            states: Counter[str] = Counter()
            attempts = 0
            for job in jobs:
                until = time.monotonic() + PATIENCE_S
                while True:
                    row = ask(deployment.api, "GET", f"/jobs/{job}")
                    if row["state"] in ("done", "failed") or time.monotonic() > until:
                        break
                    time.sleep(0.5)
                states[row["state"]] += 1
                attempts += row["attempts"]
            with (
                open_ground(folder / "home", database_url=deployment.url) as ground,
                ground.database.reading() as connection,
            ):
                vehicle = repository.vehicle_id(connection, 76, "flight")
                found = archive_hash(connection, vehicle)
                count = repository.page(connection, repository.PACKETS, limit=1).total
                rows = repository.page(connection, repository.INGESTS, limit=10_000).rows
                ingests = Counter(row["state"] for row in rows)
        finally:
            stop.set()
            thread.join()
            deployment.stop()
    return {
        "kills": dict(sorted(killed.items())),
        "seconds": round(time.monotonic() - started),
        "uploads": len(uploads),
        "jobs": dict(states),
        "attempts": attempts,
        "ingests": dict(ingests),
        "packets_expected": stored,
        "packets": count,
        "lost": max(stored - count, 0),
        "doubled": max(count - stored, 0),
        "archive_identical": found == expected,
    }


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=500)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--pause", type=float, default=1.0, help="about how long everything runs between kills, s"
    )
    parser.add_argument("--packets", type=int, default=40_000)
    parser.add_argument("--pieces", type=int, default=60)
    parser.add_argument("--reports", type=int, default=6)
    given = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that what was started is ended
    figures = campaign(given.kills, given.seed, given.pause, given.packets, given.pieces, given.reports)
    print(json.dumps(figures, indent=2))
    good = (
        figures["archive_identical"]
        and set(figures["jobs"]) == {"done"}
        and set(figures["ingests"]) == {"done"}
    )
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
