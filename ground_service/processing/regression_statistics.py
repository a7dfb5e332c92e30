"""Paired statistics of two builds over the same frames: block bootstrap, one-sided tests, control of many tests.

Frames that follow one another see the same craters and share the state of the filter, so they are resampled in blocks.
Both builds are resampled together (the same weight for a frame in both), which leaves what they have in common out of
their difference. Everything random is seeded: the same samples give the same figures.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]


@functools.lru_cache(maxsize=8)
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
    """Index (frames,) of the block of each frame; blocks of nearly equal length, at least two where there can be."""
    blocks = min(max(2, round(frames / block)), frames)
    return np.arange(frames, dtype=np.int64) * blocks // max(frames, 1)


def degrees_of_freedom(frames_of_pass: Sequence[int], block: int) -> int:
    """Blocks less passes: how many free numbers stand behind a standard error by blocks."""
    return sum(int(block_of_frame(frames, block)[-1]) for frames in frames_of_pass if frames)


def standard_error(resampled: FloatArray, frames_of_pass: Sequence[int], block: int) -> float:
    """Standard error from resampled figures (resamples,); corrected for the few blocks that were drawn from."""
    finite = resampled[np.isfinite(resampled)]
    if len(finite) < 2:
        return float("nan")
    free = degrees_of_freedom(frames_of_pass, block)
    blocks = free + sum(1 for frames in frames_of_pass if frames)
    if free < 1:
        return float("nan")
    return float(np.std(finite, ddof=1) * math.sqrt(blocks / free))


def interval(resampled: FloatArray, confidence: float = 0.95) -> tuple[float, float]:
    """Percentile interval of resampled figures; NaN where there is none."""
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


def student_upper_tail(t: float, freedom: int) -> float:
    """Probability that Student's t with so many degrees of freedom exceeds `t`."""
    if not math.isfinite(t):
        return 0.0 if t > 0 else 1.0
    if t < 0:
        return 1.0 - student_upper_tail(-t, freedom)
    # With t = sqrt(v) tan(a) the density becomes cos(a)^(v-1), smooth on a finite interval: Simpson's rule is exact
    # to 1e-12 here; far tails lie at the end of the interval where the density goes to zero.
    constant = math.exp(math.lgamma((freedom + 1) / 2) - math.lgamma(freedom / 2)) / math.sqrt(math.pi)
    angles = np.linspace(math.atan(t / math.sqrt(freedom)), math.pi / 2, 2001)
    values = np.abs(np.cos(angles)) ** (freedom - 1)
    step = angles[1] - angles[0]
    simpson = (
        step / 3.0 * float(values[0] + values[-1] + 4.0 * values[1:-1:2].sum() + 2.0 * values[2:-1:2].sum())
    )
    return float(min(1.0, constant * simpson))


@functools.lru_cache(maxsize=4096)
def student_quantile(upper_tail: float, freedom: int) -> float:
    """Value that Student's t exceeds with this probability (below 0.5)."""
    low, high = 0.0, 1.0
    while student_upper_tail(high, freedom) > upper_tail and high < 1e6:
        high *= 2.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if student_upper_tail(middle, freedom) > upper_tail else (low, middle)
    return 0.5 * (low + high)


def holm_levels(p_values: Sequence[float], alpha: float) -> list[float]:
    """Level at which each test is judged by Holm's step-down procedure: alpha over the tests not yet refused.

    A test is refused when its p-value and those of all smaller ones are below their levels; the chance that any true
    hypothesis of the family is refused is at most alpha, whatever depends on what. After the first test that is kept
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
