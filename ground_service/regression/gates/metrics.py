"""Metrics of a build over passes: ratios of sums by unit of the evidence, values of whole passes, and fault counts."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ground_service.regression.gates.samples import BAD_OUTCOMES, EstimatorFrames, PassFrames, TimeTags
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
            Metric(f"{place}.bad_outcomes", "", False, False, _of(name, lambda e: _mean(e.share(*BAD_OUTCOMES)))),
        ]
        if any(
            np.isfinite(one.estimators[name].squared_normalised_error).any() for one in passes if name in one.estimators
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
                Metric(f"{place}.sigma_p95", "m", False, True, _of(name, lambda e: quantile(e.sigma_m, 0.95))),
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


UNDECODABLE, TIMES, FRAMES = "telemetry.undecodable", "telemetry.times", "telemetry.frames_without_value"
WRONG_FIXES = "navigation.wrong_fixes"

DELAY_TOLERANCE_S = 1.0
"""Header times may lie this much outside the delays of the baseline: a step lasts less."""


@dataclass(frozen=True, slots=True)
class Count:
    """Number of faulty items of both builds on a pass, NaN where unknown; `text` states those of the candidate."""

    baseline: float
    candidate: float
    text: str = ""


def counts(before: PassFrames, after: PassFrames) -> dict[str, Count]:
    """Return the faults of each kind on one pass."""
    return {
        UNDECODABLE: Count(before.undecodable, after.undecodable, f"{after.undecodable} packets cannot be decoded"),
        TIMES: _times(before.times, after.times),
        FRAMES: _frames(before, after),
        WRONG_FIXES: _wrong_fixes(before, after),
    }


def identical(before: Mapping[str, PassFrames], after: Mapping[str, PassFrames]) -> bool:
    """Return whether both builds sent the same packets, octet by octet, on every pass."""
    return all(
        bool(one.digests) and one.digests == after[name].digests and one.undecodable == after[name].undecodable
        for name, one in before.items()
    )


def first_difference(before: PassFrames, after: PassFrames) -> int | None:
    """Return the row of the first frame with different packets (0 also for packets before it); None: no such frame."""
    pairs = zip(before.digests, after.digests, strict=True)
    return next((max(row - 1, 0) for row, (a, b) in enumerate(pairs) if a != b), None)


def _times(before: TimeTags, after: TimeTags) -> Count:
    parts, faulty = [], 0
    for name, unknown in after.unknown_images.items():
        if unknown > before.unknown_images.get(name, 0):
            faulty += unknown
            parts.append(f"{unknown} of {after.packets[name]} {name} packets name a time at which no image was taken")
    late, packets, worst = 0, 0, 0.0
    usual = [delays for delays in before.delays_s.values() if len(delays)]
    for name, delays in after.delays_s.items():
        known = before.delays_s.get(name)
        expected = known if known is not None and len(known) else np.concatenate([*usual, [0.0]])
        low, high = expected.min() - DELAY_TOLERANCE_S, expected.max() + DELAY_TOLERANCE_S
        off = np.maximum(delays - high, low - delays)
        late += int(np.count_nonzero(off > 0.0))
        packets += len(delays)
        worst = max(worst, float(np.max(off, initial=0.0)) + DELAY_TOLERANCE_S)
    if late:
        parts.append(
            f"the header times of {late} of {packets} packets contradict the image or step that they report, by up to "
            f"{worst:.1f} s"
        )
    disordered = after.backwards - before.backwards
    if disordered > 0:
        parts.append(f"{disordered} packets more than in the baseline are out of order in time")
    total = faulty + late + max(disordered, 0)
    return Count(0, total, "; ".join(parts))


def _frames(before: PassFrames, after: PassFrames) -> Count:
    """Count the frames on which the baseline has a report, and the candidate does not."""
    lost = before.answered & ~after.answered
    parts = [f"no detections in {np.count_nonzero(lost)}"] if lost.any() else []
    for name, estimator in before.estimators.items():
        other = after.estimators.get(name)
        silent = estimator.stated if other is None else estimator.stated & ~other.stated
        if silent.any():
            parts.append(f"no state of the estimator {name} in {np.count_nonzero(silent)}")
        lost = lost | silent
    text = f"{' and '.join(parts)} of {len(before)} frames on which the baseline has one"
    return Count(0, int(np.count_nonzero(lost)), text)


def _wrong_fixes(before: PassFrames, after: PassFrames) -> Count:
    """Count the wrong fixes; NaN without a reference, which alone shows whether a fix is wrong."""
    sums = []
    for frames in (before, after):
        wrong = np.concatenate([*(one.wrong for one in frames.estimators.values()), np.zeros(0)])
        sums.append(float(np.nansum(wrong)) if np.isfinite(wrong).any() else math.nan)
    return Count(sums[0], sums[1], f"{sums[1]:.0f} fixes are wrong, against {sums[0]:.0f} of the baseline")
