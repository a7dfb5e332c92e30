"""Any report value as HTML, PDF or JSON."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from reports.errors import UnknownReportKind
from reports.json_form import to_json
from reports.paper_values import PaperReport
from reports.values import DetectorReport, MonthlyReportValue, PassReport, RegressionReport

if TYPE_CHECKING:
    from reports.document import Document
    from reports.drawings import Drawings

__all__ = ["render_html", "render_pages", "to_json"]


def render_html(report: Any, drawings: Drawings | None = None) -> str:
    """Return one self-contained HTML page; the same value gives the same text.

    Raises
    ------
    UnknownReportKind
        when the value is none of those of `reports.values`
    InconsistentReport
        when parts of the value do not fit together
    """
    from reports.html_page import html_page

    return html_page(_document(report), drawings)


def render_pages(report: Any, drawings: Drawings | None = None) -> tuple[str, bytes]:
    """Return a report as HTML page, and in the form that `pdf_pages.pdf_of` typesets with the figures of that page.

    Raises
    ------
    UnknownReportKind
        when the value is none of those of `reports.values`
    InconsistentReport
        when parts of the value do not fit together
    """
    from reports.document import Picture
    from reports.html_page import html_page
    from reports.pdf_pages import print_form

    document = _document(report)
    if drawings is not None:
        drawings.prepare([one for one in document.blocks if isinstance(one, Picture)])
    return html_page(document, drawings), print_form(document)


def _document(report: Any) -> Document:
    match report:
        case PassReport():
            from reports.pass_report import pass_document

            return pass_document(report)
        case RegressionReport():
            from reports.regression_report import regression_document

            return regression_document(report)
        case DetectorReport():
            from reports.detector_report import detector_document

            return detector_document(report)
        case MonthlyReportValue():
            from reports.monthly_report import monthly_document

            return monthly_document(report)
        case PaperReport():
            from reports.paper_report import paper_document

            return paper_document(report)
        case _:
            raise UnknownReportKind(type(report).__name__)
