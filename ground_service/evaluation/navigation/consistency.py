"""Consistency of an estimator by the standard definitions: NEES, NIS and their bounds.

The normalised estimation error squared of an error e (d,) with covariance P (d, d) is e' P^-1 e, the normalised
innovation squared that of an innovation with its covariance. For a consistent Gaussian estimator each is chi-square
with d degrees of freedom, and the sum over n independent ones with n d.

`nees` with full covariances gives one number per sample. If only standard deviations are available, use
`squared_normalised_errors` and print `DIAGONAL_NAME`: a sum over the diagonal has the mean of a NEES but not its
distribution. Samples of one pass are not independent: the bounds of their mean are for the number of independent ones.

References
----------
Bar-Shalom, Li, Kirubarajan (2001), Estimation with Applications to Tracking and Navigation, section 5.4.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from lunar.arrays import FloatArray

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
        raise ValueError(
            f"expected errors (..., d) and covariances (..., d, d), found {e.shape} and {p.shape}"
        )
    shape = np.broadcast_shapes(e.shape[:-1], p.shape[:-2])
    errors = np.broadcast_to(e, (*shape, size)).reshape(-1, size)
    matrices = np.broadcast_to(p, (*shape, size, size)).reshape(-1, size, size)
    values = np.full(len(errors), np.nan)
    variance = np.einsum("nii->ni", matrices)
    known = np.all(np.isfinite(errors), axis=1) & np.all(np.isfinite(matrices), axis=(1, 2))
    known &= np.all(variance > 0.0, axis=1)
    # Position and velocity have different scales: solve with the correlation matrix, not the covariance.
    scale = np.sqrt(np.where(known[:, None], variance, 1.0))
    correlation = np.where(known[:, None, None], matrices, np.eye(size)) / (
        scale[:, :, None] * scale[:, None, :]
    )
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
    from scipy.special import gammaincinv  # imported here: few commands need it

    freedom = np.asarray(degrees, dtype=np.float64)
    freedom = np.where(freedom > 0.0, freedom, np.nan)
    tail = 0.5 * (1.0 - probability)
    shape = 0.5 * freedom
    return np.asarray(2.0 * gammaincinv(shape, tail)), np.asarray(2.0 * gammaincinv(shape, 1.0 - tail))


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
