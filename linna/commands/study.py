"""`linna paper | montecarlo | navigation survey | camera fov-study`: studies of the whole system."""

from __future__ import annotations

import argparse
import time
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from linna.commands._choices import CATALOGUE_HELP, open_catalogue, parse_region
from linna.data import data_folder, load_orbit
from linna.errors import UsageError
from linna.output import as_json, emit, finish, log, progress
from linna.parser import ABOVE_ZERO, number, option

if TYPE_CHECKING:
    from reports.paper_values import PaperReport


def configure_paper(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Produce Figs. 3 to 10 and Tables I and II of the LINNA paper with this system, next to the paper's values, "
        "and the same with the estimators of this system: DIR/paper.html, paper.pdf, paper.json, paper.csv "
        "(all numbers) and figures/ (PNG, CSV). Finished steps are "
        "kept in DIR; the same command continues an interrupted run."
    )
    option(parser, "--out DIR", Path, "folder of the document and its steps", required=True)
    option(parser, "--quick", bool, "3 hours and few images instead of 24 hours")
    option(parser, "--hours H", number(least=0.5, most=240), "length of the session (default: 24; quick: 3)")
    option(
        parser,
        "--model M.onnx",
        Path,
        "class-only network made elsewhere (linna detector export --classes-only) instead of training one",
    )
    finish(parser, run_paper)


def run_paper(arguments: argparse.Namespace) -> int:
    import importlib.util

    if arguments.model is not None and not arguments.model.is_file():
        raise UsageError(f"--model: expected a file, found none at {arguments.model}")
    if arguments.model is None and importlib.util.find_spec("torch") is not None:
        from linna.commands._choices import restart_for_training

        restart_for_training()
    from reports.paper_report import paper_index
    from reports.pdf_pages import pdf_of
    from reports.render import render_pages
    from studies.paper import make_paper

    duration = "6 minutes" if arguments.quick else "an hour"
    log(f"this takes about {duration} on two idle cores; the same command continues it")
    started = time.monotonic()
    report = make_paper(_step_folder(arguments, data_folder()), quick=arguments.quick)
    html, form = render_pages(report)
    out = arguments.out
    (out / "paper.html").write_text(html, encoding="utf-8")
    (out / "paper.pdf").write_bytes(pdf_of(form, html))
    save_tables(out, report)
    figures: dict[str, Any] = {
        "report": str(out / "paper.html"),
        "pdf": str(out / "paper.pdf"),
        **paper_index(report),
        "quick": report.quick,
        "not_available": dict(report.not_available),
        "data": list(report.data_sources),
    }
    (out / "paper.json").write_text(as_json(figures) + "\n", encoding="utf-8")
    figures["wall_s"] = round(time.monotonic() - started, 1)
    return emit(arguments, figures, _text(figures))


def save_tables(out: Path, report: PaperReport) -> None:
    """Write all numbers as `paper.csv`, and each figure as PNG with its plotted values as CSV into `figures`."""
    import csv

    from reports.drawings import picture_files
    from reports.paper_report import paper_figures, paper_values

    rows = [one.row() for one in paper_values(report)]
    with (out / "paper.csv").open("w", encoding="utf-8", newline="") as file:
        table = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        table.writeheader()
        table.writerows(rows)
    folder = out / "figures"
    folder.mkdir(exist_ok=True)
    for picture in paper_figures(report):
        octets, text = picture_files(picture)
        (folder / f"{picture.key}.png").write_bytes(octets)
        if text.count("\n") > 1:
            (folder / f"{picture.key}.csv").write_text(text, encoding="utf-8")


def _step_folder(arguments: argparse.Namespace, data: Any) -> Any:
    from dataclasses import replace

    from studies.paper_steps import QUICK, Effort, StepFolder

    effort = QUICK if arguments.quick else Effort()
    if arguments.hours is not None:
        effort = replace(effort, hours=arguments.hours)
    arguments.out.mkdir(parents=True, exist_ok=True)
    return StepFolder(
        arguments.out, data, effort, arguments.model, log,
        lambda items, total: progress(items, total, "frames", "frame"),
    )  # fmt: skip


def _text(figures: dict[str, Any]) -> str:
    lines = [f"{len(figures['figures'])} figures, {len(figures['tables'])} tables; {figures['wall_s']:.0f} s"]
    lines += [f"{row['subject']}: {row['here']} (paper: {row['paper']})" for row in figures["differences"]]
    lines += [f"not available: {name}: {why}" for name, why in figures["not_available"].items()]
    return "\n".join([*lines, f"document: {figures['report']}, {figures['pdf']}"])


def configure_montecarlo(parser: argparse.ArgumentParser) -> None:
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
    finish(parser, run_montecarlo)


def run_montecarlo(arguments: argparse.Namespace) -> int:
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


def configure_navigation(parser: argparse.ArgumentParser) -> None:
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


FIGURES = (
    "selected_fov_deg", "selected_every_altitude_deg", "needed", "threshold", "positions", "positions_covered",
    "craters",
)  # fmt: skip
"""Values of a study of the field of view that are printed as they are."""


def configure_camera(parser: argparse.ArgumentParser) -> None:
    commands = parser.add_subparsers(title="commands", metavar="COMMAND")
    study = commands.add_parser("fov-study", help="probability of craters in the footprint over the field of view")
    option(study, "--ephemeris F", Path, "ephemeris file (OEM, STK .e, Horizons CSV)", required=True)
    option(study, "--catalogue F", str, CATALOGUE_HELP)
    option(study, "--seed", int, "seed of a synthetic catalogue", 1)
    option(study, "--step S", ABOVE_ZERO, "seconds between positions (default: every state of the file)")
    option(study, "--needed N", number(int, least=1, most=50), "craters needed", 3)
    option(study, "--threshold P", number(least=0, below=1), "probability to exceed", 0.9)
    finish(study, run_fov_study)


def run_fov_study(arguments: argparse.Namespace) -> int:
    import numpy as np

    from lunar.datafolder import default_orientation
    from lunar.fov_study import PAPER_COUNTS, study_field_of_view
    from lunar.frames import mcmf_from_spherical
    from lunar.visibility import even_epochs, ground_track

    ephemeris = load_orbit(arguments.ephemeris)
    catalogue = open_catalogue(arguments.catalogue, arguments.seed)
    orientation = default_orientation(data_folder())
    epochs = None if arguments.step is None else even_epochs(ephemeris, arguments.step)
    track = ground_track(ephemeris, orientation, epochs)
    log(f"{len(track.utc_ns)} positions, {len(catalogue)} craters of {catalogue.source}")
    study = study_field_of_view(
        mcmf_from_spherical(track.latitude_rad, track.longitude_rad, track.altitude_m),
        catalogue,
        np.arange(10.0, 160.0 + 1e-9, 10.0).tolist(),
        tuple(sorted({*PAPER_COUNTS, arguments.needed})),
        arguments.needed,
        arguments.threshold,
    )
    figures = {
        "fov_deg": study.fov_deg,
        "probability_at_least": {str(n): values for n, values in study.probability_at_least.items()},
        **{name: getattr(study, name) for name in FIGURES},
        "altitude_km": {
            "min": float(track.altitude_m.min()) / 1e3,
            "mean": float(track.altitude_m.mean()) / 1e3,
            "max": float(track.altitude_m.max()) / 1e3,
        },
        "source": study.source,
        "orientation": orientation.name,
        "data": [f"crater catalogue {study.source}", f"lunar orientation {orientation.name}"],
    }
    covered = f"{study.positions_covered} of {study.positions} positions lie where the catalogue is complete"
    counts = list(study.probability_at_least)
    lines = ["  FoV  " + "  ".join(f"P(>={n:2d})" for n in counts)]
    for k, fov_deg in enumerate(study.fov_deg):
        row = "  ".join(f"{study.probability_at_least[n][k]:7.4f}" for n in counts)
        lines.append(f"{fov_deg:5g}  {row}")
    chosen = "none" if np.isnan(study.selected_fov_deg) else f"{study.selected_fov_deg:g} deg"
    lines.append(f"smallest with P(>={study.needed}) > {study.threshold:g}: {chosen}; {covered}; {study.source}")
    return emit(arguments, figures, text="\n".join(lines))
