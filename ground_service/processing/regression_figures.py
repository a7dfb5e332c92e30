"""Figures of a build over passes: each a function of frame samples and frame weights, so that it can be resampled."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ground_service.processing.regression_samples import BAD_OUTCOMES, EstimatorFrames, PassFrames
from ground_service.processing.regression_statistics import weighted_quantile, weighted_ratio

FloatArray = NDArray[np.float64]
Compute = Callable[[PassFrames, FloatArray], FloatArray]

LATENCY_LEVEL = 0.25
"""Of CPU times the lower quartile over the frames is taken: whatever else the machine does only ever adds."""


@dataclass(frozen=True, slots=True)
class Figure:
    """A figure that can be gated.

    Attributes
    ----------
    name, unit
        As in policies and verdicts.
    higher_is_better
        Which way is worse.
    relative
        Whether a change counts as a ratio (lengths, times) or as a difference (shares, pixels).
    compute
        Figure for each row of weights (b, n).
    """

    name: str
    unit: str
    higher_is_better: bool
    relative: bool
    compute: Compute


def figures_of(passes: Sequence[PassFrames]) -> tuple[Figure, ...]:
    """Every figure that can be made of these passes, whichever build flew them."""
    estimators = sorted({name for one in passes for name in one.estimators})
    stages = sorted({name for one in passes for name in one.latency})
    found = [
        Figure("detector.recall", "", True, False, _ratio("hits", "expected")),
        Figure("detector.precision", "", True, False, _precision),
        Figure("detector.localisation", "px", False, False, _ratio("error_px", "hits")),
        Figure("telemetry.packets_per_frame", "", False, True, _mean("packets")),
        Figure("telemetry.octets_per_frame", "octets", False, True, _mean("octets")),
        Figure("telemetry.frames_answered", "", True, False, _answered),
    ]
    for name in estimators:
        place = f"navigation.{name}"
        found += [
            Figure(f"{place}.p50", "m", False, True, _error(name, 0.5)),
            Figure(f"{place}.p95", "m", False, True, _error(name, 0.95)),
            Figure(f"{place}.bad_outcomes", "", False, False, _share(name, *BAD_OUTCOMES)),
        ]
        if any(np.isfinite(one.estimators[name].nees).any() for one in passes if name in one.estimators):
            found += [
                Figure(f"{place}.nees", "", False, True, _nees(name)),
                Figure(f"{place}.sigma_p95", "m", False, True, _sigma(name)),
                Figure(f"{place}.fixes", "", True, False, _share(name, "fixed")),
                Figure(f"{place}.wrong_fixes", "", False, False, _wrong(name)),
            ]
        else:
            found.append(Figure(f"{place}.drift", "% of path", False, True, _drift(name)))
    found += [Figure(f"latency.{name}", "yardsticks", False, True, _latency(name)) for name in stages]
    return tuple(found)


def outcome_shares(frames: PassFrames) -> dict[str, dict[str, float]]:
    """Share of frames of every outcome, by estimator."""
    shares: dict[str, dict[str, float]] = {}
    for name, estimator in frames.estimators.items():
        known = [outcome for outcome in estimator.outcome if outcome]
        shares[name] = {outcome: known.count(outcome) / len(known) for outcome in sorted(set(known))}
    return shares


def shift_px(frames: PassFrames, weights: FloatArray) -> FloatArray:
    """Mean of detected minus expected centre (b, 2) over the hits."""
    return np.column_stack(
        [
            weighted_ratio(frames.shift_u_px, frames.hits, weights),
            weighted_ratio(frames.shift_v_px, frames.hits, weights),
        ]
    )


def joined(passes: Sequence[PassFrames]) -> PassFrames:
    """The frames of some passes one after another; what a pass lacks is NaN there."""
    if len(passes) == 1:
        return passes[0]

    def column(name: str) -> FloatArray:
        return np.concatenate([np.asarray(getattr(one, name)) for one in passes])

    names = sorted({name for one in passes for name in one.estimators})

    def estimator(name: str) -> EstimatorFrames:
        parts = [one.estimators.get(name) or _silent(len(one)) for one in passes]
        return EstimatorFrames(
            np.concatenate([part.error_m for part in parts]),
            np.concatenate([part.sigma_m for part in parts]),
            np.concatenate([part.nees for part in parts]),
            np.concatenate([part.drift_percent for part in parts]),
            tuple(outcome for part in parts for outcome in part.outcome),
            np.concatenate([part.wrong for part in parts]),
        )

    def costs(kind: str) -> Mapping[str, FloatArray]:
        every: list[Mapping[str, FloatArray]] = [getattr(one, kind) for one in passes]
        return {
            stage: np.concatenate(
                [
                    given.get(stage, np.full(len(one), np.nan))
                    for given, one in zip(every, passes, strict=True)
                ]
            )
            for stage in sorted({stage for given in every for stage in given})
        }

    return PassFrames(
        answered=np.concatenate([one.answered for one in passes]),
        expected=column("expected"),
        hits=column("hits"),
        alarms=column("alarms"),
        error_px=column("error_px"),
        shift_u_px=column("shift_u_px"),
        shift_v_px=column("shift_v_px"),
        packets=column("packets"),
        octets=column("octets"),
        estimators={name: estimator(name) for name in names},
        latency=costs("latency"),
        latency_ms=costs("latency_ms"),
        undecodable=sum(one.undecodable for one in passes),
        memory_mib=max(one.memory_mib for one in passes),
    )


def _silent(frames: int) -> EstimatorFrames:
    nothing = np.full(frames, np.nan)
    return EstimatorFrames(nothing, nothing, nothing, nothing, ("",) * frames, nothing)


def _ratio(numerator: str, denominator: str) -> Compute:
    return lambda frames, weights: weighted_ratio(
        getattr(frames, numerator), getattr(frames, denominator), weights
    )


def _precision(frames: PassFrames, weights: FloatArray) -> FloatArray:
    return weighted_ratio(frames.hits, frames.hits + frames.alarms, weights)


def _mean(name: str) -> Compute:
    return lambda frames, weights: _mean_of(getattr(frames, name), weights)


def _answered(frames: PassFrames, weights: FloatArray) -> FloatArray:
    return _mean_of(frames.answered.astype(np.float64), weights)


def _mean_of(values: FloatArray, weights: FloatArray) -> FloatArray:
    return weighted_ratio(values, np.ones(len(values)), weights)


def _error(estimator: str, level: float) -> Compute:
    return _of(estimator, lambda e, w: weighted_quantile(e.error_m, level, w))


def _sigma(estimator: str) -> Compute:
    return _of(estimator, lambda e, w: weighted_quantile(e.sigma_m, 0.95, w))


def _share(estimator: str, *outcomes: str) -> Compute:
    return _of(estimator, lambda e, w: _mean_of(e.share(*outcomes), w))


def _nees(estimator: str) -> Compute:
    return _of(estimator, lambda e, w: _mean_of(e.nees, w))


def _wrong(estimator: str) -> Compute:
    return _of(estimator, lambda e, w: _mean_of(e.wrong, w))


def _drift(estimator: str) -> Compute:
    return _of(estimator, lambda e, w: weighted_quantile(e.drift_percent, 0.5, w))


def _of(estimator: str, compute: Callable[[EstimatorFrames, FloatArray], FloatArray]) -> Compute:
    def figure(frames: PassFrames, weights: FloatArray) -> FloatArray:
        if estimator not in frames.estimators:
            return np.full(len(weights), np.nan)
        return compute(frames.estimators[estimator], weights)

    return figure


def _latency(stage: str) -> Compute:
    def figure(frames: PassFrames, weights: FloatArray) -> FloatArray:
        if stage not in frames.latency:
            return np.full(len(weights), np.nan)
        return weighted_quantile(frames.latency[stage], LATENCY_LEVEL, weights)

    return figure
