"""Gates on simulated frames of known recall, bias, error and cost: what they let through and what they stop."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from benchmarks.gate_error_rates import degraded, outcomes, simulated, suite
from ground_service.regression.gates.core import (
    Gate,
    GatePolicy,
    GateRule,
    Waiver,
    judge,
    metric_interval,
    rule_of,
    verdict_of,
)
from ground_service.regression.gates.metrics import Percentile, Ratio
from ground_service.regression.gates.samples import EstimatorFrames, PassFrames

POLICY = GatePolicy(
    version="test",
    confidence=0.99,
    power=0.9,
    resamples=200,
    rules=(
        GateRule("detector.recall", 0.003, pass_margin=0.003),
        GateRule("detector.precision", 0.005),
        GateRule("detector.localisation", 0.05),
        GateRule("detector.bias", 0.12, pass_margin=0.12),
        GateRule("navigation.*.p50", 0.1),
        GateRule("navigation.*.p95", 0.15, pass_margin=0.15),
        GateRule("navigation.*.squared_normalised_error", 0.25),
        GateRule("navigation.*.fixes", 0.01),
        GateRule("navigation.*.wrong_fixes", 0.0),
        GateRule("latency.*", 0.1),
        GateRule("telemetry.*", 0.05),
        GateRule("telemetry.undecodable", 0.0),
        GateRule("memory", 0.1),
    ),
)


def failed(gates: list[Gate]) -> set[str]:
    return {gate.name for gate in gates if gate.outcome == "fail" and not gate.waived}


@pytest.fixture(scope="module")
def noisy() -> list[dict[str, PassFrames]]:
    """The same build under some noises."""
    return [suite(noise) for noise in range(10)]


def test_the_same_build_under_another_noise_fails_in_one_run_of_a_hundred_at_most() -> None:
    """210 pairs of 21 runs that differ by noise alone; passes as short as those of a small suite, the hardest case."""
    noises = [suite(noise, frames=40) for noise in range(21)]
    policy = replace(POLICY, resamples=100)
    wrong = [
        failed(judge(first, second, policy)) for i, first in enumerate(noises) for second in noises[i + 1 :]
    ]
    assert len(wrong) == 210
    assert sum(bool(names) for names in wrong) <= 2, [names for names in wrong if names]


def test_a_loss_of_two_points_of_recall_on_a_thousand_frames_is_caught_nine_times_in_ten(noisy) -> None:
    caught = [
        "detector.recall" in failed(judge(before, suite(100 + i, recall=0.68), POLICY))
        for i, before in enumerate(noisy)
    ]
    assert np.mean(caught) >= 0.9


def test_a_loss_of_one_point_of_recall_does_not_pass_either(noisy) -> None:
    caught = [
        "detector.recall" in failed(judge(before, suite(200 + i, recall=0.69), POLICY))
        for i, before in enumerate(noisy[:5])
    ]
    assert np.mean(caught) >= 0.6


def test_a_bias_of_three_tenths_of_a_pixel_is_caught_as_a_bias(noisy) -> None:
    for i, before in enumerate(noisy[:3]):
        names = failed(judge(before, suite(300 + i, bias_px=0.3), POLICY))
        assert "detector.bias" in names
        assert "detector.recall" not in names


def test_a_bias_that_goes_away_is_no_worsening(noisy) -> None:
    assert "detector.bias" not in failed(judge(suite(1, bias_px=0.3), noisy[0], POLICY))


def test_a_detector_slower_by_a_fifth_is_caught_and_by_a_twentieth_is_not(noisy) -> None:
    assert failed(judge(noisy[0], suite(400, slow=1.2), POLICY)) == {"latency.network"}
    assert failed(judge(noisy[0], suite(401, slow=1.05), POLICY)) == set()


def test_errors_half_as_large_again_fail_the_navigation(noisy) -> None:
    names = failed(judge(noisy[0], suite(500, error=1.5), POLICY))
    assert {"navigation.anchored.p50", "navigation.anchored.p95"} <= names
    assert not any(name.startswith("detector") for name in names)


def test_a_build_that_fails_on_one_pass_alone_fails_there(noisy) -> None:
    after = suite(600)
    after["pass 3"] = simulated(3, 600, recall=0.62)
    gates = judge(noisy[0], after, POLICY)
    assert {gate.pass_name for gate in gates if gate.name == "detector.recall" and not gate.passed} >= {
        "pass 3"
    }


def test_the_same_octets_pass_every_gate_and_give_no_change(noisy) -> None:
    gates = judge(noisy[0], noisy[0], POLICY)
    assert failed(gates) == set()
    assert all(gate.baseline == gate.candidate for gate in gates)


def test_the_limit_is_the_baseline_degraded_by_the_margin(noisy) -> None:
    gates = {gate.name: gate for gate in judge(noisy[0], suite(700), POLICY) if not gate.pass_name}
    assert gates["detector.recall"].limit == pytest.approx(gates["detector.recall"].baseline - 0.003)
    assert gates["navigation.anchored.p50"].limit == pytest.approx(
        1.1 * gates["navigation.anchored.p50"].baseline
    )
    assert gates["navigation.anchored.wrong_fixes"].limit == 0.0
    assert gates["memory"].limit == pytest.approx(275.0)


def test_the_outcome_follows_from_the_bounds_the_margin_and_the_resolution(noisy) -> None:
    seen = set()
    for candidate in (suite(700), suite(701, recall=0.66, slow=1.3, error=1.4)):
        for gate in judge(noisy[0], candidate, POLICY):
            if gate.name in ("memory", "telemetry.undecodable"):
                continue
            assert (gate.outcome == "fail") == (gate.p_value <= gate.level), gate
            if gate.outcome == "fail":
                assert gate.change_low > gate.margin, gate
            elif gate.outcome == "pass":
                assert gate.change_high <= gate.margin, gate
                assert gate.resolution <= gate.margin or gate.change_high <= 0.0, gate
            else:
                assert gate.resolution > gate.margin or gate.change_high > gate.margin, gate
                assert gate.frames_needed is None or gate.frames_needed > gate.frames, gate
            seen.add(gate.outcome)
    assert seen == {"pass", "fail", "inconclusive"}


def test_packets_that_cannot_be_decoded_fail_without_any_statistics(noisy) -> None:
    after = dict(noisy[0])
    after["pass 1"] = replace(after["pass 1"], undecodable=3)
    assert failed(judge(noisy[0], after, POLICY)) == {"telemetry.undecodable"}


def test_memory_beyond_the_margin_fails(noisy) -> None:
    after = {name: replace(frames, memory_mib=300.0) for name, frames in noisy[0].items()}
    assert failed(judge(noisy[0], after, POLICY)) == {"memory"}


def test_a_metric_that_the_candidate_does_not_give_fails(noisy) -> None:
    after = {name: replace(frames, estimators={}) for name, frames in noisy[0].items()}
    names = failed(judge(noisy[0], after, POLICY))
    assert {"navigation.anchored.p95", "navigation.anchored.fixes"} <= names
    assert not any(name.startswith("detector") for name in names)


def test_a_waiver_holds_to_its_last_day_and_for_its_gate(noisy) -> None:
    policy = replace(POLICY, waivers=(Waiver("latency.*", "new network, agreed", "2029-08-07"),))
    after = suite(800, slow=1.4)
    assert failed(judge(noisy[0], after, policy, today="2029-08-07")) == set()
    waived = [gate for gate in judge(noisy[0], after, policy, today="2029-08-07") if gate.waived]
    assert [(gate.name, gate.outcome) for gate in waived] == [("latency.network", "fail")]
    assert waived[0].waived == "new network, agreed (until 2029-08-07)"
    assert waived[0].counts_as_passed
    assert failed(judge(noisy[0], after, policy, today="2029-08-08")) == {"latency.network"}


SMALL = {"a": 12, "b": 12}
"""Two passes of twelve frames."""


def small(noise: int, **faults: float) -> dict[str, PassFrames]:
    return {
        name: simulated(scene, noise, frames, **faults) for scene, (name, frames) in enumerate(SMALL.items())
    }


def test_two_passes_of_twelve_frames_are_inconclusive_and_say_how_many_frames_are_needed() -> None:
    gates = judge(small(1), small(2), replace(POLICY, rules=(GateRule("detector.recall", 0.02),)))
    assert verdict_of(gates) == "inconclusive"
    (recall,) = gates
    assert (recall.outcome, recall.reason) == ("inconclusive", "the resolution exceeds the margin")
    assert recall.frames == 24
    assert recall.resolution > 0.02
    # About frames * (resolution / margin)^2; fewer, as t's quantiles fall with more degrees of freedom.
    assert recall.frames_needed is not None
    assert 24 < recall.frames_needed <= 24 * (recall.resolution / 0.02) ** 2


def test_the_number_of_frames_that_is_asked_for_resolves_the_margin() -> None:
    policy = replace(POLICY, rules=(GateRule("detector.recall", 0.02),))
    (few,) = judge(small(1), small(2), policy)
    assert few.frames_needed is not None
    needed = -(-few.frames_needed // 2)
    (enough,) = judge(suite(1, 2 * needed, 2), suite(2, 2 * needed, 2), policy)
    assert enough.frames == 4 * needed
    # Twice the number is granted: the spread that 24 frames show is itself uncertain by a third.
    assert enough.resolution <= 0.02
    assert enough.outcome == "pass"


def test_a_recall_that_falls_from_three_quarters_to_a_quarter_fails_on_two_passes_of_twelve_frames() -> None:
    for noise in range(10):
        gates = judge(small(noise, recall=0.733), small(100 + noise, recall=0.233), POLICY)
        assert "detector.recall" in failed(gates)
        assert verdict_of(gates) == "fail"


def test_without_passes_there_are_no_gates_and_no_pass() -> None:
    assert judge({}, {}, POLICY) == []
    assert verdict_of([]) == "inconclusive"


def gate(outcome: str, waived: str = "") -> Gate:
    return Gate("x", outcome, 1.0, 1.0, 0.1, 0.9, waived=waived)


@pytest.mark.parametrize(
    ("gates", "verdict"),
    [
        ([gate("pass")], "pass"),
        ([gate("pass"), gate("inconclusive")], "inconclusive"),
        ([gate("inconclusive"), gate("fail")], "fail"),
        ([gate("pass"), gate("fail", "agreed")], "pass"),
        ([gate("pass"), gate("inconclusive", "agreed")], "pass"),
        ([gate("inconclusive"), gate("fail", "agreed")], "inconclusive"),
    ],
)
def test_the_verdict_is_that_of_the_worst_gate_that_is_not_waived(gates: list[Gate], verdict: str) -> None:
    assert verdict_of(gates) == verdict


def outcome_of(gates: list[Gate], name: str) -> tuple[str, str]:
    return next((gate.outcome, gate.reason) for gate in gates if gate.name == name and not gate.pass_name)


def test_a_value_that_the_baseline_lacks_leaves_its_gate_open(noisy) -> None:
    before = {name: replace(frames, estimators={}) for name, frames in noisy[0].items()}
    gates = judge(before, suite(900), POLICY)
    assert outcome_of(gates, "navigation.anchored.p50") == (
        "inconclusive",
        "unknown: the baseline has no value",
    )
    assert verdict_of(gates) == "inconclusive"


def test_a_value_that_is_missing_on_some_frames_leaves_its_gate_open(noisy) -> None:
    def holed(frames: PassFrames) -> PassFrames:
        estimator = frames.estimators["anchored"]
        error = estimator.error_m.copy()
        error[:3] = np.nan
        return replace(frames, estimators={"anchored": replace(estimator, error_m=error)})

    gates = judge(noisy[0], {name: holed(frames) for name, frames in noisy[0].items()}, POLICY)
    told = ("inconclusive", "unknown: the candidate has no value on 15 of 1000 frames")
    assert outcome_of(gates, "navigation.anchored.p50") == told


@pytest.mark.parametrize("side", ["baseline", "candidate"])
def test_a_cost_that_was_not_measured_leaves_its_gate_open(noisy, side: str) -> None:
    rules = tuple(replace(rule, required=rule.figure in ("latency.*", "memory")) for rule in POLICY.rules)
    policy = replace(POLICY, rules=rules)
    bare = {name: replace(frames, latency={}, memory_mib=np.nan) for name, frames in noisy[0].items()}
    pair = (bare, noisy[0]) if side == "baseline" else (noisy[0], bare)
    gates = judge(*pair, policy)
    for name in ("latency.network", "memory"):
        assert outcome_of(gates, name) == ("inconclusive", f"unknown: the {side} has no value")
    gates = judge(bare, bare, policy)
    assert outcome_of(gates, "latency.*") == ("inconclusive", "unknown: neither build has this metric")
    assert verdict_of(gates) == "inconclusive"


def test_a_metric_without_change_on_few_frames_is_no_proof_that_nothing_changed() -> None:
    """No wrong fix on 24 frames of either build: up to 4.6 of 24 may be wrong in an equal sample, at 99 %."""
    gates = judge(small(1), small(2), replace(POLICY, rules=(GateRule("navigation.*.wrong_fixes", 0.05),)))
    (wrong,) = gates
    assert (wrong.baseline, wrong.candidate) == (0.0, 0.0)
    assert wrong.change_high == pytest.approx(-np.log(0.01) / 24)
    assert wrong.outcome == "inconclusive"
    policy = replace(POLICY, rules=(GateRule("navigation.*.wrong_fixes", 0.35),))
    assert verdict_of(judge(small(1), small(2), policy)) == "pass"


def test_identical_telemetry_is_compared_exactly_on_any_number_of_frames() -> None:
    before = small(1)
    after = {
        name: replace(frames, latency={"network": 1.01 * frames.latency["network"]})
        for name, frames in before.items()
    }
    gates = judge(before, after, POLICY)
    recall = next(gate for gate in gates if gate.name == "detector.recall")
    assert (recall.outcome, recall.resolution) == ("pass", 0.0)
    assert recall.reason == "identical telemetry in every frame"
    changed = {**before, "b": simulated(1, 7, 12)}
    gates = judge(before, changed, POLICY)
    by_pass = {gate.pass_name: gate.outcome for gate in gates if gate.name == "detector.recall"}
    assert by_pass == {"": "inconclusive", "a": "pass", "b": "inconclusive"}


def test_the_last_rule_that_applies_decides_the_margin() -> None:
    policy = replace(POLICY, rules=(GateRule("navigation.*", 0.5), GateRule("navigation.paper.p50", 0.1)))
    assert rule_of(policy, "navigation.paper.p50") == policy.rules[1]
    assert rule_of(policy, "navigation.anchored.p50") == policy.rules[0]
    assert rule_of(policy, "detector.recall") is None


def test_the_same_frames_give_the_same_gates() -> None:
    assert repr(judge(small(1), small(2), POLICY)) == repr(judge(small(1), small(2), POLICY))


def test_six_frames_leave_small_changes_open_and_nothing_breaks() -> None:
    before, after = {"only": simulated(1, 1, frames=6)}, {"only": simulated(1, 2, frames=6, error=9.0)}
    gates = judge(before, after, POLICY)
    # The errors of the candidate are nine times as large, and the mean of their squares 81 times.
    assert failed(gates) <= {
        f"navigation.anchored.{name}" for name in ("p50", "p95", "squared_normalised_error")
    }
    assert outcome_of(gates, "detector.recall")[0] == "inconclusive"


def largest_count(trials: int, rate: float) -> int:
    """Count that a binomial of this rate exceeds once in ten thousand tests."""
    return int(stats.binom.isf(1e-4, trials, rate))


@pytest.mark.parametrize("margins", [1.0, 2.0])
def test_a_degraded_build_seldom_passes(margins: float) -> None:
    """At its margin a gate passes with a probability of at most 1 %, whatever the number of frames."""
    pairs = 40
    for passes, frames in ((2, 12), (5, 40)):
        found = outcomes(passes, frames, margins, pairs)
        assert found["verdict"]["pass"] == 0
        for name, counts in found.items():
            assert counts["pass"] <= largest_count(pairs, 0.01), (name, passes, frames)


def test_twice_the_margin_is_not_passed_where_the_frames_resolve_it() -> None:
    found = outcomes(5, 40, 0.0, 10)
    # The same suite passes an equal build on these gates: the next line does not hold for want of frames alone.
    resolved = [
        name for name in ("detector.recall", "detector.bias", "latency.network") if found[name]["pass"] == 10
    ]
    assert resolved == ["detector.recall", "detector.bias", "latency.network"]
    twice = outcomes(5, 40, 2.0, 10)
    assert all(twice[name]["pass"] == 0 for name in resolved)
    assert all(twice[name]["fail"] > 0 for name in resolved)
    assert degraded(2.0)["recall"] == pytest.approx(0.66)


N = 100
SIGN = np.where(np.arange(N) % 2, -1.0, 1.0)


def alternating(hits: float = 14.0, swing: float = 1.0, octets: float = 1000.0, **more: Any) -> PassFrames:
    """One pass of 20 craters a frame whose hits and octets alternate: neighbours correlate negatively, time 1."""
    nothing = np.zeros(N)
    return PassFrames(
        answered=np.ones(N, dtype=np.bool_),
        expected=np.full(N, 20.0),
        hits=hits + swing * SIGN,
        alarms=nothing,
        error_px=nothing,
        shift_u_px=nothing,
        shift_v_px=nothing,
        packets=np.full(N, 8.0),
        octets=octets * (1.0 + 0.1 * swing * SIGN),
        estimators={},
        **more,
    )


def gate_of(before: PassFrames, after: PassFrames, name: str, margin: float, **more: Any) -> Gate:
    policy = replace(POLICY, rules=(GateRule(name, margin, **more),))
    (found,) = judge({"only": before}, {"only": after}, policy)
    return found


def test_a_gate_of_a_share_is_student_s_t_with_the_rule_of_three_as_its_floor() -> None:
    """The share of a frame swings by 1/20 of a hit; the change by a tenth of that: its error is 0.005 over root 99."""
    found = gate_of(alternating(), alternating(swing=1.1), "detector.recall", 0.02)
    error, t = 0.1 / 20.0 / np.sqrt(99.0), stats.t(99)
    # A single frame of the baseline may differ by root two of its swing, ln 100 of them unseen among a hundred.
    floor = -np.log(0.01) * np.sqrt(2.0) / 20.0 / N
    assert floor > t.ppf(0.99) * error
    assert (found.outcome, found.name, found.unit, found.pass_name) == ("pass", "detector.recall", "", "")
    assert (found.baseline, found.candidate) == pytest.approx((0.7, 0.7))
    assert (found.margin, found.limit) == pytest.approx((0.02, 0.68))
    assert found.change_low == pytest.approx(-t.ppf(0.99) * error)
    assert found.change_high == pytest.approx(floor)
    assert found.resolution == pytest.approx((t.ppf(0.99) + t.ppf(0.9)) * floor / t.ppf(0.99))
    # One test of one family has all of 1 - confidence.
    assert (found.p_value, found.level) == (1.0, pytest.approx(0.01))
    assert (found.frames, found.frames_needed, found.reason, found.waived) == (100, None, "", "")


def test_a_degradation_past_the_margin_has_the_p_value_of_student_s_t() -> None:
    found = gate_of(alternating(), alternating(hits=13.5, swing=1.1), "detector.recall", 0.0235)
    error = 0.1 / 20.0 / np.sqrt(99.0)
    assert found.p_value == pytest.approx(stats.t.sf(0.0015 / error, 99), rel=1e-6)
    assert (found.outcome, found.change_low) == ("fail", pytest.approx(0.025 - stats.t.ppf(0.99, 99) * error))
    close = gate_of(alternating(), alternating(hits=13.5, swing=1.1), "detector.recall", 0.0245)
    assert close.p_value == pytest.approx(stats.t.sf(0.0005 / error, 99), rel=1e-6)
    assert (close.outcome, close.reason) == ("inconclusive", "the change is too close to the margin")
    # The distance to the margin, 0.0005, would have to be resolved.
    assert close.frames_needed is not None and close.frames_needed > N
    better = gate_of(alternating(), alternating(hits=14.5, swing=1.1), "detector.recall", 0.02)
    assert (better.outcome, better.p_value) == ("pass", 1.0)
    assert better.change_high < 0.0


def test_a_share_of_counts_is_not_known_better_than_to_one_of_them() -> None:
    """Hits that never change: the floor is one crater of 2000, ln 100 of them."""
    other = replace(alternating(swing=0.0), packets=np.full(N, 9.0))
    found = gate_of(alternating(swing=0.0), other, "detector.recall", 0.02)
    assert found.change_high == pytest.approx(-np.log(0.01) / 2000.0)
    assert (found.outcome, found.change_low) == ("pass", 0.0)


def test_a_gate_of_a_mean_is_judged_by_the_ratio_of_the_means() -> None:
    """The octets of a frame swing by a tenth, the candidate's by 11 % of 1010: the change is ln 1.01."""
    found = gate_of(alternating(), alternating(swing=1.1, octets=1010.0), "telemetry.octets_per_frame", 0.05)
    error, t = 0.01 / np.sqrt(99.0), stats.t(99)
    floor = -np.log(0.01) * np.sqrt(2.0) * 0.1 / N
    assert (found.baseline, found.candidate) == pytest.approx((1000.0, 1010.0))
    assert (found.unit, found.margin, found.limit) == ("octets", 0.05, pytest.approx(1050.0))
    assert found.change_low == pytest.approx(1.01 * np.exp(-t.ppf(0.99) * error) - 1.0)
    assert found.change_high == pytest.approx(1.01 * np.exp(floor) - 1.0)
    assert found.resolution == pytest.approx(np.expm1((t.ppf(0.99) + t.ppf(0.9)) * floor / t.ppf(0.99)))
    assert found.outcome == "pass"
    worse = gate_of(alternating(), alternating(swing=1.1, octets=1055.0), "telemetry.octets_per_frame", 0.05)
    assert worse.p_value == pytest.approx(stats.t.sf(np.log(1.055 / 1.05) / error, 99), rel=1e-6)


def test_a_percentile_that_is_nought_in_both_builds_has_not_changed() -> None:
    nothing = np.zeros(N)
    still = {"anchored": EstimatorFrames(nothing, nothing, nothing, nothing, ("fixed",) * N, nothing)}
    before, after = alternating(), alternating(swing=1.1)
    found = gate_of(
        replace(before, estimators=still), replace(after, estimators=still), "navigation.anchored.p50", 0.1
    )
    assert (found.outcome, found.baseline, found.candidate, found.unit) == ("pass", 0.0, 0.0, "m")
    assert (found.change_low, found.change_high, found.resolution) == (0.0, 0.0, 0.0)


def test_the_gates_without_chance_state_their_limits_in_full() -> None:
    before, after = alternating(undecodable=2, memory_mib=200.0), alternating(undecodable=3, memory_mib=221.0)
    bad = gate_of(before, after, "telemetry.undecodable", 1.0)
    assert (bad.outcome, bad.baseline, bad.candidate, bad.margin, bad.limit) == ("pass", 2.0, 3.0, 1.0, 3.0)
    assert (bad.unit, bad.frames, bad.resolution, bad.reason) == ("packets", 100, 0.0, "")
    memory = gate_of(before, after, "memory", 0.1)
    assert (memory.outcome, memory.baseline, memory.candidate, memory.margin) == ("fail", 200.0, 221.0, 0.1)
    assert (memory.unit, memory.frames, memory.resolution, memory.reason) == ("MiB", 100, 0.0, "")
    assert memory.limit == pytest.approx(220.0)
    assert gate_of(before, replace(after, memory_mib=220.0), "memory", 0.1).outcome == "pass"
    unknown = gate_of(before, replace(after, memory_mib=np.nan), "memory", 0.1)
    assert (unknown.outcome, unknown.resolution) == ("inconclusive", np.inf)


def test_the_memory_of_a_build_is_that_of_its_worst_pass() -> None:
    before = {"a": alternating(memory_mib=100.0), "b": alternating(memory_mib=200.0)}
    after = {"a": alternating(memory_mib=230.0), "b": alternating(memory_mib=100.0)}
    (memory,) = judge(before, after, replace(POLICY, rules=(GateRule("memory", 0.1),)))
    assert (memory.baseline, memory.candidate, memory.frames) == (200.0, 230.0, 200)


def test_a_metric_that_nobody_has_states_nothing() -> None:
    found = gate_of(alternating(), alternating(), "latency.network", 0.1, required=True)
    assert (found.name, found.outcome, found.margin, found.frames) == (
        "latency.network", "inconclusive", 0.1, 100,
    )  # fmt: skip
    assert np.isnan([found.baseline, found.candidate, found.limit, found.change_low, found.p_value]).all()
    assert (found.resolution, found.unit, found.pass_name) == (np.inf, "", "")


def test_a_bias_is_tested_along_its_change() -> None:
    """Centres move by 0.3 px in columns and 0.4 in rows; every frame has ten hits and swings by 0.01 px along that."""

    def moved(along_px: float, swing_px: float) -> PassFrames:
        length = 10.0 * (along_px + swing_px * SIGN)
        return replace(alternating(), hits=np.full(N, 10.0), shift_u_px=0.6 * length, shift_v_px=0.8 * length)

    found = gate_of(moved(0.1, 0.01), moved(0.6, 0.06), "detector.bias", 0.12)
    error = 0.05 / np.sqrt(99.0)
    assert (found.outcome, found.unit, found.margin) == ("fail", "px", 0.12)
    assert (found.baseline, found.candidate, found.limit) == pytest.approx((0.1, 0.6, 0.22))
    assert found.change_low == pytest.approx(0.5 - stats.t.ppf(0.99, 99) * error)
    assert found.p_value == pytest.approx(stats.t.sf(0.38 / error, 99), rel=1e-6)
    # A bias that at least halves is no degradation, however far the centres moved.
    assert gate_of(moved(0.6, 0.01), moved(-0.3, 0.06), "detector.bias", 0.12).p_value == 1.0
    assert gate_of(moved(0.6, 0.01), moved(-0.31, 0.06), "detector.bias", 0.12).outcome == "fail"


def test_single_passes_and_the_suite_are_two_families() -> None:
    """Half of 1 - confidence for each; Holm divides it among the tests of a family that are not yet rejected."""
    rules = (GateRule("detector.recall", 0.02, pass_margin=0.03), GateRule("detector.precision", 0.02))
    before = {"a": alternating(), "b": alternating()}
    after = {"a": alternating(swing=1.1), "b": alternating(swing=1.1)}
    gates = judge(before, after, replace(POLICY, rules=rules))
    assert [(one.name, one.pass_name, one.margin) for one in gates] == [
        ("detector.recall", "", 0.02), ("detector.precision", "", 0.02),
        ("detector.recall", "a", 0.03), ("detector.recall", "b", 0.03),
    ]  # fmt: skip
    assert [one.level for one in gates] == pytest.approx([0.0025] * 4)
    assert [one.frames for one in gates] == [200, 200, 100, 100]


def test_a_waiver_may_name_a_pass() -> None:
    before = {"a": alternating(), "b": alternating()}
    after = {"a": alternating(hits=10.0), "b": alternating(hits=10.0)}
    rule = GateRule("detector.recall", 0.02, pass_margin=0.02)
    waiver = Waiver("detector.*", "dust", "2029-08-07", pass_name="a")
    gates = judge(before, after, replace(POLICY, rules=(rule,), waivers=(waiver,)), today="2029-08-01")
    assert [(one.pass_name, one.waived) for one in gates] == [
        ("", ""), ("a", "dust (until 2029-08-07)"), ("b", ""),
    ]  # fmt: skip


def test_only_passes_that_both_builds_flew_are_compared() -> None:
    gates = judge(
        {"a": alternating(), "b": alternating()},
        {"b": alternating(), "c": alternating()},
        replace(POLICY, rules=(GateRule("detector.recall", 0.02),)),
    )
    assert [(one.pass_name, one.frames) for one in gates] == [("", 100)]


def test_the_interval_of_a_share_is_that_of_independent_trials() -> None:
    """Two passes of 500 frames of 20 craters, a recall of 0.7: sigma is root (0.21 / 20,000)."""
    rng = np.random.default_rng(11)
    hits = rng.binomial(20, 0.7, 1000).astype(np.float64)
    sample = Ratio(hits, np.full(1000, 20.0), counts=True)
    low, high = metric_interval(sample, [500, 500], 2000)
    sigma = np.sqrt(0.21 / 20_000.0)
    # Frames that seem to correlate by chance widen it by a few percent; 2000 resamples know it to 3 %.
    assert high - low == pytest.approx(2.0 * 1.96 * sigma, rel=0.2)
    assert 0.5 * (low + high) == pytest.approx(hits.sum() / 20_000.0, abs=0.2 * sigma)


def test_the_interval_of_a_median_is_that_of_order_statistics() -> None:
    """Of 900 uniform numbers the median has a sigma of 1 / (2 root 900)."""
    values = np.random.default_rng(12).random(900)
    low, high = metric_interval(Percentile(values, 0.5), [900], 2000)
    assert high - low == pytest.approx(2.0 * 1.96 / 60.0, rel=0.25)
    assert low < np.median(values) < high


def test_values_that_last_widen_the_interval() -> None:
    """Each number stands for five frames: root five more uncertain."""
    values = np.repeat(np.random.default_rng(13).random(400), 5)
    low, high = metric_interval(Percentile(values, 0.5), [2000], 2000)
    assert high - low == pytest.approx(2.0 * 1.96 / 40.0, rel=0.3)


def test_no_frames_have_no_interval() -> None:
    nothing = np.zeros(0)
    assert np.isnan(metric_interval(Ratio(nothing, nothing, counts=True), [], 10)).all()
    assert np.isnan(metric_interval(Ratio(np.zeros(3), np.zeros(3), counts=True), [3], 10)).all()
