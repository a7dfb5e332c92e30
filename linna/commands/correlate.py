"""`linna correlate list | residuals | run | receptions`: time correlation of a spacecraft."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from linna.commands._ground import add_operator_options, ground_client
from linna.output import add_json_flag, emit

if TYPE_CHECKING:
    from ground_service.timekeeping.model import Correlation

BLOCK = 10_000
"""Number of receptions in one request."""


def configure(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(metavar="ACTION", required=True)
    listing = actions.add_parser("list", help="list the segments in force, one for each run of the clock")
    listing.add_argument("--all", action="store_true", help="also segments that are no longer in force")
    listing.set_defaults(handler=list_segments)
    reports = actions.add_parser("residuals", help="list the received time reports and their residuals")
    reports.set_defaults(handler=residuals)
    running = actions.add_parser(
        "run",
        help="fit the segments again from the received time reports; this replaces segments entered by hand",
    )
    running.set_defaults(handler=run)
    receiving = actions.add_parser("receptions", help="enter reception times of time reports (CSV)")
    receiving.add_argument(
        "file", type=Path, help="columns packet_ticks, sequence_count, received_utc; optional: station"
    )
    receiving.set_defaults(handler=receptions)
    for action in (listing, reports, running, receiving):
        action.add_argument("--spacecraft-id", type=int, required=True, metavar="N")
        action.add_argument("--instance", default="flight")
        add_operator_options(action)
        add_json_flag(action)


def list_segments(arguments: argparse.Namespace) -> int:
    with ground_client(arguments) as service:
        rows = list(service.list_correlations(arguments.spacecraft_id, instance=arguments.instance))
    if not arguments.all:
        rows = sorted((row for row in rows if row.in_force), key=lambda row: row.start_ticks)
    return _show(arguments, rows)


def run(arguments: argparse.Namespace) -> int:
    with ground_client(arguments) as service:
        rows = service.run_correlation(arguments.spacecraft_id, instance=arguments.instance)
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
    rows: list[Correlation] = []
    with ground_client(arguments) as service:
        for start in range(0, len(given), BLOCK):
            block = given[start : start + BLOCK]
            rows = service.add_receptions(arguments.spacecraft_id, block, instance=arguments.instance)
    return _show(arguments, rows)


def residuals(arguments: argparse.Namespace) -> int:
    with ground_client(arguments) as service:
        rows = list(service.list_time_reports(arguments.spacecraft_id, instance=arguments.instance))
    lines = [
        f"{row.received}  boot {row.boot_count}  light time {row.light_time_s:.6f} s  "
        f"correlation {row.correlation_id}  residual {row.residual_ns * 1e-3:+.1f} us"
        for row in rows
    ]
    emit(
        arguments,
        {"time_reports": [row.model_dump(mode="json") for row in rows]},
        text="\n".join(lines) or "no time reports with a known reception time",
    )
    return 0


def _show(arguments: argparse.Namespace, rows: list[Correlation]) -> int:
    lines = [
        f"{row.id:>5}  boot {row.boot_count}  from {row.reference}  drift {row.drift_ppb:+.1f} ppb  "
        f"{row.points} reports ({row.rejected} rejected)  rms {(row.residual_rms_ns or 0.0) * 1e-3:.1f} us"
        f"{'' if row.in_force else '  not in force'}"
        for row in rows
    ]
    emit(
        arguments,
        {"correlations": [row.model_dump(mode="json") for row in rows]},
        text="\n".join(lines) or "no time correlation: the on-board clock is assumed to be ideal",
    )
    return 0
