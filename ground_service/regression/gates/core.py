"""Gates: whether a candidate build is worse than a baseline by more than a policy tolerates.

A gate compares paired samples of both builds and has three outcomes:

- **fail**: the degradation exceeds the margin significantly (one-sided Student's t). Gates over the
  suite and gates of single passes are two families, each with half of 1 - confidence under Holm's procedure, so that
  a build as good as the baseline fails any gate with a probability of at most 1 - confidence.
- **pass**: the frames resolve the margin (a change as large as the margin would be detected at the policy's confidence
  and power), and the upper confidence bound of the degradation is within the margin. A build passes only if every gate
  passes, so this needs no correction for the number of gates (intersection-union test).
- **inconclusive**: everything else, such as too few frames or a value that is unknown.

A gate that needs frames is *not judged* on passes whose frames are not available, which the verdict does not count.

Telemetry that is identical in every frame is compared exactly, as are deterministic metrics (packets that cannot be
decoded, memory).

References
----------
R. L. Berger, "Multiparameter hypothesis testing and acceptance sampling", Technometrics 24, 1982 (intersection-union).
"""

from __future__ import annotations

import fnmatch
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ground_service.regression.gates.metrics import (
    Figure,
    Percentile,
    Ratio,
    Sample,
    figures_of,
    joined,
    same_telemetry,
    shift_samples,
)
from ground_service.regression.gates.samples import PassFrames
from ground_service.regression.gates.statistics import (
    Spread,
    autocorrelation_time,
    block_length,
    block_weights,
    frames_needed,
    holm_levels,
    interval,
    ratio_influence,
    resampled_spread,
    resolution,
    series_spread,
    student_quantile,
    student_upper_tail,
    unseen_changes,
)

PASS, FAIL, INCONCLUSIVE = "pass", "fail", "inconclusive"
NOT_JUDGED = "not judged"

FRAME_METRICS = ("detector.", "latency.", "memory")
"""Beginnings of the names of the metrics that need frames: detector, CPU time and memory."""

BIAS = "detector.bias"
LATENCY = "latency."
UNDECODABLE = "telemetry.undecodable"
MEMORY = "memory"
EXACT_METRICS = (UNDECODABLE, MEMORY)
"""Deterministic metrics, whose margin may be 0."""

_LARGEST_LOG = 50.0
_IDENTICAL = "identical telemetry in every frame"
_SAME = "identical values in every frame"


@dataclass(frozen=True, slots=True)
class GateRule:
    """Gate rule of a policy for some metrics.

    Attributes
    ----------
    figure
        Name of the metric; may contain wildcards.
    margin
        Tolerated degradation over the suite: in the metric's unit, or as a share of the baseline.
    pass_margin
        The same for every single pass; None if the gate is not applied to single passes.
    reason
        Rationale of the margin.
    required
        Whether a metric without a value makes the verdict inconclusive. A rule with wildcards that is not required
        applies to the metrics that exist.
    """

    figure: str
    margin: float
    pass_margin: float | None = None
    reason: str = ""
    required: bool = False


@dataclass(frozen=True, slots=True)
class Waiver:
    """Waiver of a gate until a day (ISO, inclusive); `gate` and `pass_name` may contain wildcards."""

    gate: str
    reason: str
    until: str
    pass_name: str = "*"


@dataclass(frozen=True, slots=True)
class GatePolicy:
    """Policy for the comparison of builds.

    Attributes
    ----------
    confidence
        Confidence of every pass decision; 1 - confidence is the probability that a build as good as the baseline fails
        any gate.
    power
        Probability with which a degradation as large as the resolution is detected.
    """

    version: str
    confidence: float
    power: float
    resamples: int
    rules: tuple[GateRule, ...]
    waivers: tuple[Waiver, ...] = ()


@dataclass(frozen=True, slots=True)
class Gate:
    """Decision of one gate.

    Attributes
    ----------
    outcome
        "pass", "fail", "inconclusive" or "not judged".
    pass_name
        Empty for a gate over the whole suite.
    baseline, candidate
        Values of the metric; NaN where unknown.
    margin
        Tolerated degradation: a difference, or a share of the baseline.
    limit
        The baseline degraded by the margin.
    change_low, change_high
        One-sided confidence bounds of the degradation: a difference, or a share of the baseline. Positive is worse.
    p_value, level
        Of the test for failure; NaN for gates of deterministic metrics.
    resolution
        Smallest degradation that these frames detect at the policy's confidence and power, in the unit of the margin;
        infinite if they detect none.
    frames, frames_needed
        Number of compared frames, and number needed to decide the gate; None if unknown.
    reason
        Why the gate is inconclusive; for other gates the basis of the decision if it is not the test.
    waived
        Reason of the waiver; empty if the gate is not waived.
    """

    name: str
    outcome: str
    baseline: float
    candidate: float
    margin: float
    limit: float
    unit: str = ""
    pass_name: str = ""
    change_low: float = math.nan
    change_high: float = math.nan
    p_value: float = math.nan
    level: float = math.nan
    resolution: float = 0.0
    frames: int = 0
    frames_needed: int | None = None
    reason: str = ""
    waived: str = ""

    @property
    def passed(self) -> bool:
        """Whether the gate passed."""
        return self.outcome == PASS

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
    """Return the gates of a policy over the passes processed by both builds, those of the suite first.

    Parameters
    ----------
    baseline, candidate
        Frames of each pass by its name; both have the same frames.
    today
        Day (ISO) that selects the valid waivers; empty: none are valid.
    """
    names = [name for name in baseline if name in candidate]
    if not names:
        return []
    before, after = [baseline[name] for name in names], [candidate[name] for name in names]
    suite = _tests(before, after, policy, "")
    single: list[_Test] = []
    if len(names) > 1:
        for name in names:
            single += _tests([baseline[name]], [candidate[name]], policy, name)
    # With one pass there is one family, which has all of alpha.
    alpha = (1.0 - policy.confidence) / (2.0 if single else 1.0)
    gates = [
        *_decided(suite, alpha, policy),
        *_exact(before, after, policy),
        *_decided(single, alpha, policy),
    ]
    gates += _unknown(policy, {gate.name for gate in gates}, sum(len(one) for one in before))
    return [_with_waiver(gate, policy.waivers, today) for gate in gates]


def judge_without_frames(
    baseline: Mapping[str, PassFrames],
    candidate: Mapping[str, PassFrames],
    policy: GatePolicy,
    reason: str,
    *,
    today: str = "",
) -> list[Gate]:
    """Return the gates over passes that were replayed from received detections.

    Only the metrics of navigation and telemetry are judged. The gates that need frames are not judged.
    """
    rules = tuple(rule for rule in policy.rules if not _needs_frames(rule.figure))
    gates = judge(baseline, candidate, replace(policy, rules=rules), today=today)
    label = _label(list(baseline))
    judged = [
        gate if gate.pass_name else replace(gate, pass_name=label)
        for gate in gates
        if not _needs_frames(gate.name)
    ]
    return [*judged, *not_judged(policy, list(baseline), reason, frames_only=True)]


def not_judged(
    policy: GatePolicy, names: Sequence[str], reason: str, *, frames_only: bool = False
) -> list[Gate]:
    """Return a gate that is not judged for each metric of a policy, or for each metric that needs frames."""
    rules = {rule.figure: rule for rule in policy.rules if not frames_only or _needs_frames(rule.figure)}
    return [
        Gate(
            rule.figure,
            NOT_JUDGED,
            math.nan,
            math.nan,
            rule.margin,
            math.nan,
            pass_name=_label(names),
            resolution=math.inf,
            reason=reason,
        )
        for rule in rules.values()
    ]


def _needs_frames(figure: str) -> bool:
    return figure.startswith(FRAME_METRICS)


def _label(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{len(names)} passes without frames"


def verdict_of(gates: Sequence[Gate]) -> str:
    """Return "fail", "pass" or (also without gates) "inconclusive" over the judged gates that are not waived."""
    gates = [gate for gate in gates if gate.outcome != NOT_JUDGED]
    if any(gate.outcome == FAIL and not gate.waived for gate in gates):
        return FAIL
    return PASS if gates and all(gate.counts_as_passed for gate in gates) else INCONCLUSIVE


def metric_interval(sample: Sample, sizes: Sequence[int], resamples: int) -> tuple[float, float]:
    """Return the 95 % interval of a metric of one build by a block bootstrap; NaN where there is none."""
    whole = np.ones((1, sum(sizes)))
    if isinstance(sample, Ratio):
        series = ratio_influence(sample.numerator, sample.denominator)
    else:
        value = float(sample.value(whole)[0])
        series = np.where(sample.known, sample.values > value, False).astype(np.float64)
    if not np.isfinite(series).all() or sum(sizes) == 0:
        return math.nan, math.nan
    block = block_length(autocorrelation_time(series, sizes))
    return interval(sample.value(block_weights(tuple(sizes), block, resamples)))


def rule_of(policy: GatePolicy, figure: str) -> GateRule | None:
    """Return the last rule that applies to a metric; None if none does."""
    found = [rule for rule in policy.rules if fnmatch.fnmatchcase(figure, rule.figure)]
    return found[-1] if found else None


@dataclass(frozen=True, slots=True)
class _Test:
    """Gate before the level of its test is known; `change` (positive is worse) and `margin` are in the tested scale."""

    name: str
    unit: str
    pass_name: str
    baseline: float
    candidate: float
    change: float
    spread: Spread
    margin: float
    stated_margin: float
    relative: bool
    sign: float
    frames: int
    passes: int
    missing: int = 0
    reason: str = ""

    @property
    def p_value(self) -> float:
        """Probability of at least this degradation if the true degradation equals the margin."""
        if math.isnan(self.change):
            # Telemetry that only the baseline sends is a fault of the candidate; a cost that was not measured is not.
            lost = math.isfinite(self.baseline) and not self.name.startswith(LATENCY)
            return 0.0 if lost else 1.0
        if self.change <= self.margin:
            return 1.0
        error = self.spread.failure_error
        if math.isinf(self.change) or error == 0.0:
            return 0.0
        if not math.isfinite(error) or self.spread.freedom < 1.0:
            return 1.0
        return student_upper_tail((self.change - self.margin) / error, self.spread.freedom)


def _tests(
    before: Sequence[PassFrames], after: Sequence[PassFrames], policy: GatePolicy, pass_name: str
) -> list[_Test]:
    sizes = [len(one) for one in before]
    old, new = joined(before), joined(after)
    identical = same_telemetry(old, new)
    whole = np.ones((1, len(old)))
    tests = []
    for figure in figures_of([*before, *after]):
        rule = rule_of(policy, figure.name)
        margin = _margin(rule, pass_name)
        if rule is None or margin is None:
            continue
        samples = figure.sample(old), figure.sample(new)
        then, now = (float(sample.value(whole)[0]) for sample in samples)
        if not (math.isfinite(then) or math.isfinite(now) or rule.required):
            continue  # neither build has this metric
        # Latencies are equal in every frame only if both builds are the same replay.
        exact = _same_values(*samples) if figure.name.startswith(LATENCY) else identical
        spread = Spread(0.0, math.inf, 1.0) if exact else _spread(figure, *samples, sizes, policy)
        tests.append(
            _Test(
                figure.name,
                figure.unit,
                pass_name,
                then,
                now,
                _change(figure, then, now),
                spread,
                math.log1p(margin) if figure.relative else margin,
                margin,
                figure.relative,
                -1.0 if figure.higher_is_better else 1.0,
                len(old),
                sum(1 for size in sizes if size),
                missing=_missing(figure, *samples),
                reason=(_SAME if figure.name.startswith(LATENCY) else _IDENTICAL) if exact else "",
            )
        )
    rule = rule_of(policy, BIAS)
    margin = _margin(rule, pass_name)
    if margin is not None:
        bias = _bias_test(old, new, margin, sizes, policy, pass_name, identical)
        if bias is not None:
            tests.append(bias)
    return tests


def _margin(rule: GateRule | None, pass_name: str) -> float | None:
    if rule is None:
        return None
    return rule.pass_margin if pass_name else rule.margin


def _missing(figure: Figure, old: Sample, new: Sample) -> int:
    """Return the number of frames in which only the baseline has a value of a telemetered metric."""
    if figure.name.startswith(LATENCY):
        return 0  # a stage that did not run has no latency
    return int(np.count_nonzero(old.known & ~new.known))


def _same_values(old: Sample, new: Sample) -> bool:
    return (
        isinstance(old, Percentile)
        and isinstance(new, Percentile)
        and np.array_equal(old.values, new.values, equal_nan=True)
    )


def _change(figure: Figure, then: float, now: float) -> float:
    """Return the degradation: a difference, or the logarithm of a ratio; infinite relative to zero."""
    sign = -1.0 if figure.higher_is_better else 1.0
    if not figure.relative:
        return sign * (now - then)
    if then == now:
        return 0.0
    if not (then > 0.0 and now >= 0.0):
        return math.inf if then == 0.0 and now > 0.0 else math.nan
    return sign * (math.log(now / then) if now > 0.0 else -math.inf)


def _spread(figure: Figure, old: Sample, new: Sample, sizes: Sequence[int], policy: GatePolicy) -> Spread:
    if isinstance(old, Ratio) and isinstance(new, Ratio):
        return _ratio_spread(old, new, figure.relative, sizes, policy)
    assert isinstance(old, Percentile) and isinstance(new, Percentile)
    return _percentile_spread(old, new, figure.relative, sizes, policy)


def _ratio_spread(old: Ratio, new: Ratio, relative: bool, sizes: Sequence[int], policy: GatePolicy) -> Spread:
    """Return the spread of the change of a ratio of sums, from the influence of each frame."""
    influences = []
    for sample in (old, new):
        influence = ratio_influence(sample.numerator, sample.denominator)
        if relative:
            value = float(sample.value(np.ones((1, len(influence))))[0])
            influence = influence / value if value > 0.0 else np.full(len(influence), np.nan)
        influences.append(influence)
    series = influences[1] - influences[0]
    if not np.isfinite(series).all():
        return Spread(math.nan, 0.0, 1.0)
    spread = series_spread(series, sizes)
    if spread.freedom < 1.0:
        return spread
    one_frame = math.sqrt(2.0) * float(np.sqrt(np.mean(influences[0] ** 2)))
    counted = float(np.sum(np.where(old.known, old.denominator, 0.0)))
    one_count = 1.0 / counted if old.counts and counted > 0.0 else 0.0
    changes = unseen_changes(policy.confidence) / student_quantile(policy.confidence, spread.freedom)
    return replace(spread, floor=changes * spread.correlation_frames * max(one_frame, one_count))


def _percentile_spread(
    old: Percentile, new: Percentile, relative: bool, sizes: Sequence[int], policy: GatePolicy
) -> Spread:
    """Return the spread of the change of a percentile, from a block bootstrap of both builds with equal weights."""
    whole = np.ones((1, len(old.values)))
    then, now = float(old.value(whole)[0]), float(new.value(whole)[0])
    with np.errstate(invalid="ignore"):
        beyond = np.where(new.known, new.values > now, 0.0) - np.where(old.known, old.values > then, 0.0)
    time = series_spread(np.asarray(beyond, dtype=np.float64), sizes).correlation_frames
    block = block_length(time)
    weights = block_weights(tuple(sizes), block, policy.resamples)
    pair = old.value(weights), new.value(weights)
    with np.errstate(divide="ignore", invalid="ignore"):
        change = np.log(pair[1] / pair[0]) if relative else pair[1] - pair[0]
    change = np.where(pair[0] == pair[1], 0.0, change)
    spread = resampled_spread(change, sizes, block, time)
    if spread.freedom < 1.0:
        return spread
    # In an equivalent sample, this share of the values may lie on the other side of the percentile.
    independent = float(np.count_nonzero(old.known)) / time
    unseen = unseen_changes(policy.confidence) / independent if independent > 0.0 else math.inf
    reach = student_quantile(policy.confidence, spread.freedom)

    def step(sample: Percentile, value: float, level: float) -> float:
        moved = float(Percentile(sample.values, level).value(whole)[0])
        if not relative:
            return abs(moved - value)
        return abs(math.log(moved / value)) if moved > 0.0 and value > 0.0 else 0.0

    lower = max(old.level - unseen, 1e-9)
    upper = old.level + unseen
    return replace(
        spread,
        floor=step(old, then, upper) / reach if upper < 1.0 else math.inf,
        fewest_frames=unseen_changes(policy.confidence) * time / (1.0 - old.level),
        failure_floor=max(step(old, then, lower), step(new, now, lower)) / reach,
    )


def _bias_test(
    old: PassFrames,
    new: PassFrames,
    margin: float,
    sizes: Sequence[int],
    policy: GatePolicy,
    pass_name: str,
    identical: bool,
) -> _Test | None:
    """Test whether the candidate's centres are shifted relative to the baseline's, other than by a reduced bias.

    The metric is the length of the mean difference of detected and catalogued centre. What is tested is the length of
    its change, along the direction of the change; a change that at least halves the bias is no degradation.
    """
    whole = np.ones((1, len(old)))
    pairs = list(zip(shift_samples(old), shift_samples(new), strict=True))
    then = np.array([float(first.value(whole)[0]) for first, _ in pairs])
    now = np.array([float(second.value(whole)[0]) for _, second in pairs])
    if not (np.isfinite(then).all() or np.isfinite(now).all()):
        return None
    moved = now - then
    length = float(np.linalg.norm(moved))
    better = float(np.linalg.norm(now)) <= 0.5 * float(np.linalg.norm(then))
    if identical:
        spread = Spread(0.0, math.inf, 1.0)
    else:
        direction = moved / length if math.isfinite(length) and length > 0.0 else np.array([1.0, 0.0])
        along = [
            Ratio(
                direction[0] * parts[0].numerator + direction[1] * parts[1].numerator,
                parts[0].denominator,
                counts=False,
            )
            for parts in (shift_samples(old), shift_samples(new))
        ]
        spread = _ratio_spread(along[0], along[1], False, sizes, policy)
    return _Test(
        BIAS,
        "px",
        pass_name,
        float(np.linalg.norm(then)),
        float(np.linalg.norm(now)),
        0.0 if better else length,
        spread,
        margin,
        margin,
        False,
        1.0,
        len(old),
        sum(1 for size in sizes if size),
        reason=_IDENTICAL if identical else "",
    )


def _decided(tests: Sequence[_Test], alpha: float, policy: GatePolicy) -> list[Gate]:
    levels = holm_levels([test.p_value for test in tests], alpha)
    return [_gate(test, level, policy) for test, level in zip(tests, levels, strict=True)]


def _gate(test: _Test, level: float, policy: GatePolicy) -> Gate:
    detectable = resolution(test.spread, policy.confidence, policy.power)
    low = high = math.nan
    if math.isfinite(test.change) and math.isfinite(test.spread.error):
        reach = student_quantile(policy.confidence, test.spread.freedom)
        low = test.change - (reach * test.spread.failure_error if test.spread.failure_error > 0.0 else 0.0)
        high = test.change + (reach * test.spread.credible_error if test.spread.credible_error > 0.0 else 0.0)
    outcome, reason, needed = _outcome(test, level, detectable, high, policy)
    return Gate(
        test.name,
        outcome,
        test.baseline,
        test.candidate,
        test.stated_margin,
        _limit(test),
        test.unit,
        test.pass_name,
        _stated(test, low),
        _stated(test, high),
        test.p_value,
        level,
        _stated(test, detectable),
        test.frames,
        needed,
        reason,
    )


def _outcome(
    test: _Test, level: float, detectable: float, high: float, policy: GatePolicy
) -> tuple[str, str, int | None]:
    """Return outcome, reason, and the number of frames needed to decide the gate."""
    if test.p_value <= level:
        return FAIL, "the candidate has no value" if math.isnan(test.change) else "", None
    if not math.isfinite(test.baseline):
        return INCONCLUSIVE, "unknown: the baseline has no value", None
    if math.isnan(test.change):
        return INCONCLUSIVE, "unknown: the candidate has no value", None
    if test.missing:
        return (
            INCONCLUSIVE,
            f"unknown: the candidate has no value on {test.missing} of {test.frames} frames",
            None,
        )

    def needed(detected: float) -> int | None:
        return frames_needed(test.frames, test.passes, test.spread, detected, policy.confidence, policy.power)

    better = high <= 0.0 and math.isfinite(test.spread.floor) and test.spread.error > 0.0
    if detectable > test.margin and not better:
        return INCONCLUSIVE, "the resolution exceeds the margin", needed(test.margin)
    if high > test.margin:
        return INCONCLUSIVE, "the change is too close to the margin", needed(abs(test.margin - test.change))
    return PASS, test.reason, None


def _limit(test: _Test) -> float:
    if test.relative:
        return test.baseline * _ratio(test.sign * test.margin)
    if test.name == BIAS:
        return test.baseline + test.margin
    return test.baseline + test.sign * test.margin


def _stated(test: _Test, change: float) -> float:
    """Return a change of the tested scale in the unit of the margin."""
    return _ratio(change) - 1.0 if test.relative else change


def _ratio(logarithm: float) -> float:
    """Return the ratio of a logarithm; infinite for too few frames."""
    return math.inf if logarithm > _LARGEST_LOG else math.exp(logarithm)


def _exact(before: Sequence[PassFrames], after: Sequence[PassFrames], policy: GatePolicy) -> list[Gate]:
    """Gates without chance in them."""
    gates = []
    frames = sum(len(one) for one in before)
    rule = rule_of(policy, UNDECODABLE)
    if rule is not None:
        then, now = (float(sum(one.undecodable for one in passes)) for passes in (before, after))
        limit = then + rule.margin
        outcome = PASS if now <= limit else FAIL
        gates.append(Gate(UNDECODABLE, outcome, then, now, rule.margin, limit, "packets", frames=frames))
    rule = rule_of(policy, MEMORY)
    then, now = (float(np.max([one.memory_mib for one in passes])) for passes in (before, after))
    if rule is not None and (math.isfinite(then) or math.isfinite(now) or rule.required):
        limit = then * (1.0 + rule.margin)
        known = math.isfinite(then) and math.isfinite(now)
        lacking = "the candidate" if math.isfinite(then) else "the baseline"
        gates.append(
            Gate(
                MEMORY,
                INCONCLUSIVE if not known else PASS if now <= limit else FAIL,
                then,
                now,
                rule.margin,
                limit,
                "MiB",
                resolution=0.0 if known else math.inf,
                frames=frames,
                reason="" if known else f"unknown: {lacking} has no value",
            )
        )
    return gates


def _unknown(policy: GatePolicy, judged: set[str], frames: int) -> list[Gate]:
    """Return inconclusive gates for the rules whose required metric does not exist."""
    return [
        Gate(
            rule.figure,
            INCONCLUSIVE,
            math.nan,
            math.nan,
            rule.margin,
            math.nan,
            resolution=math.inf,
            frames=frames,
            reason="unknown: neither build has this metric",
        )
        for rule in policy.rules
        if rule.required and not any(fnmatch.fnmatchcase(name, rule.figure) for name in judged)
    ]


def _with_waiver(gate: Gate, waivers: Sequence[Waiver], today: str) -> Gate:
    if gate.passed or not today:
        return gate
    for waiver in waivers:
        applies = fnmatch.fnmatchcase(gate.name, waiver.gate) and fnmatch.fnmatchcase(
            gate.pass_name, waiver.pass_name
        )
        if applies and today <= waiver.until:
            return replace(gate, waived=f"{waiver.reason} (until {waiver.until})")
    return gate
