"""Comparison of the closing figures of two mission runs."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import pytest

from linna import cli
from studies.mission_run.comparison import OF_PROCESSES, compare_reports, largest_relative

REPORT: dict[str, Any] = {
    "scenario": "selenita",
    "days": 1.0,
    "windows": {"requested": 2, "failed": 0},
    "packets": 3093,
    "navigation": {"anchored": {"passes": 2.0, "median_m": 112.192621}},
    "detector": {"recall": 0.5},
    "performance": {
        "passes": [{"pass_id": 1, "recall": 0.54, "groups": []}, {"pass_id": 2, "recall": float("nan")}]
    },
    "alerts": 0,
    "alarms": [],
    "interventions": 0,
    "interventions_list": [],
    "starts": 1,
    "wall_s": 286.1,
    "form": "distributed",
}


def changed(**values: Any) -> dict[str, Any]:
    return {**copy.deepcopy(REPORT), **values}


def test_figures_of_processes_and_the_wall_clock_are_not_compared() -> None:
    other = changed(starts=2, wall_s=1.0, kills={"done": 3})
    assert {"starts", "wall_s", "kills"} <= OF_PROCESSES
    values, differences = compare_reports(REPORT, other)
    assert differences == [] and values == 13


def test_a_pass_is_the_same_whatever_number_a_database_gave_it() -> None:
    rows = copy.deepcopy(REPORT["performance"])
    rows["passes"][0]["pass_id"] = 34
    assert compare_reports(REPORT, changed(performance=rows))[1] == []


@pytest.mark.parametrize(
    ("changes", "largest"),
    [
        ({}, 0.0),
        ({"detector": {"recall": 0.4}}, 0.2),
        (
            {
                "detector": {"recall": 0.4},
                "navigation": {"anchored": {"passes": 1.0, "median_m": 112.192621}},
            },
            0.5,
        ),
        ({"detector": {"recall": 0.4}, "packets": 3092}, None),
        ({"detector": {"recall": float("nan")}}, None),
        ({"detector": {}}, None),
    ],
)
def test_the_largest_relative_difference_is_that_of_numbers_only(
    changes: dict[str, Any], largest: float | None
) -> None:
    found = largest_relative(compare_reports(REPORT, changed(**changes))[1])
    assert found == pytest.approx(largest) if largest is not None else found is None


@pytest.mark.parametrize(
    ("change", "figure", "first", "second"),
    [
        ({"packets": 3092}, "packets", 3093, 3092),
        ({"packets": 3093.0}, "packets", 3093, 3093.0),
        ({"interventions": 1}, "interventions", 0, 1),
        ({"windows": {"requested": 2}}, "windows.failed", 0, "missing"),
        ({"windows": {"requested": 2, "failed": 0, "lost": 1}}, "windows.lost", "missing", 1),
        (
            {"navigation": {"anchored": {"passes": 2.0, "median_m": 112.1926210000001}}},
            "navigation.anchored.median_m",
            112.192621,
            112.1926210000001,
        ),
        (
            {"performance": {"passes": [{"recall": 0.55, "groups": []}, {"recall": float("nan")}]}},
            "performance.passes[0].recall",
            0.54,
            0.55,
        ),
        (
            {"performance": {"passes": [{"recall": 0.54, "groups": ["x"]}, {"recall": float("nan")}]}},
            "performance.passes[0].groups",
            [],
            "missing",
        ),
    ],
)
def test_a_difference_in_any_other_figure_is_found(
    change: dict[str, Any], figure: str, first: Any, second: Any
) -> None:
    _, differences = compare_reports(REPORT, changed(**change))
    assert (differences[0].figure, differences[0].first, differences[0].second) == (figure, first, second)


def test_the_command_compares_folders_and_files_and_says_whether_they_are_identical(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, file = tmp_path / "a", tmp_path / "b.json"
    folder.mkdir()
    (folder / "report.json").write_text(json.dumps(REPORT))
    file.write_text(json.dumps(changed(wall_s=672.3, starts=2, kills={"done": 14})))
    assert cli.run(["mission", "compare", str(folder), str(file)]) == 0
    text = capsys.readouterr().out
    assert text.endswith("13 values compared, 0 differ\n")
    assert "anchored median_m" in text and "672.3" in text and 'kills of the second run: {"done": 14}' in text
    numbers = {"anchored": {"passes": 2.0, "median_m": 112.192733}}
    file.write_text(json.dumps(changed(navigation=numbers)))
    assert cli.run(["mission", "compare", str(folder), str(file)]) == 1
    end = "13 values compared, 1 differ, all of them numbers, by at most 1.0e-06 of their value\n"
    assert capsys.readouterr().out.endswith(end)
    file.write_text(json.dumps(changed(packets=1)))
    assert cli.run(["mission", "compare", str(folder), str(file), "--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert found["differences"] == [{"figure": "packets", "first": 3093, "second": 1}]


@pytest.mark.parametrize("content", [None, "", "[]", '{"scenario": "x"}'])
def test_a_file_that_is_no_closing_report_is_refused_in_one_line(
    content: str | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if content is not None:
        (tmp_path / "report.json").write_text(content)
    assert cli.run(["mission", "compare", str(tmp_path), str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "expected the closing report of a mission run" in error
