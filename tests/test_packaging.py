"""Wheel and source distribution: complete, and usable from another folder without the checkout."""

import hashlib
import importlib.metadata
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import urllib.request
import venv
import zipfile
from functools import cache
from pathlib import Path

import yaml
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from pytest import fixture, mark

from linna import __version__
from tests.ground_service.conftest import free_port
from tests.serving import wait_for

ROOT = Path(__file__).resolve().parents[1]
TAKEN = ["PYTHONPATH", "LINNA_DATA", "LINNA_HOME", "LINNA_SERVER"]
OUTSIDE = {name: value for name, value in os.environ.items() if name not in TAKEN}
"""Environment of commands that do not know of the checkout."""

SCENARIO_NAMES = sorted(path.name for path in (ROOT / "scenarios").glob("*.toml"))


@fixture(scope="module")
def built(tmp_path_factory):
    """Folder with wheel and sdist, built from the tracked files and a page where `make docs` writes the site.

    `test_documentation` builds the site itself.
    """
    folder = tmp_path_factory.mktemp("package")
    source = folder / "source"
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard"], cwd=ROOT, capture_output=True, text=True,
        check=True,
    ).stdout.splitlines()  # fmt: skip
    for name in listed:
        if not name.startswith("tests/") and (ROOT / name).is_file():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, source / name)
    (site,) = re.findall(r"^site_dir: (.+)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE)
    page = source / site / "tutorials/first-pass.html"
    page.parent.mkdir(parents=True)
    page.write_text("First pass")
    code = f"import setuptools.build_meta as b, sys; b.build_wheel({str(folder)!r}); b.build_sdist({str(folder)!r})"
    done = subprocess.run([sys.executable, "-c", code], cwd=source, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    return folder


def test_every_pinned_package_runs_on_the_oldest_python_that_the_project_states():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    oldest = project["requires-python"].removeprefix(">=") + ".0"
    pins = {
        Requirement(line).name
        for path in (ROOT / "requirements").glob("*.txt")
        for line in path.read_text().splitlines()
        if "==" in line and not line.startswith("#")
    }
    refused, judged = [], 0
    for name in sorted(pins):
        try:
            found = importlib.metadata.distribution(name)
        except importlib.metadata.PackageNotFoundError:
            continue
        judged += 1
        needs = found.metadata.get("Requires-Python")
        if needs and oldest not in SpecifierSet(needs):
            refused.append(f"{name} {found.version}: {needs}")
    assert judged > 50 and refused == []


OTHERS = """
payload_emulator/flight/models/craters.onnx reports/pdf_pages.typ db/migrations/env.py db/migrations/schema_1.0.json
ground_service/web/static/site.css ground_service/web/templates/pass.html
"""


@mark.slow
def test_the_wheel_holds_scenarios_models_templates_and_migrations(built):
    (wheel,) = built.glob("*.whl")
    names = set(zipfile.ZipFile(wheel).namelist())
    assert {f"scenarios/{name}" for name in SCENARIO_NAMES} <= names
    assert {*OTHERS.split()} <= names
    assert not [name for name in names if name.startswith(("tests/", "benchmarks/", "docs/"))]


@mark.slow
def test_the_source_distribution_can_be_built_again(built, tmp_path):
    (sdist,) = built.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert {"pyproject.toml", "README.md", "LICENSE", "scenarios/selenita.toml"} <= names
    assert "payload_emulator/flight/models/craters.onnx" in names


@fixture(scope="module")
def installed(built, tmp_path_factory):
    """Folder `bin` of a new environment into which pip has installed the wheel; it sees the packages of this one."""
    (wheel,) = built.glob("*.whl")
    home = tmp_path_factory.mktemp("installed") / "venv"
    venv.create(home, with_pip=not has_base_pip())
    done = pip_of(home / "bin", "install", "--no-deps", "--no-index", "--no-compile", str(wheel))
    assert done.returncode == 0, done.stdout + done.stderr
    packages = Path(sysconfig.get_path("purelib", vars={"base": str(home), "platbase": str(home)}))
    (packages / "shared.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return home / "bin"


@cache
def has_base_pip():
    version = [sys._base_executable, "-m", "pip", "--version"]
    return subprocess.run(version, env=OUTSIDE, capture_output=True, check=False).returncode == 0


def pip_of(programs, *arguments):
    """Run pip for an environment: that of the base interpreter, as `make` does, else that of the environment."""
    python = programs / "python"
    pip = [sys._base_executable, "-m", "pip", "--python", python] if has_base_pip() else [python, "-m", "pip"]
    return subprocess.run([*pip, *arguments], env=OUTSIDE, capture_output=True, text=True, check=False)


def in_folder(folder, *command):
    """Output of a command that runs outside of the checkout."""
    done = subprocess.run(
        command, cwd=folder, env=OUTSIDE | {"XDG_DATA_HOME": str(folder)}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, f"{command}\n{done.stderr[-2000:]}"
    return done.stdout


SHORT = """
name = "short"
seed = 7
[window]
search = "none"
duration_s = 60.0
[terrain]
source = "procedural"
[navigation]
estimators = ["anchored"]
filter_gravity = "builtin"
filter_degree = 8
"""


@mark.slow
def test_the_commands_of_the_tour_run_with_the_installed_wheel(installed, tmp_path):
    """The tour of the README on a short pass; the service answers on a free port."""
    tour = re.findall(r"^linna (?:demo|serve|plan|report) .*$", (ROOT / "README.md").read_text(), re.MULTILINE)
    (tmp_path / "short.toml").write_text(SHORT)

    def command(line, *more):
        return [installed / "linna", *shlex.split(line)[1:], *more]

    printed = in_folder(tmp_path, *command(tour[0], "--scenario", "short.toml")).splitlines()
    assert set(tour[1:]) <= {re.sub(r"^ +\S*linna ", "linna ", line) for line in printed}
    port = free_port()
    environment = OUTSIDE | {"XDG_DATA_HOME": str(tmp_path)}
    server = subprocess.Popen(
        command(tour[1], "--port", str(port)), cwd=tmp_path, env=environment, stderr=subprocess.DEVNULL
    )
    try:
        wait_for(lambda: server.poll() is not None or answers(port), "an answer of the service")
        assert server.poll() is None
    finally:
        server.terminate()
        server.wait()
    for line in tour[2:]:
        in_folder(tmp_path, *command(line))
    assert (tmp_path / "linna-demo/window.cltu").stat().st_size > 0
    assert (tmp_path / "linna-demo/report/report.pdf").read_bytes().startswith(b"%PDF")


def answers(port):
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/help/tutorials/first-pass.html", timeout=10) as answer:
            return answer.status == 200 and b"First pass" in answer.read()
    except OSError:
        return False


def test_the_project_has_its_legal_and_citation_files():
    for name in ("LICENSE", "CITATION.cff", "CODE_OF_CONDUCT.md", "SECURITY.md"):
        assert (ROOT / name).stat().st_size > 300, name
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == __version__ and citation["cff-version"] == "1.2.0"


@mark.campaign
def test_the_bill_of_materials_has_hashes_licences_and_the_graph_of_everything_shipped(tmp_path):
    from cyclonedx.schema import SchemaVersion
    from cyclonedx.validation.json import JsonStrictValidator

    wheel, status = tmp_path / "a.whl", tmp_path / "status"
    wheel.write_bytes(b"wheel")
    gone = "Package: gone\nStatus: deinstall ok config-files\nVersion: 1\n"
    status.write_text(f"Package: libc6\nStatus: install ok installed\nVersion: 2.36-9\n\n{gone}")
    shipped = re.search(r"foreach name,([a-z ]+),", (ROOT / "Makefile").read_text())
    files = [str(ROOT / f"requirements/hashed/{name}.txt") for name in shipped[1].split()]
    words = ["bom", *files, "--wheel", str(wheel), "--status", str(status)]
    command = [sys.executable, "deploy/materials.py", *words]
    text = subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True).stdout
    assert JsonStrictValidator(SchemaVersion.V1_6).validate_str(text) is None
    document = json.loads(text)
    root, parts = document["metadata"]["component"], {one["name"]: one for one in document["components"]}
    assert root["hashes"] == [{"alg": "SHA-256", "content": hashlib.sha256(b"wheel").hexdigest()}]
    assert "gone" not in parts and parts.pop("libc6")["purl"] == "pkg:deb/debian/libc6@2.36-9"
    assert {"numpy", "fastapi", "SQLAlchemy", "onnxruntime", "openmct", "pyogrio", "psycopg"} <= parts.keys()
    assert "pytest" not in parts
    assert [name for name, one in parts.items() if not one["hashes"] or not one["licenses"]] == []
    needs = {one["ref"]: one["dependsOn"] for one in document["dependencies"]}
    reached, waiting = set(), [root["bom-ref"]]
    while waiting:
        ref = waiting.pop()
        waiting += set(needs.get(ref, ())) - reached
        reached.add(ref)
    assert {one["bom-ref"] for one in parts.values()} <= reached
