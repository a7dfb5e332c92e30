"""Consistency of an estimator by the textbook definitions: NEES, NIS, their bounds, and what the bounds contain.

The normalised estimation error squared of an error e (d,) with covariance P (d, d) is e' P^-1 e, the normalised
innovation squared that of an innovation with its covariance. For a consistent Gaussian estimator each is chi-square
with d degrees of freedom, and the sum over n independent ones with n d.

How to use it on a pass: `nees` with full covariances gives one number per sample, `summary` the line of a table, and
`met` whether a mean lies in its bounds (None: unknown). Where only standard deviations came down, use
`squared_normalised_errors` and print `DIAGONAL_NAME`: a sum over the diagonal is no NEES, and has the mean of one but
not its distribution. Samples of one pass are not independent; `summary` takes how many independent ones they are worth
from their autocorrelation, unless told.

References
----------
Bar-Shalom, Li, Kirubarajan (2001), Estimation with Applications to Tracking and Navigation, section 5.4.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]

DIAGONAL_NAME = "sum of squared normalised errors (diagonal)"
"""What to call the sum of squared errors over variances: it ignores correlations and is no NEES."""

PROBABILITY = 0.95
"""Probability of the two-sided bounds unless another is asked for."""

_LARGEST_CONDITION = 1e14
"""Condition number of a correlation matrix beyond which double precision leaves no digit of its inverse."""


def nees(error: ArrayLike, covariance: ArrayLike) -> FloatArray:
    """Return the normalised estimation errors squared, e' P^-1 e.

    Parameters
    ----------
    error
        Estimate minus truth (or reference), shape (..., d).
    covariance
        Covariance of the estimate in the same units and axes, shape (..., d, d). To judge against a reference with
        errors of its own add their covariance.

    Returns
    -------
    Shape (...); NaN where a number is missing or the covariance is not symmetric and positive definite: unknown.
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
    # Metres and centimetres per second in one matrix: the correlation is solved, not the covariance.
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


def nis(innovation: ArrayLike, covariance: ArrayLike) -> FloatArray:
    """Return the normalised innovations squared, v' S^-1 v; shapes and unknowns as for `nees`."""
    return nees(innovation, covariance)


def squared_normalised_errors(error: ArrayLike, sigma: ArrayLike) -> FloatArray:
    """Return sums of squared errors over variances, errors and standard deviations (..., d): `DIAGONAL_NAME`.

    NaN where a number is missing or a standard deviation is not positive.
    """
    e, s = np.asarray(error, dtype=np.float64), np.asarray(sigma, dtype=np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.where(s > 0.0, e / s, np.nan)
    return np.asarray(np.sum(ratio**2, axis=-1), dtype=np.float64)


def bounds(degrees: ArrayLike, probability: float = PROBABILITY) -> tuple[FloatArray, FloatArray]:
    """Return the two-sided bounds of one chi-square value of so many degrees of freedom; NaN for none."""
    # Imported here: it takes a second, and commands that judge nothing import this module as well.
    from scipy.stats import chi2

    freedom = np.asarray(degrees, dtype=np.float64)
    freedom = np.where(freedom > 0.0, freedom, np.nan)
    tail = 0.5 * (1.0 - probability)
    return np.asarray(chi2.ppf(tail, freedom)), np.asarray(chi2.ppf(1.0 - tail, freedom))


def average_bounds(degrees: float, samples: float, probability: float = PROBABILITY) -> tuple[float, float]:
    """Return the two-sided bounds of the mean of independent values (ANEES, average NIS), each of so many degrees.

    `samples` need not be whole: correlated samples are worth fewer. NaN for less than one.
    """
    if not samples >= 1.0 or not degrees > 0.0:
        return float("nan"), float("nan")
    low, high = bounds(samples * degrees, probability)
    return float(low) / samples, float(high) / samples


def share_inside(values: ArrayLike, degrees: ArrayLike, probability: float = PROBABILITY) -> float:
    """Return the share of known values inside the bounds of a single value; NaN where none is known."""
    value = np.asarray(values, dtype=np.float64)
    low, high = bounds(np.broadcast_to(np.asarray(degrees), value.shape), probability)
    known = np.isfinite(value) & np.isfinite(low)
    return float(np.mean((value >= low)[known] & (value <= high)[known])) if known.any() else float("nan")


def independent_samples(values: ArrayLike) -> float:
    """Return how many independent samples a series (n,) in time order is worth, from 1 to its known values.

    The number of known samples over the integrated autocorrelation time, summed to the first lag at which the
    correlation is not positive (the rule of Geyer's initial positive sequence for single lags).
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


@dataclass(frozen=True, slots=True)
class ConsistencySummary:
    """NEES or NIS of a series against its distribution.

    Attributes
    ----------
    samples, unknown
        Values that are known, and those that are not.
    mean_per_degree
        Sum of values over sum of degrees of freedom: 1 for a consistent estimator.
    low_per_degree, high_per_degree
        Bounds of that mean for the number of independent samples.
    independent
        How many independent samples the known ones are worth.
    inside
        Share of values inside the bounds of a single value.
    probability
        Of all bounds.
    """

    samples: int
    unknown: int
    mean_per_degree: float
    low_per_degree: float
    high_per_degree: float
    independent: float
    inside: float
    probability: float

    @property
    def met(self) -> bool | None:
        """Whether the mean lies in its bounds; None where that is not known."""
        if not np.isfinite(self.mean_per_degree) or not np.isfinite(self.low_per_degree):
            return None
        return self.low_per_degree <= self.mean_per_degree <= self.high_per_degree


def summary(
    values: ArrayLike,
    degrees: ArrayLike,
    independent: float | None = None,
    probability: float = PROBABILITY,
) -> ConsistencySummary:
    """Return the consistency of a series (n,) in time order, of values with so many degrees of freedom each.

    Parameters
    ----------
    values
        NEES or NIS, NaN where unknown.
    degrees
        Degrees of freedom, a number or (n,); a value with none counts as unknown.
    independent
        Number of independent samples, where it is known (runs of a Monte Carlo); None takes it from the series.
    """
    value = np.asarray(values, dtype=np.float64).reshape(-1)
    freedom = np.broadcast_to(np.asarray(degrees, dtype=np.float64), value.shape)
    known = np.isfinite(value) & (freedom > 0.0)
    count = int(np.count_nonzero(known))
    if count == 0:
        nan = float("nan")
        return ConsistencySummary(0, len(value), nan, nan, nan, 0.0, nan, probability)
    ratio = value[known] / freedom[known]
    worth = independent_samples(ratio) if independent is None else float(independent)
    typical = float(np.mean(freedom[known]))
    low, high = average_bounds(typical, worth, probability)
    return ConsistencySummary(
        samples=count,
        unknown=len(value) - count,
        mean_per_degree=float(value[known].sum() / freedom[known].sum()),
        low_per_degree=low / typical,
        high_per_degree=high / typical,
        independent=worth,
        inside=share_inside(value, freedom, probability),
        probability=probability,
    )
