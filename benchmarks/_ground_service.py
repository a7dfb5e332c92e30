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

from benchmarks.campaigns._deployment import Laptop
from studies.harness.parts import Part

READS = (
    "/passes", "/passes/1", "/passes/1/completeness", "/passes/1/events?limit=50", "/passes/1/detections?limit=50",
    "/passes/1/states?max_points=500", "/passes/1/telemetry/power_w?max_points=500", "/jobs", "/ingests", "/windows",
    "/telecommands", "/ephemerides", "/spacecraft/76/trends", "/spacecraft/76/correlations",
)  # fmt: skip
"""Requests of the pages of operators, in turn."""


def answers_under_load(
    stream: bytes, definition: dict[str, Any], rate_per_s: float, seconds: float
) -> dict[str, Any]:
    """Latencies of ordinary reads at a steady rate, from the moment each is due, and how many went wrong."""
    with tempfile.TemporaryDirectory() as name:
        service = Laptop(Path(name))
        try:
            base = f"{service.api}/api/v1"
            with httpx.Client(base_url=base, timeout=300.0) as client:
                job = client.post("/telemetry?spacecraft_id=76", content=stream).json()["job_id"]
                wait_for_job(client, job)
                client.post("/passes", json=definition).raise_for_status()
            asyncio.run(_ask(base, rate_per_s, 3.0))  # warms what is compiled and cached
            before = processor_s(service.parts["api"])
            figures = asyncio.run(_ask(base, rate_per_s, seconds))
            spent = processor_s(service.parts["api"]) - before
            answers = max(figures["api_requests"], 1)
            return figures | {"api_server_cpu_ms_an_answer": round(1e3 * spent / answers, 2)}
        finally:
            service.stop()


async def _ask(base: str, rate_per_s: float, seconds: float) -> dict[str, Any]:
    times: dict[str, list[float]] = {path: [] for path in READS}
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
            times[path].append(time.perf_counter() - due)

        begin = time.perf_counter()
        tasks = []
        for k, path in zip(range(round(rate_per_s * seconds)), itertools.cycle(READS)):
            due = begin + k / rate_per_s
            await asyncio.sleep(max(due - time.perf_counter(), 0.0))
            tasks.append(asyncio.create_task(one(path, due)))
        await asyncio.gather(*tasks)
    every = np.array([value for values in times.values() for value in values]) * 1e3
    return {
        "api_requests": len(every),
        "api_requests_per_s": rate_per_s,
        "api_errors": dict(errors),
        "api_p50_ms": round(float(np.percentile(every, 50)), 1),
        "api_p95_ms": round(float(np.percentile(every, 95)), 1),
        "api_p99_ms": round(float(np.percentile(every, 99)), 1),
        "api_slowest": max(times, key=lambda path: float(np.median(times[path] or [0.0]))),
    }


def wait_for_job(client: httpx.Client, job: str) -> dict[str, Any]:
    """The job when it is at its end."""
    while True:
        row: dict[str, Any] = client.get(f"/jobs/{job}").json()
        if row["state"] in ("done", "failed"):
            return row
        time.sleep(0.2)


def memory_of_a_stream(different: bytes, megabytes: int) -> dict[str, Any]:
    """Return the memory of the service while it takes and ingests a downlink of a size in one upload.

    Anonymous memory, sampled: pages of the mapped raw file belong to the page cache and can be dropped at any time. The
    stream is `different` again and again, so most of its packets are stored already when they come.
    """
    with tempfile.TemporaryDirectory() as name:
        service = Laptop(Path(name), LINNA_UPLOAD_LIMIT_MIB=str(megabytes + 1))
        try:
            idle = resident_mib(service.parts["api"], "RssAnon")
            clock = time.perf_counter()
            copies = max(round(megabytes * 1e6 / len(different)), 1)

            def pieces() -> Iterator[bytes]:
                for _ in range(copies):
                    yield from (different[at : at + (1 << 20)] for at in range(0, len(different), 1 << 20))

            client = httpx.Client(base_url=f"{service.api}/api/v1", timeout=600.0)
            with client, _peak_anonymous_mib(service.parts["api"]) as peak:
                answer = client.post("/telemetry?spacecraft_id=76", content=pieces())
                answer.raise_for_status()
                row = wait_for_job(client, answer.json()["job_id"])
            return {
                "stream_megabytes": round(copies * len(different) / 1e6),
                "stream_state": row["state"],
                "stream_packets": (row["result"] or {}).get("packets"),
                "stream_s": round(time.perf_counter() - clock, 1),
                "idle_anonymous_mib": idle,
                "stream_peak_anonymous_mib": max(peak),
            }
        finally:
            service.stop()


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


def processor_s(part: Part) -> float:
    """Processor time of a part so far, s."""
    fields = Path(f"/proc/{part.pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def resident_mib(part: Part, name: str) -> int:
    """A field of /proc/PID/status of a part, in MiB."""
    lines = Path(f"/proc/{part.pid}/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith(name)).split()[1]) >> 10
