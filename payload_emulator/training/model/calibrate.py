"""Values fixed on the validation split before a network is used: thresholds, corrections, parallax of the walls."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from payload_emulator.flight.vision.detections import Detections
from payload_emulator.flight.vision.detector import STRIDE_PX, TYPICAL_DEPTH_RATIO, remove_parallax
from payload_emulator.flight.vision.preprocess import sun_up_turns, turn_forward
from payload_emulator.training.data.dataset import Dataset, Frame, FrameTruth, frame_truth
from payload_emulator.training.evaluate.evaluate import detect_with_network
from payload_emulator.training.evaluate.scoring import (
    FrameDetections,
    MatchRule,
    Tally,
    best_threshold,
    match,
    tally,
    threshold_for_precision,
)

ON_BOARD_BETA = 0.5
"""The on-board threshold weighs precision twice as much as recall: a false crater costs a navigator more than a missed
one, and plains have fewer craters than the validation blocks, so every threshold is less precise there."""

NAVIGATION_PRECISION = 0.90
_CLEAR_DEPTH_RATIO = 0.05  # craters whose middle is seen well enough to measure a fraction of a pixel on
_CLEAR_SCORE = 0.4
_LEAST_PAIRS = 50


@dataclass(frozen=True, slots=True)
class Calibration:
    """Values fixed on the validation split.

    geometry_shift : added to the network's geometry: cells, cells, ln, ln.
    parallax_per_px : share of a crater's depth by which its apparent middle lies below the rim, over the focal length
        in pixels; `parallax_error` is its standard error.
    """

    score_threshold: float
    f1_threshold: float
    navigation_threshold: float
    geometry_shift: tuple[float, float, float, float]
    parallax_per_px: float
    parallax_error: float
    figures: dict[str, Any]


def calibrate(network: Any, datasets: Sequence[Dataset]) -> Calibration:
    """Thresholds and corrections from the validation split, on real terrain where there is any.

    Thresholds: greatest strict F0.5 (on board) and F1, and the precision that navigation may want. Corrections, each a
    median over matched craters: offset of the centre in the Sun-up image (walls in shadow draw it toward the Sun),
    logarithm of the diameter, and the scale of sigma that puts 68.3 % of the errors within one. Parallax: all of the
    split, since it is geometry and the same on any terrain.
    """
    every = [(d, f) for d in datasets for f in d.frames("val")]
    if not every:
        return Calibration(0.4, 0.4, 0.6, (0.0, 0.0, 0.0, 0.0), 0.0, float("nan"), {})
    chosen = [every[k] for k in np.unique(np.linspace(0, len(every) - 1, 400).astype(int))]
    pairs = [_sun_up(frame_truth(d, f), detect_with_network(network, d, f), f) for d, f in chosen]
    parallax, parallax_error = fit_parallax(pairs)
    real = [not f.complete for _, f in chosen]
    pairs = [pair for pair, is_real in zip(pairs, real, strict=True) if is_real or not any(real)]
    truths = [truth for truth, _ in pairs]
    found = [without_parallax(detections, parallax, truth) for truth, detections in pairs]
    provisional, _ = best_threshold(tally(truths, found))
    cell_px = network.config.cell_px
    shift = geometry_shift(tally(truths, found, low_m=3_000.0, ignore_aware=True), provisional, cell_px)
    strict = tally(truths, [_shifted(detections, shift, cell_px) for detections in found])
    balanced, _ = best_threshold(strict)
    threshold, figures = best_threshold(strict, beta=ON_BOARD_BETA)
    return Calibration(
        round(threshold, 3),
        round(balanced, 3),
        round(max(threshold, threshold_for_precision(strict, NAVIGATION_PRECISION)), 3),
        shift,
        parallax,
        parallax_error,
        figures.to_dict(),
    )


def paper_threshold(truths: Sequence[FrameTruth], found: Sequence[FrameDetections]) -> float:
    """Threshold of the greatest F1 over the three classes together, each matched within its class as in Table II."""
    tallies = [tally(truths, found, classes=(k,)) for k in range(3)]
    best, chosen = -1.0, 0.4
    for threshold in np.arange(0.10, 0.91, 0.01):
        every = [part.figures(float(threshold)) for part in tallies]
        right = sum(figures.detected_true for figures in every)
        total = sum(figures.expected + figures.detected_true + figures.false_alarms for figures in every)
        f1 = 2.0 * right / total if total else -1.0
        if f1 > best:
            best, chosen = f1, float(threshold)
    return round(chosen, 3)


def fit_parallax(pairs: Sequence[tuple[FrameTruth, FrameDetections]]) -> tuple[float, float]:
    """Share of the depth, over the focal length in pixels, that brings detections outward onto rims; standard error.

    One number by weighted least squares of the signed errors (n, 2) on depth/diameter times diameter times the place
    relative to the middle of the image.
    """
    lever, error, weight = [], [], []
    for truth, found in pairs:
        clear = np.flatnonzero(truth.depth_ratio >= _CLEAR_DEPTH_RATIO)
        good = np.flatnonzero(found.score >= _CLEAR_SCORE)
        hit = match(
            found.u_px[good],
            found.v_px[good],
            truth.u_px[clear],
            truth.v_px[clear],
            truth.diameter_px[clear],
            MatchRule(radii=0.4),
        )
        d, c = good[hit >= 0], clear[hit[hit >= 0]]
        same = np.abs(np.log(found.diameter_px[d] / truth.diameter_px[c])) < 0.3
        d, c = d[same], c[same]
        ratio = np.full(d.size, TYPICAL_DEPTH_RATIO) if found.depth_ratio is None else found.depth_ratio[d]
        depth_px = ratio * found.diameter_px[d]
        middle = 0.5 * (truth.width_px - 1), 0.5 * (truth.height_px - 1)
        lever += [depth_px * (found.u_px[d] - middle[0]), depth_px * (found.v_px[d] - middle[1])]
        error += [truth.u_px[c] - found.u_px[d], truth.v_px[c] - found.v_px[d]]
        weight += [1.0 / np.maximum(found.sigma_px[d], 0.3) ** 2] * 2
    if sum(part.size for part in lever) < 2 * _LEAST_PAIRS:
        return 0.0, float("nan")
    x, y, w = np.concatenate(lever), np.concatenate(error), np.concatenate(weight)
    slope = float((w * x * y).sum() / (w * x * x).sum())
    inner = np.abs(y - slope * x) < 4.0 / np.sqrt(w) + 1.0  # without pairs of different craters
    x, y, w = x[inner], y[inner], w[inner]
    slope = float((w * x * y).sum() / (w * x * x).sum())
    spread = float(np.sqrt((w * w * x * x * (y - slope * x) ** 2).sum()) / (w * x * x).sum())
    return slope, spread


def without_parallax(found: FrameDetections, share_per_px: float, truth: FrameTruth) -> FrameDetections:
    """Detections of a frame as the flight detector gives them when its model carries this share."""
    moved = remove_parallax(
        Detections(found.u_px, found.v_px, found.diameter_px, found.score, found.sigma_px, found.depth_ratio),
        share_per_px,
        truth.height_px,
        truth.width_px,
    )
    return replace(found, u_px=moved.u_px, v_px=moved.v_px)


def geometry_shift(tallied: Tally, threshold: float, cell_px: int = STRIDE_PX) -> tuple[float, float, float, float]:
    """Return the shift of the network's geometry that centres errors in the Sun-up image and makes sigma one sigma."""
    right = (tallied.outcome == 1) & (tallied.score >= threshold)
    if np.count_nonzero(right) < _LEAST_PAIRS:
        return (0.0, 0.0, 0.0, 0.0)
    error_u, error_v = tallied.error_u[right], tallied.error_v[right]
    bias_u, bias_v = float(np.median(error_u)), float(np.median(error_v))
    ratio = np.abs(np.concatenate([error_u - bias_u, error_v - bias_v])) / np.tile(tallied.sigma_px[right], 2)
    log_ratio = float(np.median(tallied.log_diameter_ratio[right]))
    return (-bias_u / cell_px, -bias_v / cell_px, -log_ratio, float(np.log(np.quantile(ratio, 0.683))))


def _shifted(found: FrameDetections, shift: tuple[float, float, float, float], cell_px: int) -> FrameDetections:
    """Detections in a Sun-up image as the corrected network would give them."""
    factor = float(np.exp(shift[2]))
    return replace(
        found,
        u_px=found.u_px + cell_px * shift[0],
        v_px=found.v_px + cell_px * shift[1],
        diameter_px=factor * found.diameter_px,
        diameter_m=factor * found.diameter_m,
        sigma_px=float(np.exp(shift[3])) * found.sigma_px,
    )


def _sun_up(truth: FrameTruth, found: FrameDetections, frame: Frame) -> tuple[FrameTruth, FrameDetections]:
    """Truth and detections of a frame in the coordinates of its Sun-up image."""
    turns = sun_up_turns(frame.sun_camera)
    shape = (truth.height_px, truth.width_px)
    truth_u, truth_v = turn_forward(truth.u_px, truth.v_px, turns, *shape)
    found_u, found_v = turn_forward(found.u_px, found.v_px, turns, *shape)
    return replace(truth, u_px=truth_u, v_px=truth_v), replace(found, u_px=found_u, v_px=found_v)
