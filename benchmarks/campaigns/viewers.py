"""Memory of the service with many viewers: `python -m benchmarks.campaigns.viewers [VIEWERS [MINUTES]]` (50, 10).

Each viewer holds a live feed and reads what pages of operators read, one request every two seconds; a piece of a
downlink comes in every five. Prints resident memory in MiB before, and while they watch. The exit status is 1 if an
answer was wrong, a feed ended, or memory grew by more than 5 % after the second minute.
"""

import asyncio
import itertools
import statistics
import sys
import tempfile
from collections import Counter
from pathlib import Path

import httpx
from websockets.asyncio.client import connect

from benchmarks._ground_service import READS, resident_mib, wait_for_job
from benchmarks._servers import Deployment
from benchmarks.ground import START, STEP_NS, definition, mixed_downlink
from studies.harness.parts import Part

PACKETS, PIECE, PIECE_S, PAUSE_S, SAMPLE_S = 20_000, 400, 5.0, 2.0, 5.0
SETTLED, SAMPLES = 24, 12
"""Samples until viewers have settled, two minutes, and those of a minute, whose medians are compared."""


async def _watched(base: str, part: Part, viewers: int, minutes: float) -> tuple[list[int], Counter[str]]:
    """Return the resident memory while viewers watch, and what went wrong."""
    wrong = Counter[str]()

    async def feed() -> None:
        async with connect(f"{base.replace('http', 'ws', 1)}/live?values=true") as socket:
            async for _ in socket:
                pass

    async def read(first: int) -> None:
        for path in itertools.islice(itertools.cycle(READS), first, None):
            status = (await client.get(path)).status_code
            if status != 200:
                wrong[f"{status} {path}"] += 1
            await asyncio.sleep(PAUSE_S)

    async def receive() -> None:
        for number in itertools.count(1):
            piece = mixed_downlink(PIECE, START + number * PIECE // 4 * STEP_NS)
            (await client.post("/telemetry?spacecraft_id=76", content=piece)).raise_for_status()
            await asyncio.sleep(PIECE_S)

    samples: list[int] = []
    async with httpx.AsyncClient(base_url=base, timeout=60.0, limits=httpx.Limits(max_connections=None)) as client:
        tasks = [asyncio.create_task(one) for k in range(viewers) for one in (feed(), read(k))]
        tasks.append(asyncio.create_task(receive()))
        while len(samples) < 60.0 * minutes / SAMPLE_S and not wrong:
            ended, _ = await asyncio.wait(tasks, timeout=SAMPLE_S, return_when=asyncio.FIRST_COMPLETED)
            wrong.update(str(one.exception() or "a feed ended") for one in ended)
            samples.append(resident_mib(part, "VmRSS"))
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
    return samples, wrong


def growth(samples: list[int]) -> float:
    """Return the median of the last minute over that of the minute in which the viewers have settled."""
    return statistics.median(samples[-SAMPLES:]) / statistics.median(samples[SETTLED - SAMPLES : SETTLED])


def main(viewers: str = "50", minutes: str = "10") -> int:
    """Run the campaign; 1 if something went wrong or memory grew."""
    with tempfile.TemporaryDirectory() as name, Deployment(Path(name), LINNA_SOCKETS_PER_USER=viewers) as service:
        base, part = f"{service.apis[0]}/api/v1", service.parts["api 1"]
        with httpx.Client(base_url=base, timeout=300.0) as client:
            taken = client.post("/telemetry?spacecraft_id=76", content=mixed_downlink(PACKETS)).json()
            wait_for_job(client, taken["job_id"])
            client.post("/passes", json=definition(PACKETS)).raise_for_status()
        before = resident_mib(part, "VmRSS")
        samples, wrong = asyncio.run(_watched(base, part, int(viewers), float(minutes)))
    print(f"{viewers} viewers: {before} MiB before, {samples[::SAMPLES]}, growth {growth(samples):.3f}, {dict(wrong)}")
    return int(bool(wrong) or growth(samples) > 1.05)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
