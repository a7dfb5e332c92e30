"""Long series made short without hiding anything: least, greatest and mean value per stretch of time, gaps marked."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lunar.arrays import BoolArray, FloatArray, IntArray

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
    gap = np.concatenate(([False], step > GAP_STEPS * usual)) if usual else np.zeros(len(utc_ns), dtype=np.bool_)
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


@dataclass(frozen=True, slots=True, eq=False)
class Aggregates:
    """Stretches of a series (n,) in time order, aggregated ahead of time.

    First and last time of the samples in each, how many there are, how many of them are known, and the sum, the least
    and the greatest of those.
    """

    first_utc_ns: IntArray
    last_utc_ns: IntArray
    rows: IntArray
    count: IntArray
    total: FloatArray
    low: FloatArray
    high: FloatArray


def aggregate(utc_ns: IntArray, values: FloatArray) -> Aggregates:
    """One stretch of all samples (n,) in time order; none where there are no samples."""
    utc_ns, values = np.asarray(utc_ns, dtype=np.int64), np.asarray(values, dtype=np.float64)
    known = values[np.isfinite(values)]
    some = slice(0, min(len(utc_ns), 1))
    return Aggregates(
        utc_ns[:1],
        utc_ns[-1:],
        np.array([len(utc_ns)])[some],
        np.array([len(known)])[some],
        np.array([known.sum()])[some],
        np.array([known.min(initial=np.inf)])[some],
        np.array([known.max(initial=-np.inf)])[some],
    )


def join(pieces: Sequence[Aggregates]) -> Aggregates:
    """Stretches one after another."""
    columns = zip(
        *((one.first_utc_ns, one.last_utc_ns, one.rows, one.count, one.total, one.low, one.high) for one in pieces),
        strict=True,
    )
    return Aggregates(*(np.concatenate(column) for column in columns))


def downsample_aggregates(found: Aggregates, max_points: int) -> Buckets:
    """As `downsample`, from stretches; silences inside a stretch are not seen."""
    step = np.concatenate(([0], found.first_utc_ns[1:] - found.last_utc_ns[:-1]))
    dense = found.rows > 1
    usual = (
        float(np.median((found.last_utc_ns - found.first_utc_ns)[dense] / (found.rows[dense] - 1)))
        if dense.any()
        else 0.0
    )
    gap = step > GAP_STEPS * usual if usual > 0.0 else np.zeros(len(step), dtype=np.bool_)
    keep = found.count > 0
    # A silence before a stretch without a known value is one before the next stretch that has some.
    carried = np.add.accumulate(gap.astype(np.int64))[keep]
    gap = np.diff(carried, prepend=0) > 0
    first, last, count = found.first_utc_ns[keep], found.last_utc_ns[keep], found.count[keep]
    if len(first) == 0:
        return downsample(first, first.astype(np.float64), max_points)
    width = -(-(int(last[-1] - first[0]) + 1) // max_points)
    number = (first - first[0]) // width
    starts = np.flatnonzero(np.concatenate(([True], np.diff(number) > 0)))
    ends = np.concatenate((starts[1:], [len(first)])) - 1
    counts = np.add.reduceat(count, starts).astype(np.int64)
    return Buckets(
        start_utc_ns=first[starts],
        stop_utc_ns=last[ends],
        count=counts,
        low=np.minimum.reduceat(found.low[keep], starts),
        high=np.maximum.reduceat(found.high[keep], starts),
        mean=np.add.reduceat(found.total[keep], starts) / counts,
        after_gap=np.logical_or.reduceat(gap, starts),
    )
