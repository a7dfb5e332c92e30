"""`linna report PASS`: report of a pass as HTML, PDF and JSON."""

import argparse
from pathlib import Path
from typing import Any

from linna.commands._ground import add_operator_options, ground_client, server_of, settings_of
from linna.commands.pass_ import requirement_lines
from linna.output import emit, finish, log
from linna.parser import option


def configure(parser: argparse.ArgumentParser) -> None:
    option(parser, "pass_id PASS", int, "number of the pass (see linna pass list)")
    option(
        parser,
        "--out DIR",
        Path,
        "folder for the documents (default: reports/pass-N in the home folder; with a server: pass-N)",
    )
    add_operator_options(parser)
    finish(parser, run)


def run(arguments: argparse.Namespace) -> int:
    folder = arguments.out or _default_folder(arguments)
    log("evaluating the pass ...")
    with ground_client(arguments) as service:
        report_id = service.make_report(arguments.pass_id)
        for kind in ("html", "json", "pdf"):
            service.get_report(report_id, folder / f"report.{kind}", format=kind)
        summary = service.get_report_summary(report_id).model_dump(mode="json")
    figures: dict[str, Any] = {
        "report": str(folder / "report.html"),
        "report_json": str(folder / "report.json"),
        "report_pdf": str(folder / "report.pdf"),
        "report_id": report_id,
        **summary,
    }
    lines = [figures["report"], figures["verdict"], *requirement_lines(figures.get("requirements") or [])]
    return emit(arguments, figures, text="\n".join(lines))


def _default_folder(arguments: argparse.Namespace) -> Path:
    name = f"pass-{arguments.pass_id}"
    if server_of(arguments) is not None:
        return Path(name)
    home: Path = settings_of(arguments).home.expanduser().absolute()
    return home / "reports" / name
