"""SQL of time correlations."""

from __future__ import annotations

from sqlalchemy import Connection, select

from ground_service.store import repository
from ground_service.timekeeping.core import TimeCorrelation
from ground_service.timekeeping.model import Correlation


def load_correlations(connection: Connection, vehicle: int) -> tuple[TimeCorrelation, ...]:
    """The time correlations of a vehicle that are in force, by on-board time."""
    table = repository.CORRELATIONS
    rows = connection.execute(
        select(table)
        .where(table.c.vehicle_id == vehicle, table.c.superseded == 0)
        .order_by(table.c.start_ticks)
    ).mappings()
    return tuple(
        TimeCorrelation(
            row["id"],
            row["start_ticks"],
            row["stop_ticks"],
            row["reference_ticks"],
            row["reference_utc_ns"],
            row["drift_ppb"],
        )
        for row in rows
    )


def correlation_of(row: repository.Row) -> Correlation:
    """Return the entity of a row."""
    return Correlation.of(row, in_force=not row["superseded"], reference=row["reference_utc_ns"])
