"""`linna report PASS`: the report of a pass as HTML, PDF and JSON."""

from __future__ import annotations

import argparse
from pathlib import Path

from linna.commands._ground import add_operator_options, operations
from linna.commands.pass_ import requirement_lines
from linna.output import add_json_flag, emit, log


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("pass_id", type=int, metavar="PASS", help="number of the pass (see linna pass list)")
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="folder for the documents (default: under the service's home)"
    )
    add_operator_options(parser)
    add_json_flag(parser)
    parser.set_defaults(handler=run)


def run(arguments: argparse.Namespace) -> int:
    log("evaluating the pass ...")
    with operations(arguments) as service:
        figures = service.make_report(arguments.pass_id, arguments.out)
    lines = [figures["report"], figures["verdict"], *requirement_lines(figures.get("requirements") or [])]
    emit(arguments, figures, text="\n".join(lines))
    return 0
