"""Hook of the documentation site: pages generated from the program, so that they cannot differ from it."""

from __future__ import annotations

import argparse
import importlib
import json
from pathlib import Path
from typing import Any

NOTEBOOKS = Path(__file__).resolve().parent / "docs" / "notebooks"


def on_files(files: Any, config: Any) -> Any:
    """Add the generated pages."""
    from mkdocs.structure.files import File

    for path, content in (
        ("reference/cli.md", cli_page()),
        ("reference/http.md", http_page()),
        ("reference/configuration.md", configuration_page()),
    ):
        files.append(File.generated(config, path, content=content))
    for notebook in sorted(NOTEBOOKS.glob("*.ipynb")):
        page = notebook_page(json.loads(notebook.read_text(encoding="utf-8")))
        files.append(File.generated(config, f"notebooks/{notebook.stem}.md", content=page))
    return files


def notebook_page(notebook: dict[str, Any]) -> str:
    """Return a notebook as a page: its text and its code, without outputs."""
    parts = []
    for cell in notebook["cells"]:
        text = "".join(cell["source"])
        parts.append(text if cell["cell_type"] == "markdown" else f"```python\n{text}\n```")
    return "\n\n".join(parts) + "\n"


def cli_page() -> str:
    """Return every command with its arguments and options."""
    from linna.cli import GROUPS
    from linna.completion import command_parser
    from linna.parser import all_commands

    lines = [
        "# Commands",
        "",
        "Generated from the program. `--json` prints one JSON object on stdout; progress and logs go to stderr. "
        "Exit status: 0 done, 1 a gate or requirement not met, 2 bad usage or input, 3 inconclusive.",
    ]
    for group in GROUPS:
        importlib.import_module(f"linna.commands.{GROUPS[group][0]}")
        for name, parser in all_commands(command_parser(GROUPS, group)):
            if name.split()[1] != group:
                continue
            depth = "##" if name.count(" ") == 1 else "###"
            lines += ["", f"{depth} {name}", "", _cell(parser.description or ""), "", *_options(parser)]
    return "\n".join(lines) + "\n"


def _options(parser: argparse.ArgumentParser) -> list[str]:
    rows = []
    formatter = parser._get_formatter()
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction | argparse._HelpAction):
            continue
        metavar = action.metavar or (action.dest if not action.option_strings else action.dest.upper())
        value = "" if action.nargs == 0 else formatter._format_args(action, str(metavar))
        name = f"{', '.join(action.option_strings)} {value}".strip() if action.option_strings else value
        text = formatter._expand_help(action) if action.help else ""
        needed = (
            " (required)" if action.required and action.option_strings and "(required)" not in text else ""
        )
        rows.append(f"| `{_cell(name)}` | {_cell(text + needed)} |")
    return ["| argument | meaning |", "|---|---|", *rows] if rows else []


def http_page() -> str:
    """Return every operation of the HTTP interface."""
    import tempfile
    from pathlib import Path

    from ground_service.app import create_app
    from ground_service.settings import Settings

    with tempfile.TemporaryDirectory() as home:
        document = create_app(Settings(home=Path(home))).openapi()
    lines = [
        "# HTTP",
        "",
        "Generated from the program. Paths are under the service's address; the OpenAPI document is at "
        "`/api/v1/openapi.json`, and interactive pages are at `/docs`. Times are RFC 3339 UTC. Errors are "
        "problem details (RFC 9457).",
        "",
        "| operation | path | meaning |",
        "|---|---|---|",
    ]
    for path, operations in sorted(document["paths"].items()):
        for method, operation in operations.items():
            summary = operation.get("summary") or operation.get("operationId", "")
            lines.append(f"| {method.upper()} | `{path}` | {_cell(summary)} |")
    return "\n".join(lines) + "\n"


def configuration_page() -> str:
    """Return every setting of a deployment."""
    from ground_service.settings import Settings

    lines = [
        "# Configuration",
        "",
        "Generated from the program. A deployment is configured by environment variables. A spacecraft is configured "
        "by its [mission description](../mission.md), an emulation by its scenario.",
        "",
        "| variable | default | meaning |",
        "|---|---|---|",
        "| `LINNA_DATA` | user's data directory | folder of the public data products |",
    ]
    for name, field in Settings.model_fields.items():
        if name == "data":
            continue
        default = "" if field.default_factory or field.default is None else str(field.default)
        shown = f"`{default}`" if default not in ("", "()") else "none"
        lines.append(f"| `LINNA_{name.upper()}` | {shown} | {_cell(field.description or '')} |")
    return "\n".join(lines) + "\n"


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")
