"""Noise of equal builds: what placebos changed, and whether the gates reject them as rarely as their level allows.

A placebo compares a build with itself, with other noise in the images. The change of each primary metric on each pass
is tested against no loss at `PLACEBO_LEVEL`; a placebo is rejected if it is significant. An exact gate, and the whole
verdict, is rejected if it fails, at the level of the policy. A gate is uncalibrated if so many rejections have a
probability below `DOUBT` (binomial test). Passes of one night have noise of their own and count as independent.
"""

import math
from collections.abc import Iterable, Sequence

import numpy as np

from ground_service.regression.gates import statistics
from ground_service.regression.gates.core import EXACT_METRICS, FAIL, NOT_JUDGED, PASS_SPREAD, GatePolicy, verdict_of
from ground_service.regression.gates.metrics import metrics_of
from ground_service.regression.gates.samples import PassFrames
from ground_service.regression.model import Calibration, Noise
from reports.values import Gate

PLACEBO_LEVEL = 0.05
DOUBT = 1e-3
"""Small, because the rejections are counted again after every placebo."""

VERDICT = "verdict"


def pass_noise(before: PassFrames, after: PassFrames, policy: GatePolicy, condition: str) -> list[Noise]:
    """Return the changes of the primary metrics on one pass between two replays of equal builds."""
    metrics, found = {one.name: one for one in metrics_of([before, after])}, list[Noise]()
    for rule in policy.rules:
        metric = metrics.get(rule.metric)
        if rule.weight == 0.0 or metric is None:
            continue
        if metric.sums is None:
            old, new = (np.array([metric.value(one)]) for one in (before, after))
            change = statistics.mean_change(old, new, metric.relative)
            error, freedom = PASS_SPREAD, math.inf
        else:
            change = statistics.ratio_change(*statistics.aligned(metric.sums(before), metric.sums(after)))
            error, freedom = change.error, change.units - 1.0
        loss = -change.estimate if metric.higher_is_better else change.estimate
        if math.isfinite(loss / error) and freedom >= 1.0:
            p_value = statistics.student_upper_tail(loss / error, min(freedom, 1e9))
            found.append(
                Noise(
                    metric=metric.name,
                    condition=condition,
                    loss=loss,
                    square=(loss / error) ** 2,
                    p_value=p_value,
                    level=PLACEBO_LEVEL,
                )
            )
    return found


def gate_noise(gates: Sequence[Gate], policy: GatePolicy) -> list[Noise]:
    """Return the outcomes of the exact gates and of the verdict on equal builds; none where nothing was judged."""
    outcomes = {gate.name: gate.outcome for gate in gates if gate.name in EXACT_METRICS}
    return [
        Noise(metric=name, p_value=float(outcome != FAIL), level=policy.fail_level)
        for name, outcome in {**outcomes, VERDICT: verdict_of(gates) if gates else NOT_JUDGED}.items()
        if outcome != NOT_JUDGED
    ]


def calibrations(noise: Iterable[Noise]) -> list[Calibration]:
    """Return the noise of each metric over all placebos, and under each condition."""
    groups: dict[tuple[str, str], list[Noise]] = {}
    for one in noise:
        for condition in dict.fromkeys(("", one.condition)):
            groups.setdefault((one.metric, condition), []).append(one)
    return [_calibration(*key, rows) for key, rows in sorted(groups.items())]


def _calibration(metric: str, condition: str, rows: Sequence[Noise]) -> Calibration:
    rejected = sum(one.p_value <= one.level for one in rows)
    level = max(one.level for one in rows)
    losses = np.array([one.loss for one in rows if one.loss is not None])
    squares = [one.square for one in rows if one.square is not None]
    return Calibration(
        metric=metric,
        condition=condition,
        placebos=len(rows),
        rejected=rejected,
        level=level,
        spread=float(np.sqrt(np.mean(losses**2))) if len(losses) else None,
        mean_square=float(np.mean(squares)) if squares else None,
        calibrated=rejected == 0 or statistics.binomial_upper_tail(rejected, len(rows), level) >= DOUBT,
    )
