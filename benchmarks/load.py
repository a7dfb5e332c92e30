"""Load of many users during a downlink: python -m benchmarks.load [--seconds 600] [--users 50] [--rate 500]
[--shared-buffers 128MB].

PostgreSQL, Redis, one API process and two workers. Every second, `rate` packets are uploaded; each user makes one read
every two seconds. After each minute the same packets come as those of another instance of the spacecraft, so that all
are new. Latencies count from the moment at which a read is due, so that a held-up read is not hidden.

The memory of every part is read every ten seconds, in MiB: private memory of its processes, shared memory segments (the
buffers of PostgreSQL, each page counted once), files (programs and libraries) and the private memory of the largest
process; also the number of processes. `max_at_s` is the time of the first largest value, `per_h` the slope of a
straight line after the first quarter, an hour. Shared memory of PostgreSQL grows until every buffer was used once;
`--shared-buffers` sets their size.
"""

from __future__ import annotations

import argparse
import asyncio
import itertools
import json
import os
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from benchmarks._ground_service import READS
from benchmarks.campaigns._deployment import Deployment
from benchmarks.ground import START, STEP_NS, mixed_downlink
from ground_service.access.service import add_user
from ground_service.ground import open_ground
from lunar.arrays import FloatArray
from lunar.timescales import format_utc
from studies.harness.usage import Memory, family_cpu_s, family_memory

ROUND_S = 60
EACH_USER_S = 2.0
MEMORY_S = 10.0
WARM_UP_S = 5.0


class Run:
    """One run of the load."""

    def __init__(self, service: Deployment, token: str, users: int, rate: int) -> None:
        self._service, self._users, self._rate = service, users, rate
        self._headers = {"Authorization": f"Bearer {token}"}
        self.times: list[float] = []
        self.by_path: dict[str, list[float]] = {path: [] for path in READS}
        self.errors: Counter[str] = Counter()
        self.memory: dict[str, list[tuple[float, Memory]]] = {name: [] for name in service.parts}
        self.uploads = 0
        self.last_job: str | None = None
        whole = mixed_downlink(rate * ROUND_S)
        cuts = np.linspace(0, len(whole), ROUND_S + 1).astype(int)
        self._pieces = [whole[a:b] for a, b in itertools.pairwise(cuts)]

    async def go(self, seconds: float) -> None:
        """Run the load."""
        limits = httpx.Limits(max_connections=self._users + 4, max_keepalive_connections=self._users + 4)
        async with httpx.AsyncClient(
            base_url=f"{self._service.api}/api/v1", timeout=60.0, limits=limits, headers=self._headers
        ) as client:
            for path in READS:
                await client.get(path)
            begin = time.perf_counter() + WARM_UP_S
            users = [self._user(client, begin, number, seconds) for number in range(self._users)]
            await asyncio.gather(self._upload(client, begin, seconds), self._watch(begin, seconds), *users)

    async def _user(self, client: httpx.AsyncClient, begin: float, number: int, seconds: float) -> None:
        turn = 0
        while (due := begin + EACH_USER_S * (turn + number / self._users)) < begin + seconds:
            await asyncio.sleep(max(due - time.perf_counter(), 0.0))
            path = READS[(turn + number) % len(READS)]
            try:
                answer = await client.get(path)
                if answer.status_code != 200:
                    self.errors[f"{answer.status_code} {path}"] += 1
            except httpx.HTTPError as error:
                self.errors[f"{type(error).__name__} {path}"] += 1
            took = time.perf_counter() - due
            self.times.append(took)
            self.by_path[path].append(took)
            turn += 1

    async def _upload(self, client: httpx.AsyncClient, begin: float, seconds: float) -> None:
        for second in range(int(seconds)):
            await asyncio.sleep(max(begin + second - time.perf_counter(), 0.0))
            path = f"/telemetry?spacecraft_id=76&instance=round-{second // ROUND_S}"
            if second < ROUND_S:
                path = "/telemetry?spacecraft_id=76"
            answer = await client.post(path, content=self._pieces[second % ROUND_S])
            if answer.status_code != 202:
                self.errors[f"{answer.status_code} POST /telemetry"] += 1
                continue
            self.uploads += 1
            self.last_job = answer.json()["job_id"]

    async def _watch(self, begin: float, seconds: float) -> None:
        while (now := time.perf_counter()) < begin + seconds:
            for name, part in self._service.parts.items():
                used = family_memory(part.pid)
                if used is not None:
                    self.memory[name].append((now - begin, used))
            await asyncio.sleep(MEMORY_S)


def memory_figures(samples: list[tuple[float, Memory]]) -> dict[str, Any]:
    """Return the figures of each kind of memory, of the largest process, and of the number of processes."""
    at = np.array([when for when, _ in samples])
    used = [one for _, one in samples]
    kinds = ("private", "shared", "files", "total", "largest", "processes")
    return {kind: _course(at, np.array([float(getattr(one, kind)) for one in used])) for kind in kinds}


def _course(at: FloatArray, values: FloatArray) -> dict[str, float]:
    """Return the first and last value, the maximum, its first time, and the growth an hour after the first quarter."""
    late = at > at[-1] / 4
    slope = float(np.polyfit(at[late], values[late], 1)[0]) * 3600.0 if late.sum() > 2 else float("nan")
    return {
        "first": round(float(values[0]), 1),
        "last": round(float(values[-1]), 1),
        "max": round(float(values.max()), 1),
        "max_at_s": round(float(at[int(values.argmax())])),
        "per_h": round(slope, 1),
    }


def failed_jobs(client: httpx.Client) -> int:
    """Return the number of failed jobs."""
    found, address = 0, "/jobs?limit=1000"
    while address:
        page = client.get(address).raise_for_status().json()
        found += sum(job["state"] == "failed" for job in page["items"])
        address = (page["next"] or "").removeprefix("/api/v1")
    return found


def measure(folder: Path, seconds: float, users: int, rate: int, shared_buffers: str) -> dict[str, Any]:
    """Run the load on a new deployment; return the figures."""
    service = Deployment(folder, 1, database_settings={"shared_buffers": shared_buffers})
    try:
        with open_ground(service.home, database_url=service.url) as ground:
            token = add_user(ground, "ann", "operator")
        # One user: the limit of requests a second of a caller is off in this deployment.
        run = Run(service, token, users, rate)
        stop = format_utc(START + rate * ROUND_S * STEP_NS // 4)
        definition = {"name": "all", "start": format_utc(START), "stop": stop, "spacecraft_id": 76}
        with httpx.Client(base_url=f"{service.api}/api/v1", headers=run._headers, timeout=60.0) as client:
            client.post("/telemetry?spacecraft_id=76", content=run._pieces[0]).raise_for_status()
            client.post("/passes", json=definition).raise_for_status()
            spent = {name: family_cpu_s(part.pid) or 0.0 for name, part in service.parts.items()}
            asyncio.run(run.go(seconds))
            spent = {
                name: (family_cpu_s(service.parts[name].pid) or 0.0) - before
                for name, before in spent.items()
            }
            load = os.getloadavg()
            began = time.monotonic()
            while client.get(f"/jobs/{run.last_job}").json()["state"] not in ("done", "failed"):
                time.sleep(0.2)
            behind_s = time.monotonic() - began
            failed = failed_jobs(client)
    finally:
        service.stop()
    times = np.array(run.times) * 1e3
    slowest = sorted(run.by_path, key=lambda path: -float(np.percentile(run.by_path[path] or [0.0], 95)))[:3]
    return {
        "seconds": seconds,
        "users": users,
        "packets_per_s": rate,
        "uploads": run.uploads,
        "reads": len(times),
        "errors": dict(run.errors),
        "failed_jobs": failed,
        "p50_ms": round(float(np.percentile(times, 50)), 1),
        "p95_ms": round(float(np.percentile(times, 95)), 1),
        "p99_ms": round(float(np.percentile(times, 99)), 1),
        "slowest_p95_ms": {
            path: round(float(np.percentile(run.by_path[path], 95)) * 1e3, 1) for path in slowest
        },
        "ingest_behind_at_end_s": round(behind_s, 1),
        "cores_busy": {name: round(one / seconds, 3) for name, one in spent.items()},
        "shared_buffers": shared_buffers,
        "memory": {name: memory_figures(samples) for name, samples in run.memory.items()},
        "load_average": [round(one, 1) for one in load],
    }


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--users", type=int, default=50)
    parser.add_argument("--rate", type=int, default=500, help="packets per second")
    parser.add_argument("--shared-buffers", default="128MB", help="setting of PostgreSQL")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        figures = measure(Path(name), given.seconds, given.users, given.rate, given.shared_buffers)
    print(json.dumps({"load": figures}, indent=1))
    return 1 if figures["errors"] or figures["failed_jobs"] else 0


if __name__ == "__main__":
    raise SystemExit(main())
