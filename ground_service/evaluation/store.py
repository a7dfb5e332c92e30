"""SQL of reports."""

from collections.abc import Sequence

from sqlalchemy import Connection, func, select

from ground_service.evaluation.model import Report, StoredReport
from ground_service.http.model import PageOf, Paging
from ground_service.passes.store import get_pass
from ground_service.store import repository
from ground_service.store.states import change_if

_REPORTS = repository.REPORTS
_MISSIONS = repository.MISSIONS


def get_report(connection: Connection, report_id: str) -> StoredReport:
    return StoredReport.of(repository.get(connection, _REPORTS, report_id, "report"))


def has_report(connection: Connection, report_id: str) -> bool:
    """Return whether a report exists."""
    return repository.find(connection, _REPORTS, id=report_id) is not None


def newest_report(connection: Connection, pass_id: int, *, other_than: str = "") -> StoredReport | None:
    """Return the newest report of a pass, except one; None without any."""
    query = select(_REPORTS).where(_REPORTS.c.pass_id == pass_id, _REPORTS.c.id != other_than)
    found = connection.execute(query.order_by(_REPORTS.c.created_utc_ns.desc()).limit(1)).mappings().first()
    return None if found is None else StoredReport.of(found)


def newest_reports(connection: Connection, pass_ids: Sequence[int]) -> list[StoredReport]:
    """Return the newest report of each of these passes that has one, by pass."""
    number = (
        func.row_number()
        .over(partition_by=_REPORTS.c.pass_id, order_by=(_REPORTS.c.created_utc_ns.desc(), _REPORTS.c.id))
        .label("number")
    )
    ranked = select(_REPORTS, number).where(_REPORTS.c.pass_id.in_(pass_ids)).subquery()
    query = select(ranked).where(ranked.c.number == 1).order_by(ranked.c.pass_id)
    return [StoredReport.of(row) for row in connection.execute(query).mappings()]


def list_reports(connection: Connection, pass_id: int, asked: Paging) -> PageOf[Report]:
    """Return a page of the reports of a pass, newest first."""
    get_pass(connection, pass_id)
    query = (
        select(
            _REPORTS.c.id,
            _REPORTS.c.pass_id,
            _REPORTS.c.created_utc_ns,
            _MISSIONS.c.revision.label("mission_revision"),
            _REPORTS.c.event_number.label("event"),
            _REPORTS.c.previous_id.label("previous"),
            _REPORTS.c.changes,
        )
        .outerjoin(_MISSIONS, _MISSIONS.c.id == _REPORTS.c.mission_id)
        .where(_REPORTS.c.pass_id == pass_id)
    )
    rows, total = repository.page(connection, query, asked, _REPORTS.c.created_utc_ns.desc(), _REPORTS.c.id)
    return asked.page(map(Report.of, rows), total)


def set_pdf(connection: Connection, report_id: str, sha256: str) -> None:
    """Set the PDF of a report that has none."""
    change_if(connection, _REPORTS, report_id, {"pdf_sha256": None}, pdf_sha256=sha256)


def add_report(connection: Connection, report: StoredReport) -> bool:
    """Add a report; return False if one with this id exists."""
    return repository.add_new(connection, _REPORTS, **report.model_dump()) is not None
