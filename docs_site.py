"""Hook of the documentation site: pages generated from the program, so that they cannot differ from it.

`python docs_site.py notebooks FOLDER` flies the passes of the notebooks, executes the notebooks and saves them with
their outputs in FOLDER. A build of the site with `NOTEBOOK_OUTPUTS=FOLDER` shows these outputs; without it, text and
code only.

`python docs_site.py tour FOLDER` takes the pictures of the README and of the pages of one pass from `linna-demo` and
`demo.txt` in FOLDER, which are the output folder and the printed text of `linna demo`: PNG files, and `tour.gif`, whose
comment is the text it shows. `python docs_site.py shift FOLDER` takes those of a shift from `linna demo --live` in the
new FOLDER. Each PNG file states its source and evidence level as its text.

`python docs_site.py figures` writes the generated blocks of the pages again.
"""

import argparse
import base64
import csv
import dataclasses
import html
import importlib
import inspect
import io
import json
import os
import re
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterator
from datetime import date
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

ROOT = Path(__file__).resolve().parent
NOTEBOOKS = ROOT / "docs" / "notebooks"
PASSES = ("2029-08-07T01:40:00Z", "2029-08-07T03:31:12Z")
"""Starts of the two passes of the notebooks, one revolution apart."""

SCENARIO = """
name = "notebook"
seed = 7
[dynamics]
gravity = "builtin"
orientation = "iau"
[window]
search = "none"
start = "{start}"
duration_s = 480.0
[terrain]
source = "procedural"
[navigation]
filter_gravity = "builtin"
filter_degree = 8
"""
TOUR_PAGES = {
    "pass-map": ("/passes/1", "section[aria-labelledby=map-title]"),
    "charts": ("/telemetry?pass=1&chart=1:temperature_c,bus_voltage_v&chart=1:mode", "#charts"),
    "passes": ("/passes", "body"),
    "regression": ("/regression", "body"),
}
SHIFT_PAGES = {
    "shift": ("/", "body"),
    "planner": ("/planner?window=1", "body"),
    "links": ("/commands", "section[aria-labelledby=links-title]"),
    "commands": ("/commands", "section[aria-labelledby=queue-title]"),
    "telemetry": ("/telemetry?packet=housekeeping", "section[aria-labelledby=live-title]"),
    "alarms": ("/alarms?state=any", "body"),
    "events": ("/events", "body"),
}
"""Pictures of the documentation: address and part of a page of `linna demo`, and of `linna demo --live`."""

FILLED_MS = 8000
"""Time in which a page is filled; messages of a living demo go on."""

_STYLE = re.compile(r"<style.*?</style>\s*", re.DOTALL)


def on_files(files: Any, config: Any) -> Any:
    """Add the generated pages."""
    from mkdocs.structure.files import File

    for path, content in (
        ("reference/cli.md", cli_page()),
        ("reference/http.md", http_page()),
        ("icd.md", icd_page()),
        ("reference/configuration.md", configuration_page()),
        ("reference/scenario.md", scenario_page()),
        ("explanation/programs.svg", layers_svg("")),
        ("explanation/emulator.svg", layers_svg("payload_emulator")),
        ("explanation/ground.svg", layers_svg("ground_service")),
    ):
        files.append(File.generated(config, path, content=content))
    folder = Path(os.environ.get("NOTEBOOK_OUTPUTS") or NOTEBOOKS)
    for notebook in sorted(folder.glob("*.ipynb")):
        page, pictures = notebook_page(notebook.stem, json.loads(notebook.read_text(encoding="utf-8")))
        files.append(File.generated(config, f"notebooks/{notebook.stem}.md", content=page))
        for name, octets in pictures.items():
            files.append(File.generated(config, f"notebooks/{name}", content=octets))
    return files


def notebook_page(stem: str, notebook: dict[str, Any]) -> tuple[str, dict[str, bytes]]:
    """Return a notebook as a page with text, code and the outputs it has, and its pictures by file name."""
    parts: list[str] = []
    pictures: dict[str, bytes] = {}
    for cell in notebook["cells"]:
        text = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(text)
            continue
        parts.append(f"```python\n{text}\n```")
        for output in cell.get("outputs", []):
            data = output.get("data", {})
            if "image/png" in data:
                name = f"{stem}-{len(pictures) + 1}.png"
                pictures[name] = base64.b64decode("".join(data["image/png"]))
                parts.append(f"![Output of the cell]({name})")
            elif "text/html" in data:
                # A blank line would end the block of HTML.
                table = _STYLE.sub("", "".join(data["text/html"]))
                parts.append("\n".join(line for line in table.splitlines() if line.strip()))
            else:
                plain = "".join(data.get("text/plain", output.get("text", ""))).rstrip()
                parts.append(f"```text\n{plain}\n```")
    return "\n\n".join(parts) + "\n", pictures


def fly_passes(home: Path, starts: tuple[str, ...] = PASSES) -> None:
    """Emulate passes over the procedural Moon and import them into a home folder."""
    from ground_service.ground import open_ground
    from ground_service.passes.archive_import import import_archive
    from lunar.datafolder import DataFolder
    from payload_emulator.session.archive.emulator import emulate
    from payload_emulator.session.scenario import parse_scenario

    with tempfile.TemporaryDirectory() as folder, open_ground(home) as ground:
        for number, start in enumerate(starts):
            archive = Path(folder) / str(number)
            emulate(parse_scenario(SCENARIO.format(start=start)), DataFolder(), archive, frames_kept=1)
            import_archive(ground, archive)


def executed_notebooks(home: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """Return the file name of each notebook and the notebook with its outputs for the passes of a home folder."""
    import nbformat
    from nbclient import NotebookClient

    os.environ |= {"LINNA_HOME": str(home), "PYTHONPATH": str(ROOT)}
    os.environ.pop("MPLBACKEND", None)  # pictures are outputs of cells
    for path in sorted(NOTEBOOKS.glob("*.ipynb")):
        notebook = nbformat.read(path, as_version=4)
        NotebookClient(notebook, timeout=300, kernel_name="python3").execute()
        yield path.name, notebook


def main(arguments: list[str]) -> int:
    """Run the command."""
    match arguments:
        case ["notebooks", folder]:
            save_executed_notebooks(Path(folder))
        case ["tour", folder]:
            save_tour(Path(folder), ROOT / "docs" / "pictures")
        case ["shift", folder]:
            save_shift(Path(folder), ROOT / "docs" / "pictures")
        case ["figures"]:
            write_figures()
        case _:
            print(
                "docs_site.py: expected 'notebooks FOLDER', 'tour FOLDER', 'shift FOLDER' or 'figures'", file=sys.stderr
            )
            return 2
    return 0


def save_tour(folder: Path, out: Path) -> None:
    """Save pages of a demo as PNG files; its text, the saved shift, its pass and its report are an animation."""
    from PIL import Image

    from benchmarks.pages import open_chromium, served

    text = tour_text((folder / "demo.txt").read_text(encoding="utf-8"))
    source = f"linna demo, {text.splitlines()[-1]}"
    (report,) = (folder / "linna-demo").rglob("report.html")
    terminal = (
        "<body style='margin:0;background:#1d2529;color:#e8eef0;padding:28px;font:19px/1.45 DejaVu Sans Mono'>"
        f"<pre style='margin:0;white-space:pre-wrap'><b>$ linna demo --out linna-demo</b>\n{html.escape(text)}</pre>"
    )
    with served(folder / "linna-demo" / "ground") as url, open_chromium() as browser:
        page = browser.new_page(viewport={"width": 1200, "height": 800}, color_scheme="light")
        page.set_content(terminal)
        shown = [page.screenshot(), (out / "shift.png").read_bytes()]
        for name, address in (("pass", f"{url}/passes/1"), ("report", report.resolve().as_uri())):
            page.goto(address)
            shown.append(_picture(page, out / f"{name}.png", source))
        for name, (address, part) in TOUR_PAGES.items():
            page.goto(url + address)
            _picture(page, out / f"{name}.png", source, part)
    pictures = [Image.open(io.BytesIO(one)).convert("RGB") for one in shown]
    small = [one.resize((900, 600), Image.Resampling.LANCZOS) for one in pictures]
    frames = [one.quantize(128, Image.Quantize.MAXCOVERAGE) for one in small]
    frames[0].save(
        out / "tour.gif", save_all=True, append_images=frames[1:], duration=[6000, 4000, 4000, 4000], loop=0,
        optimize=True, comment=text.encode(),
    )  # fmt: skip


def save_shift(folder: Path, out: Path) -> None:
    """Save pages of a living demo with a fault as PNG files, when it has reports of two windows."""
    from benchmarks.pages import open_chromium
    from studies.harness.parts import Part, answers_http, free_port

    port = free_port()
    url, command = f"http://127.0.0.1:{port}", [sys.executable, "-m", "linna", "demo", "--live"]
    command += ["--scenario", "live-pictures", "--out", str(folder), "--port", str(port)]
    reports: list[dict[str, Any]] = []
    with Part(command, folder.with_suffix(".log"), lambda: True, 1) as demo, open_chromium() as browser:
        page = browser.new_page(viewport={"width": 1200, "height": 800}, color_scheme="light")
        while len(reports) < 2 and not demo.has_ended:
            time.sleep(2.0)
            if answers_http(f"{url}/readyz"):
                reports = page.request.get(f"{url}/api/v1/reports?pass_id=1&pass_id=2").json()["items"]
        if len(reports) < 2:
            raise SystemExit(
                f"{folder}: expected reports of two windows, found {len(reports)}; see {folder.with_suffix('.log')}"
            )
        source = f"linna demo --live, evidence: level {reports[0]['evidence_level']}"
        for name, (address, part) in SHIFT_PAGES.items():
            page.goto(url + address)
            _picture(page, out / f"{name}.png", source, part)


def _picture(page: Any, file: Path, source: str, part: str = "body") -> bytes:
    """Return the upper 800 px of a part of a page that has been filled, and save them with their source."""
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    page.wait_for_timeout(FILLED_MS)
    octets: bytes = page.screenshot() if part == "body" else page.locator(part).screenshot()
    metadata = PngInfo()
    metadata.add_text("Source", source)
    picture = Image.open(io.BytesIO(octets)).convert("RGB")
    picture = picture.crop((0, 0, picture.width, min(picture.height, 800)))
    picture.quantize(256, Image.Quantize.MAXCOVERAGE).save(file, optimize=True, pnginfo=metadata)
    return octets


def tour_text(printed: str) -> str:
    """Return the lines of a demo from its pass to its evidence level, without those of single requirements.

    No machine changes these lines; the processor load among the requirements depends on it.
    """
    lines = printed.splitlines()
    first = next(number for number, line in enumerate(lines) if line.startswith("pass "))
    last = next(number for number, line in enumerate(lines) if line.startswith("evidence: "))
    return re.sub(r"(?m)^  \S.*\n", "", "\n".join(lines[first : last + 1])).replace("\n\n\n", "\n\n")


def save_executed_notebooks(out: Path) -> None:
    """Save the executed notebooks in a folder."""
    import nbformat

    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as home:
        fly_passes(Path(home))
        for name, notebook in executed_notebooks(Path(home)):
            nbformat.write(notebook, out / name)


def cli_page() -> str:
    """Return every command with its arguments and options."""
    from linna.cli import GROUPS
    from linna.help import example
    from linna.parser import all_commands, command_parser

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
            lines += ["", f"{depth} {name}", "", _cell(parser.description or ""), "", f"    {example(name)}", ""]
            lines += _options(parser)
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
        needed = " (required)" if action.required and action.option_strings and "(required)" not in text else ""
        rows.append(f"| {_code(name)} | {_cell(text + needed)} |")
    return ["| argument | meaning |", "|---|---|", *rows] if rows else []


def http_page() -> str:
    """Return every operation of the HTTP interface."""
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


def icd_page() -> str:
    """Return the interface control document, as `linna tm icd` prints it."""
    from payload_emulator.flight.onboard.icd import format_interfaces
    from tmtc.dictionary.icd import format_icd

    return f"{format_icd()}\n{format_interfaces()}"


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


def scenario_page() -> str:
    """Return every key of a scenario with its type and default, from the classes that read it."""
    from payload_emulator.session.scenario import Scenario

    lines = [
        "# Scenario keys",
        "",
        "Generated from the program. A scenario is a TOML file: see [your own scenario](../tutorials/own-scenario.md). "
        "`linna emulate NAME` flies a shipped one. A key that is not stated has its default, an unknown key is refused "
        "with the nearest known one.",
        *_keys("Top of the file", Scenario(""), ""),
    ]
    for section in dataclasses.fields(Scenario):
        values = getattr(Scenario(""), section.name)
        if dataclasses.is_dataclass(values):
            lines += _keys(f"`[{section.name}]`", values, inspect.getdoc(values) or "")
    return "\n".join(lines) + "\n"


def _type_text(hint: Any) -> str:
    if get_origin(hint) is Literal:
        return ", ".join(map(json.dumps, get_args(hint)))
    if get_origin(hint) is tuple:
        return f"list of {get_args(hint)[0].__name__}"
    return _type_text(get_args(hint)[0]) if get_args(hint) else str(hint.__name__)


def _keys(heading: str, values: Any, text: str) -> list[str]:
    text, _, attributes = text.partition("\nAttributes\n----------\n")
    meanings: dict[str, str] = {}
    for names, meaning in re.findall(r"^(\S[^\n]*)\n((?:    [^\n]*\n?)+)", attributes, re.MULTILINE):
        meanings |= dict.fromkeys(names.split(", "), " ".join(meaning.split()))
    rows = []
    hints = get_type_hints(type(values))
    for key in dataclasses.fields(values):
        value, stated = getattr(values, key.name), _type_text(hints[key.name])
        if dataclasses.is_dataclass(value):
            continue
        default = "not stated" if value is None else f"`{json.dumps(value)}`"
        if key.default is key.default_factory is dataclasses.MISSING:
            default = "required"
        meaning = f" {_cell(meanings.get(key.name, ''))} |" if meanings else ""
        rows.append(f"| `{key.name}` | {_cell(stated)} | {default} |{meaning}")
    return [
        "",
        f"## {heading}",
        *(["", text.strip()] if text.strip() else []),
        "",
        "| key | type or values | default |" + (" meaning |" if meanings else ""),
        "|---|---|---|" + ("---|" if meanings else ""),
        *rows,
    ]


def layers_svg(container: str) -> str:
    """Return the layers of a package (of all packages: "") as SVG, from the import contracts that the tests check."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"][
        "contracts"
    ]
    (layers,) = (one["layers"] for one in contracts if "layers" in one and one.get("containers", [""]) == [container])
    parts, top = [], 0
    for layer in layers:
        names = [name.strip() for name in layer.split("|")]
        rows = [names[start : start + 3] for start in range(0, len(names), 3)]
        parts.append(
            f'<rect x="1" y="{top + 1}" width="378" height="{26 * len(rows) + 6}" rx="4" fill="none" stroke="#78909c"/>'
        )
        for number, row in enumerate(rows):
            width = 370 / len(row)
            for place, name in enumerate(row):
                x, y = 5 + place * width, top + 5 + 26 * number
                parts.append(
                    f'<rect x="{x + 1:.0f}" y="{y}" width="{width - 2:.0f}" height="24" rx="3" fill="#e3edf5"/>'
                    f'<text x="{x + width / 2:.0f}" y="{y + 17}" text-anchor="middle">{html.escape(name)}</text>'
                )
        top += 26 * len(rows) + 16
        parts.append(f'<path d="M190 {top - 9}v7m-4 -4l4 4l4 -4" stroke="#78909c" fill="none"/>')
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 380 {top - 6}" width="380" font-family="sans-serif" '
        f'font-size="14" fill="#102027">{"".join(parts[:-1])}</svg>'
    )


BLOCK = re.compile(r"(<!-- generated: (\w+) -->\n)(.*?)(<!-- end -->)", re.DOTALL)
"""A block of a page that is generated: start, name, text and end."""


def generated_figures() -> dict[str, str]:
    """Return the text of the generated blocks of pages by the name of the block."""
    from tmtc.xtce.export import format_xtce

    def sizes(unrolled: bool) -> str:
        text = format_xtce(unrolled=unrolled)
        return f"{text.count('<SequenceContainer '):,} containers, {len(text.encode()) / 1e6:.2f} MB"

    return {
        "xtce": f"`linna tm xtce` writes {sizes(False)}; with `--unrolled` {sizes(True)}.",
        "mutation": mutation_table((ROOT / "docs" / "results" / "mutation.csv").read_text(encoding="utf-8")),
    }


def mutation_table(samples: str) -> str:
    """Return the scores of samples of mutants as a table; the interval is Wilson's at 95 %.

    Raises
    ------
    ValueError
        A group has no sample of the 60 days before the newest commit.
    """
    from scipy.stats import binomtest

    from benchmarks.mutation import GROUPS

    log = ["git", "-C", str(ROOT), "log", "-1", "--format=%cs"]
    now = date.fromisoformat(subprocess.run(log, capture_output=True, text=True, check=True).stdout.strip())
    rows = list(csv.DictReader(io.StringIO(samples)))
    fresh = {row["group"] for row in rows if (now - date.fromisoformat(row["date"])).days <= 60}
    if stale := GROUPS.keys() - fresh:
        raise ValueError(
            f"docs/results/mutation.csv: expected a sample of the last 60 days, found none: {sorted(stale)}"
        )

    lines = ["| group | commit, date | seed | tested | killed | score | interval |", "|---|---|---|---|---|---|---|"]
    for row in rows:
        killed, tested = int(row["killed"]), int(row["tested"])
        interval = binomtest(killed, tested).proportion_ci(method="wilson")
        lines.append(
            f"| {row['group']} | {row['commit']}, {row['date']} | {row['seed']} | {tested} | {killed} "
            f"| {killed / tested:.2f} | {interval.low:.2f} to {interval.high:.2f} |"
        )
    return "\n".join(lines)


def write_figures() -> None:
    """Write the generated blocks of all pages again."""
    figures = generated_figures()
    for page in (ROOT / "docs").rglob("*.md"):
        text = page.read_text(encoding="utf-8")
        renewed = BLOCK.sub(lambda block: f"{block[1]}\n{figures[block[2]]}\n\n{block[4]}", text)
        if renewed != text:
            page.write_text(renewed, encoding="utf-8")


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "&#124;")


def _code(text: str) -> str:
    # In a span of backquotes the table would end at "|", and an entity would be shown as it is.
    return f"<code>{_cell(html.escape(text, quote=False))}</code>" if "|" in text else f"`{_cell(text)}`"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
