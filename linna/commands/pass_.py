"""`linna pass list | show`: passes and their metrics."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from linna.commands._table import Command, add_commands, as_json

if TYPE_CHECKING:
    from ground_service.evaluation.model import PassFigures
    from ground_service.passes.model import PassSummary


def _listed(item: PassSummary) -> dict[str, Any]:
    times = {"start": f"{item.start[:23]}Z", "stop": f"{item.stop[:23]}Z"}
    return {"pass_id": item.id, "name": item.name, **times}


def _line(item: PassSummary) -> str:
    return f"{item.id:>6}  {item.start[:23]}Z  {item.stop[:23]}Z  {item.name}"


def describe(found: PassFigures) -> str:
    """Return the metrics of a pass as lines of text."""
    figures = as_json(found)
    lines = [
        f"pass {figures['pass_id']}: {figures['frames']} frames, {figures['packets']} packets, "
        f"{figures['packets_lost']} lost",
        figures["verdict"],
    ]
    for kind in ("navigation", "baselines"):
        for name, row in figures[kind].items():
            drift = row["drift_percent"]
            lines.append(
                f"  {name:<16} median {_metres(row['median_3d_m'])}, 95 % {_metres(row['p95_3d_m'])}, "
                f"largest {_metres(row['max_3d_m'])}, drift {'-' if drift is None else f'{drift:.3f} %'}"
            )
    lines += requirement_lines(figures.get("requirements") or [])
    detector = figures["detector"]
    if detector["recall"] is not None:
        lines.append(
            f"  detector         precision {detector['precision']:.2f}, recall {detector['recall']:.2f}, "
            f"localisation {detector['loc_px']:.2f} px"
        )
    return "\n".join(lines)


def requirement_lines(requirements: list[dict[str, Any]]) -> list[str]:
    """Return the judged requirements as lines of text, failures first, those of the experiment marked."""
    order = ("not met", "unknown", "met")
    judged = [one for one in requirements if one["status"] in order]
    marks = {"experiment": "experiment, "}
    return [
        f"  {one['status']:<8} {marks.get(one['question'], '')}{one['name']}: {_figure(one['value'], one['unit'])}, "
        f"limit {one['relation']} {_figure(one['limit'], one['unit'])}"
        + (f" ({one['note']})" if one["note"] and one["status"] != "met" else "")
        for one in sorted(judged, key=lambda one: order.index(one["status"]))
    ]


def _figure(value: float | None, unit: str) -> str:
    return "unknown" if value is None else f"{value:.4g} {unit}".rstrip()


def _metres(value: float | None) -> str:
    return "-" if value is None else f"{value:.0f} m"


COMMANDS = {
    "list": Command(
        "list_passes",
        "list passes, newest first",
        _line,
        "passes",
        "no passes: telemetry alone makes none; a pass is a flown window, an imported archive, or a defined interval",
        _listed,
        options={"search": "part of the name", "verdict": "verdict of the newest report; none: without a report"},
    ),
    "show": Command("evaluate_pass", "evaluate a pass and show its metrics", describe),
}


def configure(parser: argparse.ArgumentParser) -> None:
    add_commands(parser, COMMANDS)
