"""Statistics of navigation errors: percentiles, drift between resets, drift by path length.

Drift is the horizontal error that accumulated over a stretch, divided by the length of the reference's ground track
over it, in percent. A reset ends a stretch: what counts is the error at the instant before it.
"""

from __future__ import annotations

import numpy as np

from lunar.arrays import BoolArray, FloatArray
from reports.values import DriftSample, NavigationStatistics

PATH_LENGTHS_M = (100e3, 200e3, 500e3, 1000e3, 2000e3)
"""Sub-track lengths of the relative error, as trajectory benchmarks use them; a frame is about 24.5 km."""

LENGTH_TOLERANCE = 0.15
"""A sub-track may be this much longer or shorter than its nominal length: steps of 24.5 km hit 100 km within 2 %."""


def navigation_statistics(
    error_rtn_m: FloatArray, path_m: FloatArray, is_reset: BoolArray
) -> NavigationStatistics:
    """Percentiles of the 3-D error, end-of-pass error and drift of n samples; NaN samples are left out.

    Parameters
    ----------
    error_rtn_m
        (n, 3) estimate minus reference in R/T/N.
    path_m
        (n,) ground path of the reference from its start.
    is_reset
        (n,) True where the estimate was reset to an outside position at this sample.
    """
    known = np.isfinite(error_rtn_m).all(axis=-1) & np.isfinite(path_m)
    if not known.any():
        return NavigationStatistics()
    error, path, reset = error_rtn_m[known], path_m[known], is_reset[known]
    size = np.linalg.norm(error, axis=-1)
    p50, p68, p95, p99 = (float(p) for p in np.percentile(size, [50.0, 68.0, 95.0, 99.0]))
    return NavigationStatistics(
        median_3d_m=p50,
        p68_3d_m=p68,
        p95_3d_m=p95,
        p99_3d_m=p99,
        max_3d_m=float(size.max()),
        drift_percent=drift_percent(error, path, reset),
        end_of_pass_m=float(size[-1]),
        path_length_m=float(path[-1] - path[0]),
    )


def drift_percent(error_rtn_m: FloatArray, path_m: FloatArray, is_reset: BoolArray) -> float:
    """Median over the stretches between resets of horizontal error gained per ground path, in percent."""
    horizontal = error_rtn_m[:, 1:]
    starts = np.unique(np.concatenate(([0], np.flatnonzero(is_reset))))
    stops = np.concatenate((starts[1:], [len(path_m)])) - 1
    length = path_m[stops] - path_m[starts]
    gained = np.linalg.norm(horizontal[stops] - horizontal[starts], axis=-1)
    moved = length > 0.0
    if not moved.any():
        return float("nan")
    return float(100.0 * np.median(gained[moved] / length[moved]))


def drift_by_length(
    error_rtn_m: FloatArray, path_m: FloatArray, is_reset: BoolArray
) -> tuple[DriftSample, ...]:
    """Relative drift over every sub-track of each of `PATH_LENGTHS_M` that holds no reset."""
    known = np.isfinite(error_rtn_m).all(axis=-1) & np.isfinite(path_m)
    horizontal, path = error_rtn_m[known, 1:], path_m[known]
    run = np.cumsum(is_reset)[known]
    samples = []
    for nominal in PATH_LENGTHS_M:
        start = np.arange(len(path))
        after = np.minimum(np.searchsorted(path, path + nominal), len(path) - 1)
        before = np.maximum(after - 1, start)
        nearer = np.abs(path[before] - path - nominal) < np.abs(path[after] - path - nominal)
        stop = np.where(nearer, before, after)
        length = path[stop] - path[start]
        fits = (np.abs(length - nominal) <= nominal * LENGTH_TOLERANCE) & (run[start] == run[stop])
        if not fits.any():
            continue
        gained = np.linalg.norm(horizontal[stop] - horizontal[start], axis=-1)[fits]
        percent = 100.0 * gained / length[fits]
        samples.append(
            DriftSample(
                nominal, float(np.median(percent)), float(np.percentile(percent, 95.0)), int(fits.sum())
            )
        )
    return tuple(samples)


def error_before_reset_m(error_rtn_m: FloatArray, is_reset: BoolArray) -> FloatArray:
    """Horizontal error (n,) at the instant before each reset, which is the sample before it; NaN elsewhere."""
    before = np.full(len(is_reset), np.nan)
    at = np.flatnonzero(is_reset)
    at = at[at > 0]
    before[at] = np.hypot(error_rtn_m[at - 1, 1], error_rtn_m[at - 1, 2])
    return before
