"""SQL of the performance over many passes and of monthly reports."""

from __future__ import annotations

from sqlalchemy import Connection, func, select

from ground_service.errors import InvalidInput
from ground_service.evaluation.model import StoredReport
from ground_service.evaluation.performance.model import (
    MonthlyReport,
    MonthlyReportFilter,
    StoredMonthlyReport,
)
from ground_service.evaluation.store import newest_reports
from ground_service.http.model import PageOf
from ground_service.passes.model import PassRecord
from ground_service.store import repository

_PASSES, _VEHICLES = repository.PASSES, repository.VEHICLES
_MONTHLY = repository.MONTHLY_REPORTS
_BLOCK = 500
PASSES_LIMIT = 5000
"""Largest number of passes in a span."""


def reported_passes(
    connection: Connection,
    spacecraft_id: int,
    instance: str | None,
    start_utc_ns: int | None,
    stop_utc_ns: int | None,
) -> tuple[list[tuple[PassRecord, StoredReport]], int]:
    """Return the passes of a spacecraft that begin in a span and have a report, with the newest one, by time.

    The second value is the number of all passes in the span.

    Raises
    ------
    InvalidInput
        There are too many passes in the span.
    """
    query = (
        select(_PASSES)
        .join(_VEHICLES, _VEHICLES.c.id == _PASSES.c.vehicle_id)
        .where(_VEHICLES.c.ccsds_id == spacecraft_id)
        .order_by(_PASSES.c.start_utc_ns, _PASSES.c.id)
    )
    if instance is not None:
        query = query.where(_VEHICLES.c.instance == instance)
    if start_utc_ns is not None:
        query = query.where(_PASSES.c.start_utc_ns >= start_utc_ns)
    if stop_utc_ns is not None:
        query = query.where(_PASSES.c.start_utc_ns < stop_utc_ns)
    total = int(connection.execute(select(func.count()).select_from(query.subquery())).scalar_one())
    if total > PASSES_LIMIT:
        expected = f"at most {PASSES_LIMIT} passes in the span from start to stop"
        raise InvalidInput(f"performance of spacecraft {spacecraft_id}", "", expected, f"{total} passes")
    records = [PassRecord.of(row) for row in connection.execute(query).mappings()]
    reports: dict[int, StoredReport] = {}
    for first in range(0, len(records), _BLOCK):
        ids = [one.id for one in records[first : first + _BLOCK]]
        reports |= {one.pass_id: one for one in newest_reports(connection, ids)}
    return [(one, reports[one.id]) for one in records if one.id in reports], total


def spacecraft_with_passes(connection: Connection, instance: str) -> list[int]:
    """Return the spacecraft that have passes in an instance."""
    query = select(_VEHICLES.c.ccsds_id).join(_PASSES, _PASSES.c.vehicle_id == _VEHICLES.c.id).distinct()
    query = query.where(_VEHICLES.c.instance == instance)
    return [int(one) for one in connection.execute(query.order_by(_VEHICLES.c.ccsds_id)).scalars()]


def add_monthly_report(connection: Connection, report: StoredMonthlyReport) -> bool:
    """Add a monthly report; return False if one with this id exists."""
    values = report.model_dump(exclude={"created"})
    added = repository.add_new(connection, _MONTHLY, **values, created_utc_ns=report.created.utc_ns)
    return added is not None


def get_monthly_report(connection: Connection, report_id: str) -> StoredMonthlyReport:
    """Return a monthly report."""
    return StoredMonthlyReport.of(repository.get(connection, _MONTHLY, report_id, "monthly report"))


def list_monthly_reports(connection: Connection, asked: MonthlyReportFilter) -> PageOf[MonthlyReport]:
    """List the monthly reports, newest month first."""
    order = (_MONTHLY.c.month.desc(), _MONTHLY.c.created_utc_ns.desc(), _MONTHLY.c.id)
    rows, total = repository.page(connection, select(_MONTHLY), asked, *order)
    return asked.page((_shown(StoredMonthlyReport.of(row)) for row in rows), total)


def _shown(report: StoredMonthlyReport) -> MonthlyReport:
    return MonthlyReport.model_validate(report.model_dump(include=set(MonthlyReport.model_fields)))
