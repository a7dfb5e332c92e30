"""Gates: whether a candidate build is worse than a baseline by more than a policy tolerates, beyond what chance makes.

A gate asks one question of paired samples: is the worsening larger than the margin? It fails when chance would show so
much with a probability below the level of the test (one-sided Student's t on a block bootstrap). Two families are
tested, each with half of the policy's alpha under Holm's procedure: gates over the whole suite, and the same gates pass
by pass, so that a build that fails on one kind of terrain is not saved by the others. Gates without chance in them
(packets that cannot be decoded, memory) are compared as they are.
"""

from __future__ import annotations

import fnmatch
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ground_service.processing.regression_figures import Figure, figures_of, joined, shift_px
from ground_service.processing.regression_samples import PassFrames
from ground_service.processing.regression_statistics import (
    block_weights,
    degrees_of_freedom,
    holm_levels,
    interval,
    standard_error,
    student_quantile,
    student_upper_tail,
)

FloatArray = NDArray[np.float64]

BIAS = "detector.bias"
UNDECODABLE = "telemetry.undecodable"
MEMORY = "memory"
_LARGEST_LOG = 50.0
POWER_MISS = 0.1
"""The resolution of a gate is the worsening that it sees with a probability of nine in ten."""


@dataclass(frozen=True, slots=True)
class GateRule:
    """What a policy says of some figures: `figure` may hold wildcards; `margin` is in the figure's unit or a share."""

    figure: str
    margin: float


@dataclass(frozen=True, slots=True)
class Waiver:
    """A gate that may fail for a while: `gate` and `pass_name` may hold wildcards; `until` is the last day, ISO."""

    gate: str
    reason: str
    until: str
    pass_name: str = "*"


@dataclass(frozen=True, slots=True)
class GatePolicy:
    """How builds are judged."""

    version: str
    alpha: float
    block_frames: int
    resamples: int
    rules: tuple[GateRule, ...]
    per_pass: tuple[str, ...]
    waivers: tuple[Waiver, ...] = ()


@dataclass(frozen=True, slots=True)
class Gate:
    """The answer of one gate.

    Attributes
    ----------
    pass_name
        Empty for a gate over the whole suite.
    limit
        Value of the candidate's figure that must not be passed.
    low, high
        Interval (95 %) of the candidate's change: a difference, or a ratio minus 1.
    p_value, level
        Of the test; NaN for gates without chance in them.
    resolution
        Worsening that this gate would have seen nine times in ten: a difference, or a share of the baseline.
    waived
        Why a failure does not count; empty where it does.
    """

    name: str
    baseline: float
    candidate: float
    limit: float
    passed: bool
    unit: str = ""
    pass_name: str = ""
    low: float = math.nan
    high: float = math.nan
    p_value: float = math.nan
    level: float = math.nan
    resolution: float = math.nan
    waived: str = ""

    @property
    def counts_as_passed(self) -> bool:
        """Whether the verdict takes it as passed."""
        return self.passed or bool(self.waived)


def judge(
    baseline: Mapping[str, PassFrames],
    candidate: Mapping[str, PassFrames],
    policy: GatePolicy,
    *,
    today: str = "",
) -> list[Gate]:
    """The gates of a policy over the passes that both builds flew, those of the suite first.

    Parameters
    ----------
    baseline, candidate
        Frames of each pass by its name, the same frames in both.
    today
        Day (ISO) by which waivers are in force; none is when empty.
    """
    names = [name for name in baseline if name in candidate]
    if not names:
        return []
    before, after = [baseline[name] for name in names], [candidate[name] for name in names]
    suite = _tests(before, after, policy, "", every=True)
    single: list[_Test] = []
    if len(names) > 1:
        for name in names:
            single += _tests([baseline[name]], [candidate[name]], policy, name, every=False)
    # With one pass there is one family, which has all of alpha.
    alpha = policy.alpha / (2.0 if single else 1.0)
    gates = [*_decided(suite, alpha), *_fixed(before, after, policy), *_decided(single, alpha)]
    return [_with_waiver(gate, policy.waivers, today) for gate in gates]


@dataclass(frozen=True, slots=True)
class _Test:
    """A gate before the level of its test is known; `worsening` and `error` in the scale that is tested."""

    name: str
    unit: str
    pass_name: str
    baseline: float
    candidate: float
    worsening: float
    error: float
    margin: float
    low: float
    high: float
    freedom: int
    relative: bool
    sign: float
    p_value: float


def _tests(
    before: Sequence[PassFrames],
    after: Sequence[PassFrames],
    policy: GatePolicy,
    pass_name: str,
    *,
    every: bool,
) -> list[_Test]:
    sizes = [len(one) for one in before]
    weights = block_weights(tuple(sizes), policy.block_frames, policy.resamples)
    freedom = degrees_of_freedom(sizes, policy.block_frames)
    old, new = joined(before), joined(after)
    whole = np.ones((1, weights.shape[1]))
    tests = []
    for figure in figures_of([*before, *after]):
        margin = margin_of(policy, figure.name)
        wanted = every or any(fnmatch.fnmatch(figure.name, pattern) for pattern in policy.per_pass)
        if margin is None or not wanted:
            continue
        then, now = (float(figure.compute(frames, whole)[0]) for frames in (old, new))
        if not math.isfinite(then):
            continue  # the baseline has no such figure: there is nothing to be worse than
        change = _change(figure, figure.compute(old, weights), figure.compute(new, weights))
        worsening = float(_change(figure, np.array([then]), np.array([now]))[0])
        tests.append(_test(figure, pass_name, then, now, worsening, change, margin, sizes, policy, freedom))
    margin = margin_of(policy, BIAS)
    if margin is not None and (every or BIAS in policy.per_pass):
        bias = _bias_test(old, new, weights, whole, margin, sizes, policy, freedom, pass_name)
        if bias is not None:
            tests.append(bias)
    return tests


def _change(figure: Figure, then: FloatArray, now: FloatArray) -> FloatArray:
    """Worsening of resampled figures: a difference, or the logarithm of a ratio."""
    if not figure.relative:
        return then - now if figure.higher_is_better else now - then
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.log(now / then)
    # Nothing against nothing is no change; something against nothing is left to the finite samples.
    ratio = np.where((now == 0.0) & (then == 0.0), 0.0, ratio)
    return -ratio if figure.higher_is_better else ratio


def _test(
    figure: Figure,
    pass_name: str,
    then: float,
    now: float,
    worsening: float,
    change: FloatArray,
    margin: float,
    sizes: Sequence[int],
    policy: GatePolicy,
    freedom: int,
) -> _Test:
    error = standard_error(change, sizes, policy.block_frames)
    low, high = interval(change)
    sign = -1.0 if figure.higher_is_better else 1.0
    ends = sorted((sign * low, sign * high))
    if figure.relative:
        ends = [_ratio(end) - 1.0 for end in ends]
    return _Test(
        figure.name,
        figure.unit,
        pass_name,
        then,
        now,
        worsening,
        error,
        math.log1p(margin) if figure.relative else margin,
        ends[0],
        ends[1],
        freedom,
        figure.relative,
        sign,
        _p_value(worsening, error, math.log1p(margin) if figure.relative else margin, freedom),
    )


def _bias_test(
    old: PassFrames,
    new: PassFrames,
    weights: FloatArray,
    whole: FloatArray,
    margin: float,
    sizes: Sequence[int],
    policy: GatePolicy,
    freedom: int,
    pass_name: str,
) -> _Test | None:
    """Whether the candidate's centres lie elsewhere than the baseline's, and not because an old bias went away.

    The figure is the length of the mean difference of detected and catalogued centre. What is tested is the length of
    its change, along the direction of the change; a change that at least halves the bias is no worsening.
    """
    then, now = shift_px(old, whole)[0], shift_px(new, whole)[0]
    if not (np.isfinite(then).all() and np.isfinite(now).all()):
        return None
    moved = now - then
    length = float(np.linalg.norm(moved))
    direction = moved / length if length > 0.0 else np.array([1.0, 0.0])
    change = (shift_px(new, weights) - shift_px(old, weights)) @ direction
    better = float(np.linalg.norm(now)) <= 0.5 * float(np.linalg.norm(then))
    worsening = 0.0 if better else length
    error = standard_error(change, sizes, policy.block_frames)
    low, high = interval(change)
    return _Test(
        BIAS,
        "px",
        pass_name,
        float(np.linalg.norm(then)),
        float(np.linalg.norm(now)),
        worsening,
        error,
        margin,
        low,
        high,
        freedom,
        False,
        1.0,
        _p_value(worsening, error, margin, freedom),
    )


def _p_value(worsening: float, error: float, margin: float, freedom: int) -> float:
    if math.isnan(worsening):
        return 0.0  # the candidate gives no figure where the baseline does
    if worsening <= margin:
        return 1.0
    if math.isinf(worsening) or not error > 0.0 or freedom < 1:
        return 0.0 if error == 0.0 or math.isinf(worsening) else 1.0
    return student_upper_tail((worsening - margin) / error, freedom)


def _decided(tests: Sequence[_Test], alpha: float) -> list[Gate]:
    levels = holm_levels([test.p_value for test in tests], alpha)
    return [_gate(test, level) for test, level in zip(tests, levels, strict=True)]


def _gate(test: _Test, level: float) -> Gate:
    spread = test.error if math.isfinite(test.error) else 0.0
    reach = test.margin + (student_quantile(level, test.freedom) * spread if test.freedom > 0 else 0.0)
    if test.relative:
        limit = test.baseline * _ratio(test.sign * reach)
    elif test.name == BIAS:
        limit = max(test.candidate - test.worsening + reach, reach)
    else:
        limit = test.baseline + test.sign * reach
    seen = reach + (student_quantile(POWER_MISS, test.freedom) * spread if test.freedom > 0 else 0.0)
    return Gate(
        test.name,
        test.baseline,
        test.candidate,
        limit,
        test.p_value > level,
        test.unit,
        test.pass_name,
        test.low,
        test.high,
        test.p_value,
        level,
        _ratio(seen) - 1.0 if test.relative else seen,
    )


def _ratio(logarithm: float) -> float:
    """The ratio of a logarithm; infinite where too few blocks leave everything open."""
    return math.inf if logarithm > _LARGEST_LOG else math.exp(logarithm)


def _fixed(before: Sequence[PassFrames], after: Sequence[PassFrames], policy: GatePolicy) -> list[Gate]:
    """Gates without chance in them."""
    gates = []
    margin = margin_of(policy, UNDECODABLE)
    if margin is not None:
        then, now = (float(sum(one.undecodable for one in passes)) for passes in (before, after))
        gates.append(Gate(UNDECODABLE, then, now, then + margin, now <= then + margin, "packets"))
    margin = margin_of(policy, MEMORY)
    then, now = (max(one.memory_mib for one in passes) for passes in (before, after))
    if margin is not None and math.isfinite(then):
        limit = then * (1.0 + margin)
        gates.append(Gate(MEMORY, then, now, limit, bool(now <= limit), "MiB"))
    return gates


def margin_of(policy: GatePolicy, figure: str) -> float | None:
    """The margin of the last rule that speaks of a figure; None where none does."""
    found = [rule.margin for rule in policy.rules if fnmatch.fnmatch(figure, rule.figure)]
    return found[-1] if found else None


def _with_waiver(gate: Gate, waivers: Sequence[Waiver], today: str) -> Gate:
    if gate.passed or not today:
        return gate
    for waiver in waivers:
        applies = fnmatch.fnmatch(gate.name, waiver.gate) and fnmatch.fnmatch(
            gate.pass_name, waiver.pass_name
        )
        if applies and today <= waiver.until:
            return replace(gate, waived=f"{waiver.reason} (until {waiver.until})")
    return gate
