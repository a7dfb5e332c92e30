"""`linna pass list | show`: passes and their metrics."""

from __future__ import annotations

import argparse
from typing import Any

from linna.commands._ground import add_operator_options, ground_client
from linna.output import add_json_flag, emit


def configure(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(metavar="ACTION", required=True)
    listing = actions.add_parser("list", help="list passes, newest first")
    listing.add_argument("--limit", type=int, default=50, help="largest number of passes (default: 50)")
    listing.set_defaults(handler=list_passes)
    showing = actions.add_parser("show", help="evaluate a pass and show its metrics")
    showing.add_argument("pass_id", type=int, metavar="ID")
    showing.set_defaults(handler=show_pass)
    for action in (listing, showing):
        add_operator_options(action)
        add_json_flag(action)


def list_passes(arguments: argparse.Namespace) -> int:
    with ground_client(arguments) as service:
        page = service.list_passes().page(arguments.limit)
    rows = [
        {
            "pass_id": item.id,
            "name": item.name,
            "start": _milliseconds(item.start),
            "stop": _milliseconds(item.stop),
        }
        for item in page.items
    ]
    lines = [f"{row['pass_id']:>6}  {row['start']}  {row['stop']}  {row['name']}" for row in rows]
    emit(arguments, {"passes": rows, "total": page.total}, text="\n".join(lines) or "no passes")
    return 0


def show_pass(arguments: argparse.Namespace) -> int:
    with ground_client(arguments) as service:
        figures = service.evaluate_pass(arguments.pass_id).model_dump(mode="json")
    emit(arguments, figures, text=describe(figures))
    return 0


def _milliseconds(time: object) -> str:
    """Return the text of a time with milliseconds."""
    return f"{str(time)[:23]}Z"


def describe(figures: dict[str, Any]) -> str:
    """Return the metrics of a pass as lines of text."""
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
    """Return the judged requirements as lines of text, failures first, with what is noted on those not met."""
    order = ("not met", "unknown", "met")
    judged = [one for one in requirements if one["status"] in order]
    return [
        f"  {one['status']:<8} {one['name']}: {_figure(one['value'], one['unit'])}, "
        f"limit {one['relation']} {_figure(one['limit'], one['unit'])}"
        + (f" ({one['note']})" if one["note"] and one["status"] != "met" else "")
        for one in sorted(judged, key=lambda one: order.index(one["status"]))
    ]


def _figure(value: float | None, unit: str) -> str:
    return "unknown" if value is None else f"{value:.4g} {unit}".rstrip()


def _metres(value: float | None) -> str:
    return "-" if value is None else f"{value:.0f} m"
