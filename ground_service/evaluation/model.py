"""Entities of reports."""

from collections.abc import Mapping
from typing import Any

from pydantic import ConfigDict, Field

from ground_service.http.model import Entity, UtcTime
from reports.values import Requirement


class ReportErrors(Entity):
    """The 3-D error of one navigation solution in columns of equal length; `min_m` to `max_m` is a band."""

    name: str = Field(examples=["anchored"])
    kind: str = Field(description="estimate, smoothed or baseline", examples=["estimate"])
    time_s: list[float] = Field(description="UTC, POSIX seconds at the middle of each interval")
    min_m: list[float]
    max_m: list[float]
    mean_m: list[float]
    after_gap: list[bool] = Field(description="A gap precedes the interval: draw no line across it")


class ChangedFigure(Entity):
    """Figure of a summary that a re-evaluation changed."""

    figure: str = Field(examples=["navigation.anchored.median_3d_m"])
    before: Any
    after: Any


def changed_figures(before: Any, after: Any, name: str = "") -> list[ChangedFigure]:
    """Return the figures that differ between two nested tables: name, value before and value after."""
    if isinstance(before, Mapping) and isinstance(after, Mapping):
        return [
            change
            for key in sorted({*before, *after})
            for change in changed_figures(before.get(key), after.get(key), f"{name}.{key}" if name else key)
        ]
    return [] if before == after else [ChangedFigure(figure=name, before=before, after=after)]


class Report(Entity):
    """Report of a pass; `event`, `previous` and `changes` are null unless a re-evaluation created the report."""

    id: str
    pass_id: int
    created: UtcTime
    mission_revision: str | None = Field(description="Revision of the mission description of the evaluation")
    event: int | None = Field(description="Number of the event that caused the re-evaluation")
    previous: str | None = Field(description="Id of the preceding report")
    changes: list[ChangedFigure] | None


class ReportSummary(Entity):
    """Verdict and main figures of a report; null: not known."""

    id: str
    pass_id: int
    created: UtcTime
    verdict: str
    verdict_level: str = Field(description="met, not met or unknown", examples=["met"])
    evidence_level: str
    estimator: str | None = Field(description="Estimator of the error", examples=["anchored"])
    median_error_m: float | None
    recall: float | None
    frames: int | None


class StoredReport(Entity):
    """A stored report: see `store.models.REPORTS`; times are UTC, ns."""

    id: str
    pass_id: int
    html_sha256: str
    json_sha256: str
    pdf_sha256: str | None
    summary: dict[str, Any]
    mission_id: int | None
    event_number: int | None
    previous_id: str | None
    changes: list[ChangedFigure] | None
    created_utc_ns: int
    print_sha256: str | None = None


class ClassFigures(Entity):
    """Detector figures of one size class; null: not known."""

    model_config = ConfigDict(serialize_by_alias=True)

    size_class: int = Field(alias="class", description="0: 5-10 km, 1: 10-15 km, 2: 15-30 km, 3: 3-5 km")
    expected: int
    precision: float | None
    recall: float | None
    loc_px: float | None


class DetectorFigures(Entity):
    """Detector figures of a pass; null: not known."""

    precision: float | None
    recall: float | None
    loc_px: float | None = Field(description="Localisation error")
    per_class: list[ClassFigures]


class NavigationFigures(Entity):
    """3-D position error of a navigation solution; null: not known."""

    median_3d_m: float | None
    p68_3d_m: float | None
    p95_3d_m: float | None
    p99_3d_m: float | None
    max_3d_m: float | None
    drift_percent: float | None
    end_of_pass_m: float | None


class ErrorBudget(Entity):
    """Part of the reference in the observed error of a navigation solution; null: not known."""

    observed_rms_m: float | None
    reference_rms_m: float | None
    estimate_rms_m: float | None


class RequirementFigures(Entity):
    """A requirement of the mission description and whether the pass meets it."""

    key: str = Field(examples=["accuracy.median"])
    name: str = Field(examples=["median 3-D error"])
    value: float | None = Field(description="null: unknown")
    limit: float | None = Field(description="null: not stated in the mission description")
    relation: str = Field(examples=["<="])
    unit: str = Field(examples=["m"])
    margin: float | None
    status: str = Field(description="met, not met, unknown or not judged", examples=["met"])
    note: str
    question: str = Field(default="operations", description="operations or experiment")


class PassConditions(Entity):
    """Conditions of a pass for trends; null and empty texts: not known."""

    altitude_km: float | None = Field(description="Median over the pass")
    sun_elevation_deg: float | None = Field(description="Median at the sub-satellite point")
    build: str = Field(description="Hashes of model and parameters in the last housekeeping packet")
    estimator: str | None = Field(description="Estimator that the mission description judges")
    map_offset_m: float | None = Field(
        default=None, description="Offset of the crater list that the payload uses, 1 sigma east and north"
    )


class PassFigures(Entity):
    """Figures of an evaluated pass; null: not known. Figures that only older versions computed are left out."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    pass_id: int
    frames: int | None
    packets: int
    packets_lost: int
    packets_expected: int
    detector: DetectorFigures
    navigation: dict[str, NavigationFigures] = Field(description="By on-board estimator")
    smoothed: dict[str, NavigationFigures] = Field(description="By smoothed estimator")
    baselines: dict[str, NavigationFigures]
    verdict: str
    verdict_level: str = Field(description="met, not met or unknown", examples=["met"])
    experiment: str = Field(default="", description="The same for navigation without help; empty: no experiment")
    experiment_level: str = ""
    requirements: list[RequirementFigures]
    error_budget: dict[str, ErrorBudget]
    evidence_level: str
    data: list[str] = Field(description="Data sources")
    conditions: PassConditions | None = Field(default=None, description="null: report of an older version")
    not_available: dict[str, str] = Field(
        default_factory=dict,
        description="Reasons of missing content",
        examples=[{"recall": "the crater catalogue has no complete crater of 5 to 30 km in view"}],
    )


class ReportOverview(Entity):
    """Verdict and headline figures of a report, and its error series reduced to intervals."""

    report_id: str
    title: str
    verdict: str
    verdict_level: str = Field(description="met, not met or unknown", examples=["met"])
    evidence_level: str
    created_utc: str
    headline: list[dict[str, Any]]
    requirements: list[Requirement]
    not_available: dict[str, str]
    navigation: list[ReportErrors]
