"""Entities of the performance over many passes."""

from pydantic import Field

from ground_service.http.model import Entity, Paging, SpacecraftNumber, UtcTime


class PassPerformance(Entity):
    """Figures and conditions of one pass from its newest report; null: not known."""

    pass_id: int
    name: str
    start: UtcTime
    report_id: str
    estimator: str | None = Field(description="Estimator of drift and error", examples=["anchored"])
    recall: float | None
    drift_percent: float | None = Field(description="Percent of the ground path")
    median_error_m: float | None
    altitude_km: float | None = Field(description="Median over the pass")
    sun_elevation_deg: float | None = Field(description="Median at the sub-satellite point")
    map_offset_m: float | None = Field(
        default=None, description="Offset of the crater list as learned on board, 1 sigma east and north"
    )
    terrain: str = Field(description="Evidence level of the world; empty: not stated")
    build: str = Field(description="Hashes of model and parameters in housekeeping; empty: not known")
    frames: int | None
    packets: int
    packets_lost: int
    verdict_level: str = Field(description="met, not met or unknown", examples=["met"])


class GroupFigures(Entity):
    """Mean of a metric over the passes of a group, with its 95 % confidence interval; null: unknown."""

    factor: str = Field(description="altitude, sun elevation, terrain or build", examples=["altitude"])
    group: str = Field(examples=["20 to 30 km"])
    metric: str = Field(description="recall, drift_percent or median_error_m", examples=["recall"])
    passes: int = Field(description="Number of passes with a value")
    mean: float | None
    low: float | None
    high: float | None


class ChangePoint(Entity):
    """Significant change of the level of a metric."""

    metric: str = Field(examples=["recall"])
    pass_id: int = Field(description="First pass after the change")
    time: UtcTime = Field(description="Start of this pass")
    before: float = Field(description="Median before the change, back to the preceding change")
    after: float = Field(description="Median after the change, up to the next change")
    passes_before: int
    passes_after: int
    p_value: float = Field(description="Probability of such a change by chance")


class RollingRequirement(Entity):
    """A requirement over the passes of the last days."""

    key: str = Field(examples=["accuracy.median"])
    name: str = Field(examples=["median 3-D error"])
    unit: str = Field(examples=["m"])
    limit: float | None = Field(description="Limit of the newest report; null: not stated")
    passes: int = Field(description="Passes in the window")
    met: int
    not_met: int
    unknown: int = Field(description="Passes on which the requirement is unknown or not judged")
    share_met: float | None = Field(description="Share of the judged passes; null: none was judged")
    low: float | None = Field(description="Lower limit of the 95 % confidence interval of the share")
    high: float | None = Field(description="Upper limit of the 95 % confidence interval of the share")
    lowest_share: float | None = Field(description="Smallest share of all windows that end at a pass")
    remark: str = Field(
        default="",
        description="Mean over the passes of a NEES or NIS outside either bound; empty: inside, or no such requirement",
        examples=["mean 0.31 of 12 passes: sigmas 1.8 times too large"],
    )


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
    groups: list[GroupFigures]
    changes: list[ChangePoint]
    requirements: list[RollingRequirement]


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
