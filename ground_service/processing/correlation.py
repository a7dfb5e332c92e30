"""From on-board ticks to UTC with fitted time correlations, in whole nanoseconds.

A correlation is a straight line over a stretch of on-board time. Ticks outside every stretch use the nearest one;
without any, the clock is taken as ideal (correlation 0).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lunar.timescales import (
    tai_ns_from_utc_ns,
    ticks_from_utc_ns,
    utc_ns_from_tai_ns,
    utc_ns_from_ticks,
)

IntArray = NDArray[np.int64]

IDEAL_CLOCK = 0
"""Id of the correlation of a clock that shows TAI without error."""

# One tick is 10^9 / 2^16 ns = 1953125 / 128 ns.
_NS_NUMERATOR = 1_953_125
_NS_DENOMINATOR = 128


@dataclass(frozen=True, slots=True)
class TimeCorrelation:
    """UTC of `reference_ticks`, and how fast the clock's ticks are: real time = ticks (1 + drift_ppb 1e-9)."""

    id: int
    start_ticks: int
    stop_ticks: int
    reference_ticks: int
    reference_utc_ns: int
    drift_ppb: float

    def utc_ns(self, ticks: IntArray) -> IntArray:
        """UTC (n,) of on-board ticks (n,)."""
        since = np.asarray(ticks, dtype=np.int64) - self.reference_ticks
        nominal = since * _NS_NUMERATOR // _NS_DENOMINATOR
        drift = np.rint(nominal * (self.drift_ppb * 1e-9)).astype(np.int64)
        tai = int(tai_ns_from_utc_ns(self.reference_utc_ns)) + nominal + drift
        return np.asarray(utc_ns_from_tai_ns(tai), dtype=np.int64)


def utc_ns_of_ticks(ticks: IntArray, correlations: Sequence[TimeCorrelation]) -> tuple[IntArray, IntArray]:
    """UTC (n,) of on-board ticks (n,), and the id of the correlation used for each."""
    ticks = np.asarray(ticks, dtype=np.int64)
    if not correlations:
        return np.asarray(utc_ns_from_ticks(ticks), dtype=np.int64), np.full(len(ticks), IDEAL_CLOCK)
    start = np.array([c.start_ticks for c in correlations])
    stop = np.array([c.stop_ticks for c in correlations])
    outside = np.maximum(np.maximum(start[None, :] - ticks[:, None], ticks[:, None] - stop[None, :]), 0)
    chosen = np.argmin(outside, axis=1)
    utc = np.zeros(len(ticks), dtype=np.int64)
    for number in np.unique(chosen):
        here = chosen == number
        utc[here] = correlations[number].utc_ns(ticks[here])
    return utc, np.array([c.id for c in correlations], dtype=np.int64)[chosen]


def ticks_of_utc_ns(utc_ns: int, correlations: Sequence[TimeCorrelation]) -> int:
    """On-board ticks that the clock shows at `utc_ns`, to about a tick."""
    ticks = int(ticks_from_utc_ns(utc_ns))
    for _ in range(3):
        shown, _ = utc_ns_of_ticks(np.array([ticks], dtype=np.int64), correlations)
        ticks += int((utc_ns - int(shown[0])) * _NS_DENOMINATOR // _NS_NUMERATOR)
    return ticks
