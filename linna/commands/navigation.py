"""`linna navigation survey`: detection and navigation over the terrain of a region."""

from __future__ import annotations

import argparse
from pathlib import Path

from linna.commands._region import parse_region
from linna.output import add_json_flag, emit, log, progress


def configure(parser: argparse.ArgumentParser) -> None:
    commands = parser.add_subparsers(title="commands", metavar="COMMAND")
    survey = commands.add_parser(
        "survey",
        help="fly windows over a region with several seeds: errors, consistency, biases, coasts, identification",
        description="Fly observation windows over a region of the terrain in the data folder, with rendered images, "
        "and judge them by the truth. With --out, an interrupted survey resumes with the next seed.",
    )
    survey.add_argument("--region", required=True, metavar="W,E,S,N", help="degrees, such as 285,300,-60,60")
    survey.add_argument("--seeds", type=int, default=3, metavar="N", help="sessions (default: 3)")
    survey.add_argument("--seed", type=int, metavar="S", help="first seed (default: the scenario's)")
    survey.add_argument(
        "--windows", type=int, default=6, metavar="N", help="windows of a session (default: 6)"
    )
    survey.add_argument("--direction", choices=("ascending", "descending", "any"), default="ascending")
    survey.add_argument(
        "--scenario",
        default="unseen-strip",
        metavar="FILE",
        help="errors, attitude, camera and network (default: the shipped unseen-strip)",
    )
    survey.add_argument("--out", type=Path, metavar="DIR", help="folder that keeps the session of each seed")
    add_json_flag(survey)
    survey.set_defaults(handler=run_survey)


def run_survey(arguments: argparse.Namespace) -> int:
    from linna.data import data_folder
    from linna.errors import UsageError
    from payload_emulator.session.scenario import load_scenario
    from studies.survey import format_survey, summary, survey_scenario, survey_session

    for name in ("seeds", "windows"):
        if getattr(arguments, name) < 1:
            raise UsageError(f"--{name}: expected 1 or more, found {getattr(arguments, name)}")
    region, base = parse_region(arguments.region), load_scenario(arguments.scenario)
    first = base.seed if arguments.seed is None else arguments.seed
    if arguments.out is not None:
        arguments.out.mkdir(parents=True, exist_ok=True)
    sessions = []
    for seed in range(first, first + arguments.seeds):
        log(f"seed {seed}")
        scenario = survey_scenario(base, region, arguments.windows, arguments.direction, seed)
        sessions.append(
            survey_session(
                scenario,
                data_folder(),
                arguments.out,
                lambda rows, total: progress(rows, total, "frames", "frame"),
            )
        )
    figures = summary(sessions)
    emit(arguments, {"seeds": list(range(first, first + arguments.seeds)), **figures}, format_survey(figures))
    return 0
