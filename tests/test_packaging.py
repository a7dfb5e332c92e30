"""Wheel and source distribution: complete, and usable from another folder without the checkout."""

import os
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SCENARIO_NAMES = sorted(path.name for path in (ROOT / "scenarios").glob("*.toml"))


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with wheel and sdist, built from the tracked files alone."""
    folder = tmp_path_factory.mktemp("package")
    source = folder / "source"
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    ).stdout.splitlines()
    for name in listed:
        if not name.startswith("tests/") and (ROOT / name).is_file():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, source / name)
    code = (
        "import setuptools.build_meta as b, sys; "
        f"b.build_wheel({str(folder)!r}); b.build_sdist({str(folder)!r})"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=source, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    return folder


@pytest.mark.slow
def test_the_wheel_holds_scenarios_models_templates_and_migrations(built: Path) -> None:
    (wheel,) = built.glob("*.whl")
    names = set(zipfile.ZipFile(wheel).namelist())
    assert {f"scenarios/{name}" for name in SCENARIO_NAMES} <= names
    assert {
        "payload_emulator/flight/models/craters.onnx",
        "reports/pdf_pages.typ",
        "db/migrations/env.py",
    } <= names
    assert {"ground_service/web/static/site.css", "ground_service/web/templates/pass.html"} <= names
    assert not [name for name in names if name.startswith(("tests/", "benchmarks/", "docs/"))]


@pytest.mark.slow
def test_the_source_distribution_can_be_built_again(built: Path, tmp_path: Path) -> None:
    (sdist,) = built.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert {"pyproject.toml", "README.md", "LICENSE", "scenarios/selenita.toml"} <= names
    assert "payload_emulator/flight/models/craters.onnx" in names


@pytest.mark.slow
def test_the_installed_wheel_works_from_another_folder(built: Path, tmp_path: Path) -> None:
    (wheel,) = built.glob("*.whl")
    home = tmp_path / "venv"
    venv.create(home, with_pip=False)
    packages = Path(sysconfig.get_path("purelib", vars={"base": str(home), "platbase": str(home)}))
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(packages)
    here = sysconfig.get_path("purelib")
    (packages / "shared.pth").write_text(here + "\n")
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    kept = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "LINNA_DATA")}

    def linna(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [str(home / "bin" / "python"), "-m", "linna", *arguments],
            cwd=elsewhere, env=kept | {"XDG_DATA_HOME": str(elsewhere)}, capture_output=True, text=True, check=False,
        )  # fmt: skip

    where = subprocess.run(
        [str(home / "bin" / "python"), "-c", "import linna; print(linna.__file__)"],
        cwd=elsewhere, env=kept, capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    assert str(packages) in where
    assert linna("demo", "--help").returncode == 0
    flown = linna("orbit", "propagate", "selenita", "--days", "0.1", "--step", "60", "--out", "day.oem")
    assert flown.returncode == 0, flown.stderr
    assert (elsewhere / "day.oem").is_file()
    assert linna("mission", "write", "selenita", "--out", "mission.toml").returncode == 0
    assert linna("detector", "info").returncode == 0
    assert linna("pass", "list", "--home", "home").returncode == 0


def test_the_project_has_its_legal_and_citation_files() -> None:
    for name in ("LICENSE", "CITATION.cff", "CODE_OF_CONDUCT.md", "SECURITY.md"):
        assert (ROOT / name).stat().st_size > 300, name
    import yaml

    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    from linna import __version__

    assert citation["version"] == __version__ and citation["cff-version"] == "1.2.0"


@pytest.mark.slow
def test_the_bill_of_materials_names_every_runtime_package(tmp_path: Path) -> None:
    out = tmp_path / "linna.cdx.json"
    subprocess.run(
        [
            sys.executable, "-m", "cyclonedx_py", "requirements", str(ROOT / "requirements" / "runtime.txt"),
            "--pyproject", str(ROOT / "pyproject.toml"), "--of", "JSON", "-o", str(out),
        ],
        check=True, capture_output=True,
    )  # fmt: skip
    import json

    document = json.loads(out.read_text())
    names = {component["name"].lower() for component in document["components"]}
    assert document["bomFormat"] == "CycloneDX" and document["metadata"]["component"]["name"] == "linna"
    assert {"numpy", "fastapi", "sqlalchemy", "onnxruntime"} <= names
