"""Verdicts in lists: names of builds, and why the verdict is not pass."""

from typing import Any

import pytest

from ground_service.http.times import UtcTime
from ground_service.regression.model import REASONS_LIMIT, JudgedGate, Regression, Verdict

BUILD = {"version": "1.2", "digest": "ab" * 32, "flight_code": None, "provenance": {}}
POLICY = {"version": "1", "sha256": "00", "confidence": 0.95, "power": 0.8}  # of an earlier version


def gate(name: str, outcome: str, **values: Any) -> JudgedGate:
    known = {
        "pass_name": None,
        "passed": outcome == "pass",
        "baseline": 0.9,
        "candidate": 0.7,
        "margin": None,
        "limit": 0.05,
        "unit": "",
        "change_bounds": (None, None),
        "p_value": None,
        "level": None,
        "resolution": None,
        "frames": 10,
        "frames_needed": None,
        "reason": None,
    }
    return JudgedGate(name=name, outcome=outcome, **known | values)


def regression(verdict: str, gates: list[JudgedGate], **values: Any) -> Regression:
    result = Verdict(
        verdict=verdict,
        baseline={"name": "old", **BUILD},
        candidate={"name": "new", **BUILD},
        policy=POLICY,
        headline=f"{verdict}: no loss",
        frames=10,
        frames_needed=None,
        gates=gates,
        passes=values.get("passes", []),
        remarks=["builds were isolated"],
    )
    return Regression(id="1", verdict=verdict, created=UtcTime(0), result=result)


def test_a_list_names_builds_and_not_only_their_hashes() -> None:
    summary = regression("pass", [gate("recall", "pass")]).summary()
    assert summary.candidate_title == "new 1.2 (abababababab)"
    assert summary.baseline_title == "old 1.2 (abababababab)"
    assert (summary.reasons, summary.headline) == ([], "pass: no loss")


def test_a_gate_that_was_waived_in_an_earlier_verdict_does_not_count() -> None:
    found = regression("pass", [gate("other", "fail", waived="known"), gate("recall", "pass", waived=None)])
    assert found.result.gates[0].text == "other: waived: known"
    assert found.summary().gates_failed == 0


def test_reasons_are_failed_gates_then_open_ones_then_passes_without_a_comparison() -> None:
    open_gate = gate("drift", "inconclusive", reason="too few frames")
    failed = gate("recall", "fail", pass_name="pass 1", unit="m")
    lost = {"name": "pass 2", "archive": "x", "state": "candidate failed", "detail": "exit status 4"}
    found = regression("fail", [open_gate, failed], passes=[lost])
    assert found.summary().reasons == [
        "recall on pass 1: 0.9 to 0.7 m",
        "drift: 0.9 to 0.7, too few frames",
        "pass 2: exit status 4",
    ]


@pytest.mark.parametrize("candidate", [None, 0.7])
def test_a_gate_without_figures_states_its_reason_or_outcome(candidate: float | None) -> None:
    text = gate("recall", "fail", candidate=candidate, limit=None, reason="no detections").text
    assert text == ("recall: no detections" if candidate is None else "recall: 0.9 to 0.7, no detections")


def test_a_list_has_the_first_reasons_only() -> None:
    gates = [gate(f"gate {k}", "fail") for k in range(9)]
    assert len(regression("fail", gates).summary().reasons) == REASONS_LIMIT
