"""Error rates of the regression gates on simulated frames: python -m benchmarks.gate_error_rates [--pairs N].

Pairs of builds are simulated over the same scenes: a baseline, and a candidate whose true degradation is 0, 1 or 2
margins of the policy. The table counts the outcomes of each gate. At 1 margin a pass is wrong with a probability of at
most 1 - confidence; at 0 margins a failure of any gate is wrong with at most that probability.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np

from benchmarks._rows import Row
from ground_service.regression.gates.core import GatePolicy, GateRule, judge, verdict_of
from ground_service.regression.gates.samples import EstimatorFrames, PassFrames

RECALL, PRECISION = 0.70, 0.87
SUITES = ((2, 12), (5, 40), (5, 200))
"""Numbers of passes and of frames in each pass."""

POLICY = GatePolicy(
    version="simulated",
    confidence=0.99,
    power=0.8,
    resamples=200,
    rules=(
        GateRule("detector.recall", 0.02),
        GateRule("detector.precision", 0.02),
        GateRule("detector.bias", 0.12),
        GateRule("navigation.*.p50", 0.1),
        GateRule("navigation.*.p95", 0.1),
        GateRule("latency.*", 0.1),
    ),
)


def simulated(
    scene: int,
    noise: int,
    frames: int = 200,
    *,
    recall: float = RECALL,
    precision: float = PRECISION,
    bias_px: float = 0.0,
    slow: float = 1.0,
    error: float = 1.0,
) -> PassFrames:
    """Return a pass over a scene (craters and their difficulty) with the noise of one camera and filter run.

    The scene determines which craters are detected; noise changes one in twenty. The error of the filter has an
    autocorrelation of 0.8 from frame to frame (autocorrelation time 9 frames).
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
        alarms[i] = rng.poisson((1.0 / precision - 1.0) * hits[i])
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


def suite(
    noise: int, frames: int = 200, passes: int = 5, first_scene: int = 0, **faults: float
) -> dict[str, PassFrames]:
    """Return the passes of one build, of different scenes."""
    return {f"pass {k}": simulated(first_scene + k, noise, frames, **faults) for k in range(passes)}


def degraded(margins: float) -> dict[str, float]:
    """Return the faults that degrade every gated metric by a number of margins of `POLICY`."""
    by_name = {rule.figure: rule.margin for rule in POLICY.rules}
    return {
        "recall": RECALL - margins * by_name["detector.recall"],
        "precision": PRECISION - margins * by_name["detector.precision"],
        "bias_px": margins * by_name["detector.bias"],
        # Both percentiles scale with the error and have the same margin.
        "error": 1.0 + margins * by_name["navigation.*.p50"],
        "slow": 1.0 + margins * by_name["latency.*"],
    }


def outcomes(passes: int, frames: int, margins: float, pairs: int) -> dict[str, Counter[str]]:
    """Return the number of each outcome of each gate and of the verdict; every pair of builds has different scenes."""
    found: dict[str, Counter[str]] = {}
    for pair in range(pairs):
        scene = 100 * pair
        before = suite(2 * pair, frames, passes, scene)
        after = suite(2 * pair + 1, frames, passes, scene, **degraded(margins))
        gates = judge(before, after, POLICY)
        for gate in gates:
            found.setdefault(gate.name, Counter())[gate.outcome] += 1
        found.setdefault("verdict", Counter())[verdict_of(gates)] += 1
    return found


def rows() -> Iterator[Row]:
    """Yield shares of verdicts over 40 pairs of builds; a wrong verdict above its level is an error."""
    pairs = 40
    for passes, frames in SUITES:
        for margins, wrong_claim in ((0.0, "fail"), (2.0, "pass")):
            counts = outcomes(passes, frames, margins, pairs)["verdict"]
            share = counts[wrong_claim] / pairs
            wrong = "" if share <= 0.1 else f"{wrong_claim} in {share:.0%}"
            right = counts["pass" if wrong_claim == "fail" else "fail"] / pairs
            what = f"{passes} x {frames} frames, {margins:.0f} margins worse: right verdict"
            yield Row(what, right, "share", wrong=wrong)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--pairs", type=int, default=200, help="simulated pairs of builds of each row (default: 200)"
    )
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args(arguments)
    rows = []
    for passes, frames in SUITES:
        for margins in (0.0, 1.0, 2.0):
            for name, counts in outcomes(passes, frames, margins, given.pairs).items():
                row = {"passes": passes, "frames": passes * frames, "margins": margins, "gate": name}
                row |= {key: counts[key] / given.pairs for key in ("pass", "fail", "inconclusive")}
                rows.append(row)
                if not given.json:
                    print(
                        f"{passes} x {frames:<4} true degradation {margins:.0f} margins  {name:<26}"
                        f" pass {row['pass']:.3f}  fail {row['fail']:.3f}  inconclusive {row['inconclusive']:.3f}",
                        flush=True,
                    )
    if given.json:
        print(json.dumps(rows))


if __name__ == "__main__":
    main()
