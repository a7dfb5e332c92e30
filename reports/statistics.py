"""Small statistics of error series: lengths, quantiles, shares, bins, chi-squared bounds. NaN samples never count."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from reports.arrays import BoolArray, FloatArray, IntArray
from reports.values import NavigationSeries, NavigationStatistics, TimeSpan, TrackSeries

MOON_RADIUS_M = 1_737_400.0
QUANTILES = (0.5, 0.68, 0.95, 0.99)


def error_3d_m(error_rtn_m: FloatArray) -> FloatArray:
    """Length of each error vector, (n,)."""
    return np.asarray(np.sqrt(np.sum(np.square(error_rtn_m), axis=-1)))


def quantiles(values: FloatArray, levels: tuple[float, ...] = QUANTILES) -> tuple[float, ...]:
    """Quantiles of the finite values; NaN where there is none."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return tuple(math.nan for _ in levels)
    return tuple(float(v) for v in np.quantile(finite, levels))


def completed(series: NavigationSeries) -> NavigationStatistics:
    """Return the statistics of a series; missing ones are computed from its error vectors."""
    given = series.statistics
    length = error_3d_m(series.error_rtn_m)
    finite = length[np.isfinite(length)]
    p50, p68, p95, p99 = quantiles(length)
    found = {
        "median_3d_m": p50,
        "p68_3d_m": p68,
        "p95_3d_m": p95,
        "p99_3d_m": p99,
        "max_3d_m": float(finite.max()) if len(finite) else math.nan,
        "end_of_pass_m": float(finite[-1]) if len(finite) else math.nan,
    }

    def chosen(name: str) -> float:
        value = float(getattr(given, name))
        return value if math.isfinite(value) else found.get(name, math.nan)

    return NavigationStatistics(
        chosen("median_3d_m"),
        chosen("p68_3d_m"),
        chosen("p95_3d_m"),
        chosen("p99_3d_m"),
        chosen("max_3d_m"),
        chosen("drift_percent"),
        chosen("end_of_pass_m"),
        chosen("path_length_m"),
    )


def inside(utc_ns: IntArray, spans: Iterable[TimeSpan]) -> BoolArray:
    """True where a time lies in one of the spans."""
    result = np.zeros(len(utc_ns), dtype=np.bool_)
    for span in spans:
        result |= (utc_ns >= span.start_utc_ns) & (utc_ns < span.stop_utc_ns)
    return result


def reference_at(track: TrackSeries, utc_ns: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Latitude, longitude (degrees) and altitude (m) of a track at given times; NaN outside it.

    Directions are interpolated on the chord between samples, which at 15 s (0.8 degrees of arc) is good to a metre.
    """
    if len(track.utc_ns) == 0:
        nothing = np.full(len(utc_ns), np.nan)
        return nothing, nothing, nothing
    latitude, longitude = np.radians(track.latitude_deg), np.radians(track.longitude_deg)
    start = int(track.utc_ns[0])
    known = (track.utc_ns - start) / 1e9
    asked = (utc_ns - start) / 1e9
    parts = (
        np.cos(latitude) * np.cos(longitude),
        np.cos(latitude) * np.sin(longitude),
        np.sin(latitude),
        track.altitude_m,
    )
    x, y, z, altitude = (np.interp(asked, known, part, left=np.nan, right=np.nan) for part in parts)
    return (np.degrees(np.arctan2(z, np.hypot(x, y))), np.degrees(np.arctan2(y, x)) % 360.0, altitude)


def north_east_error_m(series: NavigationSeries, track: TrackSeries) -> tuple[FloatArray, FloatArray]:
    """Estimate minus reference on the ground, metres to the north and to the east, (n,) each."""
    latitude, longitude, _ = reference_at(track, series.utc_ns)
    north = np.radians(series.latitude_deg - latitude) * MOON_RADIUS_M
    turn = (series.longitude_deg - longitude + 180.0) % 360.0 - 180.0
    east = np.radians(turn) * MOON_RADIUS_M * np.cos(np.radians(latitude))
    return north, east


def containment(error: FloatArray, sigma: FloatArray) -> float:
    """Share of finite samples within 3 sigma, NaN where there is none."""
    usable = np.isfinite(error) & np.isfinite(sigma)
    if not usable.any():
        return math.nan
    return float(np.mean(np.abs(error[usable]) <= 3.0 * sigma[usable]))


def cumulative(values: FloatArray, points: int = 300) -> tuple[FloatArray, FloatArray]:
    """Return values and the share of samples not above them, at a limited number of points."""
    ordered = np.sort(values[np.isfinite(values)])
    if not len(ordered):
        return ordered, ordered
    share = (np.arange(len(ordered)) + 1.0) / len(ordered)
    if len(ordered) > points:
        keep = np.unique(np.round(np.linspace(0, len(ordered) - 1, points)).astype(np.int64))
        ordered, share = ordered[keep], share[keep]
    return ordered, share


@dataclass(frozen=True, slots=True, eq=False)
class Binned:
    """Median and 95th percentile of values in bins of another quantity; bins without samples are left out."""

    centre: FloatArray
    median: FloatArray
    p95: FloatArray
    count: IntArray


def binned(quantity: FloatArray, values: FloatArray, edges: FloatArray, least: int = 5) -> Binned:
    """Values by bins of a quantity; bins with fewer than ``least`` samples are left out."""
    usable = np.isfinite(quantity) & np.isfinite(values)
    which = np.digitize(quantity[usable], edges) - 1
    taken = values[usable]
    rows: list[tuple[float, float, float, int]] = []
    for i in range(len(edges) - 1):
        chosen = taken[which == i]
        if len(chosen) >= least:
            p50, p95 = quantiles(chosen, (0.5, 0.95))
            rows.append((float(edges[i] + edges[i + 1]) / 2, p50, p95, len(chosen)))
    table = np.array(rows, dtype=np.float64).reshape(-1, 4)
    return Binned(table[:, 0], table[:, 1], table[:, 2], table[:, 3].astype(np.int64))


def round_edges(quantity: FloatArray, most: int = 8) -> FloatArray:
    """Edges of at most ``most`` bins of round width that hold the finite values."""
    finite = quantity[np.isfinite(quantity)]
    if not len(finite):
        return np.zeros(0)
    low, high = float(finite.min()), float(finite.max())
    width = _round_step((high - low) / most if high > low else 1.0)
    first = math.floor(low / width) * width
    count = max(1, math.floor((high - first) / width) + 1)
    return np.asarray(first + width * np.arange(count + 1))


def _round_step(least: float) -> float:
    decade = 10.0 ** math.floor(math.log10(least))
    return next(m * decade for m in (1.0, 2.0, 2.5, 5.0, 10.0) if m * decade >= least * (1 - 1e-9))


def chi2_quantile(probability: float, dof: NDArray[np.float64] | float) -> FloatArray:
    """Quantile of chi-squared for each number of degrees of freedom, NaN where that is not positive."""
    from scipy.special import gammaincinv  # imported here: few commands need it

    freedom = np.asarray(dof, dtype=np.float64)
    return np.asarray(2.0 * gammaincinv(np.where(freedom > 0.0, freedom, np.nan) / 2.0, probability))


def per_degree(values: FloatArray, dof: FloatArray | IntArray) -> tuple[int, float, float]:
    """Return of NEES or NIS (n,): known values, mean per degree of freedom, and share inside the 95 % bounds of one.

    The mean is the sum of the values over that of their degrees, 1 for a consistent estimator.
    """
    known = np.isfinite(values) & (dof > 0)
    value, freedom = values[known], np.asarray(dof, dtype=np.float64)[known]
    if not len(value):
        return 0, float("nan"), float("nan")
    within = (value >= chi2_quantile(0.025, freedom)) & (value <= chi2_quantile(0.975, freedom))
    return len(value), float(value.sum() / freedom.sum()), float(within.mean())


def sigma_remark(mean: float, low: float, high: float) -> str:
    """Return by which factor sigmas are wrong: a mean NEES or NIS per degree outside its bounds; else nothing."""
    if mean > high:
        return f"sigmas {math.sqrt(mean):.1f} times too small"
    if 0.0 < mean < low:
        return f"sigmas {1.0 / math.sqrt(mean):.1f} times too large"
    return ""


def running_mean(values: FloatArray, window: int) -> FloatArray:
    """Mean of the finite values in a centred window, NaN where there is none, (n,)."""
    finite = np.isfinite(values)
    kernel = np.ones(min(window, max(len(values), 1)))
    total = np.convolve(np.where(finite, values, 0.0), kernel, mode="same")
    count = np.convolve(finite.astype(np.float64), kernel, mode="same")
    return np.where(count > 0, total / np.maximum(count, 1e-9), np.nan)[: len(values)]


def runs(labels: tuple[str, ...]) -> list[tuple[int, int, str]]:
    """Stretches of equal labels: first index, index after the last, label."""
    result: list[tuple[int, int, str]] = []
    start = 0
    for i in range(1, len(labels) + 1):
        if i == len(labels) or labels[i] != labels[start]:
            result.append((start, i, labels[start]))
            start = i
    return result
