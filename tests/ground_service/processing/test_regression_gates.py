"""Gates on simulated frames of known recall, bias, error and cost: what they let through and what they stop."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ground_service.processing.regression_gates import Gate, GatePolicy, GateRule, Waiver, judge
from ground_service.processing.regression_samples import EstimatorFrames, PassFrames

POLICY = GatePolicy(
    version="test",
    alpha=0.01,
    block_frames=5,
    resamples=200,
    rules=(
        GateRule("detector.recall", 0.003),
        GateRule("detector.precision", 0.005),
        GateRule("detector.localisation", 0.05),
        GateRule("detector.bias", 0.12),
        GateRule("navigation.*.p50", 0.1),
        GateRule("navigation.*.p95", 0.15),
        GateRule("navigation.*.nees", 0.25),
        GateRule("navigation.*.fixes", 0.01),
        GateRule("navigation.*.wrong_fixes", 0.0),
        GateRule("latency.*", 0.1),
        GateRule("telemetry.*", 0.05),
        GateRule("telemetry.undecodable", 0.0),
        GateRule("memory", 0.1),
    ),
    per_pass=("detector.recall", "detector.bias", "navigation.*.p95"),
)


def simulated(
    scene: int,
    noise: int,
    frames: int = 200,
    *,
    recall: float = 0.70,
    bias_px: float = 0.0,
    slow: float = 1.0,
    error: float = 1.0,
) -> PassFrames:
    """A pass of a scene (its craters, how hard they are) with the noise of one camera and filter run.

    A crater is as hard to find as its scene makes it; noise turns one in twenty around. The error of the filter
    wanders with a memory of some frames, as that of a filter does.
    """
    world, rng = np.random.default_rng((1, scene)), np.random.default_rng((2, scene, noise))
    expected = world.integers(8, 30, frames).astype(np.float64)
    hits, alarms = np.zeros(frames), np.zeros(frames)
    shift = np.zeros((frames, 2))
    error_px = np.zeros(frames)
    for i in range(frames):
        ease = world.random(int(expected[i]))
        found = np.where(rng.random(len(ease)) < 0.05, rng.random(len(ease)), ease) < recall
        hits[i] = found.sum()
        lasting = 0.8 * world.standard_normal((len(ease), 2))[found]
        off = lasting + 0.5 * rng.standard_normal((int(hits[i]), 2)) + [bias_px, 0.0]
        shift[i] = off.sum(axis=0)
        error_px[i] = np.linalg.norm(off, axis=1).sum()
        alarms[i] = rng.poisson(0.15 * hits[i])
    wander = np.zeros((frames, 3))
    for i in range(1, frames):
        wander[i] = 0.8 * wander[i - 1] + 12.0 * rng.standard_normal(3) + 9.0 * world.standard_normal(3)
    length = error * np.linalg.norm(wander, axis=1)
    nothing = np.full(frames, np.nan)
    return PassFrames(
        answered=np.ones(frames, dtype=np.bool_),
        expected=expected,
        hits=hits,
        alarms=alarms,
        error_px=error_px,
        shift_u_px=shift[:, 0],
        shift_v_px=shift[:, 1],
        packets=np.full(frames, 8.0),
        octets=np.full(frames, 900.0) + 14.0 * (hits + alarms),
        estimators={
            "anchored": EstimatorFrames(
                length,
                np.full(frames, 43.0),
                (length / 25.0) ** 2,
                nothing,
                ("fixed",) * frames,
                np.zeros(frames),
            )
        },
        latency={"network": slow * (9.0 + 0.5 * rng.standard_exponential(frames))},
        memory_mib=250.0,
    )


def suite(noise: int, frames: int = 200, **faults: float) -> dict[str, PassFrames]:
    """Five passes, of 1,000 frames together."""
    return {f"pass {scene}": simulated(scene, noise, frames, **faults) for scene in range(5)}


def failed(gates: list[Gate]) -> set[str]:
    return {gate.name for gate in gates if not gate.counts_as_passed}


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


def test_the_limit_is_the_value_at_which_a_gate_fails(noisy) -> None:
    for candidate in (suite(700), suite(701, recall=0.66, slow=1.3, error=1.4)):
        for gate in judge(noisy[0], candidate, POLICY):
            higher = gate.name in ("detector.recall", "detector.precision") or gate.name.endswith(
                ("fixes", "answered")
            )
            if gate.name == "navigation.anchored.wrong_fixes":
                higher = False
            beyond = gate.candidate < gate.limit if higher else gate.candidate > gate.limit
            assert beyond == (not gate.passed), gate


def test_packets_that_cannot_be_decoded_fail_without_any_statistics(noisy) -> None:
    after = dict(noisy[0])
    after["pass 1"] = replace(after["pass 1"], undecodable=3)
    assert failed(judge(noisy[0], after, POLICY)) == {"telemetry.undecodable"}


def test_memory_beyond_the_margin_fails(noisy) -> None:
    after = {name: replace(frames, memory_mib=300.0) for name, frames in noisy[0].items()}
    assert failed(judge(noisy[0], after, POLICY)) == {"memory"}


def test_a_figure_that_the_candidate_does_not_give_fails(noisy) -> None:
    after = {name: replace(frames, estimators={}) for name, frames in noisy[0].items()}
    names = failed(judge(noisy[0], after, POLICY))
    assert {"navigation.anchored.p95", "navigation.anchored.fixes"} <= names
    assert not any(name.startswith("detector") for name in names)


def test_a_waiver_holds_to_its_last_day_and_for_its_gate(noisy) -> None:
    policy = replace(POLICY, waivers=(Waiver("latency.*", "new network, agreed", "2029-08-07"),))
    after = suite(800, slow=1.4)
    assert failed(judge(noisy[0], after, policy, today="2029-08-07")) == set()
    waived = [gate for gate in judge(noisy[0], after, policy, today="2029-08-07") if gate.waived]
    assert [(gate.name, gate.passed) for gate in waived] == [("latency.network", False)]
    assert failed(judge(noisy[0], after, policy, today="2029-08-08")) == {"latency.network"}


def test_one_pass_of_a_few_frames_says_how_little_it_sees() -> None:
    before, after = {"only": simulated(1, 1, frames=12)}, {"only": simulated(1, 2, frames=12)}
    gates = judge(before, after, POLICY)
    recall = next(gate for gate in gates if gate.name == "detector.recall")
    assert failed(gates) == set()
    assert recall.resolution > 0.02


def test_without_passes_there_are_no_gates() -> None:
    assert judge({}, {}, POLICY) == []


def test_two_blocks_of_frames_leave_everything_open_and_nothing_breaks() -> None:
    before, after = {"only": simulated(1, 1, frames=6)}, {"only": simulated(1, 2, frames=6, error=9.0)}
    gates = judge(before, after, POLICY)
    assert failed(gates) <= {"navigation.anchored.p50", "navigation.anchored.p95"}
    assert all(
        gate.resolution > 0.0 for gate in gates if gate.name.startswith("navigation") and gate.unit == "m"
    )
