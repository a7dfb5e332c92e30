"""Entities of reports."""

from __future__ import annotations

from typing import Any

from pydantic import Field

from ground_service.http.model import Entity
from ground_service.http.times import UtcTime


class ReportErrors(Entity):
    """The 3-D error of one navigation solution in columns of equal length; `min_m` to `max_m` is a band."""

    name: str = Field(examples=["anchored"])
    kind: str = Field(description="estimate, smoothed or baseline", examples=["estimate"])
    time_s: list[float] = Field(description="UTC, POSIX seconds at the middle of each interval")
    min_m: list[float]
    max_m: list[float]
    mean_m: list[float]
    after_gap: list[bool] = Field(description="A gap precedes the interval: draw no line across it")


class ReportRequirement(Entity):
    """Row of the verdict table: the value must be at most, or at least, the limit."""

    key: str = Field(examples=["accuracy.median"])
    name: str = Field(examples=["median 3-D error"])
    unit: str = Field(examples=["m"])
    value: float | None = Field(description="null: unknown")
    limit: float | None = Field(description="null: not stated in the mission description")
    at_most: bool
    status: str = Field(description="met, not met, unknown or not judged", examples=["met"])
    note: str


class ChangedFigure(Entity):
    """Figure of a summary that a re-evaluation changed."""

    figure: str = Field(examples=["navigation.anchored.median_3d_m"])
    before: Any
    after: Any


class Report(Entity):
    """Report of a pass. The last three values are those of a re-evaluation, null for a report on request."""

    id: str
    pass_id: int
    created: UtcTime
    mission_revision: str | None = Field(description="Revision of the mission description of the evaluation")
    event: int | None = Field(description="Number of the event that caused the re-evaluation")
    previous: str | None = Field(description="The report before it")
    changes: list[ChangedFigure] | None


class ReportOverview(Entity):
    """Verdict and headline figures of a report, and its error series reduced to intervals."""

    report_id: str
    title: str
    verdict: str
    verdict_level: str = Field(examples=["good"])
    evidence_level: str
    created_utc: str
    headline: list[dict[str, Any]]
    requirements: list[ReportRequirement]
    not_available: dict[str, str]
    navigation: list[ReportErrors]
