"""What the project stands on: pinned, installed as pinned, under licences that a product can carry."""

import re
import tomllib
from importlib import metadata
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
NORMAL = re.compile(r"[-_.]+")
COPYLEFT = re.compile(r"\b(A?GPL|GNU (Affero )?General Public)", re.IGNORECASE)
WEAK = re.compile(r"LGPL|Lesser|Library General", re.IGNORECASE)


def name_of(text: str) -> str:
    return NORMAL.sub("-", re.split(r"[\[<>=!~ ;]", text, maxsplit=1)[0]).lower()


def pins(name: str) -> dict[str, str]:
    lines = (ROOT / "requirements" / f"{name}.txt").read_text().splitlines()
    entries = [line.split("#")[0].strip() for line in lines]
    return {name_of(entry): entry for entry in entries if entry}


RUNTIME = {**pins("runtime"), **pins("postgres"), **pins("terrain")}
EVERYTHING = {**RUNTIME, **pins("train"), **pins("dev")}


def test_every_requirement_is_pinned_to_one_version() -> None:
    assert all(re.fullmatch(r"[A-Za-z0-9._-]+==[^=<>~* ]+", entry) for entry in EVERYTHING.values())


def test_every_declared_dependency_has_its_pin() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert {name_of(text) for text in project["dependencies"]} <= set(pins("runtime"))
    extras = project["optional-dependencies"]
    for extra, file in (("terrain", "terrain"), ("postgres", "postgres"), ("docs", "docs")):
        known = {**pins("runtime"), **pins(file)}
        assert {name_of(text) for text in extras[extra]} <= set(known)


@pytest.mark.parametrize("name", sorted(RUNTIME))
def test_what_runs_is_what_was_pinned_and_may_be_carried(name: str) -> None:
    found = metadata.distribution(name)
    assert RUNTIME[name].endswith(f"=={found.version}")
    about = found.metadata
    told = [about.get("License-Expression") or "", (about.get("License") or "")[:200]]
    told += [line for line in about.get_all("Classifier") or [] if line.startswith("License")]
    copyleft = [text for text in told if COPYLEFT.search(text) and not WEAK.search(text)]
    assert not copyleft, f"{name}: {copyleft}"
