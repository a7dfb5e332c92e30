"""Long series made short without hiding anything: least, greatest and mean value per stretch of time, gaps marked."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

GAP_STEPS = 5.0
"""A silence of this many usual steps is a gap, over which no line should be drawn."""


@dataclass(frozen=True, slots=True, eq=False)
class Buckets:
    """Stretches of a series that hold samples, arrays (n,): first and last time, count, value statistics, gaps.

    `after_gap` is True where the samples of a stretch begin after a silence.
    """

    start_utc_ns: IntArray
    stop_utc_ns: IntArray
    count: IntArray
    low: FloatArray
    high: FloatArray
    mean: FloatArray
    after_gap: BoolArray


def downsample(utc_ns: IntArray, values: FloatArray, max_points: int) -> Buckets:
    """At most `max_points` stretches of equal length over a series in time order (n,); NaN values are left out.

    A series that is short enough comes back sample by sample.
    """
    known = np.isfinite(values)
    utc_ns, values = np.asarray(utc_ns)[known], np.asarray(values, dtype=np.float64)[known]
    if len(utc_ns) == 0:
        none = np.zeros(0)
        whole = none.astype(np.int64)
        return Buckets(whole, whole, whole, none, none, none, none.astype(np.bool_))
    step = np.diff(utc_ns)
    usual = float(np.median(step[step > 0])) if (step > 0).any() else 0.0
    gap = (
        np.concatenate(([False], step > GAP_STEPS * usual))
        if usual
        else np.zeros(len(utc_ns), dtype=np.bool_)
    )
    if len(utc_ns) <= max_points:
        one = np.ones(len(utc_ns), dtype=np.int64)
        return Buckets(utc_ns, utc_ns, one, values, values, values, gap)
    span = int(utc_ns[-1] - utc_ns[0]) + 1
    number = (utc_ns - utc_ns[0]) // -(-span // max_points)
    first = np.flatnonzero(np.concatenate(([True], np.diff(number) > 0)))
    last = np.concatenate((first[1:], [len(utc_ns)])) - 1
    count = (last - first + 1).astype(np.int64)
    return Buckets(
        start_utc_ns=utc_ns[first],
        stop_utc_ns=utc_ns[last],
        count=count,
        low=np.minimum.reduceat(values, first),
        high=np.maximum.reduceat(values, first),
        mean=np.add.reduceat(values, first) / count,
        after_gap=np.logical_or.reduceat(gap, first),
    )
