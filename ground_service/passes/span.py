"""On-board time interval of a pass."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from sqlalchemy import Connection

from ground_service.ingest.redecode import readable_version
from ground_service.passes.model import PassRecord
from ground_service.timekeeping.core import TimeCorrelation, ticks_of_utc_ns, utc_ns_of_ticks
from ground_service.timekeeping.store import load_correlations
from lunar.arrays import IntArray


@dataclass(frozen=True, slots=True)
class PassSpan:
    """On-board time interval of a pass, its correlation with UTC, and its dictionary version."""

    vehicle: int
    start_ticks: int
    stop_ticks: int
    correlations: tuple[TimeCorrelation, ...]
    dictionary_version: int

    def utc_ns(self, ticks: Sequence[int] | IntArray) -> IntArray:
        """Return the correlated UTC (n,) of on-board ticks."""
        return utc_ns_of_ticks(np.array(ticks, dtype=np.int64), self.correlations)[0]


PASS_MARGIN_NS = 60_000_000_000
"""Samples this far outside a window still belong to it: housekeeping before the first and after the last image."""


LAST_TICKS = (1 << 48) - 1


def vehicle_span(
    connection: Connection, vehicle: int, start_utc_ns: int | None, stop_utc_ns: int | None
) -> PassSpan:
    """Return an interval of a vehicle's on-board time; None: without an end."""
    correlations = load_correlations(connection, vehicle)
    return PassSpan(
        vehicle,
        0 if start_utc_ns is None else ticks_of_utc_ns(start_utc_ns, correlations),
        LAST_TICKS if stop_utc_ns is None else ticks_of_utc_ns(stop_utc_ns, correlations),
        correlations,
        readable_version(connection, vehicle),
    )


def pass_span(connection: Connection, record: PassRecord) -> PassSpan:
    """The stretch of on-board time of a pass, a margin included."""
    correlations = load_correlations(connection, record.vehicle_id)
    return PassSpan(
        vehicle=record.vehicle_id,
        start_ticks=ticks_of_utc_ns(record.start_utc_ns - PASS_MARGIN_NS, correlations),
        stop_ticks=ticks_of_utc_ns(record.stop_utc_ns + PASS_MARGIN_NS, correlations),
        correlations=correlations,
        dictionary_version=readable_version(connection, record.vehicle_id),
    )
