"""`linna catalogue minimum`: how few landmarks keep the error of navigation bounded."""

from __future__ import annotations

import argparse
from dataclasses import asdict, replace
from pathlib import Path

from linna.output import add_json_flag, emit, log

LEVEL = "level 2: simulated detections over craters of the paper's density, no images"
SHARES = (1.0, 0.3, 0.1, 0.05, 0.02, 0.01)


def configure(minimum: argparse.ArgumentParser) -> None:
    minimum.add_argument("--hours", type=float, default=4.0, help="length of each flight (default: 4)")
    minimum.add_argument(
        "--shares",
        default=",".join(str(share) for share in SHARES),
        metavar="S,...",
        help="parts of the catalogue on board (default: %(default)s)",
    )
    minimum.add_argument("--seed", type=int, default=1, help="default: 1")
    minimum.add_argument("--no-map", action="store_true", help="without the payload's own landmark map")
    minimum.add_argument("--plot", type=Path, metavar="FILE", help="curves as a picture (png, svg or pdf)")
    add_json_flag(minimum)
    minimum.set_defaults(handler=run)


def run(arguments: argparse.Namespace) -> int:
    from linna.data import data_folder
    from linna.errors import UsageError
    from studies.anchoring import study_sizes
    from studies.montecarlo_world import standard_case

    try:
        shares = [float(part) for part in arguments.shares.split(",")]
    except ValueError:
        shares = []
    if not shares or not all(0.0 < share <= 1.0 for share in shares):
        raise UsageError(f"--shares: expected numbers above 0 and up to 1, found {arguments.shares!r}")
    if not 0.5 <= arguments.hours <= 48.0:
        raise UsageError(f"--hours: expected 0.5 to 48, found {arguments.hours:g}")
    case = standard_case(data_folder(), "test", arguments.hours)
    mapped = replace(case.parameters, map_landmarks=not arguments.no_map)
    # The question is what keeps an orbit that is known, not what finds one: the start is as after a good fix.
    case = replace(case, parameters=mapped, start_position_m=200.0, start_velocity_m_s=0.2)
    log(f"{len(shares)} sizes of {len(case.craters)} craters, {arguments.hours:g} h each")
    scores = study_sizes(case, shares, arguments.seed)
    bounded = [score.craters for score in scores if score.bounded]
    figures = {
        "scores": [asdict(score) for score in scores],
        "fewest_bounded": min(bounded) if bounded else None,
        "craters": len(case.craters),
        "landmark_map": not arguments.no_map,
        "hours": arguments.hours,
        "seed": arguments.seed,
        "level": LEVEL,
        "data": ["synthetic craters of the paper's density", f"gravity {case.gravity.name}"],
    }
    if arguments.plot is not None:
        from reports.studies import save_anchoring_study

        save_anchoring_study(arguments.plot, figures["scores"], f"{len(case.craters)} craters; {LEVEL}")
        figures["plot"] = str(arguments.plot)
    lines = [
        f"{'chosen':<9}{'craters':>8}{'per image':>11}{'median m':>10}{'p95 m':>9}{'max m':>9}{'fixed':>8}"
    ]
    lines += [
        f"{score.choice:<9}{score.craters:>8}{score.per_footprint:>11.1f}{score.median_m:>10.0f}{score.p95_m:>9.0f}"
        f"{score.largest_m:>9.0f}{100 * score.fixed_share:>7.0f}%"
        for score in scores
    ]
    emit(arguments, figures, text="\n".join([*lines, LEVEL]))
    return 0
