"""The documentation site: strict build, generated reference, self-contained pages, spelling, and commands that run."""

import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from PIL import Image
from pytest import approx, fixture, raises

import docs_site
from ground_service.web import pages
from linna.cli import GROUPS
from linna.parser import all_commands, command_parser
from tests.serving import ran

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
README = (ROOT / "README.md").read_text()
TUTORIALS = sorted(path.name for path in (DOCS / "tutorials").glob("*.md"))


def read(name):
    return (DOCS / name).read_text()


TUTORIAL_TEXTS = [read(f"tutorials/{name}") for name in TUTORIALS]
MARK = re.compile(
    r"^ *<!-- (?P<kind>file|run|tour|output)(?:: (?P<name>[\w.-]+))?(?:, status (?P<status>[\d,]+))?[^\n]*-->\n"
    r" *```\w+\n(?P<text>.*?)^ *```$",
    re.MULTILINE | re.DOTALL,
)


@fixture(scope="session")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    built = ran(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)],
        cwd=ROOT,
        env=os.environ | {"NO_MKDOCS_2_WARNING": "1"},
    )
    assert built.returncode == 0, built.stdout + built.stderr
    return folder


def test_the_site_builds_without_a_warning_and_has_the_generated_reference(site):
    commands = (site / "reference/cli.html").read_text()
    for group in GROUPS:
        for name, _ in all_commands(command_parser(GROUPS, group)):
            if name.split()[1] == group:
                assert f">{name}<" in commands, name
    assert "/api/v1/passes" in (site / "reference/http.html").read_text()


def test_pages_load_nothing_from_elsewhere(site):
    for page in site.rglob("*.html"):
        body = page.read_text()
        for source in re.findall(r'<(?:script|img|link)[^>]+(?:src|href)="(https?:[^"]+)"', body):
            assert 'rel="canonical"' in body and source.startswith("https://linna"), f"{page.name}: {source}"


def test_the_service_shows_the_site_under_its_policy(site, monkeypatch):
    monkeypatch.setattr(pages, "HELP", Path("absent"))
    monkeypatch.setattr(pages, "DOCS", Path("absent"))
    absent = pages.documentation_file("index.html")
    assert absent.status_code == 404 and b"make docs" in absent.body
    monkeypatch.setattr(pages, "HELP", site)
    answer = pages.documentation_file("index.html")
    policy = answer.headers["Content-Security-Policy"]
    assert answer.media_type == "text/html; charset=utf-8" and "default-src 'none'" in policy
    inline = re.findall(rb"<script>(.*?)</script>", bytes(answer.body), re.DOTALL)
    assert inline and policy.count("'sha256-") == len(set(inline)) and "script-src 'self' 'unsafe" not in policy
    for path in ("../pages.py", "no.html", "/etc/passwd"):
        with raises(pages.NotFound):
            pages.documentation_file(path)


def test_every_page_links_to_help_and_help_needs_no_build(monkeypatch):
    assert {pages.rendered.__wrapped__(one).count('href="/help"') for one in pages.PAGES} == {1}
    monkeypatch.setattr(pages, "HELP", Path("absent"))
    answer = pages.documentation_file("index.html")
    assert answer.headers["Content-Security-Policy"] == pages.POLICY
    assert b'<a href="tutorials/first-pass.html">first pass</a>' in answer.body
    assert pages.documentation_file("pictures/tour.gif").media_type == "image/gif"
    warned = bytes(pages.documentation_file("tutorials/first-pass.html").body)
    assert b"<strong>What went wrong</strong>" in warned and b"!!!" not in warned


def test_links_and_anchors_of_help_lead_to_what_is_there():
    names = [one.relative_to(DOCS).as_posix() for one in DOCS.rglob("*.md")]
    found = {name: pages.page_of(name) for name in names}
    for source, page in found.items():
        for target, anchor in re.findall(r'<a href="([^":#]*)(?:#([^"]*))?"', page):
            if target.startswith("/"):
                continue
            name = os.path.normpath(Path(source).parent / target).replace(".html", ".md") if target else source
            assert (DOCS / name).exists() and (not anchor or f'id="{anchor}"' in found[name]), (source, target, anchor)


def test_spelling():
    checked = ran(
        [str(Path(sys.executable).with_name("typos")), "--config", str(ROOT / "typos.toml"), "docs", "README.md"],
        cwd=ROOT,
    )
    assert checked.returncode == 0, checked.stdout


def test_the_readme_has_the_tour_of_the_first_tutorial():
    (tour,) = [m["text"] for m in MARK.finditer(read("tutorials/first-pass.md")) if m["kind"] == "tour"]
    assert tour in README


def environment(home):
    taken = ("LINNA_DATA", "LINNA_HOME", "LINNA_SERVER")
    return {name: value for name, value in os.environ.items() if name not in taken} | {
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT),
        "XDG_DATA_HOME": str(home),
    }


def run_script(script, folder):
    """Return what a shell script prints that ends with status 0."""
    with (folder / "log").open("w") as log:
        command, known = ["bash", "-c", script], environment(folder / "data")
        done = subprocess.run(command, cwd=folder, env=known, stdout=log, stderr=log, check=False)
    printed = (folder / "log").read_text()
    assert done.returncode == 0, printed[-3000:]
    return printed


def command_lines(text):
    """Return the words of each `linna` command of a shell script, without redirections and pipes."""
    lines = []
    for line in text.replace("\\\n", " ").splitlines():
        words = shlex.split(line, comments=True)
        if words[:1] == ["linna"]:
            ends = [k for k, word in enumerate(words) if re.match(r"\d?>|[|&;]", word)]
            lines.append(words[1 : min(ends, default=len(words))])
    return lines


@pytest.mark.parametrize("name", TUTORIALS)
def test_the_commands_of_a_tutorial_are_accepted_by_the_parser(name):
    marks = [m for m in MARK.finditer(read(f"tutorials/{name}")) if m["kind"] in ("run", "tour")]
    commands = [words for mark in marks for words in command_lines(mark["text"])]
    assert commands
    for words in commands:
        command_parser(GROUPS, words[0]).parse_args(words)


# `test_packaging` runs the first tutorial, the tour of the README.
@pytest.mark.campaign
@pytest.mark.parametrize("name", [name for name in TUTORIALS if name != "first-pass.md"])
def test_the_commands_of_a_tutorial_run_as_written(name, tmp_path):
    script, expected = ["set -e", "trap 'kill $(jobs -p) || true' EXIT"], list[str]()
    for mark in MARK.finditer(read(f"tutorials/{name}")):
        if mark["kind"] == "file":
            (tmp_path / mark["name"]).write_text(mark["text"])
            continue
        if mark["kind"] == "output":
            expected += mark["text"].splitlines()
            continue
        allowed = f' || [[ ",{mark["status"]}," == *",$?,"* ]]' if mark["status"] else ""
        script += [line.strip() + allowed for line in mark["text"].splitlines()]
    assert len(script) > 2
    printed = run_script("\n".join(script), tmp_path)
    assert [line for line in expected if line.strip() not in printed] == []
    if name == "first-spacecraft.md":
        _check_first_spacecraft(tmp_path)
    if name == "own-build.md":
        stated, found = (
            re.search(r"^fail: recall falls by ([\d.]+) .*$", text, re.MULTILINE)
            for text in (read(f"tutorials/{name}"), printed)
        )
        assert stated and found and float(found[1]) == approx(float(stated[1]), abs=0.02)
        assert re.sub(r"[\d.]+", "1", found[0]) == re.sub(r"[\d.]+", "1", stated[0])


@pytest.mark.campaign
def test_the_workflow_of_the_ci_page_runs_with_short_passes(tmp_path):
    (workflow,) = re.findall(r"```yaml\n(.*?)```", read("ci.md"), re.DOTALL)
    steps = [step.get("run", "") for step in yaml.safe_load(workflow)["jobs"]["gates"]["steps"]]
    script = [step for step in steps if "linna regress" in step]
    assert [step.count("linna regress") for step in script] == [1, 1, 1]
    contract = read("build-contract.md").split("### Template of a program")[1]
    for name, kind in (("build.toml", "toml"), ("fly.py", "python")):
        (tmp_path / name).write_text(re.findall(rf"```{kind}\n(.*?)```", contract, re.DOTALL)[0])
    text = "\n".join(["set -e", *script]).replace("--out passes", "--frames 6 --out passes")
    assert "pass: identical in every octet on 12 frames" in run_script(text, tmp_path)
    assert "</testsuite>" in (tmp_path / "junit.xml").read_text() and (tmp_path / "report.html").exists()


def _check_first_spacecraft(folder):
    """Check report, archive, webhook and alarms of the spacecraft that was flown with the page alone."""
    names = ("summary", "archives", "alarms", "notification")
    summary, archives, alarms, notified = (json.loads((folder / f"{name}.json").read_text()) for name in names)
    assert (notified["trigger"], notified["pass_id"]) == ("report done", 1)
    assert summary["frames"] > 0 == summary["packets_lost"] == alarms["total"]
    assert {*summary["navigation"]} == {"spherical", "anchored"}
    assert archives[0]["pass_id"] == 1 and archives[0]["frames"] == summary["frames"]
    assert "first" in (folder / "report.html").read_text()


def test_the_table_of_changes_names_files_that_exist():
    table = read("contributing.md").split("## Where do I change")[1].split("\n## ")[0]
    named = re.findall(r"`([\w./]+)`", " ".join(row.split("|")[2] for row in re.findall(r"^\| .*\|$", table, re.M)))
    found = {name for name in named if (ROOT / name).exists() or [*ROOT.glob(f"ground_service/**/{name}")]}
    assert len(named) > 20 and {*named} - found == {"Command", "PAGES", "Requirements", "add_list"}


@pytest.mark.parametrize("page", ["explanation/walks", "results/attempts"])
def test_the_walks_and_attempts_name_functions_that_exist(page):
    steps = re.findall(r"`([\w/]+\.py): (\w+)`", read(f"{page}.md"))
    gone = [
        (file, name)
        for file, name in steps
        if not re.search(rf"^(async )?(def|class) {name}\b", (ROOT / file).read_text(), re.MULTILINE)
    ]
    assert len(steps) > 20 and gone == []


def test_the_page_of_scenario_keys_states_types_and_defaults():
    page = docs_site.scenario_page()
    assert "| `fov_deg` | float | `120.0` |" in page.split("## `[camera]`")[1].split("\n## ")[0]
    assert "| `name` | str | required |" in page


def test_figures_of_pages_are_those_of_the_program():
    blocks = [block for page in DOCS.rglob("*.md") for block in docs_site.BLOCK.findall(page.read_text())]
    assert {name: text.strip() for _, name, text, _ in blocks} == docs_site.generated_figures()


def test_the_animation_of_the_readme_shows_the_figures_of_the_text():
    with Image.open(DOCS / "pictures/tour.gif") as picture:
        shown = picture.info["comment"].decode()
    assert shown == read("tutorials/first-pass.md").split("```text\n")[1].split("```")[0].strip()
    median, p95, level = re.findall(r"^anchored +(\d+) +(\d+) .*level (\d)", shown, re.MULTILINE | re.DOTALL)[0]
    navigation = read("navigation.md")
    assert f"| `linna demo` with `LINNA_DATA`, one window | {level} | {median} m | {p95} m |" in navigation
    for name in ("pass", "report", *docs_site.TOUR_PAGES, *docs_site.SHIFT_PAGES):
        with Image.open(DOCS / "pictures" / f"{name}.png") as picture:
            assert f"evidence: level {level}" in picture.info["Source"], name
        shown_on = [text for text in TUTORIAL_TEXTS if f"pictures/{name}.png" in text]
        assert shown_on and all(f"level {level}" in text for text in shown_on), name
    assert (DOCS / "pictures/tour.gif").stat().st_size < 1e6 and "pictures/tour.gif" in README


def test_the_release_notes_are_one_page():
    assert len((ROOT / "CHANGELOG.md").read_bytes()) <= 8_000
