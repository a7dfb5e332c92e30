"""`linna navigation table|drift`: pass archives side by side, and the study of bounded drift."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path

from linna.output import add_json_flag, emit


def configure(parser: argparse.ArgumentParser) -> None:
    commands = parser.add_subparsers(title="commands", metavar="COMMAND")
    table = commands.add_parser("table", help="a row per pass archive of linna emulate, from its summary")
    table.add_argument("archives", nargs="+", type=Path, metavar="DIR", help="pass archive")
    table.add_argument("--markdown", action="store_true", help="print the table as Markdown")
    add_json_flag(table)
    table.set_defaults(handler=run_table)
    drift = commands.add_parser(
        "drift",
        help="study when vision beats propagation and how long a coast stays bounded (simulated detections)",
    )
    drift.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="folder for drift.json, drift.png, drift.md"
    )
    drift.add_argument(
        "--runs", type=int, default=8, metavar="N", help="passes of each condition (default: 8)"
    )
    drift.add_argument("--seed", type=int, default=2001, help="seed of the first pass (default: 2001)")
    drift.add_argument(
        "--coast-hours", type=float, default=3.0, metavar="H", help="length of the coast (default: 3)"
    )
    drift.add_argument(
        "--factor",
        action="append",
        choices=("altitude", "illumination", "terrain", "catalogue", "build"),
        help="only this factor next to the nominal pass (may be repeated; default: all)",
    )
    add_json_flag(drift)
    drift.set_defaults(handler=run_drift)


def run_table(arguments: argparse.Namespace) -> int:
    from studies.navigation_table import format_markdown, format_text, load_row

    rows = [load_row(archive) for archive in arguments.archives]
    figures = {
        "rows": [asdict(row) for row in rows],
        "truth_reads_after_start": sum(row.truth_reads_after_start for row in rows),
    }
    emit(arguments, figures, text=(format_markdown if arguments.markdown else format_text)(rows))
    return 0


def run_drift(arguments: argparse.Namespace) -> int:
    import json

    from linna.data import data_folder
    from linna.errors import UsageError
    from linna.output import as_json, progress
    from reports.studies import save_drift_study
    from studies.drift import conditions, format_markdown, study

    if arguments.runs < 2 or not 0.1 <= arguments.coast_hours <= 48.0:
        raise UsageError(
            "expected --runs of 2 or more and --coast-hours of 0.1 to 48, found "
            f"{arguments.runs} and {arguments.coast_hours:g}"
        )
    cases = conditions(data_folder(), arguments.coast_hours)
    wanted = {"nominal", *(arguments.factor or [one.factor for one in cases])}
    cases = [one for one in cases if one.factor in wanted]
    seeds = range(arguments.seed, arguments.seed + arguments.runs)
    rows, flown = study(cases, seeds, lambda jobs: progress(jobs, len(jobs), "passes", "pass"))
    out: Path = arguments.out
    out.mkdir(parents=True, exist_ok=True)
    table = format_markdown(rows)
    gravity = {"truth": cases[0].case.gravity.name, "filter": cases[0].case.filter_gravity.name}
    curves = {
        name: (passes[0].elapsed_s, [one.vision_m for one in passes], [one.propagation_m for one in passes])
        for name, passes in flown.items()
    }
    save_drift_study(
        out / "drift.png",
        curves,
        f"{arguments.runs} passes of each condition, simulated detections (evidence level 1); "
        f"truth {gravity['truth']}, filter {gravity['filter']}.",
    )
    figures = {
        "rows": [asdict(row) for row in rows],
        "passes": arguments.runs,
        "seeds": [seeds[0], seeds[-1]],
        "coast_hours": arguments.coast_hours,
        "gravity": gravity,
        "detections": "simulated",
        "level": "1 (unit geometry)",
        "figure": str(out / "drift.png"),
    }
    (out / "drift.json").write_text(
        json.dumps(json.loads(as_json(figures)), indent=2) + "\n", encoding="utf-8"
    )
    (out / "drift.md").write_text(table + "\n", encoding="utf-8")
    emit(arguments, figures, text=table)
    return 0
