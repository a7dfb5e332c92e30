"""The running service under load: answers at a steady rate of requests, and memory while a long downlink streams in."""

import asyncio
import itertools
import os
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from benchmarks._rows import Row
from benchmarks._servers import Deployment
from studies.harness.parts import Part, descendants

READS = (
    "/passes", "/passes/1", "/passes/1/completeness", "/passes/1/events?limit=50", "/passes/1/detections?limit=50",
    "/passes/1/states?max_points=500", "/passes/1/telemetry/power_w?max_points=500", "/jobs", "/ingests", "/windows",
    "/telecommands", "/ephemerides", "/spacecraft/76/trends", "/spacecraft/76/correlations",
)  # fmt: skip
"""Requests of the pages of operators, in turn."""


def answers_under_load(stream: bytes, definition: dict[str, Any], rate_per_s: float, seconds: float) -> Row:
    """Latencies of ordinary reads at a steady rate, from the moment each is due, and how many went wrong."""
    with tempfile.TemporaryDirectory() as name, Deployment(Path(name)) as service:
        base = f"{service.apis[0]}/api/v1"
        with httpx.Client(base_url=base, timeout=300.0) as client:
            job = client.post("/telemetry?spacecraft_id=76", content=stream).json()["job_id"]
            wait_for_job(client, job)
            client.post("/passes", json=definition).raise_for_status()
        asyncio.run(_ask(base, rate_per_s, 3.0))  # warms what is compiled and cached
        times, errors = asyncio.run(_ask(base, rate_per_s, seconds))
    half, most = map(float, np.percentile(times, (50, 95)))
    wrong = f"errors {dict(errors)}" if errors else ""
    return Row(f"API reads at {rate_per_s:.0f}/s, 95 %", most, "ms", "median", half, wrong)


async def _ask(base: str, rate_per_s: float, seconds: float) -> tuple[list[float], Counter[str]]:
    times: list[float] = []
    errors: Counter[str] = Counter()
    async with httpx.AsyncClient(base_url=base, timeout=30.0) as client:

        async def one(path: str, due: float) -> None:
            try:
                status = (await client.get(path)).status_code
            except httpx.HTTPError as error:
                errors[type(error).__name__] += 1
                return
            if status != 200:
                errors[f"{status} {path}"] += 1
            times.append(1e3 * (time.perf_counter() - due))

        begin = time.perf_counter()
        tasks = []
        for k, path in zip(range(round(rate_per_s * seconds)), itertools.cycle(READS)):
            due = begin + k / rate_per_s
            await asyncio.sleep(max(due - time.perf_counter(), 0.0))
            tasks.append(asyncio.create_task(one(path, due)))
        await asyncio.gather(*tasks)
    return times, errors


def wait_for_job(client: httpx.Client, job: str) -> dict[str, Any]:
    """The job when it is at its end."""
    while True:
        row: dict[str, Any] = client.get(f"/jobs/{job}").json()
        if row["state"] in ("done", "failed"):
            return row
        time.sleep(0.2)


def memory_of_a_stream(different: bytes, megabytes: int) -> Row:
    """Return the memory of the service while it takes and ingests a downlink of a size in one upload.

    Anonymous memory, sampled: pages of the mapped raw file belong to the page cache and can be dropped at any time. The
    stream is `different` again and again, so most of its packets are stored already when they come.
    """
    limit = str(megabytes + 1)
    with tempfile.TemporaryDirectory() as name, Deployment(Path(name), LINNA_UPLOAD_LIMIT_MIB=limit) as service:
        idle = resident_mib(service.parts["api 1"], "RssAnon")
        copies = max(round(megabytes * 1e6 / len(different)), 1)

        def pieces() -> Iterator[bytes]:
            for _ in range(copies):
                yield from (different[at : at + (1 << 20)] for at in range(0, len(different), 1 << 20))

        client = httpx.Client(base_url=f"{service.apis[0]}/api/v1", timeout=600.0)
        with client, _peak_anonymous_mib(service.parts["api 1"]) as peak:
            answer = client.post("/telemetry?spacecraft_id=76", content=pieces())
            answer.raise_for_status()
            row = wait_for_job(client, answer.json()["job_id"])
    wrong = "" if row["state"] == "done" and max(peak) < idle + 300 else f"{row['state']}, {max(peak)} MiB"
    what = f"upload of {megabytes} MB: anonymous memory, peak"
    return Row(what, max(peak), "MiB", "idle", idle, wrong)


@contextmanager
def _peak_anonymous_mib(part: Part) -> Iterator[list[int]]:
    """Sample the anonymous memory of a part, in MiB, into the list while the context lasts."""
    samples, done = [resident_mib(part, "RssAnon")], threading.Event()

    def watch() -> None:
        while not done.wait(0.05):
            samples.append(resident_mib(part, "RssAnon"))

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        yield samples
    finally:
        done.set()
        watcher.join()


def processor_s(part: Part, *, children: bool = False) -> float:
    """Processor time of a part so far, s; also of its children, where asked."""
    found = 0
    for pid in (part.pid, *(descendants(part.pid) if children else ())):
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        found += sum(map(int, fields[11 : 15 if children else 13]))
    return found / os.sysconf("SC_CLK_TCK")


def resident_mib(part: Part, name: str) -> int:
    """A field of /proc/PID/status of a part, in MiB."""
    lines = Path(f"/proc/{part.pid}/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith(name)).split()[1]) >> 10
