"""Growth of cost with the work: python -m benchmarks.growth PLOT.svg.

Each job runs with 1, 10 and 100 times its work. Its exponent is the power of the work that its processor time follows
(1: in proportion; 0: no growth). A job whose exponent is above `LARGEST` grows faster than its work.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from matplotlib.figure import Figure

from benchmarks._rows import Row
from benchmarks.ground import START, STEP_NS, mixed_downlink, states
from ground_service.access.service import add_user, authenticate
from ground_service.evaluation.service import pass_summary
from ground_service.ground import Ground, open_ground
from ground_service.ingest.service import ingest_file
from ground_service.passes.model import PassFilter
from ground_service.passes.service import define_pass
from ground_service.passes.store import list_passes
from ground_service.store.vehicles import vehicle_id
from lunar.arrays import FloatArray
from lunar.camera import PinholeCamera, nadir_camera_from_mcmf
from lunar.catalogue import CraterCatalogue
from lunar.frames import mcmf_from_spherical
from payload_emulator.sim.render.light import sun_direction_mcmf
from payload_emulator.sim.render.renderer import render
from payload_emulator.sim.terrain.procedural import ProceduralTerrain

FACTORS = (1, 10, 100)
LARGEST = 1.15
"""Largest exponent that counts as in proportion: small caches of the processor are left on the way."""

Ask = Callable[[], object]


def _frames(count: int, ground: Ground) -> Ask:
    terrain, camera, light = ProceduralTerrain(1), PinholeCamera(), np.radians([20.0, 60.0])

    def fly() -> None:
        for longitude in np.radians(0.8 * np.arange(count)):
            position = mcmf_from_spherical(0.1, longitude, 30e3)
            sun = sun_direction_mcmf(*light, 0.1, longitude)
            render(terrain, camera, position, nadir_camera_from_mcmf(position), sun)

    return fly


def _packets(count: int, ground: Ground) -> Ask:
    stream = ground.home / "stream.cadu"
    stream.write_bytes(mixed_downlink(count))
    return lambda: ingest_file(ground, stream)


def _define(ground: Ground, name: str, first: int, last: int) -> int:
    times = {"start_utc_ns": START + first * STEP_NS, "stop_utc_ns": START + last * STEP_NS}
    return define_pass(ground, name=name, spacecraft_id=76, **times)


def _pass_packets(count: int, ground: Ground) -> Ask:
    _packets(count, ground)()
    number = _define(ground, "all", 0, count // 4)
    return lambda: pass_summary(ground, number)


def _passes(count: int, ground: Ground) -> Ask:
    ground.write(vehicle_id, 76, "flight")
    for k in range(count):
        _define(ground, f"pass {k}", k, k + 1)
    return lambda: [ground.read(list_passes, PassFilter()) for _ in range(20)]


def _spacecraft(count: int, ground: Ground) -> Ask:
    stream = ground.home / "stream.cadu"
    stream.write_bytes(mixed_downlink(400))
    return lambda: [ingest_file(ground, stream, instance=f"emulated-{k}") for k in range(count)]


def _users(count: int, ground: Ground) -> Ask:
    tokens = [add_user(ground, f"user{k}", "viewer") for k in range(count)]
    return lambda: [authenticate(ground, tokens[k % count]) for k in range(200)]


def _craters(count: int, ground: Ground) -> Ask:
    rng = np.random.default_rng(1)
    latitude, longitude = np.arcsin(rng.uniform(-1, 1, count)), rng.uniform(0, 2 * np.pi, count)
    flat = np.zeros(count)
    listed = CraterCatalogue(
        np.arange(count), latitude, longitude, flat + 5e3, flat, flat, "random", flat == 0
    )
    return lambda: [listed.select(listed.near(a, b, 150e3)) for a, b in rng.uniform(0.2, 1.4, (200, 2))]


JOBS: dict[str, tuple[int, Callable[[int, Ground], Ask]]] = {
    "frames rendered": (1, _frames),
    "packets ingested": (800, _packets),
    "packets of an evaluated pass": (80, _pass_packets),
    "passes of a list, 20 first pages": (10, _passes),
    "spacecraft, an ingest each": (1, _spacecraft),
    "users, 200 requests": (5, _users),
    "craters of a catalogue, 200 places": (10_000, _craters),
}


def measured(least: int, job: Callable[[int, Ground], Ask]) -> FloatArray:
    """Return the processor times (3,) in s of a job of `least` times `FACTORS`, after one that compiles."""
    spent = []
    for count in (least, *(least * factor for factor in FACTORS)):
        with TemporaryDirectory() as folder, open_ground(Path(folder)) as ground:
            ask = job(count, ground)
            begun = time.process_time()
            ask()
            spent.append(time.process_time() - begun)
    return np.array(spent[1:])


def growth() -> Iterator[tuple[str, int, FloatArray, float]]:
    """Yield name, least work, processor times (3,) in s and exponent of each job."""
    for name, (least, job) in JOBS.items():
        spent = measured(least, job)
        yield name, least, spent, float(np.polyfit(np.log(FACTORS), np.log(spent), 1)[0])
    spent = np.array([1e-3 * states(5_000 * factor)["states_p95_cpu_ms"] for factor in FACTORS])
    yield "samples of a series, 95 %", 5_000, spent, float(np.polyfit(np.log(FACTORS), np.log(spent), 1)[0])


def rows() -> Iterator[Row]:
    """Yield the exponent of each job; growth faster than the work is an error."""
    for name, least, spent, exponent in growth():
        times = ", ".join(f"{one:.3g}" for one in spent)
        wrong = f"exponent {exponent:.2f}" if exponent > LARGEST else ""
        yield Row(f"{name}, from {least:,}: {times} s", round(exponent, 2), "exponent", wrong=wrong)


def main() -> None:
    figure = Figure(figsize=(7.0, 4.5), layout="constrained")
    axes = figure.add_subplot(
        xscale="log", yscale="log", xlabel="times the least work", ylabel="processor time, s"
    )
    for name, least, spent, exponent in growth():
        print(
            f"| {name} | {least:,} | " + " | ".join(f"{one:.3g}" for one in spent) + f" | {exponent:.2f} |",
            flush=True,
        )
        axes.plot(FACTORS, spent, "o-", label=f"{name}: {exponent:.2f}")
    axes.grid(alpha=0.3)
    figure.legend(loc="outside right", fontsize="x-small")
    figure.savefig(sys.argv[1])


if __name__ == "__main__":
    main()
