"""Position errors of detections: signed errors by Sun.

Errors are detection minus crater in pixels, u right and v down. They are given along the image's axes, and toward the
Sun in the image and across it (to the right of who looks toward it): shadows would draw a detector along the first.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from lunar.arrays import BoolArray, FloatArray
from payload_emulator.training.data.dataset import FrameTruth
from payload_emulator.training.evaluate.scoring import Tally, resampled_sums

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
