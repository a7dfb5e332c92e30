"""The gate of this project's own payload: its network and parameters pass a small suite, an untrained network does not.

The passes are made here, on the procedural Moon (level 2): a few frames in the light of the paper, and with the faults
of the shipped suite.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from linna import cli
from lunar.datafolder import DataFolder
from payload_emulator.flight.models import load_shipped_model
from payload_emulator.session.suite import SUITE, suite_scenarios, write_suite

FRAMES = 8

pytestmark = pytest.mark.timeout(1200)
"""A confined build compiles its kernels in every run, since nothing that it writes is kept."""


@pytest.fixture(scope="module")
def suite(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("suite")
    chosen = [str(SUITE / f"{name}.toml") for name in ("paper-light", "faults")]
    write_suite(suite_scenarios(chosen, frames=FRAMES), DataFolder(), folder)
    return folder


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("service")


def untrained(folder: Path) -> Path:
    """A build whose network has the shipped one's shape and newly drawn weights, as a training starts from."""
    import onnx
    from onnx import numpy_helper

    model = onnx.load_from_string(load_shipped_model())
    rng = np.random.default_rng(1)
    for tensor in model.graph.initializer:
        weights = numpy_helper.to_array(tensor)
        if weights.dtype == np.float32 and weights.ndim == 4:
            drawn = weights.std() * rng.standard_normal(weights.shape)
            tensor.CopyFrom(numpy_helper.from_array(drawn.astype(np.float32), tensor.name))
    folder.mkdir()
    (folder / "untrained.onnx").write_bytes(model.SerializeToString())
    (folder / "build.toml").write_text('schema_version = 1\nname = "untrained"\nmodel = "untrained.onnx"\n')
    return folder / "build.toml"


def regress(
    suite: Path, home: Path, build: str, capsys: pytest.CaptureFixture[str], *more: str
) -> tuple[int, dict]:
    status = cli.run(
        ["regress", "run", "--archive", str(suite), "--build", build, "--home", str(home), "--json", *more]
    )
    return status, json.loads(capsys.readouterr().out)


def test_the_shipped_network_and_parameters_pass_their_own_suite(suite, home, capsys, tmp_path: Path) -> None:
    status, figures = regress(
        suite,
        home,
        "current",
        capsys,
        "--junit",
        str(tmp_path / "j.xml"),
        "--report",
        str(tmp_path / "r.html"),
    )
    assert (status, figures["verdict"]) == (0, "pass"), figures
    gates = {gate["name"]: gate for gate in figures["gates"] if gate["pass"] is None}
    # Far below what it does on this Moon (recall 0.6, 35 m): a suite on which nothing is seen would gate nothing.
    assert gates["detector.recall"]["baseline"] > 0.4
    assert gates["detector.precision"]["baseline"] > 0.6
    assert gates["navigation.anchored.p50"]["baseline"] < 300.0
    assert gates["telemetry.undecodable"]["baseline"] == 0
    assert [one["frames"] for one in figures["passes"]] == [FRAMES, FRAMES]
    assert (tmp_path / "j.xml").read_text().startswith("<?xml")
    assert "Regression report" in (tmp_path / "r.html").read_text()


def test_an_untrained_network_fails_for_what_it_takes_for_craters(
    suite, home, capsys, tmp_path: Path
) -> None:
    status, figures = regress(suite, home, str(untrained(tmp_path / "untrained")), capsys)
    assert (status, figures["verdict"]) == (1, "fail")
    failed = {gate["name"] for gate in figures["gates"] if gate["outcome"] == "fail"}
    assert {"detector.precision", "navigation.anchored.fixes"} <= failed
    assert "telemetry.undecodable" not in failed
    assert all(one["state"] == "judged" for one in figures["passes"])


def test_bisecting_names_the_parameter_that_moved_a_figure(suite, home, capsys, tmp_path: Path) -> None:
    """Three parameters are changed, one of which decides what is detected."""
    (tmp_path / "good.toml").write_text('name = "good"\n')
    (tmp_path / "bad.toml").write_text('name = "bad"\nparameters = "p.toml"\n')
    (tmp_path / "p.toml").write_text(
        "detector.score_threshold = 0.9\nflight.housekeeping_interval_s = 30.0\nflight.odometry.time_gap_s = 61.0\n"
    )
    builds = ("--good", str(tmp_path / "good.toml"), "--bad", str(tmp_path / "bad.toml"))
    archive = str(suite / "suite-paper-light")
    options = ("--figure", "detector.recall", "--home", str(home), "--json")
    status = cli.run(["regress", "bisect", "--archive", archive, *builds, *options])
    found = json.loads(capsys.readouterr().out)
    assert status == 0
    assert len(found["changes"]) == 3
    assert [item["changes"] for item in found["culprits"]] == [["detector.score_threshold"]]
    assert found["bad"] == found["culprits"][0]["value"] < found["good"]
    same = ("--good", str(tmp_path / "good.toml"), "--bad", str(tmp_path / "good.toml"))
    assert (
        cli.run(["regress", "bisect", "--archive", archive, *same, "--figure", "x", "--home", str(home)]) == 2
    )
    assert "expected two that differ in model or parameters" in capsys.readouterr().err
