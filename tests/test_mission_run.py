"""A simulated mission from end to end: spacecraft, stations, ground, reports; and what goes on after a stop."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from linna import cli
from lunar.datafolder import DataFolder
from payload_emulator.errors import ScenarioError
from payload_emulator.session.scenario import parse_scenario
from studies.mission_run.run import RunTerms, run_mission

SCENARIO = """
name = "six-hours"
seed = 3
[orbit]
epoch = "2029-08-07T00:00:00Z"
[dynamics]
gravity = "builtin"
degree = 8
[window]
search = "none"
duration_s = 60.0
[camera]
images = "reduced"
[terrain]
source = "procedural"
[navigation]
estimators = ["spherical"]
"""


def test_six_hours_are_planned_flown_received_and_reported_without_a_person(tmp_path: Path) -> None:
    terms = RunTerms(days=0.25, windows_per_day=1, window_s=600.0)
    said: list[str] = []
    figures = run_mission(parse_scenario(SCENARIO), DataFolder(None), tmp_path, terms, said.append)
    windows = figures["windows"]
    assert windows["requested"] == 2  # one on each of two days
    assert windows["flown"] >= 1 and windows["failed"] == 0
    assert windows["processed"] == windows["flown"] == figures["reports"]
    assert figures["packets_lost"] == 0 and figures["interventions"] == 0
    flown = [row for row in figures["trend"] if row["state"] == "processed"]
    assert all(38 <= row["frames"] <= 42 for row in flown)  # 600 s / 15 s
    assert figures["frames"] == sum(row["frames"] for row in flown)
    assert json.loads((tmp_path / "report.json").read_text())["windows"] == windows
    assert "six-hours" in (tmp_path / "report.html").read_text()
    # The same again prints the figures of the run that has ended; other terms need another folder.
    again = run_mission(parse_scenario(SCENARIO), DataFolder(None), tmp_path, terms, said.append)
    assert again["windows"] == windows and "this run has ended" in said[-1]
    with pytest.raises(ScenarioError, match="expected a new folder, or the same scenario and options"):
        run_mission(
            parse_scenario(SCENARIO), DataFolder(None), tmp_path, replace(terms, days=0.5), said.append
        )


@pytest.mark.parametrize("words", [["--speed", "0"], ["--speed", "quick"], ["--window-min", "0.1"]])
def test_impossible_options_are_refused_in_one_line(
    words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.run(["mission", "run", "selenita", "--days", "1", *words]) == 2
    assert capsys.readouterr().err.count("\n") == 1
