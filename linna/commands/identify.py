"""`linna identify`: how often craters are found and taken for others, on simulated detections or rendered frames."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from linna.output import add_json_flag, emit, log
from linna.parser import option

if TYPE_CHECKING:
    from payload_emulator.sim.detector import SimulatedDetector
    from studies.identification import StudyWorld

LEVEL = "level 1-2: simulated detections of the craters of a catalogue (stated recall, precision and errors), no images"


def configure(parser: argparse.ArgumentParser) -> None:
    commands = parser.add_subparsers(title="commands", metavar="COMMAND")
    lost = commands.add_parser(
        "lost", help="lost in space: places found from one frame or four, without a prior"
    )
    option(
        lost,
        "catalogue FILE",
        str,
        "anchoring table of `linna catalogue curate`, or a catalogue (default: the available one)",
        nargs="?",
    )
    option(lost, "--frames", int, "", 300)
    option(lost, "--seed", int, "", 1)
    option(lost, "--recall", float, "", 0.5)
    option(lost, "--precision", float, "", 0.8)
    option(lost, "--sigma-px", float, "per axis", 1.4)
    option(lost, "--log-diameter-sigma", float, "", 0.05)
    add_json_flag(lost)
    option(lost, "--attitude-deg", float, "error of nadir and heading, 1 sigma per axis", 0.5)
    option(lost, "--sets", int, "sets of four frames (default: a third of the frames)")
    rendered = lost.add_argument_group("rendered", "frames along a scenario and the detector that flies")
    option(
        rendered,
        "--scenario FILE",
        str,
        "render frames of a scenario in sets of four; its terrain's craters are the map, FILE is not used",
    )
    option(rendered, "--min-diameter-km", float, "smallest craters of the map", 3.0)
    option(rendered, "--detections F.npz", Path, "keep the detections here, or take those kept here")
    option(
        rendered,
        "--hostile",
        bool,
        "search each frame also with its detections mirrored, turned and scattered: each fix is wrong",
    )
    lost.set_defaults(handler=run_lost)


def run_lost(arguments: argparse.Namespace) -> int:
    import math

    from linna.errors import UsageError
    from payload_emulator.flight.navigation.lost_in_space import place_index
    from studies.identification import KINDS, study_lost, study_lost_in_frames

    if arguments.scenario is not None:
        from linna.commands._identify_rendered import run as run_rendered

        return run_rendered(arguments)
    if arguments.hostile:
        raise UsageError("--hostile: expected --scenario, found none")
    model = _model(arguments)
    world = _world(arguments)
    attitude_rad = math.radians(arguments.attitude_deg)
    hostile = max(arguments.frames // 3, 1)
    scores = []
    for kind in KINDS:
        frames = arguments.frames if kind == "true" else hostile
        log(f"{frames} frames, {kind}")
        scores.append(
            study_lost(world, frames, arguments.seed, kind=kind, model=model, attitude_rad=attitude_rad)
        )
    sets = hostile if arguments.sets is None else arguments.sets
    log(f"{sets} sets of four frames")
    scores.append(study_lost_in_frames(world, sets, arguments.seed, model=model, attitude_rad=attitude_rad))
    figures: dict[str, Any] = {
        "single_correct_share": scores[0].correct_share,
        "four_frames_correct_share": scores[-1].correct_share,
        "wrong": sum(score.wrong for score in scores),
        "searches": sum(score.frames for score in scores),
        "median_cpu_s": scores[0].median_cpu_s,
        "scores": [asdict(score) | {"correct_share": score.correct_share} for score in scores],
        "craters": len(world.board),
        "index_octets": place_index(world.board).octets,
        "altitude_km": [14.0, 50.0],
        "attitude_sigma_deg": arguments.attitude_deg,
        "least_true_detections": 6,
        **_provenance(arguments, world.name, model),
    }
    lines = [
        f"{'frames':<12}{'searches':>9}{'correct':>9}{'wrong':>7}{'no fix':>8}{'error m':>9}{'p95':>7}{'CPU s':>7}"
    ]
    for score in scores:
        none = score.frames - score.correct - score.wrong
        lines.append(
            f"{score.kind:<12}{score.frames:>9}{score.correct:>9}{score.wrong:>7}{none:>8}"
            f"{score.median_error_m:>9.0f}{score.p95_error_m:>7.0f}{score.median_cpu_s:>7.2f}"
        )
    return emit(
        arguments, figures, text="\n".join([*lines, f"{world.name}, {len(world.board)} craters; {LEVEL}"])
    )


def _provenance(arguments: argparse.Namespace, name: str, model: SimulatedDetector) -> dict[str, object]:
    return {
        "detections": {
            "recall": arguments.recall,
            **{name: getattr(model, name) for name in ("precision", "sigma_px", "log_diameter_sigma")},
        },
        "seed": arguments.seed,
        "level": LEVEL,
        "data": [f"crater catalogue {name}"],
    }


def _model(arguments: argparse.Namespace) -> SimulatedDetector:
    from linna.errors import UsageError
    from payload_emulator.sim.detector import SimulatedDetector

    if arguments.frames < 1:
        raise UsageError(f"--frames: expected at least 1, found {arguments.frames}")
    for name in ("recall", "precision"):
        if not 0.0 < getattr(arguments, name) <= 1.0:
            raise UsageError(
                f"--{name}: expected a share above 0 and up to 1, found {getattr(arguments, name):g}"
            )
    if not (arguments.sigma_px > 0.0 and arguments.log_diameter_sigma >= 0.0):
        raise UsageError(
            f"--sigma-px, --log-diameter-sigma: expected positive sizes, found {arguments.sigma_px:g} and "
            f"{arguments.log_diameter_sigma:g}"
        )
    return SimulatedDetector(
        recall=(arguments.recall,) * 4,
        recall_outside=arguments.recall,
        precision=arguments.precision,
        sigma_px=arguments.sigma_px,
        log_diameter_sigma=arguments.log_diameter_sigma,
    )


def _world(arguments: argparse.Namespace) -> StudyWorld:
    from linna.commands._catalogue_choice import open_catalogue
    from payload_emulator.sim.terrain.curation import catalogue_of_table
    from studies.identification import study_world

    name = arguments.catalogue
    table = None
    if name is not None and Path(name).is_file():
        table = catalogue_of_table(Path(name))
    craters = open_catalogue(name, arguments.seed) if table is None else table
    sized = (craters.diameter_m >= 5e3 if table is None else craters.diameter_m >= 3e3) & (
        craters.diameter_m <= 30e3
    )
    with_depth = ~(craters.depth_m < 0.03 * craters.diameter_m)
    chosen = craters.select(sized & with_depth)
    return study_world(chosen, arguments.seed, craters.source)
