"""`linna paper`: every figure and table of the LINNA paper made with this system, in one document."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from linna.data import data_folder
from linna.errors import UsageError
from linna.output import as_json, emit, finish, log, progress
from linna.parser import number, option

if TYPE_CHECKING:
    from reports.paper_values import PaperReport


def configure(parser: argparse.ArgumentParser) -> None:
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
    finish(parser, run)


def run(arguments: argparse.Namespace) -> int:
    import importlib.util

    if arguments.model is not None and not arguments.model.is_file():
        raise UsageError(f"--model: expected a file, found none at {arguments.model}")
    if arguments.model is None and importlib.util.find_spec("torch") is not None:
        from linna.commands._detector_common import restart_for_training

        restart_for_training()
    from reports.paper_report import paper_index
    from reports.render import render_pages
    from studies.paper import make_paper

    duration = "6 minutes" if arguments.quick else "an hour"
    log(f"this takes about {duration} on two idle cores; the same command continues it")
    started = time.monotonic()
    report = make_paper(_step_folder(arguments, data_folder()), quick=arguments.quick)
    html, pdf = render_pages(report)
    out = arguments.out
    (out / "paper.html").write_text(html, encoding="utf-8")
    (out / "paper.pdf").write_bytes(pdf)
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
