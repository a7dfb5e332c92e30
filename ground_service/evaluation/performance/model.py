"""Entities of the performance over many passes."""

from dataclasses import dataclass

from pydantic import Field

from ground_service.http.model import Entity, Paging, SpacecraftNumber, UtcTime
from reports.values import LevelChange, MeanByGroup, MonthPass, RequirementOverTime


@dataclass(frozen=True, slots=True, kw_only=True)
class PassPerformance(MonthPass):
    """Figures and conditions of one pass from its newest report; null and empty texts: not known."""

    start: UtcTime
    report_id: str
    frames: int | None


@dataclass(frozen=True, slots=True)
class ChangePoint(LevelChange):
    """Significant change of the level of a metric, at the start of the first pass after it."""

    time: UtcTime


class Performance(Entity):
    """Performance of a spacecraft over many passes."""

    spacecraft_id: int
    instance: str | None = Field(description="null: all imported passes")
    window_days: float
    false_alarm_rate: float = Field(
        description="Probability that a constant level gives any change point", examples=[0.01]
    )
    passes_in_span: int = Field(description="Number of passes in the span, with or without a report")
    passes: list[PassPerformance] = Field(description="Passes with a report, in order of time")
    groups: list[MeanByGroup]
    changes: list[ChangePoint]
    requirements: list[RequirementOverTime]


class MonthlyReport(Entity):
    """A monthly report; the same content is stored once, and late data give a new one."""

    id: str
    spacecraft_id: int
    instance: str = Field(examples=["flight"])
    month: str = Field(examples=["2029-08"])
    passes: int
    verdict: str
    created: UtcTime


class StoredMonthlyReport(MonthlyReport):
    """A monthly report with the hashes of its documents."""

    html_sha256: str
    pdf_sha256: str
    json_sha256: str


class MonthlyReportFilter(Paging):
    """Monthly reports to list."""

    spacecraft_id: SpacecraftNumber | None = None
