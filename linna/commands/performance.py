"""`linna performance`: recall, drift and error over many passes, and monthly reports."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from linna.commands._table import Command, Option, add_commands, as_json

if TYPE_CHECKING:
    from ground_service.client import Client
    from ground_service.evaluation.performance.model import Performance

METRICS = {"recall": ("%", 100.0, 1), "drift_percent": ("% of path", 1.0, 3), "median_error_m": ("m", 1.0, 0)}
"""Unit, scale and decimals of the metrics."""


def performance_lines(found: Performance) -> str:
    """Return the performance as lines of text."""
    missing = found.passes_in_span - len(found.passes)
    lines = [f"{len(found.passes)} passes with a report" + (f", {missing} without" if missing else "")]
    for one in found.groups:
        unit, scale, decimals = METRICS[one.metric]
        if one.mean is None:
            continue
        between = "interval unknown"
        if one.low is not None and one.high is not None:
            between = f"{scale * one.low:.{decimals}f} to {scale * one.high:.{decimals}f}"
        value = f"{scale * one.mean:.{decimals}f} {unit} ({between}, {one.passes} passes)"
        lines.append(f"  {one.factor}, {one.group}: {one.metric} {value}")
    for change in found.changes:
        unit, scale, decimals = METRICS[change.metric]
        lines.append(
            f"  change of {change.metric} at pass {change.pass_id} ({change.time}): "
            f"{scale * change.before:.{decimals}f} -> {scale * change.after:.{decimals}f} {unit}, "
            f"p = {change.p_value:.3g}"
        )
    if found.passes and not found.changes:
        lines.append("  no change of level")
    for rule in found.requirements:
        judged = rule.met + rule.not_met
        status = f"met on {rule.met} of {judged} judged passes" if judged else "not judged"
        remark = f"; {rule.remark}" if rule.remark else ""
        lines.append(f"  {rule.name}, last {found.window_days:g} days: {status}, unknown on {rule.unknown}{remark}")
    return "\n".join(lines)


def _report(service: Client, *, spacecraft_id: int, instance: str = "flight", month: str, out: Path) -> dict[str, Any]:
    made = service.add_monthly_report(spacecraft_id, month, instance=instance)
    for kind in ("html", "pdf", "json"):
        service.get_monthly_report(made.id, out / f"report.{kind}", format=kind)
    return {"report": str(out / "report.html"), **as_json(made)}


COMMANDS = {
    "show": Command(
        "get_performance",
        "show recall, drift and error by condition, changes of level, and requirements",
        performance_lines,
        options={
            "instance": "instance (default: the flown one if it has passes, otherwise all imported passes)",
            "start": "only passes from this time",
            "stop": "only passes before this time",
            "window_days": Option("rolling window of the requirements", "D"),
        },
    ),
    "report": Command(
        _report,
        "write the report of a month as HTML, PDF and JSON",
        lambda made: f"{made['report']}\n{made['verdict']}",
        options={
            "month": Option("month (UTC)", "YYYY-MM"),
            "out": Option("folder for the documents of the report", "DIR"),
        },
    ),
    "list": Command(
        "list_monthly_reports",
        "list the monthly reports",
        lambda one: (
            f"{one.month}  spacecraft {one.spacecraft_id} ({one.instance})  {one.passes:4} passes  "
            f"{one.verdict}  {one.id}"
        ),
        "reports",
        "there is no monthly report",
        options={"spacecraft_id": "only of this spacecraft"},
        limit=None,
    ),
}


def configure(parser: argparse.ArgumentParser) -> None:
    add_commands(parser, COMMANDS)
