"""The closing report of a mission run: verdict, unknown values and what is absent."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from reports.document import Absent, Cell, Facts, Paragraph, Picture, Table, Verdict
from studies.mission_run.document import mission_document, save_document

TREND = [
    {
        "window": 1, "start": "2029-08-07T01:01:48.75Z", "state": "processed", "contacts_to_processed": 1, "frames": 33,
        "packets_lost": 0, "verdict": "met", "recall": 0.5, "median_m": {"anchored": 90.0},
        "drift_percent": {"anchored": 0.01}, "nees_inside_percent": None, "not_met": ["consistency.nis"], "lacks": {},
        "evidence": "2",
    },
    {"window": 2, "start": "2029-08-07T03:00:00Z", "state": "failed", "contacts_to_processed": None},
]  # fmt: skip
MEMORY = {
    "first": 100.0, "peak": 120.0, "last": 110.0, "restarts": 1, "first_third": None, "last_third": None,
    "slope_per_day": None, "flat": None,
}  # fmt: skip


def figures(**changes: Any) -> dict[str, Any]:
    """Closing figures of two windows, of which one has failed."""
    return {
        "scenario": "small", "days": 0.5, "end": "2029-08-07T12:00:00Z", "form": "embedded",
        "windows": {
            "requested": 2, "flown": 1, "processed": 1, "failed": 1, "processed_after_contacts": {"1": 1, "unknown": 1},
        },
        "frames": 33, "frames_received": 33, "reports_without_frames": 0, "packets": 10, "packets_lost_on_link": 0,
        "packets_received": 10, "packets_lost": 0, "packets_lost_of_passes": 0, "reports": 1, "reports_complete": 1,
        "reports_lack": {}, "evidence": {"2": 1}, "time_correlation": {}, "interventions": 0, "interventions_list": [],
        "navigation": {"anchored": {"passes": 1.0, "median_m": 90.0, "p95_m": None, "drift_percent": 0.01}},
        "detector": {"recall": 0.5, "precision": None}, "nees_inside_percent": None,
        "requirements": {
            "a": {"met": 2}, "b": {"met": 1, "unknown": 1}, "c": {"met": 1, "not met": 1}, "d": {"not judged": 2},
        },
        "verdicts": {"met": 1}, "trends": {}, "trend": TREND, "contacts": 3, "telecommands": 8,
        "telecommand_octets_lost": 0, "spacecraft_resets": 0, "starts": 1, "incidents": [],
        "memory_mib": {"ground": MEMORY}, "memory_series_mib": {"ground": [100.0, 120.0, 110.0]},
        "memory_lives": {"ground": [[0.1, 7], [0.2, 7], [0.3, 9]]}, "cpu_s": {"ground": 12.0}, "wall_s": 20.0,
        **changes,
    }  # fmt: skip


def table(given: dict[str, Any], caption: str) -> Table:
    (found,) = [
        one
        for one in mission_document(given).blocks
        if isinstance(one, Table) and one.caption.startswith(caption)
    ]
    return found


@pytest.mark.parametrize(
    ("changes", "level"),
    [
        ({}, "met"),
        ({"interventions": 1}, "partly met"),
        ({"verdicts": {"not met": 1}}, "partly met"),
        ({"verdicts": {"met": 1, "unknown": 1}}, "partly met"),
        ({"reports_complete": 0}, "partly met"),
        ({"packets_lost": 1}, "not met"),
        ({"windows": {**figures()["windows"], "flown": 2}}, "not met"),
        ({"windows": {**figures()["windows"], "flown": 0, "processed": 0}}, "not met"),
    ],
)
def test_the_verdict_is_good_only_if_all_is_known_to_be_good(changes: dict[str, Any], level: str) -> None:
    verdict = mission_document(figures(**changes)).blocks[0]
    assert isinstance(verdict, Verdict) and verdict.level == level


def test_a_requirement_with_unknown_passes_is_not_shown_as_met() -> None:
    rows = table(figures(), "Requirements").rows
    assert [row[0].swatch for row in rows if isinstance(row[0], Cell)] == [
        "green",
        "orange",
        "vermillion",
        "",
    ]
    assert [row[1:] for row in rows][1] == ("1", "0", "1", "0")


def test_unknown_values_are_dashes_and_what_is_missing_is_named(tmp_path: Path) -> None:
    given = figures()
    first, second = table(given, "Windows").rows
    assert first[3:9] == ("1", "33", "0", "90", "0.50", "–")
    assert second[2:] == ("failed", *["–"] * 8)
    assert table(given, "Processes").rows[0][-2:] == ("unknown", "12")
    missing = {one.what for one in mission_document(given).blocks if isinstance(one, Absent)}
    assert missing == {"Trends over the passes", "On-board time to UTC, in force"}
    assert mission_document(given).blocks[-1] == Paragraph("None.")
    facts = [pair for one in mission_document(given).blocks if isinstance(one, Facts) for pair in one.pairs]
    assert ("Precision, median", "–") in facts
    save_document(given, tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert page.count("<figure") == 2 and "small, 0.5 days" in page


def test_a_run_without_windows_and_samples_has_a_report(tmp_path: Path) -> None:
    empty = {"memory_mib": {}, "memory_series_mib": {}, "memory_lives": {}, "cpu_s": {}}
    given = figures(trend=[], navigation={}, requirements={}, verdicts={}, evidence={}, **empty)
    assert not [one for one in mission_document(given).blocks if isinstance(one, Picture)]
    save_document(given, tmp_path / "report.html")


def test_kills_are_listed_with_their_recovery() -> None:
    kills = {
        "seed": 7, "planned": 3, "done": 2, "by_part": {"api": 1, "broker": 1}, "by_phase": {"ended": 2},
        "recovery_s": {"api": {"median": 7.7, "longest": 12.3}}, "ended_by_themselves": {},
    }  # fmt: skip
    rows = table(figures(kills=kills), "Kills").rows
    assert [row[1:] for row in rows] == [("1", "7.7", "12.3"), ("1", "–", "–")]
