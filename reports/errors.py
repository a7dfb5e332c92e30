"""Errors of the reports.

ReportError
├── InconsistentReport   a value whose arrays do not agree with one another
└── UnknownReportKind    a value that no renderer is written for
"""


class ReportError(Exception):
    """Base of all errors raised by the reports."""


class InconsistentReport(ReportError):
    """A value whose parts do not fit together, such as arrays of different lengths."""

    def __init__(self, where: str, expected: str, found: str) -> None:
        super().__init__(f"{where}: expected {expected}, found {found}")
        self.where = where
        self.expected = expected
        self.found = found


class UnknownReportKind(ReportError):
    """A value that no renderer is written for."""

    def __init__(self, found: str) -> None:
        super().__init__(f"report: expected one of the values of reports.values, found {found}")
        self.found = found
