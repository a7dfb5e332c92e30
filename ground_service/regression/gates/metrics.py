"""Metrics of a build over passes: ratios of sums by unit of the evidence, and values of whole passes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ground_service.regression.gates.samples import BAD_OUTCOMES, EstimatorFrames, PassFrames
from ground_service.regression.gates.statistics import UnitSums, joined_sums, quantile, unit_sums
from lunar.arrays import FloatArray

START_FRAMES = 2
"""First frames, which belong to the start: code is compiled and buffers are made in them."""

BLOCK_FRAMES = 6
"""Successive frames share the state of the filter: a block of them is one unit."""

RECALL, PRECISION = "detector.recall", "detector.precision"
MEMORY, LATENCY, START, RUN = "memory", "latency.total", "latency.start", "latency.run"


@dataclass(frozen=True, slots=True)
class Metric:
    """A metric of one build.

    Attributes
    ----------
    name, unit
        Name and unit in policies and verdicts.
    higher_is_better
        Direction of improvement.
    relative
        Whether a change counts as a ratio (lengths, times) or as a difference (shares, pixels).
    value
        Value of a pass; NaN if unknown.
    sums
        Numerators and denominators by unit, for metrics that are ratios of sums.
    evidence
        Name of the units.
    """

    name: str
    unit: str
    higher_is_better: bool
    relative: bool
    value: Callable[[PassFrames], float]
    sums: Callable[[PassFrames], UnitSums] | None = None
    evidence: str = "passes"

    def over(self, passes: Sequence[PassFrames]) -> float:
        """Return the value over several passes: the ratio of sums, or the median of the passes."""
        if self.sums is not None:
            return joined_sums([self.sums(one) for one in passes]).value if passes else float("nan")
        return quantile(np.array([self.value(one) for one in passes]), 0.5)


def metrics_of(passes: Sequence[PassFrames]) -> tuple[Metric, ...]:
    """Return every metric that these passes provide, for either build."""
    estimators = sorted({name for one in passes for name in one.estimators})
    found = [
        _ratio(RECALL, "", True, _recall, "tracks"),
        _ratio(PRECISION, "", True, _precision, "ground cells"),
        _ratio("detector.localisation", "px", False, _localisation, "tracks"),
        Metric("detector.bias", "px", False, False, _bias),
        Metric("telemetry.packets_per_frame", "", False, True, lambda f: _mean(f.packets)),
        Metric("telemetry.octets_per_frame", "octets", False, True, lambda f: _mean(f.octets)),
        Metric(MEMORY, "MiB", False, True, lambda f: f.memory_mib),
        Metric(LATENCY, "ms", False, True, lambda f: _mean(frame_ms(f)[START_FRAMES:])),
        Metric(START, "s", False, True, _start_s),
        Metric(RUN, "s", False, True, lambda f: f.cpu_s),
    ]
    for name in estimators:
        place = f"navigation.{name}"
        found += [
            Metric(f"{place}.p50", "m", False, True, _of(name, lambda e: quantile(e.error_m, 0.5))),
            Metric(f"{place}.p95", "m", False, True, _of(name, lambda e: quantile(e.error_m, 0.95))),
            Metric(
                f"{place}.bad_outcomes", "", False, False, _of(name, lambda e: _mean(e.share(*BAD_OUTCOMES)))
            ),
        ]
        if any(
            np.isfinite(one.estimators[name].squared_normalised_error).any()
            for one in passes
            if name in one.estimators
        ):
            found += [
                _ratio(f"{place}.fixes", "", True, _fixes(name), f"blocks of {BLOCK_FRAMES} frames"),
                Metric(
                    f"{place}.squared_normalised_error",
                    "",
                    False,
                    True,
                    _of(name, lambda e: _mean(e.squared_normalised_error)),
                ),
                Metric(
                    f"{place}.sigma_p95", "m", False, True, _of(name, lambda e: quantile(e.sigma_m, 0.95))
                ),
            ]
    return tuple(found)


def outcome_shares(frames: PassFrames) -> dict[str, dict[str, float]]:
    """Return the share of frames of every outcome, by estimator."""
    shares: dict[str, dict[str, float]] = {}
    for name, estimator in frames.estimators.items():
        known = [outcome for outcome in estimator.outcome if outcome]
        shares[name] = {outcome: known.count(outcome) / len(known) for outcome in sorted(set(known))}
    return shares


def _ratio(
    name: str, unit: str, higher_is_better: bool, sums: Callable[[PassFrames], UnitSums], evidence: str
) -> Metric:
    return Metric(name, unit, higher_is_better, False, lambda f: sums(f).value, sums, evidence)


def _recall(frames: PassFrames) -> UnitSums:
    rows = frames.craters
    return unit_sums(rows.track, rows.kind, rows.hit.astype(np.float64), np.ones(len(rows.hit)))


def _localisation(frames: PassFrames) -> UnitSums:
    rows = frames.craters
    error_px = np.nan_to_num(np.hypot(rows.du_px, rows.dv_px))
    return unit_sums(rows.track, rows.kind, error_px, rows.hit.astype(np.float64))


def _precision(frames: PassFrames) -> UnitSums:
    rows = frames.detections
    cells = rows.cell
    return unit_sums(cells, np.zeros_like(cells), rows.true.astype(np.float64), np.ones(len(cells)))


def _fixes(name: str) -> Callable[[PassFrames], UnitSums]:
    def sums(frames: PassFrames) -> UnitSums:
        fixed = _estimator(frames, name).share("fixed")
        block = np.arange(len(frames)) // BLOCK_FRAMES
        known = np.isfinite(fixed).astype(np.float64)
        return unit_sums(block, np.zeros_like(block), np.nan_to_num(fixed), known)

    return sums


def _start_s(frames: PassFrames) -> float:
    """Return the processor time of a run without its frames; NaN if those of the frames are not known."""
    of_frames = frame_ms(frames)[START_FRAMES:]
    return frames.cpu_s - float(np.nansum(of_frames)) / 1e3 if np.isfinite(of_frames).any() else float("nan")


def _bias(frames: PassFrames) -> float:
    """Return the length of the mean difference of detected and catalogued centre over the hits."""
    return float(np.hypot(_mean(frames.craters.du_px), _mean(frames.craters.dv_px)))


def _mean(values: FloatArray) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else float("nan")


def _estimator(frames: PassFrames, name: str) -> EstimatorFrames:
    nothing = np.full(len(frames), np.nan)
    silent = EstimatorFrames(np.isfinite(nothing), nothing, nothing, nothing, ("",) * len(frames), nothing)
    return frames.estimators.get(name) or silent


def _of(estimator: str, value: Callable[[EstimatorFrames], float]) -> Callable[[PassFrames], float]:
    return lambda frames: value(_estimator(frames, estimator))


def frame_ms(frames: PassFrames) -> FloatArray:
    """Return the processor time of all stages by frame (n,); NaN where none is known."""
    total = np.nansum([np.full(len(frames), np.nan), *frames.latency_ms.values()], axis=0)
    return np.where(total > 0.0, total, np.nan)
