"""`linna report PASS`: the report of a pass as HTML and JSON."""

from __future__ import annotations

import argparse
from pathlib import Path

from linna.commands._ground import add_service_options, open_service
from linna.output import add_json_flag, emit, log


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("pass_id", type=int, metavar="PASS", help="number of the pass (see linna pass list)")
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="folder for the documents (default: under the service's home)"
    )
    add_service_options(parser)
    add_json_flag(parser)
    parser.set_defaults(handler=run)


def run(arguments: argparse.Namespace) -> int:
    from ground_service.services.reports import make_report

    log("evaluating the pass ...")
    with open_service(arguments) as ground:
        made = make_report(ground, arguments.pass_id, out=arguments.out)
    figures = {
        "report": str(made.html),
        "report_json": str(made.json),
        "report_id": made.report_id,
        **made.summary,
    }
    emit(arguments, figures, text=f"{made.html}\n{made.summary['verdict']}")
    return 0
