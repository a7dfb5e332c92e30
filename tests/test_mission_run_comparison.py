"""Comparison of the closing figures of two mission runs, and the judgement of memory in them."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import pytest

from linna import cli
from studies.mission_run.comparison import OF_PROCESSES, compare_reports, largest_relative
from studies.mission_run.processes import judged_memory

REPORT: dict[str, Any] = {
    "scenario": "selenita",
    "days": 1.0,
    "windows": {"requested": 2, "failed": 0},
    "packets": 3093,
    "navigation": {"anchored": {"passes": 2.0, "median_m": 112.192621}},
    "detector": {"recall": 0.5},
    "trend": [{"window": 1, "recall": 0.54, "not_met": []}, {"window": 2, "recall": float("nan")}],
    "interventions": 0,
    "interventions_list": [],
    "incidents": [],
    "starts": 1,
    "wall_s": 286.1,
    "cpu_s": {"api": 1.0},
    "memory_mib": {"api": {"first": 100.0, "flat": True}},
    "form": "distributed",
}


def changed(**values: Any) -> dict[str, Any]:
    return {**copy.deepcopy(REPORT), **values}


def test_figures_of_processes_and_the_wall_clock_are_not_compared() -> None:
    other = changed(
        starts=2, wall_s=1.0, cpu_s={}, memory_mib={}, incidents=[{"kind": "kill"}], kills={"done": 3}
    )
    assert {"starts", "wall_s", "cpu_s", "memory_mib", "incidents", "kills"} <= OF_PROCESSES
    values, differences = compare_reports(REPORT, other)
    assert differences == [] and values == 12


def test_a_window_is_the_same_whatever_number_a_database_gave_it() -> None:
    rows = copy.deepcopy(REPORT["trend"])
    rows[0]["window"] = 34
    assert compare_reports(REPORT, changed(trend=rows))[1] == []


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
            {"trend": [{"window": 1, "recall": 0.55, "not_met": []}, REPORT["trend"][1]]},
            "trend[0].recall",
            0.54,
            0.55,
        ),
        (
            {"trend": [{"window": 1, "recall": 0.54, "not_met": ["x"]}, REPORT["trend"][1]]},
            "trend[0].not_met",
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
    assert text.endswith("12 values compared, 0 differ\n")
    assert "anchored median_m" in text and "672.3" in text and 'kills of the second run: {"done": 14}' in text
    numbers = {"anchored": {"passes": 2.0, "median_m": 112.192733}}
    file.write_text(json.dumps(changed(navigation=numbers)))
    assert cli.run(["mission", "compare", str(folder), str(file)]) == 1
    end = "12 values compared, 1 differ, all of them numbers, by at most 1.0e-06 of their value\n"
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


def series(slope: float, process: int, start: float, level: float = 100.0) -> tuple[list[float], list[Any]]:
    days = [start + k / 4 for k in range(24)]
    # Much memory is taken in the first day of a process.
    return [level + slope * (day - start) + 50.0 * (day - start < 1.0) for day in days], [
        (day, process) for day in days
    ]


def test_memory_that_grows_within_each_life_of_a_process_is_not_flat() -> None:
    first, lives = series(5.0, 1, 0.0)
    second, later = series(5.0, 2, 6.0)
    found = judged_memory([*first, *second], [*lives, *later])
    assert found["slope_per_day"] == pytest.approx(5.0) and found["restarts"] == 1
    assert found["last_third"] == pytest.approx(found["first_third"], abs=15.0) and found["flat"] is False


def test_memory_that_starts_higher_after_each_restart_is_not_flat() -> None:
    first, lives = series(0.0, 1, 0.0)
    second, later = series(0.0, 2, 6.0, 130.0)
    found = judged_memory([*first, *second], [*lives, *later])
    assert found["slope_per_day"] == pytest.approx(0.0) and found["flat"] is False
    assert (found["first_third"], found["last_third"]) == (100.0, 130.0)


def test_constant_memory_is_flat_without_the_first_day_of_each_process() -> None:
    first, lives = series(0.0, 1, 0.0)
    second, later = series(0.0, 2, 6.0)
    found = judged_memory([*first, *second], [*lives, *later])
    assert found == {
        "first": 150.0, "peak": 150.0, "last": 100.0, "restarts": 1, "first_third": 100.0, "last_third": 100.0,
        "slope_per_day": 0.0, "flat": True,
    }  # fmt: skip


def test_memory_of_a_short_run_is_not_judged() -> None:
    found = judged_memory([1.0] * 8, [(float(k), 1) for k in range(8)])
    assert found["flat"] is None and found["peak"] == 1.0 and found["slope_per_day"] is None
    assert judged_memory([], [])["flat"] is None and judged_memory([], [])["first"] is None
    # Kills of every half a day leave no sample after the first day of a process.
    assert judged_memory([1.0] * 40, [(k / 4, k // 2) for k in range(40)])["flat"] is None
