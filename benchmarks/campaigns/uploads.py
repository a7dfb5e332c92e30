"""Campaign of many clients: simultaneous uploads, incomplete requests, and a flood of WebSockets.

    python -m benchmarks.campaigns.uploads [--uploads N] [--half-sent N] [--sockets N] [--postgres] [--json]

Starts the ground service on a private port (SQLite; `--postgres`: a private PostgreSQL server) and measures, from
separate processes:

- *uploads*: N clients connect, then all send a downlink at the same moment. One that is answered with 503 comes again
  after Retry-After until it is accepted.
- *half-sent*: N connections send the head of an upload and a part of its body, then nothing; meanwhile honest uploads
  have to be accepted. The same with incomplete heads.
- *sockets*: N WebSockets of one viewer; meanwhile reads are timed.
- *stop*: SIGTERM while uploads hang; the service has to end, and no temporary file may remain.

Health is asked for on a new connection every 20 ms throughout, and of the idle service before (`health_idle`: what the
machine itself takes). Exit status 1 where a client got no answer, health took
more than 100 ms, memory went over 1 GB, the service did not stop, or files remained.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import multiprocessing
import os
import random
import resource
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from benchmarks.campaigns._deployment import Laptop, wait_until
from ground_service.access.service import add_user
from ground_service.ground import open_ground
from ground_service.store.database import prepare_database
from studies.mission_run.parts import PostgresServer
from tmtc.dictionary import DICTIONARY

HEALTH_LIMIT_MS = 100.0
MEMORY_LIMIT_MIB = 1024
STOP_LIMIT_S = 30.0
ANSWER_S = 180.0
PROBE_S = 60.0
WATCHED_S = 5.0
FORK = multiprocessing.get_context("fork")
"""Context for clients as forks of this process, which need no time for imports."""

SPACECRAFT = 76


@dataclass(frozen=True, slots=True)
class Server:
    """Address of the service, and a token with the right to upload."""

    port: int
    token: str

    @property
    def head(self) -> str:
        """Return the headers of every request."""
        return f"Host: 127.0.0.1:{self.port}\r\nAuthorization: Bearer {self.token}\r\n"

    def upload(self, octets: int) -> bytes:
        """Return the head of an upload of a length."""
        return (
            f"POST /api/v1/telemetry?spacecraft_id={SPACECRAFT} HTTP/1.1\r\n{self.head}"
            f"Content-Length: {octets}\r\n\r\n"
        ).encode()

    def read(self, path: str) -> bytes:
        """Return a request on a separate connection."""
        return f"GET {path} HTTP/1.1\r\n{self.head}Connection: close\r\n\r\n".encode()


def downlink(number: int, packets: int) -> bytes:
    """Return space packets that are unique to a client."""
    values: dict[str, Any] = {"event_id": "observation_stopped", "value_1": 0.0, "value_2": 0.0}
    return b"".join(
        DICTIONARY.pack(
            "event_info",
            {**values, "frame_number": k},
            ticks=(number * packets + k + 1) << 16,
            sequence_count=(number * packets + k) % 16384,
        )
        for k in range(packets)
    )


async def answer_of(reader: asyncio.StreamReader) -> tuple[int, dict[str, str]]:
    """Read a response; return its status and headers."""
    status = int((await reader.readline()).split()[1])
    headers: dict[str, str] = {}
    while line := (await reader.readline()).decode("latin-1").strip():
        name, _, value = line.partition(":")
        headers[name.lower()] = value.strip()
    await reader.readexactly(int(headers.get("content-length", "0")))
    return status, headers


async def upload(server: Server, body: bytes, start: asyncio.Event, counts: Counter[str]) -> None:
    """Send a body until it is accepted; count the responses in `counts`."""
    chance = random.Random(len(body))
    begin = time.monotonic()
    first = True
    while time.monotonic() - begin < ANSWER_S:
        writer: asyncio.StreamWriter | None = None
        try:
            reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
            if first:
                counts["connected"] += 1
                await start.wait()
                first, begin = False, time.monotonic()
            writer.write(server.upload(len(body)) + body)
            status, headers = await asyncio.wait_for(answer_of(reader), ANSWER_S)
        except (OSError, TimeoutError, asyncio.IncompleteReadError, IndexError, ValueError) as error:
            counts[f"no answer: {type(error).__name__}"] += 1
            await asyncio.sleep(1.0)
            continue
        finally:
            if writer is not None:
                await dropped([writer])
        counts[str(status)] += 1
        if status not in (408, 503):
            counts["accepted" if status == 202 else "refused"] += 1
            return
        await asyncio.sleep(float(headers.get("retry-after", "1")) * (0.5 + chance.random()))
    counts["given up"] += 1


def send_uploads(server: Server, first: int, count: int, packets: int, results: Any, go: Event) -> None:
    """Run the process of the clients: connect, wait for the signal, send, report."""
    allow_files()
    counts: Counter[str] = Counter()
    bodies = [downlink(number, packets) for number in range(first, first + count)]

    async def run() -> None:
        start = asyncio.Event()
        tasks = [asyncio.create_task(upload(server, body, start, counts)) for body in bodies]
        until = time.monotonic() + 60.0
        while counts["connected"] < count and time.monotonic() < until:
            await asyncio.sleep(0.05)
        results.put("connected")
        await asyncio.to_thread(go.wait)
        start.set()
        await asyncio.gather(*tasks)

    asyncio.run(run())
    results.put(dict(counts))


def probe(server: Server, path: str, every_s: float, stop: Event, results: Any) -> None:
    """Run a process that repeats a request on new connections; report its times in ms, and errors."""

    results.put("ready")

    async def run() -> tuple[list[float], Counter[str]]:
        times: list[float] = []
        errors: Counter[str] = Counter()
        while not stop.is_set():
            begin = time.perf_counter()
            try:
                async with asyncio.timeout(PROBE_S):
                    reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
                    writer.write(server.read(path))
                    status, _ = await answer_of(reader)
                    writer.close()
                if status != 200:
                    errors[str(status)] += 1
            except (OSError, TimeoutError, asyncio.IncompleteReadError, IndexError) as error:
                errors[type(error).__name__] += 1
            times.append(1e3 * (time.perf_counter() - begin))
            await asyncio.sleep(every_s)
        return times, errors

    results.put(asyncio.run(run()))


class Probes:
    """Repeated health checks or other requests while a part of the campaign runs."""

    def __init__(self, server: Server, path: str = "/healthz", every_s: float = 0.02) -> None:
        self._stop, self._results = FORK.Event(), FORK.SimpleQueue()
        self._process = FORK.Process(target=probe, args=(server, path, every_s, self._stop, self._results))
        self._process.start()
        assert self._results.get() == "ready"

    def figures(self, name: str) -> dict[str, Any]:
        """Return percentiles of the response time, ms."""
        self._stop.set()
        times, errors = self._results.get()
        self._process.join()
        return {
            f"{name}_asked": len(times),
            f"{name}_errors": dict(errors),
            f"{name}_p50_ms": round(float(np.percentile(times, 50)), 1),
            f"{name}_p99_ms": round(float(np.percentile(times, 99)), 1),
            f"{name}_max_ms": round(max(times), 1),
        }


def simultaneous_uploads(server: Server, count: int, packets: int) -> dict[str, Any]:
    """Connect all clients, then send simultaneously."""
    results, go = FORK.SimpleQueue(), FORK.Event()
    clients = FORK.Process(target=send_uploads, args=(server, 0, count, packets, results, go))
    clients.start()
    assert results.get() == "connected"
    health = Probes(server)
    begin = time.perf_counter()
    go.set()
    counts = results.get()
    wall_s = time.perf_counter() - begin
    clients.join()
    return {
        "uploads": count,
        "upload_octets": len(downlink(0, packets)),
        "answers": {name: number for name, number in sorted(counts.items()) if name != "connected"},
        "uploads_s": round(wall_s, 1),
        **health.figures("health"),
    }


def half_sent(server: Server, count: int, honest: int) -> dict[str, Any]:
    """Keep connections with incomplete requests open while other clients upload."""
    allow_files()

    async def run() -> dict[str, Any]:
        counts: Counter[str] = Counter()
        held = []
        for k in range(count):
            octets = (
                server.upload(1 << 20) + b"x" * 1000 if k % 2 else b"POST /api/v1/telemetry HTTP/1.1\r\nHos"
            )
            with contextlib.suppress(OSError):
                reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
                writer.write(octets)
                held.append((reader, writer))
        start = asyncio.Event()
        start.set()
        begin = time.perf_counter()
        bodies = [downlink(100_000 + k, 5) for k in range(honest)]
        await asyncio.gather(*(upload(server, body, start, counts) for body in bodies))
        took_s = time.perf_counter() - begin
        ended: Counter[str] = Counter()

        async def end(reader: asyncio.StreamReader) -> None:
            try:
                async with asyncio.timeout(60.0):
                    ended[str((await answer_of(reader))[0])] += 1
            except (OSError, TimeoutError, asyncio.IncompleteReadError, IndexError) as error:
                ended[type(error).__name__] += 1

        await asyncio.gather(*(end(reader) for reader, _ in held))
        await dropped(writer for _, writer in held)
        return {
            "half_sent": len(held),
            "half_sent_ended_with": dict(ended),
            "honest_uploads_accepted": counts["accepted"],
            "honest_uploads": honest,
            "honest_uploads_s": round(took_s, 1),
        }

    return asyncio.run(run())


def socket_flood(server: Server, count: int, seconds: float) -> dict[str, Any]:
    """Open WebSockets of one caller; return the number accepted, and the response times meanwhile."""
    allow_files()

    async def run() -> Counter[str]:
        found: Counter[str] = Counter()
        held = []
        for _ in range(count):
            reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
            writer.write(
                f"GET /api/v1/live HTTP/1.1\r\n{server.head}Upgrade: websocket\r\nConnection: Upgrade\r\n"
                "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n".encode()
            )
            held.append(writer)
            try:
                found[(await asyncio.wait_for(reader.readline(), 30.0)).split()[1].decode()] += 1
            except (OSError, TimeoutError, IndexError) as error:
                found[type(error).__name__] += 1
        await asyncio.sleep(seconds)
        await dropped(held)
        return found

    reads = Probes(server, "/api/v1/passes", 0.05)
    statuses = asyncio.run(run())
    return {"sockets": count, "sockets_answered_with": dict(statuses), **reads.figures("reads_with_sockets")}


async def dropped(writers: Iterable[asyncio.StreamWriter]) -> None:
    """Close connections without waiting for the other side."""
    ended = list(writers)
    for writer in ended:
        writer.transport.abort()
    await asyncio.gather(*(writer.wait_closed() for writer in ended), return_exceptions=True)


def allow_files() -> None:
    """Raise the limit of open files of this process to the maximum of the system."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))


def peak_rss_mib(pid: int) -> int:
    """Return the peak resident memory of a process, MiB."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith("VmHWM")).split()[1]) >> 10


def stopped(server: Server, service: Laptop, hanging: int) -> dict[str, Any]:
    """Send SIGTERM during incomplete uploads; return the time to stop, and the remaining temporary files."""

    async def hang() -> list[asyncio.StreamWriter]:
        writers = []
        for _ in range(hanging):
            _, writer = await asyncio.open_connection("127.0.0.1", server.port)
            writer.write(server.upload(4 << 20) + b"x" * (1 << 20))
            writers.append(writer)
        await asyncio.sleep(1.0)
        os.kill(service.parts["api"].pid, signal.SIGTERM)
        return writers

    loop = asyncio.new_event_loop()
    begin = time.perf_counter()
    writers = loop.run_until_complete(hang())
    with contextlib.suppress(SystemExit):
        wait_until(lambda: not alive(service.parts["api"].pid), "service", ANSWER_S)
    took_s = time.perf_counter() - begin
    ended = not alive(service.parts["api"].pid)
    loop.run_until_complete(dropped(writers))
    loop.close()
    left = [path.name for path in service.home.rglob(".incoming-*")]
    return {"hanging_at_stop": hanging, "stopped": ended, "stop_s": round(took_s, 1), "files_left": len(left)}


def alive(pid: int) -> bool:
    """Return whether a child process runs and is not a zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def campaign(
    folder: Path,
    *,
    uploads: int,
    half: int,
    sockets: int,
    postgres: bool,
    packets: int,
    watched_s: float = WATCHED_S,
    **settings: str,
) -> dict[str, Any]:
    """Run all parts in sequence with these settings of the service; see the module.

    Parameters
    ----------
    watched_s
        Observation time of the idle service, and of the service with many WebSockets, s.
    """
    database = PostgresServer(folder) if postgres else None
    if database is not None:
        settings["LINNA_DATABASE_URL"] = database.url
        prepare_database(database.url, upgrade=True).engine.dispose()
    with open_ground(folder / "home", database_url=database.url if database is not None else None) as ground:
        token = add_user(ground, "olga", "operator")
    service = Laptop(folder, **settings)
    try:
        server = Server(urlsplit(service.api).port or 0, token)
        pid = service.parts["api"].pid
        figures: dict[str, Any] = {"database": "postgresql" if postgres else "sqlite"}
        idle = Probes(server)
        time.sleep(watched_s)
        figures |= idle.figures("health_idle")
        if uploads:
            figures |= simultaneous_uploads(server, uploads, packets)
            print(figures, file=sys.stderr, flush=True)
        if half:
            health = Probes(server)
            figures |= half_sent(server, half, honest=20)
            figures |= health.figures("health_half_sent")
        if sockets:
            figures |= socket_flood(server, sockets, watched_s)
        figures["peak_rss_mib"] = peak_rss_mib(pid)
        figures |= stopped(server, service, hanging=20)
        return figures
    finally:
        service.stop()
        if database is not None:
            database.part.end()


def verdict(figures: dict[str, Any]) -> list[str]:
    """Return the faults, one line each."""
    answers = figures.get("answers", {})
    faults = []
    if answers.get("accepted", 0) != figures.get("uploads", 0):
        faults.append(f"{figures['uploads'] - answers.get('accepted', 0)} uploads were not accepted")
    faults += [f"{name}: {number}" for name, number in answers.items() if name.startswith("no answer")]
    if figures.get("honest_uploads_accepted") != figures.get("honest_uploads"):
        faults.append("honest uploads were held up by half-sent requests")
    for name in ("health", "health_half_sent"):
        if figures.get(f"{name}_errors"):
            faults.append(f"{name}: {figures[f'{name}_errors']}")
        if figures.get(f"{name}_max_ms", 0.0) > HEALTH_LIMIT_MS:
            faults.append(f"{name}: {figures[f'{name}_max_ms']} ms, expected at most {HEALTH_LIMIT_MS:.0f}")
    if figures["peak_rss_mib"] > MEMORY_LIMIT_MIB:
        faults.append(f"memory: {figures['peak_rss_mib']} MiB, expected at most {MEMORY_LIMIT_MIB}")
    if not figures["stopped"]:
        faults.append("the service did not stop")
    elif figures["stop_s"] > STOP_LIMIT_S:
        faults.append(f"stopped after {figures['stop_s']} s, expected at most {STOP_LIMIT_S:.0f} s")
    if figures["files_left"]:
        faults.append(f"{figures['files_left']} temporary files remain")
    return faults


def main(words: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--uploads", type=int, default=1000)
    parser.add_argument("--packets", type=int, default=100, help="packets in each upload")
    parser.add_argument("--half-sent", type=int, default=1100)
    parser.add_argument("--sockets", type=int, default=900)
    parser.add_argument("--postgres", action="store_true")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args(words)
    with tempfile.TemporaryDirectory() as name:
        figures = campaign(
            Path(name),
            uploads=given.uploads,
            half=given.half_sent,
            sockets=given.sockets,
            postgres=given.postgres,
            packets=given.packets,
        )
    faults = verdict(figures)
    if given.json:
        print(json.dumps({**figures, "faults": faults}))
    else:
        for name, value in figures.items():
            print(f"{name:28} {value}")
        print("\n".join(faults) if faults else "all as required")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
