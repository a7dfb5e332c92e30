"""`linna performance`: recall, drift and error over many passes, and monthly reports."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from linna.commands._ground import add_operator_options, ground_client
from linna.output import add_json_flag, emit

if TYPE_CHECKING:
    from ground_service.performance.model import Performance

METRICS = {"recall": ("%", 100.0, 1), "drift_percent": ("% of path", 1.0, 3), "median_error_m": ("m", 1.0, 0)}
"""Unit, scale and decimals of the metrics."""


def configure(parser: argparse.ArgumentParser) -> None:
    commands = parser.add_subparsers(dest="what", metavar="COMMAND", required=True)
    show = commands.add_parser(
        "show", help="show recall, drift and error by condition, changes of level, and requirements"
    )
    _spacecraft(show)
    show.add_argument(
        "--instance",
        metavar="NAME",
        help="instance (default: the flown one if it has passes, otherwise all imported passes)",
    )
    show.add_argument("--start", metavar="UTC", help="only passes from this time")
    show.add_argument("--stop", metavar="UTC", help="only passes before this time")
    show.add_argument(
        "--window-days",
        type=float,
        default=7.0,
        metavar="D",
        help="rolling window of the requirements (default: 7)",
    )
    _finish(show, _show)
    report = commands.add_parser("report", help="write the report of a month as HTML, PDF and JSON")
    _spacecraft(report)
    report.add_argument(
        "--instance", default="flight", metavar="NAME", help="instance of the spacecraft (default: flight)"
    )
    report.add_argument("--month", required=True, metavar="YYYY-MM", help="month (UTC)")
    report.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="folder for the documents of the report"
    )
    _finish(report, _report)
    reports = commands.add_parser("list", help="list the monthly reports")
    reports.add_argument("--spacecraft-id", type=int, metavar="N", help="only of this spacecraft")
    _finish(reports, _list)


def _spacecraft(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--spacecraft-id", type=int, required=True, metavar="N", help="CCSDS spacecraft identifier"
    )


def _finish(parser: argparse.ArgumentParser, handler: object) -> None:
    add_operator_options(parser)
    add_json_flag(parser)
    parser.set_defaults(handler=handler)


def _show(arguments: argparse.Namespace) -> int:
    with ground_client(arguments) as service:
        found = service.get_performance(
            arguments.spacecraft_id,
            instance=arguments.instance,
            start=arguments.start,
            stop=arguments.stop,
            window_days=arguments.window_days,
        )
    emit(arguments, found.model_dump(mode="json"), text="\n".join(performance_lines(found)))
    return 0


def performance_lines(found: Performance) -> list[str]:
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
        told = f"met on {rule.met} of {judged} judged passes" if judged else "not judged"
        lines.append(f"  {rule.name}, last {found.window_days:g} days: {told}, unknown on {rule.unknown}")
    return lines


def _report(arguments: argparse.Namespace) -> int:
    with ground_client(arguments) as service:
        made = service.add_monthly_report(
            arguments.spacecraft_id, arguments.month, instance=arguments.instance
        )
        for kind in ("html", "pdf", "json"):
            service.get_monthly_report(made.id, arguments.out / f"report.{kind}", format=kind)
    page = str(arguments.out / "report.html")
    emit(arguments, {"report": page, **made.model_dump(mode="json")}, text=f"{page}\n{made.verdict}")
    return 0


def _list(arguments: argparse.Namespace) -> int:
    with ground_client(arguments) as service:
        found = list(service.list_monthly_reports(spacecraft_id=arguments.spacecraft_id))
    lines = [
        f"{one.month}  spacecraft {one.spacecraft_id} ({one.instance})  {one.passes:4} passes  {one.verdict}  {one.id}"
        for one in found
    ]
    rows = [one.model_dump(mode="json") for one in found]
    emit(arguments, {"reports": rows}, text="\n".join(lines) or "there is no monthly report")
    return 0
