"""Trends of housekeeping parameters: how they move, and where they left their limits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ground_service.passes.core import Buckets
from tmtc.schema import Field

DAY_NS = 86_400_000_000_000
LIMIT_STATES = ("within", "warning", "alarm")


@dataclass(frozen=True, slots=True)
class Trend:
    """One parameter over a span: its statistics, its slope by least squares, and the worst limit state met.

    `slope_per_day` is NaN where less than two stretches hold samples.
    """

    parameter: str
    unit: str
    samples: int
    low: float
    high: float
    mean: float
    slope_per_day: float
    limit_state: str


def trend_of(field: Field, buckets: Buckets) -> Trend | None:
    """The trend of a parameter from its stretches; None where there are no samples."""
    total = int(buckets.count.sum())
    if total == 0:
        return None
    low, high = float(buckets.low.min()), float(buckets.high.max())
    worst = int(field.limit_states(np.array([low, high])).max())
    return Trend(
        field.name,
        field.unit,
        total,
        low,
        high,
        float(np.sum(buckets.mean * buckets.count) / total),
        _slope_per_day(buckets),
        LIMIT_STATES[worst],
    )


def _slope_per_day(buckets: Buckets) -> float:
    """Least squares through the means at the middles of the stretches, weighted by their samples."""
    middle = (buckets.start_utc_ns // 2 + buckets.stop_utc_ns // 2).astype(np.float64)
    days = (middle - middle[0]) / DAY_NS
    weight = buckets.count.astype(np.float64)
    days = days - np.average(days, weights=weight)
    square = float(np.sum(weight * days**2))
    if len(days) < 2 or square <= 0.0:
        return float("nan")
    return float(np.sum(weight * days * (buckets.mean - np.average(buckets.mean, weights=weight))) / square)
