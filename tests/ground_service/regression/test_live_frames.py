"""A live pass with the declared world: planned over the API, flown, received over TCP, kept, rendered and judged."""

from __future__ import annotations

from pathlib import Path

import pytest

from ground_service.ground import open_ground
from ground_service.regression.archives import kept_archives
from ground_service.regression.builds import CURRENT, load_build, register_build
from ground_service.regression.gates.policy import load_policy
from ground_service.regression.pass_archives import keep_pass
from ground_service.regression.rendering import settle_archive
from ground_service.regression.service import run_regression
from lunar.datafolder import DataFolder
from payload_emulator.session.scenario import parse_scenario
from studies.mission_run.run import RunTerms, run_mission
from tests.test_mission_run import SCENARIO

DATA = DataFolder(None)
TERMS = RunTerms(days=0.3, windows_per_day=1, window_s=180.0)
WORLD = SCENARIO.replace('images = "reduced"', "").replace("degree = 8", 'degree = 8\norientation = "iau"')


def build_with(folder: Path, parameters: str) -> str:
    folder.mkdir()
    (folder / "parameters.toml").write_text(parameters)
    (folder / "build.toml").write_text(
        'schema_version = 1\nname = "candidate"\nversion = "1"\nparameters = "parameters.toml"\n'
    )
    return str(folder / "build.toml")


@pytest.mark.campaign
@pytest.mark.timeout(600)
def test_builds_are_judged_on_the_frames_of_a_live_pass(tmp_path: Path) -> None:
    figures = run_mission(parse_scenario(WORLD), DATA, tmp_path / "mission", TERMS, print)
    assert figures["windows"]["processed"] == 1 and figures["packets_lost"] == 0
    with open_ground(tmp_path / "mission" / "ground", DATA) as ground:
        [kept] = kept_archives(ground)
        assert (kept.state, kept.reason, kept.frames_stored) == ("to render", "", 0)
        assert kept.frames >= 10
        digest = kept.digest
        assert keep_pass(ground, kept.pass_id or 0).digest == digest
        current = load_build(CURRENT)
        good = run_regression(ground, [digest], current, current, load_policy())
        kept = settle_archive(ground, digest)
        assert (kept.digest, kept.state, kept.frames) == (digest, "complete", kept.frames_stored)
        assert [one.state for one in good.passes] == ["judged"] and good.verdict == "pass"
        assert any(gate.name.startswith("detector.") for gate in good.gates)
        blind = register_build(
            ground, load_build(build_with(tmp_path / "blind", "detector.score_threshold = 0.999\n"))
        )
        bad = run_regression(ground, [digest], blind, current, load_policy())
        assert bad.verdict == "fail"
        failed = [gate.name for gate in bad.gates if gate.outcome == "fail"]
        assert any(name.startswith("detector.") for name in failed), failed
        # The frames belong to the received data: keeping the pass again changes nothing.
        assert keep_pass(ground, kept.pass_id or 0) == settle_archive(ground, digest)
