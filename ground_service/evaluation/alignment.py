"""Estimates against the reference ephemeris at their own times, in R/T/N of the reference orbit.

Nothing is fitted: no shift, rotation or scale is taken out before the errors are formed, since an alignment would
hide drift. Positions of estimates are mean-Earth (MCMF); errors are formed in ICRF axes about the Moon.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lunar import frames
from lunar.arrays import BoolArray, FloatArray, IntArray
from lunar.constants import NS
from lunar.ephemeris import Ephemeris
from lunar.timescales import tdb_s_from_utc_ns
from reports.statistics import chi2_quantile
from reports.values import DriftSample, ErrorBudget, NavigationStatistics


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceStates:
    """The reference at n epochs: ICRF states (n, 3) and mean-Earth place; NaN where `covered` is False."""

    utc_ns: IntArray
    covered: BoolArray
    position_icrf_m: FloatArray
    velocity_icrf_m_s: FloatArray
    mcmf_from_icrf: FloatArray
    position_mcmf_m: FloatArray
    latitude_rad: FloatArray
    longitude_rad: FloatArray
    altitude_m: FloatArray

    def at_rows(self, rows: IntArray) -> ReferenceStates:
        """The reference at some of its epochs."""
        return ReferenceStates(
            self.utc_ns[rows],
            self.covered[rows],
            self.position_icrf_m[rows],
            self.velocity_icrf_m_s[rows],
            self.mcmf_from_icrf[rows],
            self.position_mcmf_m[rows],
            self.latitude_rad[rows],
            self.longitude_rad[rows],
            self.altitude_m[rows],
        )

    @property
    def latitude_deg(self) -> FloatArray:
        """Mean-Earth latitude in degrees."""
        return np.degrees(self.latitude_rad)

    @property
    def longitude_deg(self) -> FloatArray:
        """Mean-Earth east longitude in degrees, 0 to 360."""
        return np.degrees(self.longitude_rad) % 360.0


def reference_states(
    reference: Ephemeris | None, orientation: frames.Orientation | None, utc_ns: IntArray
) -> ReferenceStates:
    """Return the reference at `utc_ns` (n,); epochs that it does not cover are NaN.

    Without a reference, or without an orientation to relate it to the ground, all epochs are NaN.
    """
    utc_ns = np.asarray(utc_ns, dtype=np.int64)
    if reference is None or orientation is None:
        reference = orientation = None
    covered = np.zeros(len(utc_ns), dtype=np.bool_) if reference is None else reference.covers(utc_ns)
    position = np.full((len(utc_ns), 3), np.nan)
    velocity = np.full((len(utc_ns), 3), np.nan)
    if reference is not None and covered.any():
        position[covered], velocity[covered] = reference.at(utc_ns[covered])
    rotation = np.full((len(utc_ns), 3, 3), np.nan)
    if orientation is not None and covered.any():
        rotation[covered] = orientation.mcmf_from_icrf(np.asarray(tdb_s_from_utc_ns(utc_ns[covered])))
    position_mcmf = np.einsum("nij,nj->ni", rotation, position)
    latitude, longitude, altitude = frames.spherical_from_mcmf(position_mcmf)
    return ReferenceStates(utc_ns, covered, position, velocity, rotation, position_mcmf, latitude, longitude, altitude)


def error_of_places_rtn_m(
    reference: ReferenceStates, latitude_deg: FloatArray, longitude_deg: FloatArray, altitude_m: FloatArray
) -> FloatArray:
    """Estimate minus reference (n, 3) in R/T/N, of estimates given as mean-Earth places at the same epochs."""
    estimate_mcmf = frames.mcmf_from_spherical(np.radians(latitude_deg), np.radians(longitude_deg), altitude_m)
    estimate_icrf = np.einsum("nji,nj->ni", reference.mcmf_from_icrf, estimate_mcmf)
    return error_of_positions_rtn_m(reference, estimate_icrf)


def error_of_positions_rtn_m(reference: ReferenceStates, position_icrf_m: FloatArray) -> FloatArray:
    """Estimate minus reference (n, 3) in R/T/N, of estimated ICRF positions (n, 3) at the same epochs."""
    rotation = frames.rtn_from_inertial(reference.position_icrf_m, reference.velocity_icrf_m_s)
    return np.asarray(np.einsum("nij,nj->ni", rotation, position_icrf_m - reference.position_icrf_m))


def places_of_positions(
    reference: ReferenceStates, position_icrf_m: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mean-Earth latitude and east longitude in degrees and altitude in m of ICRF positions (n, 3)."""
    latitude, longitude, altitude = frames.spherical_from_mcmf(
        np.einsum("nij,nj->ni", reference.mcmf_from_icrf, position_icrf_m)
    )
    return np.degrees(latitude), np.degrees(longitude) % 360.0, altitude


def angle_from_meridian_deg(reference: ReferenceStates) -> float:
    """Return the median angle of the ground track with the meridian, 0 to 90 degrees; NaN where nothing is covered."""
    velocity = np.einsum("nij,nj->ni", reference.mcmf_from_icrf, reference.velocity_icrf_m_s)
    up = reference.position_mcmf_m / np.linalg.norm(reference.position_mcmf_m, axis=-1, keepdims=True)
    east = np.cross([0.0, 0.0, 1.0], up)
    east /= np.maximum(np.linalg.norm(east, axis=-1, keepdims=True), 1e-12)
    across = np.abs(np.einsum("ni,ni->n", velocity, east))
    along = np.abs(np.einsum("ni,ni->n", velocity, np.cross(up, east)))
    angles = np.degrees(np.arctan2(across, along))[reference.covered]
    return float(np.median(angles)) if angles.size else math.nan


def ground_path_m(reference: ReferenceStates, radius_m: float) -> FloatArray:
    """Length (n,) of the reference's ground track from the first epoch to each, along a sphere of `radius_m`."""
    direction = reference.position_mcmf_m / np.linalg.norm(reference.position_mcmf_m, axis=-1, keepdims=True)
    chord = np.linalg.norm(np.diff(direction, axis=0), axis=-1)
    arc = 2.0 * np.arcsin(np.clip(chord / 2.0, 0.0, 1.0))
    return radius_m * np.concatenate(([0.0] if len(direction) else [], np.cumsum(arc)))


DIAGONAL_NAME = "sum of squared normalised errors (diagonal)"
"""Name of the sum of squared errors over variances, which ignores correlations and is not a NEES."""

PROBABILITY = 0.95
"""Default probability of the two-sided bounds."""

_LARGEST_CONDITION = 1e14
"""Condition number of a correlation matrix above which its inverse has no correct digit in double precision."""


def nees(error: ArrayLike, covariance: ArrayLike) -> FloatArray:
    """Return the normalised estimation errors squared, e' P^-1 e.

    Parameters
    ----------
    error
        Estimate minus truth (or reference), shape (..., d).
    covariance
        Covariance of the estimate in the same units and axes, shape (..., d, d). For a reference with its
        own errors, add their covariance.

    Returns
    -------
    Shape (...); NaN (unknown) where a number is missing or the covariance is not symmetric and positive definite.
    """
    e, p = np.asarray(error, dtype=np.float64), np.asarray(covariance, dtype=np.float64)
    size = e.shape[-1] if e.ndim else 0
    if size == 0 or p.shape[-2:] != (size, size):
        raise ValueError(f"expected errors (..., d) and covariances (..., d, d), found {e.shape} and {p.shape}")
    shape = np.broadcast_shapes(e.shape[:-1], p.shape[:-2])
    errors = np.broadcast_to(e, (*shape, size)).reshape(-1, size)
    matrices = np.broadcast_to(p, (*shape, size, size)).reshape(-1, size, size)
    values = np.full(len(errors), np.nan)
    variance = np.einsum("nii->ni", matrices)
    known = np.all(np.isfinite(errors), axis=1) & np.all(np.isfinite(matrices), axis=(1, 2))
    known &= np.all(variance > 0.0, axis=1)
    # Position and velocity have different scales: solve with the correlation matrix, not the covariance.
    scale = np.sqrt(np.where(known[:, None], variance, 1.0))
    correlation = np.where(known[:, None, None], matrices, np.eye(size)) / (scale[:, :, None] * scale[:, None, :])
    known &= np.all(np.abs(correlation - np.swapaxes(correlation, 1, 2)) < 1e-6, axis=(1, 2))
    least_and_greatest = np.linalg.eigvalsh(0.5 * (correlation + np.swapaxes(correlation, 1, 2)))[:, [0, -1]]
    known &= least_and_greatest[:, 0] > least_and_greatest[:, 1] / _LARGEST_CONDITION
    rows = np.flatnonzero(known)
    whitened = errors[rows] / scale[rows]
    solved = np.linalg.solve(correlation[rows], whitened[..., None])[..., 0]
    values[rows] = np.einsum("ni,ni->n", whitened, solved)
    return values.reshape(shape)


def squared_normalised_errors(error: ArrayLike, sigma: ArrayLike) -> FloatArray:
    """Return sums of squared errors over variances, errors and standard deviations (..., d): `DIAGONAL_NAME`.

    NaN where a number is missing or a standard deviation is not positive.
    """
    e, s = np.asarray(error, dtype=np.float64), np.asarray(sigma, dtype=np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.where(s > 0.0, e / s, np.nan)
    return np.asarray(np.sum(ratio**2, axis=-1), dtype=np.float64)


def bounds(degrees: ArrayLike, probability: float = PROBABILITY) -> tuple[FloatArray, FloatArray]:
    """Return the two-sided bounds of one chi-square value; NaN for zero degrees of freedom."""
    tail, freedom = 0.5 * (1.0 - probability), np.asarray(degrees, dtype=np.float64)
    return chi2_quantile(tail, freedom), chi2_quantile(1.0 - tail, freedom)


def bounds_per_degree(degrees: float, samples: float, probability: float) -> tuple[float, float]:
    """Return the two-sided bounds of the mean of independent values (ANEES, average NIS) per degree of freedom.

    `samples` may be fractional, because correlated samples count as fewer independent ones. NaN for less than one.
    """
    if not samples >= 1.0:
        return float("nan"), float("nan")
    low, high = bounds(samples * degrees, probability)
    return float(low) / (samples * degrees), float(high) / (samples * degrees)


def independent_samples(values: ArrayLike) -> float:
    """Return the effective number of independent samples of a series (n,) in time order, at least 1.

    This is the number of known samples over the integrated autocorrelation time, summed to the first lag with a
    correlation that is not positive (the rule of Geyer's initial positive sequence for single lags).
    """
    value = np.asarray(values, dtype=np.float64)
    value = value[np.isfinite(value)]
    count = len(value)
    if count < 3:
        return float(count)
    centred = value - value.mean()
    variance = float(centred @ centred)
    if variance == 0.0:
        return 1.0
    time = 1.0
    for lag in range(1, count):
        correlation = float(centred[:-lag] @ centred[lag:]) / variance
        if correlation <= 0.0:
            break
        time += 2.0 * correlation
    return min(max(count / time, 1.0), float(count))


PATH_LENGTHS_M = (100e3, 200e3, 500e3, 1000e3, 2000e3)
"""Sub-track lengths of the relative error, as trajectory benchmarks use them; a frame is about 24.5 km."""

LENGTH_TOLERANCE = 0.15
"""A sub-track may be this much longer or shorter than its nominal length: steps of 24.5 km hit 100 km within 2 %."""


def navigation_statistics(error_rtn_m: FloatArray, path_m: FloatArray, is_reset: BoolArray) -> NavigationStatistics:
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


def drift_by_length(error_rtn_m: FloatArray, path_m: FloatArray, is_reset: BoolArray) -> tuple[DriftSample, ...]:
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
            DriftSample(nominal, float(np.median(percent)), float(np.percentile(percent, 95.0)), int(fits.sum()))
        )
    return tuple(samples)


def error_before_reset_m(error_rtn_m: FloatArray, is_reset: BoolArray) -> FloatArray:
    """Horizontal error (n,) at the instant before each reset, which is the sample before it; NaN elsewhere."""
    before = np.full(len(is_reset), np.nan)
    at = np.flatnonzero(is_reset)
    at = at[at > 0]
    before[at] = np.hypot(error_rtn_m[at - 1, 1], error_rtn_m[at - 1, 2])
    return before


Sigma = tuple[float, float, float]


def reference_covariance_m2(sigma_rtn_m: Sigma | None) -> FloatArray:
    """Return the covariance (3, 3) of the reference in R/T/N; zero if its error is not declared."""
    return np.diag(np.square(sigma_rtn_m or (0.0, 0.0, 0.0)))


def error_budget(error_rtn_m: FloatArray, reference_sigma_rtn_m: Sigma | None) -> ErrorBudget | None:
    """Return the error budget of an observed error (n, 3); None without errors or a declared reference error."""
    known = np.isfinite(error_rtn_m).all(axis=1)
    if reference_sigma_rtn_m is None or not known.any():
        return None
    observed = float(np.mean(np.sum(error_rtn_m[known] ** 2, axis=1)))
    reference = float(np.sum(np.square(reference_sigma_rtn_m)))
    rest = observed - reference
    return ErrorBudget(observed**0.5, reference**0.5, rest**0.5 if rest >= 0.0 else float("nan"))


def format_tum(utc_ns: IntArray, position_m: FloatArray, reference_m: FloatArray) -> str:
    """A trajectory in TUM form: a line "t x y z qx qy qz qw" per pose, seconds past the Unix epoch, metres.

    Parameters
    ----------
    position_m
        Mean-Earth axes, shape (n, 3).
    reference_m
        Positions of the reference at the same times, which give the orientation; n is at least 2.
    """
    seconds = (utc_ns - utc_ns[0]) / NS
    velocity = np.gradient(reference_m, seconds, axis=0)
    turns = frames.quaternion_from_matrix(np.swapaxes(frames.rtn_from_inertial(reference_m, velocity), 1, 2))
    lines = [
        f"{int(t) // NS}.{int(t) % NS:09d} "
        + " ".join(f"{value:.6f}" for value in position)
        + " "
        + " ".join(f"{value:.12f}" for value in turn)
        for t, position, turn in zip(
            utc_ns, position_m, np.roll(frames.continuous_quaternions(turns), -1, axis=1), strict=True
        )
    ]
    return "# timestamp tx ty tz qx qy qz qw\n" + "\n".join(lines) + "\n"
