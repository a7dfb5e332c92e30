"""Loss of one process under ingest load: python -m benchmarks.loss [--only NAME ...] [--rate 2].

Two API processes, two workers, a scheduler, Redis and PostgreSQL. Two clients upload pieces of a downlink. One part
after another is killed (SIGKILL). A supervisor starts ended processes again after a second, as the restart policy of
the compose file does. No person acts. For each loss:

- `uploads_s`: longest time without an acknowledged upload after the kill;
- `jobs_s`: time from the kill until a job that was accepted after it is done, and `started_s` until it started. The
  jobs that wait at the kill and when that job is done are counted (`waiting`), because it also waits for these;
- `complete_s`: time until every process runs again, with a scheduler.

At the end every acknowledged job must be done and no packet may be missing or doubled.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import json
import os
import random
import tempfile
import threading
import time
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

from benchmarks.campaigns._clients import Session, cut_pieces
from benchmarks.campaigns._deployment import Deployment, wait_until
from benchmarks.campaigns.kill import contents, ends_of
from benchmarks.ground import mixed_downlink
from ground_service.access.service import add_user
from ground_service.errors import GroundError
from ground_service.ground import Ground, open_ground
from ground_service.ingest.service import ingest_file
from ground_service.jobs.service import unfinished_jobs
from ground_service.worker.scheduler import has_scheduler
from studies.mission_run.parts import runs

PARTS = ("api 1", "worker 1", "scheduler 1", "broker", "database")
LIMIT_S = 60.0
"""Requirement: recovery without a person."""

PACKETS = 2_000
PIECES = 60
CLIENTS = 2


class Supervisor(threading.Thread):
    """Starts ended processes again after about a second, until stopped."""

    def __init__(self, service: Deployment) -> None:
        super().__init__(daemon=True)
        self._service = service
        self.over = threading.Event()

    def run(self) -> None:
        while not self.over.wait(1.0):
            for part in list(self._service.parts.values()):
                part.revive()


class Uploads:
    """Clients that upload pieces and repeat what was not acknowledged, with the same key."""

    def __init__(self, session: Session, stream: bytes, rate: float) -> None:
        self._pause_s = CLIENTS / rate
        self.acknowledged: list[tuple[float, float, str]] = []
        self.over = threading.Event()
        self._session = session
        self._pieces = cut_pieces(stream, PIECES, random.Random(1), "piece")
        self.threads = [
            threading.Thread(target=self._run, args=(number,), daemon=True) for number in range(CLIENTS)
        ]

    def _run(self, number: int) -> None:
        due = time.monotonic()
        for turn in itertools.count():
            if self.over.wait(max(due - time.monotonic(), 0.0)):
                return
            piece = self._pieces[(CLIENTS * turn + number) % PIECES]
            asked = time.monotonic()
            due = max(due, asked - self._pause_s) + self._pause_s
            key = f"{number} {turn}"
            answer = self._session.ask("POST", "/telemetry?spacecraft_id=76", piece.octets, key)
            if answer.status != 202:
                raise SystemExit(f"POST /telemetry: {answer.status} {answer.body[:300]!r}")
            self.acknowledged.append((asked, time.monotonic(), answer.json()["job_id"]))


def loss_of(name: str, service: Deployment, uploads: Uploads, ground: Ground) -> dict[str, Any]:
    """Kill a part and measure the recovery."""
    session = Session(service.apis, uploads._session.token)
    before = service.parts[name].pid
    waiting = [len(unfinished_jobs(ground))]
    killed = time.monotonic()
    service.parts[name].kill()

    def first_after() -> tuple[float, float, str] | None:
        return next((one for one in list(uploads.acknowledged) if one[0] > killed), None)

    wait_until(lambda: first_after() is not None, f"upload after the loss of {name}")
    accepted = first_after()
    assert accepted is not None
    wait_until(
        lambda: session.get(f"/jobs/{accepted[2]}")["state"] == "done", f"job after the loss of {name}", 300.0
    )
    jobs_s = time.monotonic() - killed
    took_s = _waited_s(session.get(f"/jobs/{accepted[2]}"))
    waiting.append(len(unfinished_jobs(ground)))

    def complete() -> bool:
        if service.parts[name].pid == before:
            return False
        try:
            scheduled = has_scheduler(ground)
        except GroundError:
            return False
        return scheduled and all(runs(part.pid) for part in service.parts.values())

    wait_until(complete, f"complete service after the loss of {name}", 300.0)
    complete_s = time.monotonic() - killed
    times = [at for _, at, _ in list(uploads.acknowledged) if at > killed]
    uploads_s = max(later - earlier for earlier, later in itertools.pairwise([killed, *times]))
    return {
        "lost": name,
        "uploads_s": round(uploads_s, 1),
        "started_s": round(accepted[1] - killed + took_s, 1),
        "jobs_s": round(jobs_s, 1),
        "waiting": waiting,
        "complete_s": round(complete_s, 1),
    }


def _waited_s(job: Mapping[str, Any]) -> float:
    """Return the time that a job waited for a worker, s."""
    created, started = (datetime.fromisoformat(job[name]) for name in ("created", "started"))
    return (started - created).total_seconds()


def losses(folder: Path, names: tuple[str, ...], rate: float) -> dict[str, Any]:
    """Lose one part after another; return the figures."""
    stream = mixed_downlink(PACKETS)
    (folder / "whole.cadu").write_bytes(stream)
    with open_ground(folder / "reference") as ground:
        ingest_file(ground, folder / "whole.cadu")
        expected, packets = contents(ground)
    service = Deployment(folder, 2, schedulers=1)
    supervisor = Supervisor(service)
    try:
        with open_ground(service.home, database_url=service.url) as ground:
            session = Session(service.apis, add_user(ground, "ann", "operator"))
            uploads = Uploads(session, stream, rate)
            wait_until(functools.partial(has_scheduler, ground), "scheduler")
            supervisor.start()
            for thread in uploads.threads:
                thread.start()
            wait_until(lambda: len(uploads.acknowledged) >= 5, "first uploads")
            rows = [loss_of(name, service, uploads, ground) for name in names]
            wait_until(lambda: len(uploads.acknowledged) > 2 * PIECES, "all pieces", 300.0)
            uploads.over.set()
            for thread in uploads.threads:
                thread.join()
            states, attempts = ends_of(session, [job for _, _, job in uploads.acknowledged])
            found, stored = contents(ground)
    finally:
        supervisor.over.set()
        service.stop()
    return {
        "uploads_a_second": rate,
        "losses": rows,
        "acknowledged": len(uploads.acknowledged),
        "jobs": dict(states),
        "attempts": attempts,
        "packets_lost": len(set(packets) - set(stored)),
        "packets_doubled": len(stored) - len(set(stored)),
        "archive_identical": found == expected,
        "load_average": os.getloadavg()[0],
    }


def main() -> int:
    """Measure and print; 1 if something was lost or the recovery took longer than required."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", choices=PARTS, nargs="+", default=PARTS, help="parts to lose")
    parser.add_argument("--rate", type=float, default=2.0, help="uploads a second")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        figures = losses(Path(name), tuple(given.only), given.rate)
    print(json.dumps({"loss": figures}, indent=1))
    slowest = max(max(row["uploads_s"], row["jobs_s"]) for row in figures["losses"])
    kept = figures["archive_identical"] and set(figures["jobs"]) == {"done"}
    return 0 if kept and slowest <= LIMIT_S else 1


if __name__ == "__main__":
    raise SystemExit(main())
