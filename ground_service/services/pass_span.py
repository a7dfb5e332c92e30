"""On-board time interval of a pass."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ground_service.processing.correlation import TimeCorrelation, utc_ns_of_ticks
from lunar.arrays import IntArray


@dataclass(frozen=True, slots=True)
class PassSpan:
    """On-board time interval of a pass, its correlation with UTC, and its dictionary version."""

    vehicle: int
    start_ticks: int
    stop_ticks: int
    correlations: tuple[TimeCorrelation, ...]
    dictionary_version: int

    def utc_ns(self, ticks: Sequence[int]) -> IntArray:
        """Return the correlated UTC (n,) of on-board ticks."""
        return utc_ns_of_ticks(np.array(ticks, dtype=np.int64), self.correlations)[0]
