"""`linna montecarlo`: many seeded runs of anchored navigation with simulated detections, errors against claims."""

import argparse
from dataclasses import asdict
from typing import Any

from linna.data import data_folder
from linna.output import emit, finish
from linna.parser import number, option


def configure(parser: argparse.ArgumentParser) -> None:
    option(parser, "--runs N", number(int, least=1), "runs", 50)
    option(parser, "--seed", int, "seed of the first run", 1)
    option(parser, "--hours H", number(above=0.1), "length of a run", 3.0)
    option(
        parser,
        "--track",
        ("test", "tuning", "inclined", "limb"),
        "orbit: the paper's (test), the one on which process noise is tuned, or one of two held-out orbits",
        "test",
    )
    catalogued = "share of the craters in the catalogue; the payload maps the others"
    option(parser, "--catalogued S", number(above=0, most=1), catalogued, 1.0)
    option(
        parser,
        "--attitude-noise-deg A",
        number(least=0, most=10),
        "true noise of the attitude per axis in each frame (default: as declared on board)",
    )
    option(parser, "--workers N", int, "processes (default: one per core)")
    finish(parser, run)


def run(arguments: argparse.Namespace) -> int:
    from dataclasses import replace
    from math import radians

    from studies.montecarlo import consistency, fly_many, verdict
    from studies.montecarlo_world import standard_case

    stated = ("track", "hours", "catalogued", "attitude_noise_deg", "runs")
    given = {name: getattr(arguments, name) for name in stated}
    case = standard_case(data_folder(), *(given[name] for name in stated[:3]))
    if given["attitude_noise_deg"] is not None:
        case = replace(case, attitude_noise_rad=radians(given["attitude_noise_deg"]))
    seeds = list(range(arguments.seed, arguments.seed + arguments.runs))
    result = consistency(fly_many(case, seeds, arguments.workers), settle_frames=60)
    judged = verdict(result, arguments.runs)
    figures = {
        **given,
        "seeds": [seeds[0], seeds[-1]],
        "gravity": {"truth": case.gravity.name, "filter": case.filter_gravity.name},
        "detections": "simulated",
        **asdict(result),
        **asdict(judged),
    }
    return emit(arguments, figures, text=describe(figures))


def describe(figures: dict[str, Any]) -> str:
    """A few lines about the runs, for people."""
    low, high = figures["anees_bounds"]
    inside = ", ".join(f"{share:.3f}" for share in figures["contained_95"])
    return "\n".join(
        [
            f"{figures['runs']} runs of {figures['hours']:g} h, track {figures['track']}, simulated detections",
            f"position error: median {figures['median_m']:.0f} m, 95 % {figures['p95_m']:.0f} m, largest "
            f"{figures['largest_m']:.0f} m",
            f"ANEES(6) {figures['anees']:.2f}, 95 % bounds {low:.2f} to {high:.2f}; NIS per degree "
            f"{figures['nis_per_degree']:.3f}; lag-one correlation {figures['innovation_correlation']:.3f}",
            f"inside 1.96 sigma, radial, transverse, normal: {inside}; {figures['own_share']:.0%} of the craters own",
            f"attitude judged noisier than declared in {figures['degraded_share']:.1%} of the frames",
            "consistent" if figures["consistent"] else f"not consistent: {'; '.join(figures['reasons'])}",
        ]
    )
