"""Gates: whether a candidate build is worse than a baseline by more than a policy tolerates.

Few gates decide. *Exact* gates compare counts without chance: packets that cannot be decoded, time tags that contradict
each other, frames without a value, wrong fixes, memory. *Primary* gates compare recall, false detections, localisation,
share of fixes and position error, and make one of three claims:

- **fail**: the lower confidence bound of the loss is above what is material;
- **pass**: the upper 95 % bound of the loss is below the margin;
- **inconclusive**: neither, with the number of frames still needed.

If both bounds hold, fail takes precedence. The level of all fail claims together is that of the policy: half for the
gates over all passes, shared by their weights, and half for recall and precision of single passes and kinds of terrain;
one pass has no second half. A pass needs no correction for the number of gates, since every gate must pass
(intersection-union test). All other metrics *inform*: their changes are significant under Holm's procedure at a level
of their own, and never decide. Claims are on the passes that were replayed.

References
----------
R. L. Berger, "Multiparameter hypothesis testing and acceptance sampling", Technometrics 24, 1982.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np
from annotated_types import Interval

from ground_service.regression.gates import statistics
from ground_service.regression.gates.metrics import (
    FRAMES,
    LATENCY,
    MEMORY,
    PRECISION,
    RECALL,
    RUN,
    START,
    TIMES,
    UNDECODABLE,
    WRONG_FIXES,
    Metric,
    counts,
    identical,
    metrics_of,
)
from ground_service.regression.gates.samples import KINDS, PassFrames
from reports.text import counted, loss_text
from reports.values import Gate

PASS, FAIL, INCONCLUSIVE = "pass", "fail", "inconclusive"
NOT_JUDGED, INFORMS = "not judged", "informs"

COSTS = {
    MEMORY: "peak memory",
    LATENCY: "processor time of a frame",
    START: "processor time of the start",
    RUN: "processor time of the run",
}
EXACT_METRICS = (UNDECODABLE, TIMES, FRAMES, WRONG_FIXES, *COSTS)
"""Metrics that are compared without chance."""

NEEDS_FRAMES = ("detector.", "latency.", MEMORY)
"""Beginnings of the names of the metrics that need images."""

PASS_CONFIDENCE = 0.95
POWER = 0.8

INFORM_LEVEL = 0.01
"""Probability that an equal build has any significant change among the metrics that inform."""

WINDOW_FRAMES = 200
"""With fewer frames the larger materiality and margin of a single window apply."""

CHANCE_SIGMAS = 2.33
"""Roots of the number of wrong fixes of the baseline on a pass by which that of an equal build is larger in 1 %."""

FEWEST_TRACKS = 90
"""Tracks or ground cells below which only a loss beyond the margin of a window is claimed."""

FEWEST_PASSES = 10
"""Passes from which position errors are judged by their own spread; fewer inform only, except of a gross change."""

START_FLOOR_S = 0.5
"""Shorter delays of the start and of a run are tolerated."""

PASSES_OF_TIMES = 5
"""Passes from which the narrower margin of processor times applies to the median of their ratios."""

PASS_SPREAD = 0.33
"""Largest standard deviation between passes of the log ratio of the median errors of two equal builds."""

IDENTICAL = "identical in every octet"
_LARGEST_LOG = 50.0


Size = Annotated[float, Interval(ge=0.0, le=1e9)]


@dataclass(frozen=True, slots=True)
class GateRule:
    """Gate of a policy: an exact metric with a margin, or a primary metric with a weight and the sizes that count.

    Attributes
    ----------
    weight
        Share of the level of the fail claims; 0 for exact metrics.
    materiality, margin
        A failure proves a larger loss, a pass excludes one as large: in the metric's unit, or as a share of the
        baseline.
    window_materiality, window_margin
        The same for less than `WINDOW_FRAMES` frames, and for single passes; None: the same values.
    """

    metric: str
    margin: Size
    reason: str
    weight: Annotated[float, Interval(ge=0.0, le=1.0)] = 0.0
    materiality: Size = 0.0
    window_margin: Annotated[float, Interval(gt=0.0, le=1e9)] | None = None
    window_materiality: Size | None = None

    def sizes(self, window: bool) -> tuple[float, float]:
        """Return materiality and margin."""
        pairs = ((self.window_materiality, self.materiality), (self.window_margin, self.margin))
        materiality, margin = (own if window and own is not None else general for own, general in pairs)
        return materiality, margin


@dataclass(frozen=True, slots=True)
class GatePolicy:
    """Policy for the comparison of builds.

    Attributes
    ----------
    fail_level
        Probability that an equal build fails any gate by chance.
    inconclusive
        What an inconclusive verdict is in JUnit: "failure" or "skip".
    """

    version: str
    fail_level: float
    rules: tuple[GateRule, ...]
    inconclusive: str = "failure"


def judge(
    before: Mapping[str, PassFrames],
    after: Mapping[str, PassFrames],
    policy: GatePolicy,
    *,
    imaged: Collection[str] | None = None,
) -> list[Gate]:
    """Return the gates over the passes replayed by both builds: exact ones, primary ones, metrics that inform.

    Parameters
    ----------
    before, after
        Frames of each pass by its name, of baseline and candidate.
    imaged
        Passes that were replayed from images; the others have no metrics that need them. None: all.
    """
    names = [name for name in before if name in after]
    if not names:
        return []
    before, after = ({name: side[name] for name in names} for side in (before, after))
    pictured = names if imaged is None else [name for name in names if name in imaged]
    same = identical(before, after)
    metrics = {one.name: one for one in metrics_of([*before.values(), *after.values()])}
    tests = _local_tests(before, after, pictured, policy, metrics)
    level = policy.fail_level / (2.0 if tests else 1.0)
    gates = [_exact_gate(before, after, rule, pictured, metrics) for rule in policy.rules if rule.weight == 0.0]
    for rule in policy.rules:
        if rule.weight > 0.0:
            chosen = pictured if rule.metric.startswith(NEEDS_FRAMES) else names
            gates.append(_primary(before, after, chosen, rule, metrics, level * rule.weight, same))
    local = [_decided(*test, level / len(tests), window=True) for test in tests]
    gates += [gate for gate in local if gate.outcome == FAIL]
    return gates + _informing(before, after, names, pictured, policy, metrics)


def verdict_of(gates: Sequence[Gate]) -> str:
    """Return "fail", "pass" or (also if no gate passed) "inconclusive" over the deciding gates."""
    counted = [gate for gate in gates if gate.outcome not in (NOT_JUDGED, INFORMS)]
    if any(gate.outcome == FAIL for gate in counted):
        return FAIL
    chance = [gate for gate in counted if gate.name not in EXACT_METRICS]
    return PASS if chance and all(gate.passed for gate in counted) else INCONCLUSIVE


def _exact_gate(
    before: Mapping[str, PassFrames],
    after: Mapping[str, PassFrames],
    rule: GateRule,
    pictured: Sequence[str],
    metrics: Mapping[str, Metric],
) -> Gate:
    frames = sum(len(one) for one in before.values())
    if rule.metric in COSTS:
        return _cost_gate(before, after, rule, pictured, metrics[rule.metric], frames)
    found = {name: counts(before[name], after[name])[rule.metric] for name in before}
    found = {name: one for name, one in found.items() if math.isfinite(one.baseline + one.candidate)}
    then, now = sum(one.baseline for one in found.values()), sum(one.candidate for one in found.values())
    if not found:
        then = now = math.nan
    tolerated, chance = rule.margin, 0.0
    if rule.metric == WRONG_FIXES:
        # Where the reference of a pass is wrong, most fixes of both builds are, and noise moves some over the limit.
        tolerated, chance = rule.margin * frames, CHANCE_SIGMAS
    excess = (one.candidate - one.baseline - chance * math.sqrt(one.baseline) for one in found.values())
    failed = sum(max(count, 0.0) for count in excess) > tolerated
    worst = max(found, key=lambda name: found[name].candidate - found[name].baseline, default="")
    unit = "packets" if rule.metric in (UNDECODABLE, TIMES) else "frames"
    more = sum(one.candidate > one.baseline for one in found.values()) - 1
    reason = f"{worst}: {found[worst].text}" + (f" (and on {more} more)" if more else "") if failed else ""
    if not found:
        reason = "it is unknown without a reference"
    limit = then + tolerated
    outcome = FAIL if failed else PASS if found else NOT_JUDGED
    return Gate(rule.metric, outcome, then, now, tolerated, limit, unit, frames=frames, reason=reason)


def _cost_gate(
    before: Mapping[str, PassFrames],
    after: Mapping[str, PassFrames],
    rule: GateRule,
    pictured: Sequence[str],
    metric: Metric,
    frames: int,
) -> Gate:
    """Compare the peak memory over the passes, or the median of the ratios of their processor times."""
    old, new = (np.array([metric.value(side[name]) for name in pictured]) for side in (before, after))
    known = np.isfinite(old + new)
    if not known.any():
        reason = "it was not measured for both builds"
        return Gate(metric.name, NOT_JUDGED, math.nan, math.nan, rule.margin, math.nan, metric.unit, reason=reason)
    if metric.name == MEMORY:
        margin, then, now = rule.margin, old[known].max(), new[known].max()
    else:
        _, margin = rule.sizes(int(known.sum()) < PASSES_OF_TIMES)
        then = float(np.median(old[known]))
        now = then * float(np.median(new[known] / old[known]))
    # A program that starts or runs in a tenth of a second has no time to speak of.
    limit = max(then * (1.0 + margin), then + START_FLOOR_S * (metric.name in (START, RUN)))
    reason = f"{COSTS[metric.name]} rises from {then:.4g} to {now:.4g} {metric.unit}" if now > limit else ""
    outcome = FAIL if reason else PASS
    return Gate(metric.name, outcome, then, now, margin, limit, metric.unit, frames=frames, reason=reason)


def _sums(
    before: Mapping[str, PassFrames], after: Mapping[str, PassFrames], names: Sequence[str], metric: Metric
) -> tuple[statistics.UnitSums, statistics.UnitSums]:
    assert metric.sums is not None
    pairs = [statistics.aligned(metric.sums(before[name]), metric.sums(after[name])) for name in names]
    return statistics.joined_sums([one for one, _ in pairs]), statistics.joined_sums([one for _, one in pairs])


_LocalTest = tuple[str, statistics.Change, Metric, GateRule, int]


def _local_tests(
    before: Mapping[str, PassFrames],
    after: Mapping[str, PassFrames],
    names: Sequence[str],
    policy: GatePolicy,
    metrics: Mapping[str, Metric],
) -> list[_LocalTest]:
    """Return recall and precision of single passes and of kinds of terrain, where they have enough units."""
    found: list[_LocalTest] = []
    for rule in policy.rules:
        if rule.metric not in (RECALL, PRECISION) or rule.weight == 0.0 or len(names) == 0:
            continue
        metric = metrics[rule.metric]
        parts = {name: _sums(before, after, [name], metric) for name in names} if len(names) > 1 else {}
        if rule.metric == RECALL:
            old, new = _sums(before, after, names, metric)
            kinds = [kind for kind in range(len(KINDS)) if np.sum(old.stratum == kind) >= FEWEST_TRACKS]
            for kind in kinds if len(kinds) > 1 else ():
                parts[f"{KINDS[kind]} terrain"] = (_stratum(old, kind), _stratum(new, kind))
        for name, (first, second) in parts.items():
            change = statistics.ratio_change(first, second)
            frames = len(before[name]) if name in before else sum(len(before[one]) for one in names)
            if change.units >= FEWEST_TRACKS:
                found.append((name, change, metric, rule, frames))
    return found


def _stratum(sums: statistics.UnitSums, stratum: int) -> statistics.UnitSums:
    rows = sums.stratum == stratum
    return statistics.UnitSums(sums.unit[rows], sums.stratum[rows], sums.numerator[rows], sums.denominator[rows])


def _primary(
    before: Mapping[str, PassFrames],
    after: Mapping[str, PassFrames],
    names: Sequence[str],
    rule: GateRule,
    metrics: Mapping[str, Metric],
    level: float,
    same: bool,
) -> Gate:
    frames = sum(len(before[name]) for name in names)
    nothing = Gate(rule.metric, NOT_JUDGED, math.nan, math.nan, rule.margin, math.nan, resolution=math.inf)
    if not names:
        return replace(nothing, reason="no pass was replayed from images")
    metric = metrics.get(rule.metric)
    if metric is None:
        return replace(nothing, frames=frames, reason="neither build has this metric")
    if metric.sums is None:
        values = [np.array([metric.value(side[name]) for name in names]) for side in (before, after)]
        change = statistics.mean_change(values[0], values[1], metric.relative)
    else:
        change = statistics.ratio_change(*_sums(before, after, names, metric))
    gate = _decided("", change, metric, rule, frames, level, window=frames < WINDOW_FRAMES)
    if same and math.isfinite(change.baseline):
        return replace(
            gate, outcome=PASS, change_low=0.0, change_high=0.0, resolution=0.0, reason=IDENTICAL, frames_needed=None
        )
    return gate


def _decided(
    place: str, change: statistics.Change, metric: Metric, rule: GateRule, frames: int, level: float, *, window: bool
) -> Gate:
    """Return the claim of one gate."""
    materiality, margin = rule.sizes(window)
    sign = -1.0 if metric.higher_is_better else 1.0
    stated = margin
    if metric.relative:
        materiality, margin = math.log1p(materiality), math.log1p(margin)
    limit = change.baseline * math.exp(sign * margin) if metric.relative else change.baseline + sign * margin
    gate = Gate(
        metric.name, INCONCLUSIVE, change.baseline, change.candidate, stated, limit, metric.unit, place,
        level=level, resolution=math.inf, frames=frames, evidence=counted(change.units, metric.evidence),
        relative=metric.relative,
    )  # fmt: skip
    if not math.isfinite(change.estimate):
        if math.isfinite(change.baseline):
            return replace(gate, outcome=FAIL, reason="the candidate has no value")
        return replace(gate, reason="unknown: the baseline has no value")
    loss, by_pass = sign * change.estimate, metric.sums is None
    error, freedom = change.error, change.units - 1.0
    if by_pass and change.units < FEWEST_PASSES:
        error, freedom = PASS_SPREAD / math.sqrt(change.units), math.inf
    if freedom < 1.0:
        return replace(gate, reason=f"{change.units} {metric.evidence} have no spread")
    reach, ahead, power = (
        statistics.student_quantile(at, min(freedom, 1e9)) for at in (1.0 - level, PASS_CONFIDENCE, POWER)
    )
    few = metric.evidence in ("tracks", "ground cells") and change.units < FEWEST_TRACKS
    claim = max(materiality, margin) if few else materiality
    low, high = loss - ahead * error, loss + ahead * error
    gate = replace(
        gate,
        change_low=_stated(metric, low),
        change_high=_stated(metric, high),
        p_value=statistics.student_upper_tail(loss / error, min(freedom, 1e9)) if error > 0.0 else float(loss <= 0.0),
        resolution=_stated(metric, claim + (reach + power) * error),
    )
    if loss - reach * error > claim:
        return replace(gate, outcome=FAIL)
    if by_pass and change.units < FEWEST_PASSES:
        reason = f"{_size(change, metric)}; fewer than {FEWEST_PASSES} passes inform only"
        return replace(gate, outcome=NOT_JUDGED, reason=reason)
    if few:
        needed = math.ceil(frames * FEWEST_TRACKS / max(change.units, 1))
        reason = f"{change.units} of {FEWEST_TRACKS} {metric.evidence}"
        return replace(gate, reason=reason, frames_needed=needed)
    if high < margin:
        return replace(gate, outcome=PASS)
    # The nearer claim: a pass if the loss is nearer to none than to the margin, else a failure.
    needed_to_pass = statistics.frames_needed(frames, error, margin - max(loss, 0.0), ahead + power)
    needed_to_fail = statistics.frames_needed(frames, error, loss - materiality, reach + power)
    known = [one for one in (needed_to_pass, needed_to_fail) if one is not None]
    reason = f"a loss of {loss_text(_stated(metric, max(high, 0.0)), metric.relative)} cannot be excluded"
    return replace(gate, reason=reason, frames_needed=min(known, default=None))


def _informing(
    before: Mapping[str, PassFrames],
    after: Mapping[str, PassFrames],
    names: Sequence[str],
    pictured: Sequence[str],
    policy: GatePolicy,
    metrics: Mapping[str, Metric],
) -> list[Gate]:
    """Return the metrics without a gate: values, and significance over the passes, which are the units."""
    decided = {rule.metric for rule in policy.rules}
    rows: list[tuple[Metric, statistics.Change, int]] = []
    for metric in metrics.values():
        chosen = pictured if metric.name.startswith(NEEDS_FRAMES) else names
        if metric.name in decided or not chosen:
            continue
        values = [np.array([metric.value(side[name]) for name in chosen]) for side in (before, after)]
        change = statistics.mean_change(values[0], values[1], metric.relative)
        if math.isfinite(change.baseline) or math.isfinite(change.candidate):
            rows.append((metric, change, sum(len(before[name]) for name in chosen)))
    p_values = [_two_sided(change) for _, change, _ in rows]
    levels = statistics.holm_levels(p_values, INFORM_LEVEL)
    gates = []
    for (metric, change, frames), p, level in zip(rows, p_values, levels, strict=True):
        reason = ""
        if p <= level:
            better = metric.higher_is_better == (change.estimate > 0.0)
            reason = f"{'better' if better else 'worse'} ({_size(change, metric)}, {counted(change.units, 'passes')})"
        gates.append(
            Gate(
                metric.name, INFORMS, change.baseline, change.candidate, math.nan, math.nan, metric.unit,
                p_value=p, level=level, resolution=math.inf, frames=frames,
                evidence=counted(change.units, "passes"), reason=reason,
            )
        )  # fmt: skip
    return gates


def _two_sided(change: statistics.Change) -> float:
    """Return the p-value of a mean change of passes; 1 for fewer than `FEWEST_PASSES`."""
    if change.units < FEWEST_PASSES or not math.isfinite(change.error):
        return 1.0
    if change.error == 0.0:
        return float(change.estimate == 0.0)
    return 2.0 * statistics.student_upper_tail(abs(change.estimate) / change.error, change.units - 1.0)


def _size(change: statistics.Change, metric: Metric) -> str:
    return f"{math.expm1(change.estimate):+.0%}" if metric.relative else f"{change.estimate:+.3g}"


def _stated(metric: Metric, change: float) -> float:
    """Return a loss of the tested scale in the unit of the margin."""
    if not metric.relative:
        return change
    return math.inf if change > _LARGEST_LOG else math.expm1(change)


SPREAD = {
    "detector.recall": 0.08,
    "detector.precision": 0.09,
    "detector.localisation": 0.3,
    "navigation.anchored.fixes": 0.13,
}
"""Standard error of the change by a threshold of 0.3, times the root of the number of frames.

Measured over the 42 windows of docs/results/regression.md. For a network of similar quality it is a fifth.
"""

MINUTES_PER_FRAME = 0.005
"""Time of a candidate from stored frames on one core."""


def detectable(policy: GatePolicy, frames: int, passes: int) -> list[dict[str, Any]]:
    """Return the loss of each primary metric that fails with a power of 0.8."""
    found = []
    for rule in policy.rules:
        if rule.metric in SPREAD and frames:
            level = policy.fail_level * rule.weight / (2.0 if passes > 1 else 1.0)
            reach = statistics.student_quantile(1.0 - level, 1e9) + statistics.student_quantile(POWER, 1e9)
            materiality, _ = rule.sizes(frames < WINDOW_FRAMES)
            change = round(materiality + reach * SPREAD[rule.metric] / math.sqrt(frames), 3)
            minutes = round(frames * MINUTES_PER_FRAME, 1)
            found.append({"metric": rule.metric, "change": change, "frames": frames, "minutes": minutes})
    return found


def power_text(found: Sequence[dict[str, Any]]) -> str:
    """Return the frames and minutes of all passes together and the losses that they detect, as one line."""
    losses = ", ".join(f"{one['metric']} {one['change']:.2g}" for one in found)
    cost = "{frames} frames, {minutes} minutes of a core for the candidate".format(**found[0])
    return f"all passes together ({cost}) find with a power of {POWER:g} a loss of: {losses}"
