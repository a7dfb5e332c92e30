"""Paired statistics of two builds over the same frames.

Both builds process the same frames, so the change of a metric is computed for each frame and common variation cancels.
For a metric that is a ratio of sums, each frame has a linear influence; the standard error follows from the sum of the
influences. The influence on a percentile cannot be estimated from few frames; its standard error comes from a block
bootstrap with equal weights for both builds. Successive frames show the same craters and share the state of the filter:
the integrated autocorrelation time, estimated from the paired series, increases the standard error and reduces the
degrees of freedom. Passes are strata: only variation within passes counts as random. Random numbers are seeded: the
same samples give the same results.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lunar.arrays import FloatArray, IntArray

BLOCKS_PER_CORRELATION_TIME = 2.0
"""Length of a bootstrap block in autocorrelation times: shorter blocks lose correlation, longer ones lose blocks."""

LARGEST_FRAMES_NEEDED = 100_000_000
"""Largest reported number of needed frames; no archive has more."""


@dataclass(frozen=True, slots=True)
class Spread:
    """Random variation of the change of a metric.

    Attributes
    ----------
    error
        Standard error of the sample; NaN if the frames do not determine it.
    freedom
        Degrees of freedom of Student's t.
    correlation_frames
        Integrated autocorrelation time of the paired series, in frames.
    floor
        Smallest credible standard error, given by a sample without a changed frame. Infinite if the frames do not
        bound it.
    fewest_frames
        Number of frames from which the floor is finite.
    failure_floor
        Smallest credible standard error for claims of a degradation, given by the position of a percentile between
        few values.
    """

    error: float
    freedom: float
    correlation_frames: float
    floor: float = 0.0
    fewest_frames: float = 0.0
    failure_floor: float = 0.0

    @property
    def failure_error(self) -> float:
        """Standard error for claims of a degradation."""
        return max(self.error, self.failure_floor) if math.isfinite(self.error) else math.nan

    @property
    def credible_error(self) -> float:
        """Standard error for claims that nothing has changed."""
        return max(self.error, self.floor) if math.isfinite(self.error) else math.nan


def series_spread(influence: FloatArray, sizes: Sequence[int]) -> Spread:
    """Return the spread of the sum of a series (n,) of influences, stratified by pass.

    Parameters
    ----------
    sizes
        Number of frames of each pass, in order.
    """
    centred = _centred(influence, sizes)
    time = autocorrelation_time(influence, sizes)
    independent = len(influence) / time
    freedom = independent - sum(1 for size in sizes if size)
    if freedom < 1.0:
        return Spread(math.nan, max(freedom, 0.0), time)
    square = float(centred @ centred)
    return Spread(math.sqrt(time * square * independent / freedom), freedom, time)


def autocorrelation_time(series: FloatArray, sizes: Sequence[int]) -> float:
    """Return the integrated autocorrelation time of a series (n,) in frames, at least 1, pooled over passes.

    The time is 1 + 2 (r_1 + r_2 + ...). Sums of neighbouring terms are added as long as they are positive (initial
    positive sequence). Subtracting the mean of a short pass lowers every autocovariance by about the time over the
    length of the pass; this is corrected iteratively. A pass shows no correlation that lasts longer than a third of it.

    References
    ----------
    C. J. Geyer, "Practical Markov chain Monte Carlo", Statistical Science 7, 1992, section 3.3.
    """
    parts = [part for part in _passes(_centred(series, sizes), sizes) if len(part)]
    square = sum(float(part @ part) for part in parts)
    longest = max((len(part) for part in parts), default=0)
    if square <= 0.0 or longest < 4:
        return 1.0
    variance = square / sum(len(part) for part in parts)
    mean_length = sum(len(part) for part in parts) / len(parts)
    products = np.zeros(longest // 2 + 1)
    counts = np.zeros(longest // 2 + 1)
    for part in parts:
        lags = min(len(part), len(products))
        products[:lags] += np.correlate(part, part, "full")[len(part) - 1 :][:lags]
        counts[:lags] += np.arange(len(part), len(part) - lags, -1.0)
    correlations = products / counts / variance
    time = 1.0
    for _ in range(10):
        loss = min(time / mean_length, 0.5)
        corrected = correlations * (1.0 - loss) + loss
        corrected[0] = 1.0
        pairs = corrected[0::2][: len(corrected) // 2] + corrected[1::2]
        ended = np.flatnonzero(pairs <= 0.0)
        total = 2.0 * float(pairs[: ended[0] if len(ended) else None].sum()) - 1.0
        time = min(max(total, 1.0), max(mean_length / 3.0, 1.0))
    return time


def resampled_spread(
    resampled: FloatArray, sizes: Sequence[int], block: int, correlation_frames: float
) -> Spread:
    """Return the spread from resampled values (resamples,) of a change, corrected for the number of blocks."""
    frames, passes = sum(sizes), sum(1 for size in sizes if size)
    freedom = frames / correlation_frames - passes
    blocks = sum(int(block_of_frame(size, block)[-1]) + 1 for size in sizes if size)
    finite = resampled[np.isfinite(resampled)]
    if freedom < 1.0 or blocks <= passes or len(finite) < max(2, len(resampled) // 2):
        return Spread(math.nan, max(freedom, 0.0), correlation_frames)
    error = float(np.std(finite, ddof=1) * math.sqrt(blocks / (blocks - passes)))
    return Spread(error, freedom, correlation_frames)


def block_length(correlation_frames: float) -> int:
    """Return the length of a bootstrap block in frames for a series with this autocorrelation time."""
    if correlation_frames <= 1.0:
        return 1
    return math.ceil(BLOCKS_PER_CORRELATION_TIME * correlation_frames)


@functools.lru_cache(maxsize=32)
def block_weights(frames_of_pass: tuple[int, ...], block: int, resamples: int, seed: int = 0) -> FloatArray:
    """Weights (resamples, frames) of bootstrap resamples: blocks of frames drawn with replacement within each pass.

    Parameters
    ----------
    frames_of_pass
        Number of frames of each pass, in the order in which the passes follow one another.
    block
        Frames in a block; a pass shorter than two blocks is cut into two.
    """
    rng = np.random.default_rng(seed)
    parts = []
    for frames in frames_of_pass:
        owner = block_of_frame(frames, block)
        blocks = int(owner[-1]) + 1 if frames else 0
        if blocks == 0:
            continue
        drawn = rng.multinomial(blocks, np.full(blocks, 1.0 / blocks), size=resamples)
        parts.append(drawn[:, owner].astype(np.float64))
    return np.concatenate(parts, axis=1) if parts else np.zeros((resamples, 0))


def block_of_frame(frames: int, block: int) -> IntArray:
    """Return the index (frames,) of the block of each frame; of nearly equal length, at least two if possible."""
    blocks = min(max(2, round(frames / block)), frames)
    return np.arange(frames, dtype=np.int64) * blocks // max(frames, 1)


def interval(resampled: FloatArray, confidence: float = 0.95) -> tuple[float, float]:
    """Return the percentile interval of resampled values; NaN if there is none."""
    finite = resampled[np.isfinite(resampled)]
    if len(finite) == 0:
        return float("nan"), float("nan")
    low, high = np.quantile(finite, [(1.0 - confidence) / 2.0, (1.0 + confidence) / 2.0])
    return float(low), float(high)


def weighted_ratio(numerator: FloatArray, denominator: FloatArray, weights: FloatArray) -> FloatArray:
    """Sum of numerators over sum of denominators for each row of weights (b, n); NaN where nothing was counted."""
    above = weights @ np.nan_to_num(numerator)
    below = weights @ np.where(np.isfinite(numerator), denominator, 0.0)
    return np.divide(above, below, out=np.full_like(above, np.nan), where=below > 0.0)


def ratio_influence(numerator: FloatArray, denominator: FloatArray) -> FloatArray:
    """Return the influence (n,) of each frame on the ratio of sums: its residual over the sum of the denominators.

    References
    ----------
    W. G. Cochran, "Sampling Techniques", 3rd edition, 1977, section 6.3 (variance of a ratio estimate).
    """
    above = np.nan_to_num(numerator)
    below = np.where(np.isfinite(numerator), denominator, 0.0)
    total = float(below.sum())
    if total <= 0.0:
        return np.full(len(above), np.nan)
    return np.asarray((above - float(above.sum()) / total * below) / total, dtype=np.float64)


def weighted_quantile(values: FloatArray, level: float, weights: FloatArray) -> FloatArray:
    """Quantile of the finite values (n,) for each row of weights (b, n); NaN where no value has weight.

    It is the smallest value with at least that share of the weight at or below it (inverse of the distribution).
    """
    known = np.flatnonzero(np.isfinite(values))
    result = np.full(weights.shape[0], np.nan)
    if len(known) == 0:
        return result
    order = known[np.argsort(values[known], kind="stable")]
    below = np.cumsum(weights[:, order], axis=1)
    total = below[:, -1]
    reached = np.argmax(below >= (level * total * (1.0 - 1e-12))[:, None], axis=1)
    result[total > 0.0] = values[order][reached[total > 0.0]]
    return result


def unseen_changes(confidence: float) -> float:
    """Return the upper bound of the number of changed items if none was observed: 4.6 at 99 %, 3.0 at 95 % confidence.

    References
    ----------
    J. A. Hanley, A. Lippman-Hand, "If nothing goes wrong, is everything all right?", JAMA 249, 1983.
    """
    return -math.log1p(-confidence)


def student_quantile(probability: float, freedom: float) -> float:
    """Return the quantile of Student's t at this probability."""
    from scipy import special  # imported here: the service starts without it

    if math.isinf(freedom):
        return float(special.ndtri(probability))
    return float(special.stdtrit(freedom, probability))


def student_upper_tail(t: float, freedom: float) -> float:
    """Return the probability that Student's t exceeds `t`."""
    from scipy import special

    return float(special.ndtr(-t) if math.isinf(freedom) else special.stdtr(freedom, -t))


def resolution(spread: Spread, confidence: float, power: float) -> float:
    """Return the smallest change that a one-sided test at this confidence detects with this power; infinite if none.

    References
    ----------
    H. S. Bloom, "Minimum detectable effects", Evaluation Review 19, 1995.
    """
    if not math.isfinite(spread.credible_error) or spread.freedom < 1.0:
        return math.inf
    reach = student_quantile(confidence, spread.freedom) + student_quantile(power, spread.freedom)
    return reach * spread.credible_error


def frames_needed(
    frames: int, passes: int, spread: Spread, detectable: float, confidence: float, power: float
) -> int | None:
    """Return the number of similar frames needed to resolve a change of `detectable`; None if unknown.

    The standard error falls with the root of the number of frames, its floor with the number, and the quantiles of t
    with the degrees of freedom: about frames * (resolution / detectable)^2 where these are many.
    """
    if not (math.isfinite(spread.error) and detectable > 0.0 and frames > 0):
        return None
    # An infinite floor decreases to a finite value that these frames do not determine; the number is a lower bound
    # then.
    floor = spread.floor if math.isfinite(spread.floor) else 0.0

    def coarse(count: int) -> bool:
        ratio = frames / count
        freedom = count / spread.correlation_frames - passes
        then = Spread(spread.error * math.sqrt(ratio), freedom, spread.correlation_frames, floor * ratio)
        return resolution(then, confidence, power) > detectable

    high = max(frames, math.ceil(spread.fewest_frames), 1)
    if not coarse(high):
        return high
    while coarse(high):
        high *= 2
        if high > LARGEST_FRAMES_NEEDED:
            return None
    low = high // 2
    while low + 1 < high:
        middle = (low + high) // 2
        low, high = (middle, high) if coarse(middle) else (low, middle)
    return high


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


def _passes(series: FloatArray, sizes: Sequence[int]) -> list[FloatArray]:
    return np.split(series, np.cumsum(sizes)[:-1]) if len(sizes) else []


def _centred(series: FloatArray, sizes: Sequence[int]) -> FloatArray:
    """Return the series minus the mean of its pass."""
    parts = [part - part.mean() if len(part) else part for part in _passes(series, sizes)]
    return np.concatenate(parts) if parts else series
