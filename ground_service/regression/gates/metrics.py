"""Metrics of a build over passes. Each metric is a ratio of sums or a percentile over frames."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ground_service.regression.gates.samples import BAD_OUTCOMES, EstimatorFrames, PassFrames
from ground_service.regression.gates.statistics import weighted_quantile, weighted_ratio
from lunar.arrays import FloatArray

LATENCY_LEVEL = 0.25
"""Level of the percentile of CPU times: the lower quartile, because other load on the machine only increases them."""


@dataclass(frozen=True, slots=True, eq=False)
class Ratio:
    """Ratio of two sums over frames, (n,) each; NaN in the numerator excludes a frame.

    Attributes
    ----------
    counts
        Whether it is a share of counted items (craters, frames), whose resolution is limited to a few items.
    """

    numerator: FloatArray
    denominator: FloatArray
    counts: bool

    def value(self, weights: FloatArray) -> FloatArray:
        """Return the value for each row of weights (b, n)."""
        return weighted_ratio(self.numerator, self.denominator, weights)

    @property
    def known(self) -> NDArray[np.bool_]:
        """Return the mask (n,) of the frames that have a value."""
        return np.isfinite(self.numerator)


@dataclass(frozen=True, slots=True, eq=False)
class Percentile:
    """Percentile of the finite values (n,); `level` between 0 and 1."""

    values: FloatArray
    level: float

    def value(self, weights: FloatArray) -> FloatArray:
        """Return the value for each row of weights (b, n)."""
        return weighted_quantile(self.values, self.level, weights)

    @property
    def known(self) -> NDArray[np.bool_]:
        """Return the mask (n,) of the frames that have a value."""
        return np.isfinite(self.values)


Sample = Ratio | Percentile


@dataclass(frozen=True, slots=True)
class Figure:
    """Metric to which a gate can be applied.

    Attributes
    ----------
    name, unit
        Name and unit in policies and verdicts.
    higher_is_better
        Direction of improvement.
    relative
        Whether a change counts as a ratio (lengths, times) or as a difference (shares, pixels).
    sample
        Function that returns the sample of the metric.
    """

    name: str
    unit: str
    higher_is_better: bool
    relative: bool
    sample: Callable[[PassFrames], Sample]

    def compute(self, frames: PassFrames, weights: FloatArray) -> FloatArray:
        """Return the value for each row of weights (b, n)."""
        return self.sample(frames).value(weights)


def figures_of(passes: Sequence[PassFrames]) -> tuple[Figure, ...]:
    """Return every metric that these passes provide, for either build."""
    estimators = sorted({name for one in passes for name in one.estimators})
    stages = sorted({name for one in passes for name in one.latency})
    found = [
        Figure("detector.recall", "", True, False, lambda f: Ratio(f.hits, f.expected, counts=True)),
        Figure(
            "detector.precision", "", True, False, lambda f: Ratio(f.hits, f.hits + f.alarms, counts=True)
        ),
        Figure(
            "detector.localisation", "px", False, False, lambda f: Ratio(f.error_px, f.hits, counts=False)
        ),
        Figure("telemetry.packets_per_frame", "", False, True, lambda f: _mean(f.packets)),
        Figure("telemetry.octets_per_frame", "octets", False, True, lambda f: _mean(f.octets)),
        Figure("telemetry.frames_answered", "", True, False, lambda f: _share(f.answered.astype(np.float64))),
    ]
    for name in estimators:
        place = f"navigation.{name}"
        found += [
            Figure(f"{place}.p50", "m", False, True, _of(name, lambda e: Percentile(e.error_m, 0.5))),
            Figure(f"{place}.p95", "m", False, True, _of(name, lambda e: Percentile(e.error_m, 0.95))),
            Figure(
                f"{place}.bad_outcomes", "", False, False, _of(name, lambda e: _share(e.share(*BAD_OUTCOMES)))
            ),
        ]
        if any(
            np.isfinite(one.estimators[name].squared_normalised_error).any()
            for one in passes
            if name in one.estimators
        ):
            found += [
                Figure(
                    f"{place}.squared_normalised_error",
                    "",
                    False,
                    True,
                    _of(name, lambda e: _mean(e.squared_normalised_error)),
                ),
                Figure(
                    f"{place}.sigma_p95", "m", False, True, _of(name, lambda e: Percentile(e.sigma_m, 0.95))
                ),
                Figure(f"{place}.fixes", "", True, False, _of(name, lambda e: _share(e.share("fixed")))),
                Figure(f"{place}.wrong_fixes", "", False, False, _of(name, lambda e: _share(e.wrong))),
            ]
        else:
            found.append(
                Figure(
                    f"{place}.drift",
                    "% of path",
                    False,
                    True,
                    _of(name, lambda e: Percentile(e.drift_percent, 0.5)),
                )
            )
    found += [Figure(f"latency.{name}", "yardsticks", False, True, _latency(name)) for name in stages]
    return tuple(found)


def outcome_shares(frames: PassFrames) -> dict[str, dict[str, float]]:
    """Return the share of frames of every outcome, by estimator."""
    shares: dict[str, dict[str, float]] = {}
    for name, estimator in frames.estimators.items():
        known = [outcome for outcome in estimator.outcome if outcome]
        shares[name] = {outcome: known.count(outcome) / len(known) for outcome in sorted(set(known))}
    return shares


def shift_samples(frames: PassFrames) -> tuple[Ratio, Ratio]:
    """Return the mean of detected minus expected centre over the hits, in columns and rows."""
    return (
        Ratio(frames.shift_u_px, frames.hits, counts=False),
        Ratio(frames.shift_v_px, frames.hits, counts=False),
    )


def same_telemetry(first: PassFrames, second: PassFrames) -> bool:
    """Return whether two builds sent the same values in every frame; CPU times and memory are not compared."""
    names = (
        "answered",
        "expected",
        "hits",
        "alarms",
        "error_px",
        "shift_u_px",
        "shift_v_px",
        "packets",
        "octets",
    )
    if first.undecodable != second.undecodable or first.estimators.keys() != second.estimators.keys():
        return False
    pairs = [(getattr(first, name), getattr(second, name)) for name in names]
    for key, one in first.estimators.items():
        other = second.estimators[key]
        if one.outcome != other.outcome:
            return False
        pairs += [
            (getattr(one, name), getattr(other, name))
            for name in ("error_m", "sigma_m", "squared_normalised_error", "drift_percent", "wrong")
        ]
    return all(np.array_equal(a, b, equal_nan=True) for a, b in pairs)


def joined(passes: Sequence[PassFrames]) -> PassFrames:
    """Return the concatenated frames of several passes; values that a pass does not have are NaN."""
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
            np.concatenate([part.squared_normalised_error for part in parts]),
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


def _mean(values: FloatArray) -> Ratio:
    return Ratio(values, np.ones(len(values)), counts=False)


def _share(values: FloatArray) -> Ratio:
    return Ratio(values, np.ones(len(values)), counts=True)


def _of(estimator: str, sample: Callable[[EstimatorFrames], Sample]) -> Callable[[PassFrames], Sample]:
    return lambda frames: sample(frames.estimators.get(estimator) or _silent(len(frames)))


def _latency(stage: str) -> Callable[[PassFrames], Sample]:
    return lambda frames: Percentile(
        np.asarray(frames.latency.get(stage, np.full(len(frames), np.nan)), dtype=np.float64), LATENCY_LEVEL
    )
