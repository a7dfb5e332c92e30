"""`linna navigation table`: the navigation of several pass archives side by side."""

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


def run_table(arguments: argparse.Namespace) -> int:
    from studies.navigation_table import format_markdown, format_text, load_row

    rows = [load_row(archive) for archive in arguments.archives]
    figures = {
        "rows": [asdict(row) for row in rows],
        "truth_reads_after_start": sum(row.truth_reads_after_start for row in rows),
    }
    emit(arguments, figures, text=(format_markdown if arguments.markdown else format_text)(rows))
    return 0
