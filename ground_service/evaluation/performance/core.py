"""Trends over passes: means by condition, change points, and requirements over a rolling window.

**Means.** Each pass counts once. The interval of a mean is Student's t over the passes; with one pass it is unknown.

**Change points.** The statistic is the largest standardised CUSUM of the ranks of the values,
``max_k |S_k| / sqrt(k (n - k) / n)``, over splits that leave at least `LEAST_PASSES` passes on each side. Its
probability under "no change" comes from random permutations, so that no distribution of the values is assumed. If it is
significant, both parts are searched in the same way (binary segmentation). The false alarm rate is divided among the
metrics (Bonferroni): with constant levels, the probability of any change point is at most `FALSE_ALARM_RATE`. Passes
are taken as independent; a trend of the conditions, such as the elevation of the Sun, also is a change.

**Share of met requirements.** Interval of Wilson.

References
----------
A. N. Pettitt, "A non-parametric approach to the change-point problem", Applied Statistics 28, 1979.
E. B. Wilson, "Probable inference, the law of succession, and statistical inference", JASA 22, 1927.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from lunar.arrays import FloatArray, IntArray

FALSE_ALARM_RATE = 0.01
LEAST_PASSES = 5
PERMUTATIONS = 1999
_SEED = 20
_BLOCK_VALUES = 500_000
"""Values that are permuted at a time, which limits the memory."""

METRICS = ("recall", "drift_percent", "median_error_m")
ALTITUDE_EDGES_KM = (20.0, 30.0, 40.0)
SUN_EDGES_DEG = (0.0, 15.0, 30.0, 60.0)
CONFIDENCE = 0.95


@dataclass(frozen=True, slots=True)
class Level:
    """Mean over passes with its confidence interval; NaN where unknown."""

    passes: int
    mean: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class Change:
    """Change of level at the value number `index`; medians of the segments before and after it."""

    index: int
    before: float
    after: float
    count_before: int
    count_after: int
    p_value: float


@dataclass(frozen=True, slots=True)
class Share:
    """Share of successes with its confidence interval; NaN without trials."""

    share: float
    low: float
    high: float


def mean_level(values: Sequence[float]) -> Level:
    """Return the mean of the finite values and its 95 % interval."""
    from scipy import special  # imported here: the service starts without it

    known = np.array([value for value in values if math.isfinite(value)], dtype=np.float64)
    n = len(known)
    if n == 0:
        return Level(0, math.nan, math.nan, math.nan)
    mean = float(known.mean())
    if n == 1:
        return Level(1, mean, math.nan, math.nan)
    reach = float(special.stdtrit(n - 1, 0.5 + CONFIDENCE / 2.0)) * float(known.std(ddof=1)) / math.sqrt(n)
    return Level(n, mean, mean - reach, mean + reach)


def interval_name(value: float, edges: Sequence[float], unit: str) -> str:
    """Return the name of the interval of a value, such as "20 to 30 km"; "unknown" for NaN."""
    if not math.isfinite(value):
        return "unknown"
    at = int(np.searchsorted(edges, value, side="right"))
    if at == 0:
        return f"below {edges[0]:g} {unit}"
    if at == len(edges):
        return f"{edges[-1]:g} {unit} and above"
    return f"{edges[at - 1]:g} to {edges[at]:g} {unit}"


def interval_names(edges: Sequence[float], unit: str) -> list[str]:
    """Return the names of all intervals in order, and "unknown"."""
    inside = [(low + high) / 2.0 for low, high in pairwise(edges)]
    values = [edges[0] - 1.0, *inside, edges[-1] + 1.0, math.nan]
    return [interval_name(value, edges, unit) for value in values]


def change_points(
    values: Sequence[float], *, metrics: int = len(METRICS), permutations: int = PERMUTATIONS
) -> list[Change]:
    """Return the changes of level of a series (n,) in order; values that are not finite are left out.

    Parameters
    ----------
    metrics
        Number of series among which the false alarm rate is divided.
    """
    series = np.array(values, dtype=np.float64)
    places = np.flatnonzero(np.isfinite(series))
    known = series[places]
    rng = np.random.default_rng(_SEED)
    found = sorted(_splits(known, 0, FALSE_ALARM_RATE / metrics, permutations, rng))
    bounds = [0, *(at for at, _ in found), len(known)]
    return [
        Change(
            int(places[at]),
            float(np.median(known[start:at])),
            float(np.median(known[at:stop])),
            at - start,
            stop - at,
            p_value,
        )
        for (at, p_value), start, stop in zip(found, bounds, bounds[2:], strict=False)
    ]


def _splits(
    values: FloatArray, first: int, alpha: float, permutations: int, rng: np.random.Generator
) -> list[tuple[int, float]]:
    """Return place and p-value of the changes of a segment that begins at `first`."""
    if len(values) < 2 * LEAST_PASSES:
        return []
    ranks = _ranks(values)
    statistic, split = _largest_cusum(ranks[None, :])
    block = max(_BLOCK_VALUES // len(ranks), 1)
    reached = 0
    for first_row in range(0, permutations, block):
        rows = min(block, permutations - first_row)
        shuffled, _ = _largest_cusum(rng.permuted(np.tile(ranks, (rows, 1)), axis=1))
        # The margin makes equal statistics equal that differ by rounding.
        reached += int(np.count_nonzero(shuffled >= statistic[0] - 1e-9))
    p_value = (1 + reached) / (permutations + 1)
    if p_value > alpha:
        return []
    at = int(split[0])
    return [
        *_splits(values[:at], first, alpha, permutations, rng),
        (first + at, p_value),
        *_splits(values[at:], first + at, alpha, permutations, rng),
    ]


def _ranks(values: FloatArray) -> FloatArray:
    """Return the centred ranks (n,); equal values have their mean rank."""
    _, inverse, counts = np.unique(values, return_inverse=True, return_counts=True)
    mean = np.cumsum(counts) - (counts - 1) / 2.0
    return np.asarray(mean[inverse] - (len(values) + 1) / 2.0)


def _largest_cusum(ranks: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return the largest standardised CUSUM of each row (b, n), and the number of values before the split."""
    n = ranks.shape[1]
    before = np.arange(LEAST_PASSES, n - LEAST_PASSES + 1)
    sums = np.abs(np.cumsum(ranks, axis=1)[:, before - 1]) / np.sqrt(before * (n - before) / n)
    best = np.argmax(sums, axis=1)
    return sums[np.arange(len(ranks)), best], before[best]


def wilson(successes: int, trials: int) -> Share:
    """Return a share and its 95 % interval."""
    from scipy import special

    if trials == 0:
        return Share(math.nan, math.nan, math.nan)
    z = float(special.ndtri(0.5 + CONFIDENCE / 2.0))
    share = successes / trials
    middle = share + z * z / (2.0 * trials)
    reach = z * math.sqrt(share * (1.0 - share) / trials + z * z / (4.0 * trials * trials))
    scale = 1.0 + z * z / trials
    return Share(share, max((middle - reach) / scale, 0.0), min((middle + reach) / scale, 1.0))


def rolling_counts(times_ns: Sequence[int], statuses: Sequence[str], window_ns: int) -> list[Mapping[str, int]]:
    """Return the numbers of passes by status within the window that ends at each pass.

    Parameters
    ----------
    times_ns
        Times of the passes, ascending.
    statuses
        Status of the requirement on each pass.
    """
    counts: list[Mapping[str, int]] = []
    first = 0
    inside: Counter[str] = Counter()
    for time_ns, status in zip(times_ns, statuses, strict=True):
        inside[status] += 1
        while times_ns[first] <= time_ns - window_ns:
            inside[statuses[first]] -= 1
            first += 1
        counts.append({name: count for name, count in sorted(inside.items()) if count})
    return counts
