"""All figures of detections against truth: strict and ignore-aware side by side, by what they depend on."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lunar.arrays import BoolArray, FloatArray
from payload_emulator.flight.vision.detections import DEGRADED_DEPTH_RATIO, FRESH_DEPTH_RATIO
from payload_emulator.training.data.dataset import FrameTruth
from payload_emulator.training.evaluate.scoring import (
    DEGRADATION_EDGES,
    PAPER_TABLE_2,
    FrameDetections,
    MatchRule,
    Tally,
    average_precision,
    bootstrap_recall,
    resampled_sums,
    tally,
    with_interval,
)

FEWEST_PAIRS = 20
"""A mean error of fewer craters says nothing to a quarter of a pixel: one of them may be two pixels off."""


def right(tallied: Tally, threshold: float) -> BoolArray:
    """Return which detections are right at a threshold."""
    chosen: BoolArray = (tallied.score >= threshold) & (tallied.outcome == 1)
    return chosen


def bias_by_octant(tallied: Tally, threshold: float, truths: Sequence[FrameTruth]) -> list[dict[str, Any]]:
    """Mean signed error of right detections by octant of the Sun's azimuth in the image, clockwise from its top.

    `interval_95` of each component comes from resampling frames, whose craters share a pose and its errors.
    """
    found = right(tallied, threshold)
    azimuth = np.array([truth.sun_azimuth_image_rad for truth in truths])
    return [
        {
            "octant": octant,
            "sun_azimuth_image_deg": [45 * octant, 45 * (octant + 1)],
            **_bias(tallied, found & (tallied.detection_octant == octant), azimuth),
        }
        for octant in range(8)
    ]


def bias_overall(
    tallied: Tally, threshold: float, truths: Sequence[FrameTruth], by_octant: Sequence[dict[str, Any]]
) -> dict[str, Any]:
    """Mean signed error whatever the Sun, and the longest of the octants' with its number and its noise.

    `worst_octant_noise_px` is how long the mean of as many unbiased pairs would be, rms: a length cannot be negative,
    so it is never zero. Octants of fewer than `FEWEST_PAIRS` pairs are passed over.
    """
    azimuth = np.array([truth.sun_azimuth_image_rad for truth in truths])
    every = _bias(tallied, right(tallied, threshold), azimuth)
    judged = [row for row in by_octant if row["pairs"] >= FEWEST_PAIRS]
    worst = max(judged, key=lambda row: float(row["length_px"]), default=None)
    return {
        **every,
        "worst_octant": None if worst is None else worst["octant"],
        "worst_octant_px": float("nan") if worst is None else worst["length_px"],
        "worst_octant_noise_px": float("nan") if worst is None else worst["noise_px"],
    }


def _bias(tallied: Tally, chosen: BoolArray, sun_azimuth_rad: FloatArray) -> dict[str, Any]:
    """Mean errors of chosen detections along the axes of the image and of the Sun, each with a 95 % interval."""
    names = ("du_px", "dv_px", "toward_sun_px", "across_sun_px")
    count = int(chosen.sum())
    if not count:
        lengths, nan = ("length_px", "noise_px", "standard_error_px", "median_length_px"), float("nan")
        empty: dict[str, Any] = dict.fromkeys((*names, *lengths), nan)
        return {"pairs": 0, **empty, "interval_95": {name: [nan, nan] for name in names}}
    frame = tallied.detection_frame[chosen].astype(int)
    sine, cosine = np.sin(sun_azimuth_rad[frame]), np.cos(sun_azimuth_rad[frame])
    u, v = tallied.error_u[chosen], tallied.error_v[chosen]
    errors = np.stack([u, v, u * sine - v * cosine, u * cosine + v * sine], axis=1)
    sums = resampled_sums(np.column_stack([errors, np.ones(count)]), frame)
    drawn = sums[:, :-1] / sums[:, -1:]
    low, high = np.percentile(drawn, (2.5, 97.5), axis=0)
    mean = errors.mean(axis=0)
    return {
        "pairs": count,
        **{name: float(value) for name, value in zip(names, mean, strict=True)},
        "length_px": float(np.hypot(mean[0], mean[1])),
        "noise_px": float(np.sqrt(drawn[:, 0].var() + drawn[:, 1].var())),
        "standard_error_px": float(np.std(u) / np.sqrt(count)),
        "median_length_px": float(np.hypot(np.median(u), np.median(v))),
        "interval_95": {name: [float(a), float(b)] for name, a, b in zip(names, low, high, strict=True)},
    }


LOWLAND_M = -1_000.0
"""Mean ground of a frame below this is called lowland: nearly all of it is mare, and nearly all mare lies below."""

_ALTITUDE_EDGES_KM = (12.0, 20.0, 30.0, 40.0, 50.0)
_ELEVATION_EDGES_DEG = (3.0, 6.0, 9.0, 12.0, 15.0, 30.0, 60.0)
_CURVE_THRESHOLDS = tuple(round(0.10 + 0.05 * k, 2) for k in range(17))
RADIUS_RULE = MatchRule(radii=0.5)


@dataclass(frozen=True, slots=True)
class Scene:
    """Circumstances of one frame."""

    altitude_km: float  # above the mean ground
    sun_elevation_deg: float
    ground_m: float
    source: str


@dataclass(frozen=True, slots=True)
class Thresholds:
    """Scores that a model's metadata carry, all fixed on its validation split."""

    on_board: float
    balanced: float
    navigation: float


def score(
    truths: Sequence[FrameTruth], found: Sequence[FrameDetections], thresholds: Thresholds, scenes: Sequence[Scene]
) -> dict[str, Any]:
    """Every figure of detections against truths, as one mapping of plain values."""
    threshold = thresholds.on_board
    strict = tally(truths, found)
    fair = tally(truths, found, ignore_aware=True)
    wide = tally(truths, found, low_m=3_000.0, high_m=30_000.0)
    wide_fair = tally(truths, found, low_m=3_000.0, high_m=30_000.0, ignore_aware=True)
    strict_radius = tally(truths, found, rule=RADIUS_RULE)
    fair_radius = tally(truths, found, rule=RADIUS_RULE, ignore_aware=True)
    pair = (strict, fair)
    octants = bias_by_octant(strict, threshold, truths)
    return {
        "threshold": threshold,
        "per_class": [_class(truths, found, k, threshold) for k in range(4)][:3],
        "class_3_to_5_km": _class(truths, found, 3, threshold),
        "micro": with_interval(strict, threshold),
        "micro_half_radius": strict_radius.figures(threshold).to_dict(),
        "ignore_aware": with_interval(fair, threshold),
        "strict_3_to_30_km": wide.figures(threshold).to_dict(),
        "ignore_aware_3_to_30_km": wide_fair.figures(threshold).to_dict(),
        "average_precision_half_radius": {
            "strict": average_precision(strict_radius),
            "ignore_aware": average_precision(fair_radius),
            "per_class": [average_precision(tally(truths, found, classes=(k,), rule=RADIUS_RULE)) for k in range(3)],
        },
        "balanced": _at(pair, thresholds.balanced),
        "navigation": _at(pair, thresholds.navigation),
        "recall_by_degradation": _recall_by(strict, strict.crater_depth_ratio, DEGRADATION_EDGES, threshold),
        "degradation_state": _state(fair, threshold),
        "by_altitude_km": _by_frame(pair, threshold, np.array([s.altitude_km for s in scenes]), _ALTITUDE_EDGES_KM),
        "by_sun_elevation_deg": _by_frame(
            pair, threshold, np.array([s.sun_elevation_deg for s in scenes]), _ELEVATION_EDGES_DEG
        ),
        "by_sun_octant": _by_frame(
            pair,
            threshold,
            np.degrees(np.array([t.sun_azimuth_image_rad for t in truths])) % 360.0,
            tuple(45.0 * k for k in range(9)),
        ),
        "by_terrain": _by_name(pair, threshold, ["lowland" if s.ground_m < LOWLAND_M else "upland" for s in scenes]),
        "by_source": _by_name(pair, threshold, [s.source for s in scenes]),
        "bias_px_by_sun_octant": octants,
        "bias_px": bias_overall(strict, threshold, truths, octants),
        "sigma_calibration": {
            **_calibration(fair, threshold),
            "by_altitude_km": _calibration_by_altitude(fair, threshold, scenes),
        },
        "score_calibration": _score_calibration(strict),
        "precision_recall": _curve(strict),
        "precision_recall_per_class": [_curve(tally(truths, found, classes=(k,))) for k in range(3)],
        "unique_craters": int(np.unique(strict.crater_id).size),
        "blocks": int(np.unique(strict.crater_block).size),
    }


def _class(truths: Sequence[FrameTruth], found: Sequence[FrameDetections], k: int, threshold: float) -> dict[str, Any]:
    strict = tally(truths, found, classes=(k,))
    fair = tally(truths, found, classes=(k,), ignore_aware=True)
    return {
        **with_interval(strict, threshold),
        "size_class": k,
        "ignore_aware": fair.figures(threshold).to_dict(),
        "paper": PAPER_TABLE_2[k] if k < 3 else None,
    }


def _at(pair: tuple[Tally, Tally], threshold: float) -> dict[str, Any]:
    return {
        "threshold": threshold,
        "strict": with_interval(pair[0], threshold),
        "ignore_aware": with_interval(pair[1], threshold),
    }


def _group(pair: tuple[Tally, Tally], threshold: float, chosen: BoolArray) -> dict[str, Any]:
    """Figures of chosen frames (f,)."""
    strict, fair = (part.select(*_of_frames(part, chosen)) for part in pair)
    return {
        "frames": int(chosen.sum()),
        "strict": strict.figures(threshold).to_dict(),
        "ignore_aware": fair.figures(threshold).to_dict(),
    }


def _of_frames(part: Tally, chosen: BoolArray) -> tuple[BoolArray, BoolArray]:
    """Masks of the detections and craters of chosen frames (f,)."""
    return chosen[part.detection_frame.astype(int)], chosen[part.crater_frame.astype(int)]


def _by_frame(
    pair: tuple[Tally, Tally], threshold: float, values: FloatArray, edges: Sequence[float]
) -> list[dict[str, Any]]:
    return [
        {"low": low, "high": high, **_group(pair, threshold, chosen)}
        for low, high in itertools.pairwise(edges)
        if (chosen := (values >= low) & (values < high)).any()
    ]


def _by_name(pair: tuple[Tally, Tally], threshold: float, names: Sequence[str]) -> list[dict[str, Any]]:
    return [
        {"name": name, **_group(pair, threshold, np.array([other == name for other in names]))}
        for name in sorted(set(names))
    ]


def _recall_by(tallied: Tally, values: FloatArray, edges: Sequence[float], threshold: float) -> list[dict[str, Any]]:
    with np.errstate(invalid="ignore"):
        found = tallied.crater_score >= threshold
    rows = []
    for low, high in itertools.pairwise(edges):
        chosen = (values >= low) & (values < high) if low > edges[0] else values < high
        count = int(chosen.sum())
        rows.append(
            {
                "by": "depth_ratio",
                "low": low,
                "high": high,
                "expected": count,
                "recall": float(found[chosen].mean()) if count else float("nan"),
                "recall_interval_95": list(bootstrap_recall(found[chosen], tallied.crater_block[chosen])),
            }
        )
    return rows


def _state(tallied: Tally, threshold: float) -> dict[str, Any]:
    """Return how well the network separates fresh from degraded, over matched craters; rows are truth, columns said."""
    known = (tallied.outcome == 1) & (tallied.score >= threshold) & np.isfinite(tallied.detection_depth_ratio)
    said, true = tallied.detection_depth_ratio[known], tallied.matched_depth_ratio[known]
    edges = (DEGRADED_DEPTH_RATIO, FRESH_DEPTH_RATIO)
    table = np.zeros((3, 3), int)
    np.add.at(table, (np.digitize(true, edges), np.digitize(said, edges)), 1)
    count = int(known.sum())
    return {
        "states": ["degraded", "worn", "fresh"],
        "confusion": table.tolist(),
        "agreement": float(np.trace(table) / count) if count else float("nan"),
        "depth_ratio_median_error": float(np.median(np.abs(said - true))) if count else float("nan"),
        "craters": count,
    }


def _calibration(tallied: Tally, threshold: float, chosen: BoolArray | None = None) -> dict[str, float]:
    """Compare the errors with the predicted sigma: 1 and 0.683 would be perfect for a Gaussian."""
    hit = right(tallied, threshold)
    if chosen is not None:
        hit &= chosen
    sigma = tallied.sigma_px[hit]
    scaled = np.concatenate([tallied.error_u[hit] / sigma, tallied.error_v[hit] / sigma])
    if scaled.size == 0:
        names = ("mean_sigma_px", "rms", "inside_one_sigma", "inside_three_sigma")
        return {"pairs": 0} | dict.fromkeys(names, float("nan"))
    return {
        "pairs": int(hit.sum()),
        "mean_sigma_px": float(sigma.mean()),
        "rms": float(np.sqrt(np.mean(scaled**2))),
        "inside_one_sigma": float(np.mean(np.abs(scaled) < 1.0)),
        "inside_three_sigma": float(np.mean(np.abs(scaled) < 3.0)),
    }


def _calibration_by_altitude(tallied: Tally, threshold: float, scenes: Sequence[Scene]) -> list[dict[str, float]]:
    altitude = np.array([s.altitude_km for s in scenes])
    rows = []
    for low, high in itertools.pairwise(_ALTITUDE_EDGES_KM):
        chosen, _ = _of_frames(tallied, (altitude >= low) & (altitude < high))
        rows.append({"low": low, "high": high, **_calibration(tallied, threshold, chosen)})
    return rows


def _score_calibration(tallied: Tally) -> list[dict[str, float]]:
    """Share of the detections that are true, by score."""
    rows = []
    for low in np.arange(0.1, 1.0, 0.1):
        chosen = (tallied.score >= low) & (tallied.score < low + 0.1) & (tallied.outcome >= 0)
        if chosen.any():
            rows.append(
                {
                    "mean_score": float(tallied.score[chosen].mean()),
                    "fraction_true": float((tallied.outcome[chosen] == 1).mean()),
                    "count": int(chosen.sum()),
                }
            )
    return rows


def _curve(tallied: Tally) -> list[dict[str, float]]:
    rows = []
    for threshold in _CURVE_THRESHOLDS:
        figures = tallied.figures(threshold)
        rows.append(
            {"threshold": threshold, "precision": figures.precision, "recall": figures.recall, "f1": figures.f1}
        )
    return rows
