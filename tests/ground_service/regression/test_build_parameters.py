"""Parameters of builds on the flight code are checked in the sandbox before registration."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from ground_service.errors import BuildNotChecked, InvalidInput
from ground_service.ground import Ground, open_ground
from ground_service.http.model import Paging
from ground_service.regression import builds
from ground_service.regression.builds import load_build, register_build
from ground_service.regression.sandbox.host import SandboxRefused
from ground_service.regression.store import list_builds
from linna.cli import run as run_command


@pytest.fixture
def home(tmp_path: Path) -> Ground:
    return open_ground(tmp_path / "home")


@pytest.fixture
def write(tmp_path: Path) -> Callable[[str], str]:
    def build(parameters: str) -> str:
        (tmp_path / "p.toml").write_text(parameters)
        (tmp_path / "build.toml").write_text('name = "b"\nparameters = "p.toml"\n')
        return str(tmp_path / "build.toml")

    return build


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (
            "flight.anchored.gravity_degre = 60",
            "p.toml, flight.anchored.gravity_degre: expected gravity_degree (nearest known key), "
            "found an unknown key",
        ),
        (
            "detector.score_threshold = 7.0",
            "p.toml, detector.score_threshold: expected a finite number from 0 to 1, found 7.0",
        ),
    ],
)
def test_a_wrong_parameter_is_refused_in_one_line_and_nothing_is_registered(
    home: Ground, write: Callable[[str], str], text: str, told: str
) -> None:
    with pytest.raises(InvalidInput) as error:
        register_build(home, load_build(write(text)))
    assert str(error.value) == told
    assert home.read(list_builds, Paging()).items == []
    assert not list((home.home / "regression" / "builds").glob("*"))


def test_right_parameters_are_registered_and_checked_once(
    home: Ground, write: Callable[[str], str], monkeypatch: pytest.MonkeyPatch
) -> None:
    file = write("flight.anchored.gravity_degree = 60")
    first = register_build(home, load_build(file))
    assert [one.digest for one in home.read(list_builds, Paging()).items] == [first.digest]
    monkeypatch.setattr(builds, "run_confined", None)
    assert register_build(home, load_build(file)).digest == first.digest


def _refused(*_: Any, **__: Any) -> dict[str, Any]:
    raise SandboxRefused("no user namespaces")


def _ended(**changes: Any) -> Callable[..., dict[str, Any]]:
    def run(request: Any, staged: Path, written: Path, printed: Path, **_: Any) -> dict[str, Any]:
        printed.write_text("Traceback\nMemoryError\n")
        return {"cause": "", "exit_status": 0} | changes

    return run


@pytest.mark.parametrize(
    ("run", "told"),
    [
        (_refused, "no user namespaces"),
        (_ended(exit_status=1), "status 1: MemoryError"),
        (_ended(exit_status=2), "status 2: MemoryError"),
        (_ended(exit_status=137), "status 137"),
        (_ended(cause="timeout"), "ended with timeout"),
    ],
)
def test_a_build_that_cannot_be_checked_is_not_registered(
    home: Ground,
    write: Callable[[str], str],
    monkeypatch: pytest.MonkeyPatch,
    run: Callable[..., dict[str, Any]],
    told: str,
) -> None:
    monkeypatch.setattr(builds, "run_confined", run)
    with pytest.raises(BuildNotChecked, match=told):
        register_build(home, load_build(write("flight.anchored.gravity_degree = 60")))
    assert home.read(list_builds, Paging()).items == []


def test_the_command_checks_a_build_file(
    write: Callable[[str], str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_command(["replay", "--check-build", write("detector.max_detection = 3")]) == 2
    assert "expected max_detections (nearest known key), found an unknown key" in capsys.readouterr().out
    file = write("detector.max_detections = 3")
    assert run_command(["replay", "--check-build", file]) == 0
    text = Path(file).read_text()
    for wrong, told in (("schema_version = 7", "expected 1, found 7"), ("modle = 'x'", "expected 'model'")):
        Path(file).write_text(f"{wrong}\n{text.replace('schema_version = 1', '')}")
        capsys.readouterr()
        assert run_command(["replay", "--check-build", file]) == 2
        assert told in capsys.readouterr().out
    assert run_command(["replay", "--out", "x"]) == 2
    assert "expected ARCHIVE, or --check-build BUILD" in capsys.readouterr().err
