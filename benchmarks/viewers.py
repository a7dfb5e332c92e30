"""Live feed with many viewers: python -m benchmarks.viewers [--viewers N] [--rate R] [--seconds S] [--processes 1 2].

A station sends housekeeping packets over a TCP link to `linna serve` (PostgreSQL, Redis, one or more API processes).
Viewers spread over the processes receive newest values over WebSockets. Latency is from the transmission of a packet
to the arrival of its values, or of newer ones, at a viewer. Memory is the resident set of the API processes, sampled
each second; its growth is the slope of a line through the samples of the last two thirds.

With `--browser` a browser opens the layout of a pass shift of the telemetry displays instead: time from the request of
the page to the start of Open MCT and to the first value, and from the transmission of a packet to its value on screen.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import re
import socket
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from benchmarks.campaigns._deployment import ManyApis
from benchmarks.pages import open_chromium
from ground_service.store.database import prepare_database
from lunar.timescales import parse_utc, ticks_from_utc_ns
from studies.harness.parts import Part, PostgresServer, descendants
from tmtc.dictionary import DICTIONARY
from tmtc.downlink import encode_cadus

SPACECRAFT = 76
START_TICKS = int(ticks_from_utc_ns(parse_utc("2029-08-07T06:00:00Z")))
PATIENCE_S = 120.0
GATHER_S = 3.0
"""Time after the last packet in which viewers receive what is on its way."""

_NUMBER = re.compile(r'"name":"packets_sent","value":(\d+)')
_FIELDS = {one.name: 0 for one in DICTIONARY.packet("housekeeping").fields}
_WATCH = """(() => {
    window.shown = {};
    const look = () => {
        for (const row of document.querySelectorAll('[aria-label="lad row"]')) {
            const text = `${row.textContent} `.replace(/\\d{4}-\\d\\d-\\d\\d.*?Z/, " ");
            const found = /packets sent\\D*?(\\d+)\\s/.exec(text);
            if (found) window.shown[found[1]] ??= Date.now();
        }
        requestAnimationFrame(look);
    };
    requestAnimationFrame(look);
})()"""


@dataclass(eq=False)
class Station:
    """A ground station that sends one housekeeping packet at a time, with its number in `packets_sent`."""

    listener: socket.socket = field(default_factory=lambda: socket.create_server(("127.0.0.1", 0)))
    connection: socket.socket | None = None
    sent: dict[int, float] = field(default_factory=dict)

    def mission(self) -> bytes:
        """Return a mission description with a link to this station."""
        port = self.listener.getsockname()[1]
        return (
            f'name = "viewers"\n[spacecraft]\nid = {SPACECRAFT}\n'
            f'[[links]]\nname = "lab"\nkind = "tcp"\ndownlink = "127.0.0.1:{port}"\n'
        ).encode()

    def accept(self) -> None:
        """Wait for the link."""
        self.listener.settimeout(PATIENCE_S)
        self.connection, _ = self.listener.accept()

    def send(self) -> int:
        """Send the next packet; return its number."""
        assert self.connection is not None
        number = len(self.sent) + 1
        values = _FIELDS | {"structure_id": 1, "bus_voltage_v": 12.0, "packets_sent": number}
        packet = DICTIONARY.pack(
            "housekeeping", values, ticks=START_TICKS + number * 3_276, sequence_count=number % 16_384
        )
        octets = encode_cadus([packet], spacecraft_id=SPACECRAFT)
        self.sent[number] = time.time()
        self.connection.sendall(octets)
        return number


@contextmanager
def deployed(processes: int) -> Iterator[tuple[ManyApis, Station]]:
    """Operate API processes on PostgreSQL and Redis, and the link to a station."""
    with tempfile.TemporaryDirectory() as name, PostgresServer(Path(name)) as database:
        prepare_database(database.url, upgrade=True).engine.dispose()
        with ManyApis(Path(name), database.url, processes, LINNA_SOCKETS_PER_USER="500") as apis:
            station = Station()
            url = f"http://127.0.0.1:{apis.ports[0]}/api/v1/missions"
            httpx.post(url, content=station.mission(), timeout=60.0).raise_for_status()
            station.accept()
            yield apis, station


async def view(port: int, arrivals: list[tuple[int, float]]) -> None:
    """Note the number and the time of each message with values."""
    from websockets.asyncio.client import connect

    async with connect(
        f"ws://127.0.0.1:{port}/api/v1/live?values=true", compression=None, open_timeout=PATIENCE_S
    ) as socket_:
        async for text in socket_:
            found = _NUMBER.search(str(text))
            if found:
                arrivals.append((int(found[1]), time.time()))


async def measure(
    apis: ManyApis, station: Station, viewers: int, rate: float, seconds: float
) -> dict[str, Any]:
    """Send packets to viewers and return the figures."""
    arrivals: list[list[tuple[int, float]]] = [[] for _ in range(viewers)]
    tasks = [
        asyncio.create_task(view(apis.ports[k % len(apis.ports)], one)) for k, one in enumerate(arrivals)
    ]
    until = time.monotonic() + PATIENCE_S
    while not all(arrivals):  # everybody is connected
        if time.monotonic() > until:
            raise SystemExit("viewers: not all of them have received values")
        await asyncio.sleep(0.2)
        await asyncio.to_thread(station.send)
    first = len(station.sent) + 1
    parts = [part for name, part in apis.parts.items() if name.startswith("api")]
    samples: list[tuple[float, float]] = []
    began, spent = time.monotonic(), sum(map(processor_s, parts))
    for k in range(round(rate * seconds)):
        await asyncio.sleep(max(began + k / rate - time.monotonic(), 0.0))
        await asyncio.to_thread(station.send)
        if time.monotonic() - began >= len(samples):
            samples.append((time.monotonic() - began, sum(map(resident_mib, parts))))
    took, spent = time.monotonic() - began, sum(map(processor_s, parts)) - spent
    await asyncio.sleep(GATHER_S)
    lost = sum(task.done() for task in tasks)
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    return figures(station.sent, arrivals, first) | memory(samples) | {
        "viewers": viewers,
        "updates_per_s": round(len([k for k in station.sent if k >= first]) / took, 1),
        "viewers_lost": lost,
        "processor_percent": round(100 * spent / took, 1),
    }  # fmt: skip


def figures(sent: dict[int, float], arrivals: list[list[tuple[int, float]]], first: int) -> dict[str, Any]:
    """Return latency percentiles over packets and viewers, and shares of packets.

    A packet whose values a viewer skipped is shown by the next newer values; `never` counts those that nothing showed.
    """
    latencies: list[float] = []
    shown = never = 0
    numbers = np.array([k for k in sent if k >= first])
    times = np.array([sent[k] for k in numbers.tolist()])
    for one in arrivals:
        got = np.array([k for k, _ in one])
        at = np.array([t for _, t in one])
        shown += len(set(got.tolist()) & set(numbers.tolist()))
        index = np.searchsorted(np.maximum.accumulate(got) if len(got) else got, numbers)
        known = index < len(got)
        never += int((~known).sum())
        latencies.extend((at[index[known]] - times[known]).tolist())
    ms = 1e3 * np.array(latencies or [np.nan])
    return {
        "latency_ms": {name: round(float(np.percentile(ms, q)), 1) for name, q in (("p50", 50), ("p95", 95))},
        "shown_one_by_one_percent": round(100 * shown / max(len(arrivals) * len(numbers), 1), 1),
        "never_shown": never,
    }


def memory(samples: list[tuple[float, float]]) -> dict[str, Any]:
    """Return the resident memory at the start and the end, and its growth over the last two thirds."""
    late = np.array(samples[len(samples) // 3 :])
    growth = 60.0 * float(np.polyfit(late[:, 0], late[:, 1], 1)[0]) if len(late) > 2 else None
    return {
        "memory_mib": {"start": round(samples[0][1]), "end": round(samples[-1][1])},
        "memory_growth_mib_per_min": None if growth is None else round(growth, 2),
    }


def family(part: Part) -> list[int]:
    """Return the processes of a part."""
    return [part.pid, *descendants(part.pid)]


def processor_s(part: Part) -> float:
    """Return the processor time of a part so far."""
    total = 0
    for pid in family(part):
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        total += int(fields[11]) + int(fields[12])
    return total / os.sysconf("SC_CLK_TCK")


def resident_mib(part: Part) -> float:
    """Return the resident memory of a part."""
    page = os.sysconf("SC_PAGE_SIZE") / 2**20
    return sum(page * int(Path(f"/proc/{pid}/statm").read_text().split()[1]) for pid in family(part))


def displays(apis: ManyApis, station: Station, updates: int) -> dict[str, Any]:
    """Return the times of the telemetry displays in Chromium; the second opening has the files in the cache."""
    station.send()
    url = f"http://127.0.0.1:{apis.ports[-1]}/mct"
    opened = []
    with open_chromium() as chromium:
        context = chromium.new_context(viewport={"width": 1280, "height": 900})
        for _ in range(2):
            page = context.new_page()
            page.add_init_script(_WATCH)
            began = time.time()
            page.goto(url)
            page.wait_for_function("Object.keys(shown).length > 0", timeout=1e3 * PATIENCE_S)
            started = page.evaluate("performance.getEntriesByName('linna-started')[0].startTime") / 1e3
            first = page.evaluate("Math.min(...Object.values(shown))") / 1e3 - began
            opened.append({"started_s": round(started, 2), "first_value_s": round(first, 2)})
            if len(opened) < 2:
                page.close()
        page.get_by_text("Live feed connected").wait_for(timeout=1e3 * PATIENCE_S)
        for _ in range(updates):
            number = station.send()
            page.wait_for_function(f"shown[{number}]", timeout=1e3 * PATIENCE_S)
            page.wait_for_timeout(300)
        shown = page.evaluate("shown")
    late = [float(shown[str(k)]) - 1e3 * station.sent[k] for k in sorted(station.sent)[-updates:]]
    return {
        "first_opening": opened[0],
        "second_opening": opened[1],
        "on_screen_ms": {
            name: round(float(np.percentile(late, q))) for name, q in (("p50", 50), ("p95", 95))
        },
        "updates": updates,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--viewers", type=int, default=50)
    parser.add_argument("--rate", type=float, default=20.0, help="packets a second")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--processes", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--browser", action="store_true", help="measure the telemetry displays in Chromium")
    parser.add_argument("--updates", type=int, default=40, help="packets shown with --browser")
    given = parser.parse_args()
    for processes in given.processes:
        load = os.getloadavg()[0]
        with deployed(processes) as (apis, station):
            if given.browser:
                found = displays(apis, station, given.updates)
            else:
                found = asyncio.run(measure(apis, station, given.viewers, given.rate, given.seconds))
        print(json.dumps({"processes": processes, **found, "load_average_before": round(load, 2)}, indent=2))


if __name__ == "__main__":
    main()
