"""Agreement of detections with a catalogue: one-to-one matching, strict and ignore-aware figures.

Strict counts every catalogued crater whose centre lies in the frame. Ignore-aware leaves out what hardly anyone could
see: the truth is craters of depth/diameter of at least 0.03 whose centre lies half a radius inside the frame, and a
detection on any other catalogued crater is neither right nor wrong.

Classes follow the paper: 5-10, 10-15 and 15-30 km; the class of a detection comes from its diameter in pixels and the
range, as on board. Per class, detections of a class are matched with craters of that class; "all" matches detections
and craters of 5-30 km whatever their class.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lunar.arrays import BoolArray, FloatArray, IntArray
from lunar.catalogue import CLASS_LIMITS_M, size_class
from payload_emulator.flight.vision.detections import Detections
from payload_emulator.training.data.dataset import FrameTruth

PAPER_TABLE_2 = (
    {"precision": 0.7021, "recall": 0.3248, "loc_px": 3.50},
    {"precision": 0.7362, "recall": 0.3586, "loc_px": 4.11},
    {"precision": 0.8131, "recall": 0.4659, "loc_px": 4.75},
)
MATCH_RADIUS_PX = 10.0  # the pixel rule, as in the project's first studies; the paper does not print its own
FAIR_DEPTH_RATIO = 0.03
_ROUNDS = 400
_LEAST_FOR_PRECISION = 100  # below, one false detection more moves the precision by a hundredth and over
DEGRADATION_EDGES = (0.0, 0.03, 0.06, 0.10, 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class FrameDetections:
    """Detections of one frame, arrays (n,), best first, with the diameter on the ground.

    `depth_ratio` where the network tells it; `size_class` where it names the class itself, as the paper's does.
    """

    u_px: FloatArray
    v_px: FloatArray
    diameter_px: FloatArray
    diameter_m: FloatArray
    score: FloatArray
    sigma_px: FloatArray
    depth_ratio: FloatArray | None = None
    size_class: NDArray[np.int8] | None = None


@dataclass(frozen=True, slots=True)
class Figures:
    """Counts and what follows from them; localisation over the matched pairs."""

    expected: int
    detected_true: int
    false_alarms: int
    precision: float
    recall: float
    f1: float
    loc_px: float
    loc_median_px: float

    def to_dict(self) -> dict[str, float | int]:
        return asdict(self)


@dataclass(frozen=True, slots=True)
class MatchRule:
    """`pixels`: centres within that many pixels; `radii`: within that share of the crater's radius instead."""

    pixels: float = MATCH_RADIUS_PX
    radii: float = 0.0

    def limits_px(self, diameter_px: FloatArray) -> FloatArray:
        """Return the largest distance (n,) from craters of some diameters (n,)."""
        return np.full(diameter_px.shape, self.pixels) if self.radii == 0.0 else 0.5 * self.radii * diameter_px


def match(
    detection_u: FloatArray,
    detection_v: FloatArray,
    truth_u: FloatArray,
    truth_v: FloatArray,
    truth_diameter: FloatArray,
    rule: MatchRule,
) -> IntArray:
    """Index of the crater that each detection (best first) takes, -1 for none; nearest free crater within the rule."""
    taken = np.zeros(truth_u.shape[0], bool)
    found = np.full(detection_u.shape[0], -1, np.int64)
    if truth_u.shape[0] == 0:
        return found
    limit = rule.limits_px(truth_diameter)
    for i in range(detection_u.shape[0]):
        distance = np.hypot(truth_u - detection_u[i], truth_v - detection_v[i])
        distance[taken | (distance > limit)] = np.inf
        best = int(np.argmin(distance))
        if np.isfinite(distance[best]):
            taken[best] = True
            found[i] = best
    return found


@dataclass(frozen=True, slots=True, eq=False)
class Tally:
    """Every detection and every wanted crater of a set of frames after matching, for one rule and one truth.

    Detections: score, outcome (1 right, 0 wrong, -1 not counted); where right error_u, error_v (detection minus
    crater) and log_diameter_ratio (detection over crater). Craters: score at which each was found (NaN: never).
    matched_depth_ratio is the crater's (NaN: none), detection_depth_ratio what the network says (NaN: it does not).
    """

    score: FloatArray
    outcome: NDArray[np.int8]
    error_u: FloatArray
    error_v: FloatArray
    sigma_px: FloatArray
    detection_block: IntArray
    detection_octant: IntArray
    log_diameter_ratio: FloatArray
    detection_u: FloatArray
    detection_v: FloatArray
    detection_frame: IntArray
    detection_depth_ratio: FloatArray
    matched_depth_ratio: FloatArray
    crater_score: FloatArray
    crater_depth_ratio: FloatArray
    crater_id: IntArray
    crater_block: IntArray
    crater_frame: IntArray

    def select(self, detections: BoolArray, craters: BoolArray) -> Tally:
        """The part of a tally that masks of its detections and craters choose."""
        return Tally(
            **{
                item.name: getattr(self, item.name)[craters if item.name.startswith("crater_") else detections]
                for item in fields(self)
            }
        )

    def figures(self, threshold: float) -> Figures:
        """Figures of the detections with a score of at least `threshold`."""
        with np.errstate(invalid="ignore"):
            right = (self.score >= threshold) & (self.outcome == 1)
            wrong = (self.score >= threshold) & (self.outcome == 0)
            found = self.crater_score >= threshold
        return make_figures(
            int(self.crater_score.size),
            int(found.sum()),
            int(wrong.sum()),
            np.hypot(self.error_u[right], self.error_v[right]),
        )


def make_figures(expected: int, found: int, false_alarms: int, errors_px: FloatArray) -> Figures:
    """Figures of counts; NaN where nothing was expected or claimed."""
    precision = found / (found + false_alarms) if found + false_alarms else float("nan")
    recall = found / expected if expected else float("nan")
    f1 = 2.0 * found / (2 * found + false_alarms + (expected - found)) if expected + false_alarms else float("nan")
    return Figures(
        expected,
        found,
        false_alarms,
        precision,
        recall,
        f1,
        float(errors_px.mean()) if errors_px.size else float("nan"),
        float(np.median(errors_px)) if errors_px.size else float("nan"),
    )


def tally(
    truths: Sequence[FrameTruth],
    detections: Sequence[FrameDetections],
    *,
    low_m: float = CLASS_LIMITS_M[0],
    high_m: float = CLASS_LIMITS_M[3],
    classes: tuple[int, ...] = (),
    ignore_aware: bool = False,
    rule: MatchRule | None = None,
) -> Tally:
    """Match frame by frame. `classes` given: detections and craters of those size classes; else by diameter.

    Detections are matched best first, so the outcome at every threshold is that of the detections above it.
    """
    rule = rule or MatchRule()
    parts: list[tuple[NDArray[np.generic], ...]] = []
    craters: list[tuple[NDArray[np.generic], ...]] = []
    for number, (truth, found) in enumerate(zip(truths, detections, strict=True)):
        wanted = _in_frame(truth)
        if classes:
            wanted &= np.isin(size_class(truth.diameter_m), classes)
            own = size_class(found.diameter_m) if found.size_class is None else found.size_class
            chosen = np.isin(own, classes)
        else:
            wanted &= (truth.diameter_m >= low_m) & (truth.diameter_m <= high_m)
            chosen = (found.diameter_m >= low_m) & (found.diameter_m <= high_m)
        if ignore_aware:
            wanted &= _could_be_seen(truth)
        w = np.flatnonzero(wanted)
        d = np.flatnonzero(chosen)
        hit = match(found.u_px[d], found.v_px[d], truth.u_px[w], truth.v_px[w], truth.diameter_px[w], rule)
        outcome = (hit >= 0).astype(np.int8)
        if ignore_aware:
            other = np.flatnonzero(~wanted)
            near = match_any(
                found.u_px[d], found.v_px[d], truth.u_px[other], truth.v_px[other], truth.diameter_px[other], rule
            )
            outcome[(outcome == 0) & near] = -1
        parts.append(detection_columns(number, truth, found, w, d, hit, outcome))
        craters.append(crater_columns(number, truth, found.score[d], w, hit))
    return joined(parts, craters)


def joined(
    detections: Sequence[tuple[NDArray[np.generic], ...]], craters: Sequence[tuple[NDArray[np.generic], ...]]
) -> Tally:
    """Return the tally of frames from their `detection_columns` and `crater_columns`."""
    if not detections:
        empty: list[NDArray[Any]] = [np.zeros(0)] * len(fields(Tally))
        return Tally(*empty)
    return Tally(*(np.concatenate(column) for part in (detections, craters) for column in zip(*part, strict=True)))


def _in_frame(truth: FrameTruth) -> BoolArray:
    """Return which craters have their centre in the image."""
    return np.asarray(
        (truth.u_px >= -0.5)
        & (truth.u_px <= truth.width_px - 0.5)
        & (truth.v_px >= -0.5)
        & (truth.v_px <= truth.height_px - 0.5)
    )


def _could_be_seen(truth: FrameTruth) -> BoolArray:
    """Return which craters are deep enough and have their centre half a radius inside the image."""
    inset = 0.25 * truth.diameter_px
    return np.asarray(
        (truth.u_px >= inset)
        & (truth.u_px <= truth.width_px - 1 - inset)
        & (truth.v_px >= inset)
        & (truth.v_px <= truth.height_px - 1 - inset)
        & (truth.depth_ratio >= FAIR_DEPTH_RATIO)
    )


def detection_columns(
    number: int,
    truth: FrameTruth,
    found: FrameDetections | Detections,
    wanted: IntArray,
    chosen: IntArray,
    hit: IntArray,
    outcome: NDArray[np.int8],
) -> tuple[NDArray[np.generic], ...]:
    """Return the columns of a tally that describe the ``chosen`` detections of a frame.

    ``hit`` is the place among the ``wanted`` craters of the crater that each detection takes, -1 for none.
    """
    matched = hit >= 0

    def of_crater(values: FloatArray) -> FloatArray:
        """Return values of the matched craters; NaN where none."""
        return np.where(matched, values[wanted][hit], np.nan) if wanted.size else np.full(hit.size, np.nan)

    octant = int(np.floor(np.mod(truth.sun_azimuth_image_rad, 2.0 * np.pi) / (np.pi / 4.0))) % 8
    return (
        found.score[chosen],
        outcome,
        found.u_px[chosen] - of_crater(truth.u_px),
        found.v_px[chosen] - of_crater(truth.v_px),
        found.sigma_px[chosen],
        np.full(chosen.size, truth.block),
        np.full(chosen.size, octant),
        np.log(found.diameter_px[chosen] / of_crater(truth.diameter_px)),
        found.u_px[chosen],
        found.v_px[chosen],
        np.full(chosen.size, number),
        np.full(chosen.size, np.nan) if found.depth_ratio is None else found.depth_ratio[chosen],
        of_crater(truth.depth_ratio),
    )


def crater_columns(
    number: int, truth: FrameTruth, scores: FloatArray, wanted: IntArray, hit: IntArray
) -> tuple[NDArray[np.generic], ...]:
    """Return the columns of a tally that describe the ``wanted`` craters of a frame."""
    score = np.full(wanted.size, np.nan)
    score[hit[hit >= 0]] = scores[hit >= 0]
    return (
        score,
        truth.depth_ratio[wanted],
        truth.ids[wanted],
        np.full(wanted.size, truth.block),
        np.full(wanted.size, number),
    )


def match_any(
    detection_u: FloatArray,
    detection_v: FloatArray,
    truth_u: FloatArray,
    truth_v: FloatArray,
    truth_diameter: FloatArray,
    rule: MatchRule,
) -> BoolArray:
    """Return whether each detection lies on any of the craters by the rule; several may share one."""
    if truth_u.size == 0 or detection_u.size == 0:
        return np.zeros(detection_u.size, bool)
    limit = rule.limits_px(truth_diameter)
    distance = np.hypot(detection_u[:, None] - truth_u[None, :], detection_v[:, None] - truth_v[None, :])
    return np.asarray((distance <= limit[None, :]).any(axis=1))


def best_threshold(tallied: Tally, beta: float = 1.0) -> tuple[float, Figures]:
    """Threshold of the greatest F-beta and its figures (choose it on a validation set only).

    `beta` below 1 gives precision more weight than recall.
    """
    candidates = np.arange(0.10, 0.91, 0.01)
    every = [tallied.figures(float(threshold)) for threshold in candidates]
    best = int(np.argmax(np.array([_f_beta(figures, beta) for figures in every])))
    return float(candidates[best]), every[best]


def _f_beta(figures: Figures, beta: float) -> float:
    """F-beta of the counts; -1 where nothing was expected or claimed."""
    missed = figures.expected - figures.detected_true
    right = (1.0 + beta * beta) * figures.detected_true
    total = right + beta * beta * missed + figures.false_alarms
    return right / total if total else -1.0


def threshold_for_precision(tallied: Tally, precision: float) -> float:
    """Lowest threshold from which on the precision stays at or above the value asked for; 0.95 where none does.

    Thresholds that leave fewer than `_LEAST_FOR_PRECISION` detections say nothing and are passed over.
    """
    chosen = 0.95
    for threshold in np.arange(0.95, 0.095, -0.01):
        figures = tallied.figures(float(threshold))
        claimed = figures.detected_true + figures.false_alarms
        if claimed >= _LEAST_FOR_PRECISION and figures.precision < precision:
            break
        chosen = float(threshold)
    return chosen


def average_precision(tallied: Tally) -> float:
    """Area under precision over recall, with precision made to fall with recall as usual; NaN without craters."""
    counted = tallied.outcome >= 0
    if tallied.crater_score.size == 0:
        return float("nan")
    order = np.argsort(-tallied.score[counted], kind="stable")
    right = np.cumsum(tallied.outcome[counted][order] == 1)
    if right.size == 0:
        return 0.0
    precision = right / np.arange(1, right.size + 1)
    precision = np.maximum.accumulate(precision[::-1])[::-1]
    recall = np.concatenate([[0.0], right / tallied.crater_score.size])
    return float(np.sum(np.diff(recall) * precision))


def with_interval(tallied: Tally, threshold: float) -> dict[str, Any]:
    """Return the figures at a threshold with the 95 % interval of F1 over resampled blocks of ground."""
    with np.errstate(invalid="ignore"):
        found = tallied.crater_score >= threshold
    wrong = (tallied.score >= threshold) & (tallied.outcome == 0)
    # F1 is twice the craters found over all craters and claims.
    parts = np.concatenate([np.stack([found, 1.0 + found], axis=1), np.stack([0.0 * wrong, wrong], axis=1)])
    blocks = np.concatenate([tallied.crater_block, tallied.detection_block])
    return {**tallied.figures(threshold).to_dict(), "f1_interval_95": list(_interval(2.0, parts, blocks))}


def bootstrap_recall(found: BoolArray, block: IntArray) -> tuple[float, float]:
    """95 % interval of the share of craters found (n,), over resampled blocks of ground (n,)."""
    return _interval(1.0, np.stack([found, np.ones(found.size)], axis=1), block)


def _interval(factor: float, parts: FloatArray, block: IntArray) -> tuple[float, float]:
    """95 % interval of `factor` times the sum of the first of the columns (n, 2) over that of the second."""
    if block.size == 0:
        return float("nan"), float("nan")
    above, below = resampled_sums(parts, block).T
    low, high = np.percentile(factor * above / np.maximum(below, 1.0), (2.5, 97.5))
    return float(low), float(high)


def resampled_sums(values: FloatArray, group: IntArray) -> FloatArray:
    """Sums (rounds, k) of values (n, k) over groups that are drawn with replacement from those of the rows (n,)."""
    _, place = np.unique(group, return_inverse=True)
    sums = np.stack([np.bincount(place, weights=column) for column in values.T], axis=1)
    drawn = np.random.default_rng(0).integers(0, len(sums), (_ROUNDS, len(sums)))
    return np.asarray(sums[drawn].sum(axis=1), dtype=np.float64)
