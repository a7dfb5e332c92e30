"""`linna identify lost`: lost in space on rendered frames and what the network finds in them."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from linna.output import emit, finish, log, progress
from linna.parser import number, option

if TYPE_CHECKING:
    from studies.lost_in_space import LostRow, Share

LEAST_CATALOGUED = 6


def configure(parser: argparse.ArgumentParser) -> None:
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    lost = commands.add_parser(
        "lost", help="lost in space: places found from one frame or four, without a prior"
    )
    option(
        lost,
        "--scenario FILE",
        str,
        "frames along a scenario in sets of four; its terrain's craters are the map",
        required=True,
    )
    option(lost, "--frames", int, "", 300)
    option(
        lost, "--attitude-deg", number(above=0, most=2), "error of nadir and heading, 1 sigma per axis", 0.5
    )
    option(lost, "--min-diameter-km", number(least=1, most=20), "smallest craters of the map", 3.0)
    option(
        lost,
        "--hostile",
        bool,
        "search each frame also with its detections mirrored, turned and scattered: each fix is wrong",
    )
    finish(lost, run)


def run(arguments: argparse.Namespace) -> int:
    from linna.data import data_folder
    from linna.errors import UsageError
    from payload_emulator.flight.models import load_shipped_model
    from payload_emulator.flight.navigation.lost_in_space import LostParameters
    from payload_emulator.flight.vision.detector import DetectorParameters, OnnxDetector
    from payload_emulator.session.mission import level_of, level_text, unseen_share
    from payload_emulator.session.scenario import load_scenario
    from payload_emulator.session.world import build_world
    from studies import lost_in_space as study
    from studies.lost_frames import FRAMES_COMBINED

    if arguments.frames < FRAMES_COMBINED:
        raise UsageError(f"--frames: expected at least {FRAMES_COMBINED}, found {arguments.frames}")
    scenario = study.pointed(load_scenario(arguments.scenario), arguments.attitude_deg)
    world = build_world(scenario, data_folder())
    numbers = study.frames_in_sets(world, math.ceil(arguments.frames / FRAMES_COMBINED))
    if not numbers.size:
        raise UsageError(
            f"--scenario {arguments.scenario}: expected {FRAMES_COMBINED} frames in a row, found none"
        )
    size = {"width_px": world.camera.width_px, "height_px": world.camera.height_px}
    detector = OnnxDetector(load_shipped_model(), DetectorParameters(**size))
    seen = study.see_frames(
        world, detector, numbers, lambda frames, total: progress(frames, total, "frames", "frame")
    )
    log("map of the search")
    true, board = study.search_map(world, numbers, 1e3 * arguments.min_diameter_km)
    parameters = LostParameters(attitude_sigma_rad=math.radians(arguments.attitude_deg))
    single, sets = study.search_frames(
        world, seen, true, board, parameters, lambda rows, total: progress(rows, total, "searches", "frame")
    )
    hostile = []
    if arguments.hostile:
        hostile = study.search_hostile(
            seen, board, world.camera, parameters, scenario.seed,
            lambda rows, total: progress(rows, total, "hostile searches", "frame"),
        )  # fmt: skip
    rows = {
        "all frames": study.share(single),
        f"frames, {LEAST_CATALOGUED} known": study.share(single, LEAST_CATALOGUED),
        "all sets of four": study.share(sets),
        f"sets, {LEAST_CATALOGUED} known in each": study.share(sets, LEAST_CATALOGUED),
    }
    unseen = unseen_share(world)
    found = level_of("real-terrain" if world.terrain.is_real else "procedural", unseen)
    level = f"level {level_text(found, unseen)}: frames rendered along {scenario.name}, the shipped detector"
    figures: dict[str, Any] = {
        "single_correct_share": rows[f"frames, {LEAST_CATALOGUED} known"].correct_share,
        "four_frames_correct_share": rows[f"sets, {LEAST_CATALOGUED} known in each"].correct_share,
        "wrong": rows["all frames"].wrong
        + rows["all sets of four"].wrong
        + sum(one.fixes for one in hostile),
        "searches": len(single) + len(sets) + sum(one.searches for one in hostile),
        "hostile": [*map(_hostile_as_json, hostile)],
        "scores": {name: _as_json(row) for name, row in rows.items()},
        "by_altitude": [
            {"from_km": low, "to_km": None if math.isinf(high) else high, **_as_json(row)}
            for low, high, row in study.by_altitude(single, LEAST_CATALOGUED)
        ],
        **_statistics(single, study.WRONG_PLACE_M),
        "craters": len(board),
        "min_diameter_km": arguments.min_diameter_km,
        "attitude_sigma_deg": arguments.attitude_deg,
        "least_true_detections": LEAST_CATALOGUED,
        "wrong_beyond_m": study.WRONG_PLACE_M,
        "scenario": scenario.name,
        "seed": scenario.seed,
        "model_sha256": detector.sha256,
        "level": level,
        "data": list(world.data_names),
    }
    table = _table(rows, study.by_altitude(single, LEAST_CATALOGUED))
    table += [f"{one.kind:<24}{one.searches:>9}{0:>9}{'':>8}{one.fixes:>7}" for one in hostile]
    last = (
        f"{figures['catalogued_per_frame']:.1f} of {figures['detections_per_frame']:.1f} detections a frame are of "
        f"the {len(board)} craters of the map; {figures['median_cpu_s']:.2f} s "
        f"(largest {figures['largest_cpu_s']:.2f}) a search"
    )
    return emit(arguments, figures, text="\n".join([*table, last, level]))


def _statistics(single: Sequence[LostRow], wrong_m: float) -> dict[str, float | None]:
    """Return errors of the frames placed within ``wrong_m``, processor times, and counts per frame."""
    import numpy as np

    errors = np.array([row.error_m for row in single])
    right = errors[errors <= wrong_m]
    spent = np.array([row.cpu_s for row in single])
    return {
        "median_error_m": float(np.median(right)) if right.size else None,
        "p95_error_m": float(np.percentile(right, 95.0)) if right.size else None,
        "median_cpu_s": float(np.median(spent)),
        "largest_cpu_s": float(np.max(spent)),
        "catalogued_per_frame": float(np.mean([row.catalogued for row in single])),
        "detections_per_frame": float(np.mean([row.detections for row in single])),
    }


def _table(rows: dict[str, Share], by_altitude: Iterable[tuple[float, float, Share]]) -> list[str]:
    """Return the lines of a table of correct and wrong searches."""
    named = [*rows.items(), *((f"  {low:.0f} to {high:.0f} km", row) for low, high, row in by_altitude)]
    return [f"{'':<24}{'searches':>9}{'correct':>9}{'share':>8}{'wrong':>7}"] + [
        f"{name:<24}{row.searches:>9}{row.correct:>9}{100 * row.correct_share:>7.1f}%{row.wrong:>7}"
        for name, row in named
    ]


def _hostile_as_json(one: Any) -> dict[str, Any]:
    least = one.least_log10_false
    return asdict(one) | {"least_log10_false": least if math.isfinite(least) else None}


def _as_json(row: Share) -> dict[str, Any]:
    return asdict(row) | {"correct_share": row.correct_share if row.searches else None}
