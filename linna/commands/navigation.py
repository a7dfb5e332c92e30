"""`linna navigation survey`: detection and navigation over the terrain of a region."""

import argparse
from pathlib import Path

from linna.commands._choices import parse_region
from linna.data import data_folder
from linna.output import emit, finish, log, progress
from linna.parser import number, option


def configure(parser: argparse.ArgumentParser) -> None:
    commands = parser.add_subparsers(title="commands", metavar="COMMAND")
    survey = commands.add_parser(
        "survey",
        help="fly windows over a region with several seeds: errors, consistency, biases, coasts, identification",
        description="Fly observation windows over a region of the terrain in the data folder, with rendered images, "
        "and judge them by the truth. With --out, an interrupted survey resumes with the next seed.",
    )
    option(survey, "--region W,E,S,N", str, "degrees, such as 285,300,-60,60", required=True)
    option(survey, "--seeds N", number(int, least=1), "sessions", 3)
    option(survey, "--seed S", int, "first seed (default: the scenario's)")
    option(survey, "--windows N", number(int, least=1), "windows of a session", 6)
    option(
        survey,
        "--scenario FILE",
        str,
        "errors, attitude, camera and network (default: the shipped unseen-strip)",
        "unseen-strip",
    )
    option(survey, "--out DIR", Path, "folder that keeps the session of each seed")
    finish(survey, run_survey)


def run_survey(arguments: argparse.Namespace) -> int:
    from payload_emulator.session.scenario import load_scenario
    from studies.survey import format_survey, summary, survey_scenario, survey_session

    region, base = parse_region(arguments.region), load_scenario(arguments.scenario)
    first = base.seed if arguments.seed is None else arguments.seed
    if arguments.out is not None:
        arguments.out.mkdir(parents=True, exist_ok=True)
    sessions = []
    for seed in range(first, first + arguments.seeds):
        log(f"seed {seed}")
        scenario = survey_scenario(base, region, arguments.windows, seed)
        sessions.append(
            survey_session(
                scenario, data_folder(), arguments.out, lambda rows, total: progress(rows, total, "frames", "frame")
            )
        )
    figures = summary(sessions)
    return emit(arguments, {"seeds": list(range(first, first + arguments.seeds)), **figures}, format_survey(figures))
