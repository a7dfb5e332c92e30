"""The table of sessions shows what the summaries say, and refuses what is none."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from payload_emulator.errors import RecordError
from studies.navigation_table import format_markdown, format_text, load_row


def _summary(**changes: Any) -> dict[str, Any]:
    errors = {"count": 100, "median_m": 41.2, "p95_m": 83.0, "max_m": 1204.0}
    navigation = {
        "counted_from": "third arc",
        "imaging": errors,
        "end_of_coast": {"count": 0, "median_m": None, "p95_m": None, "max_m": None},
        "propagate_only": errors | {"median_m": 14_834.0},
        "velocity_p95_m_s": 0.246,
        "bias_rtn_m": [-7.7, 1.0, 2.0],
        "nees6": 5.44,
        "nis_per_degree": 0.98,
        "fixed_share_imaging": 0.982,
        "wrong_fixes": 0,
        "recovery": {"after": "silent kidnap", "frames_with_image": 60, "frames_until_below_500_m": 5},
    }
    return {
        "scenario": "kidnapped-silently",
        "seed": 2034,
        "frames": 165,
        "altitude_km": {"min": 18.7, "mean": 31.3, "max": 43.1},
        "data": ["procedural Moon, seed 2034", "gravity GRGM660PRIM to degree 100"],
        "truth_reads_after_start": 0,
        "navigation": navigation,
    } | changes


def _archive(folder: Path, summary: dict[str, Any], evidence: str = 'world = "procedural"') -> Path:
    folder.mkdir()
    if evidence:
        (folder / "mission.toml").write_text(f"schema_version = 1\n[evidence]\n{evidence}\n")
    (folder / "summary.json").write_text(json.dumps(summary))
    return folder


def test_a_row_has_the_altitude_the_level_and_the_figures_of_its_summary(tmp_path: Path) -> None:
    row = load_row(_archive(tmp_path / "a", _summary()))
    assert (row.level, row.altitude_km, row.recovery_frames) == ("2", (18.7, 31.3, 43.1), 5)
    line = format_markdown([row]).splitlines()[2]
    assert line == (
        "| kidnapped-silently | 2034 | 2 | 31 (19 to 43) | 165 | 41 | 83 | 1,204 |  | 0.25 | 98.2 % | 0 | 5.4 | 0.98 "
        "| -8 | 14,834 | 5 frames | 0 |"
    )
    assert "| 1 frame |" in format_markdown([replace(row, recovery_frames=1)])


@pytest.mark.parametrize(
    ("evidence", "level", "cell"),
    [
        ('world = "procedural"', "2", "2"),
        ('world = "real-terrain"\nunseen_share = 1.0', "3", "3"),
        ('world = "real-terrain"\nunseen_share = 0.29', "3s", "3s, 29 % of frames unseen"),
        ('world = "real-terrain"\nunseen_share = 0.0', "3s", "3s, 0 % of frames unseen"),
        ('world = "real-terrain"', "", "not stated"),
        ("", "", "not stated"),
    ],
)
def test_the_level_is_that_of_the_declared_world(
    tmp_path: Path, evidence: str, level: str, cell: str
) -> None:
    # The names of the data do not decide: they say "procedural" in every case.
    row = load_row(_archive(tmp_path / "a", _summary(), evidence))
    assert row.level == level
    assert format_markdown([row]).splitlines()[2].split(" | ")[2] == cell


def test_a_damaged_mission_description_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordError, match=r"mission\.toml: expected a mission description, found"):
        load_row(_archive(tmp_path / "a", _summary(), "world ="))


def test_the_columns_of_the_text_are_aligned(tmp_path: Path) -> None:
    rows = [load_row(_archive(tmp_path / name, _summary(scenario=name))) for name in ("a", "longer-name")]
    assert len({len(line) for line in format_text(rows).splitlines()}) == 1


def test_an_archive_without_the_anchored_estimator_is_refused_with_advice(tmp_path: Path) -> None:
    summary = _summary()
    del summary["navigation"]
    with pytest.raises(RecordError, match=r"summary\.json: expected .*--mode anchored"):
        load_row(_archive(tmp_path / "a", summary))
    with pytest.raises(RecordError, match=r"expected the summary of a pass archive, found"):
        load_row(tmp_path / "nothing")
