"""Paired statistics of two builds over the same passes.

Both builds process the same images, so the evidence is what changed. Units of the evidence are nearly independent of
each other (tracks of craters, ground cells, blocks of frames, passes); rows within a unit are not. The change of a
ratio of sums is linear in the influences of its units, whose sum of squares gives its standard error. For hits over
visible craters this is the clustered form of McNemar's test.

References
----------
N. A. Obuchowski, "On the comparison of correlated proportions for clustered data", Statistics in Medicine 17, 1998.
V. L. Durkalski et al., "Analysis of clustered matched-pair data", Statistics in Medicine 22, 2003.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lunar.arrays import FloatArray, IntArray

UNSEEN_PAIRS = 1.8
"""Standard error of a count of discordant pairs of which none was seen: the 95 % bound, 3 (Hanley 1983), over 1.645."""

LARGEST_FRAMES_NEEDED = 100_000_000
"""Largest reported number of needed frames; no archive has more."""


@dataclass(frozen=True, slots=True, eq=False)
class UnitSums:
    """Numerator and denominator of a ratio of sums by unit (k,), of one build.

    Attributes
    ----------
    unit
        Identity of the unit, unique within the sums.
    stratum
        Kind of terrain of the unit: the mean change may differ between strata.
    """

    unit: IntArray
    stratum: IntArray
    numerator: FloatArray
    denominator: FloatArray

    @property
    def value(self) -> float:
        """Return the ratio; NaN if nothing was counted."""
        total = float(self.denominator.sum())
        return float(self.numerator.sum()) / total if total > 0.0 else math.nan


@dataclass(frozen=True, slots=True)
class Change:
    """Change of a metric from baseline to candidate with its standard error, over a number of units."""

    baseline: float
    candidate: float
    estimate: float
    error: float
    units: int


def unit_sums(unit: IntArray, stratum: IntArray, numerator: FloatArray, denominator: FloatArray) -> UnitSums:
    """Return the sums of rows (m,) by unit; the stratum is that of the first row of a unit."""
    units, first, row_of = np.unique(unit, return_index=True, return_inverse=True)
    sums = np.zeros((2, len(units)))
    for row, values in zip(sums, (numerator, denominator), strict=True):
        np.add.at(row, row_of, values)
    return UnitSums(units, stratum[first], sums[0], sums[1])


def joined_sums(passes: Sequence[UnitSums]) -> UnitSums:
    """Return the sums of several passes, one after the other; a unit belongs to one pass."""
    return UnitSums(
        np.arange(sum(len(one.unit) for one in passes)),
        np.concatenate([one.stratum for one in passes]),
        np.concatenate([one.numerator for one in passes]),
        np.concatenate([one.denominator for one in passes]),
    )


def aligned(before: UnitSums, after: UnitSums) -> tuple[UnitSums, UnitSums]:
    """Return both sums over the units of either."""
    units, first = np.unique(np.concatenate((before.unit, after.unit)), return_index=True)
    stratum = np.concatenate((before.stratum, after.stratum))[first]

    def spread(one: UnitSums) -> UnitSums:
        at = np.searchsorted(units, one.unit)
        sums = np.zeros((2, len(units)))
        sums[0, at], sums[1, at] = one.numerator, one.denominator
        return UnitSums(units, stratum, sums[0], sums[1])

    return spread(before), spread(after)


def ratio_change(before: UnitSums, after: UnitSums) -> Change:
    """Return the change of a ratio of sums over units (k,) that both builds have.

    s^2 = sum over strata of K_h / (K_h - 1) sum (e_k - mean e)^2 with the influences
    e_k = (c_k - R' n'_k) / N' - (b_k - R n_k) / N. Without any change the error is that of unseen pairs, 1.8 / N.
    """
    first, second = before.value, after.value
    total = float(before.denominator.sum())
    if not (math.isfinite(first) and math.isfinite(second)):
        return Change(first, second, math.nan, math.nan, len(before.unit))
    influence = (after.numerator - second * after.denominator) / float(after.denominator.sum())
    influence -= (before.numerator - first * before.denominator) / total
    square, units = 0.0, 0
    for stratum in np.unique(before.stratum):
        part = influence[before.stratum == stratum]
        units += len(part)
        if len(part) > 1:
            square += len(part) / (len(part) - 1) * float(np.sum((part - part.mean()) ** 2))
        else:
            square += float(part @ part)
    return Change(first, second, second - first, max(math.sqrt(square), UNSEEN_PAIRS / total), units)


def ratio_error(sums: UnitSums) -> float:
    """Return the standard error of a ratio of sums, from its units."""
    total = float(sums.denominator.sum())
    if total <= 0.0 or len(sums.unit) < 2:
        return math.nan
    influence = (sums.numerator - sums.value * sums.denominator) / total
    return math.sqrt(len(influence) / (len(influence) - 1) * float(influence @ influence))


def mean_change(before: FloatArray, after: FloatArray, relative: bool) -> Change:
    """Return the mean change of values of passes (k,), in logarithms if it is relative; passes are the units."""
    first, second = quantile(before, 0.5), quantile(after, 0.5)
    with np.errstate(divide="ignore", invalid="ignore"):
        change = np.where(before == after, 0.0, np.log(after / before) if relative else after - before)
    change = change[np.isfinite(change)]
    if len(change) == 0:
        return Change(first, second, math.nan, math.nan, 0)
    error = float(np.std(change, ddof=1)) / math.sqrt(len(change)) if len(change) > 1 else math.nan
    return Change(first, second, float(change.mean()), error, len(change))


def quantile(values: FloatArray, level: float) -> float:
    """Return the quantile of the finite values; NaN if there are none."""
    known = values[np.isfinite(values)]
    return float(np.quantile(known, level)) if len(known) else math.nan


def student_quantile(probability: float, freedom: float) -> float:
    """Return the quantile of Student's t at this probability."""
    from scipy import special  # imported here: the service starts without it

    return float(special.stdtrit(freedom, probability))


def student_upper_tail(t: float, freedom: float) -> float:
    """Return the probability that Student's t exceeds `t`."""
    from scipy import special

    return float(special.stdtr(freedom, -t))


def binomial_upper_tail(count: int, trials: int, rate: float) -> float:
    """Return the probability that a binomial of this rate reaches a count above 0."""
    from scipy import special

    return float(special.bdtrc(count - 1, trials, rate))


def frames_needed(frames: int, error: float, distance: float, reach: float) -> int | None:
    """Return the number of similar frames whose error is `distance` over `reach` quantiles; None if unknown.

    The error falls with the root of the number of frames: frames * (reach * error / distance)^2.
    """
    if not (frames > 0 and math.isfinite(error) and distance > 0.0):
        return None
    needed = frames * (reach * error / distance) ** 2
    return math.ceil(needed) if needed <= LARGEST_FRAMES_NEEDED else None


def holm_levels(p_values: Sequence[float], alpha: float) -> list[float]:
    """Return the level of each test in Holm's step-down procedure: alpha over the number of tests not yet rejected.

    A test is rejected when its p-value and those of all smaller ones are below their levels; the chance that any true
    hypothesis of the family is rejected is at most alpha, whatever the dependence. After the first test that is kept
    all others are judged at its level.

    References
    ----------
    S. Holm, "A simple sequentially rejective multiple test procedure", 1979.
    """
    order = sorted(range(len(p_values)), key=lambda i: p_values[i])
    levels = [alpha] * len(p_values)
    stopped: float | None = None
    for rank, i in enumerate(order):
        level = alpha / (len(p_values) - rank) if stopped is None else stopped
        levels[i] = level
        if stopped is None and p_values[i] > level:
            stopped = level
    return levels
