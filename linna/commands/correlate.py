"""`linna correlate`: how a spacecraft's clock runs: segments, what the time reports leave of them, fitting again."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from linna.commands._ground import add_operator_options, operations
from linna.output import add_json_flag, emit

BLOCK = 10_000
"""Receptions told to a server at a time."""


def configure(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(metavar="ACTION", required=True)
    listing = actions.add_parser("list", help="the segments in force, one for each run of the clock")
    listing.add_argument("--all", action="store_true", help="also those that were in force before")
    listing.set_defaults(handler=list_segments)
    reports = actions.add_parser("residuals", help="every received time report and what the fit leaves of it")
    reports.set_defaults(handler=residuals)
    running = actions.add_parser(
        "run", help="fit again from the received time reports, over what was entered by hand"
    )
    running.set_defaults(handler=run)
    receiving = actions.add_parser("receptions", help="tell when time reports were received (CSV)")
    receiving.add_argument(
        "file", type=Path, help="columns packet_ticks, sequence_count, received_utc, and maybe station"
    )
    receiving.set_defaults(handler=receptions)
    for action in (listing, reports, running, receiving):
        action.add_argument("--spacecraft-id", type=int, required=True, metavar="N")
        action.add_argument("--instance", default="flight")
        add_operator_options(action)
        add_json_flag(action)


def list_segments(arguments: argparse.Namespace) -> int:
    with operations(arguments) as service:
        rows = service.correlations(arguments.spacecraft_id, arguments.instance)["items"]
    if not arguments.all:
        rows = sorted((row for row in rows if row["in_force"]), key=lambda row: int(row["start_ticks"]))
    return _show(arguments, rows)


def run(arguments: argparse.Namespace) -> int:
    with operations(arguments) as service:
        rows = service.correlate_again(arguments.spacecraft_id, arguments.instance)["items"]
    return _show(arguments, rows)


def receptions(arguments: argparse.Namespace) -> int:
    from ground_service.timekeeping.recorrelation import read_receptions
    from lunar.timescales import format_utc

    given = [
        {
            "packet_ticks": one.ticks,
            "sequence_count": one.sequence_count,
            "received": format_utc(one.earth_utc_ns),
            "station": one.station,
        }
        for one in read_receptions(arguments.file)
    ]
    rows: list[dict[str, Any]] = []
    with operations(arguments) as service:
        for start in range(0, len(given), BLOCK):
            block = given[start : start + BLOCK]
            rows = service.enter_receptions(arguments.spacecraft_id, arguments.instance, block)["items"]
    return _show(arguments, rows)


def residuals(arguments: argparse.Namespace) -> int:
    with operations(arguments) as service:
        rows = service.time_reports(arguments.spacecraft_id, arguments.instance)["items"]
    lines = [
        f"{row['received']}  boot {row['boot_count']}  light time {row['light_time_s']:.6f} s  "
        f"correlation {row['correlation_id']}  left {row['residual_ns'] * 1e-3:+.1f} us"
        for row in rows
    ]
    emit(
        arguments, {"time_reports": rows}, text="\n".join(lines) or "no time reports whose reception is known"
    )
    return 0


def _show(arguments: argparse.Namespace, rows: list[dict[str, Any]]) -> int:
    lines = [
        f"{row['id']:>5}  boot {row['boot_count']}  from {row['reference']}  drift {row['drift_ppb']:+.1f} ppb  "
        f"{row['points']} reports ({row['rejected']} left out)  rms {(row['residual_rms_ns'] or 0.0) * 1e-3:.1f} us"
        f"{'' if row['in_force'] else '  not in force'}"
        for row in rows
    ]
    emit(
        arguments,
        {"correlations": rows},
        text="\n".join(lines) or "no time correlation: the clock is taken as ideal",
    )
    return 0
