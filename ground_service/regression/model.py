"""Entities of payload builds, kept pass archives and regressions."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from ground_service.http.model import Entity, Given
from ground_service.http.times import UtcTime


class Build(Entity):
    """A registered payload build."""

    digest: str
    name: str = Field(examples=["detector 7"])
    version: str = Field(examples=["1.2.0"])
    description: str
    kind: str = Field(description="command or flight", examples=["flight"])
    files: dict[str, str]
    flight_code: str | None
    provenance: dict[str, Any]
    registered_by: str
    registered: UtcTime


class KeptArchive(Entity):
    """A pass archive that is kept for replays."""

    digest: str
    name: str
    frames: int
    octets: int
    pinned: bool
    kept_since: UtcTime


class ArchiveChange(Given):
    """Change of a kept archive."""

    pinned: bool = Field(description="Exempt the archive from removal")


class Pruned(Entity):
    """Archives that were removed."""

    removed: list[str] = Field(description="Identities")


class UnusableArchive(Given):
    """Archive that could not be kept: it makes the verdict inconclusive."""

    name: str = Field(max_length=300)
    detail: str = Field(max_length=1000, description="Why it cannot be used")


class Comparison(Given):
    """Builds to compare, and the archives to replay."""

    candidate: str = Field(
        pattern=r"^(current|[0-9a-f]{8,64})$", description="Identity of a build, or current"
    )
    baseline: str = Field(default="current", pattern=r"^(current|[0-9a-f]{8,64})$")
    archives: list[Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]] = Field(
        default_factory=list, max_length=1000, description="Identities of kept archives; all when empty"
    )
    unusable: list[UnusableArchive] = Field(
        default_factory=list, max_length=1000, description="Archives that could not be kept"
    )
    workers: int | None = Field(
        default=None,
        ge=1,
        le=256,
        description="Simultaneous replays in one job; default: a job for each replay",
    )


class RegressionRequest(Comparison):
    """Builds to compare, the archives to replay, and the policy of the gates."""

    policy: str | None = Field(
        default=None, max_length=200_000, description="Policy of the gates (TOML); default: the shipped one"
    )
    policy_name: str = Field(default="policy", max_length=300, description="Name of the policy in messages")


class AnalysisRequest(Comparison):
    """Builds to analyse without a verdict."""

    analysis: Literal["baseline", "differences", "bisection"] = Field(
        description="baseline: metrics of one build; differences: passes ordered by the difference of the builds; "
        "bisection: the changes from baseline to candidate that changed a metric"
    )
    figure: str = Field(default="", max_length=100, description="Metric of a bisection")


class Regression(Entity):
    """The verdict on a candidate build."""

    id: str
    verdict: str = Field(description="pass, fail or inconclusive", examples=["pass"])
    created: UtcTime
    result: dict[str, Any] = Field(description="As printed by `linna regress run --json`")


class RegressionSummary(Entity):
    """The verdict on a candidate build in a list."""

    id: str
    verdict: str = Field(description="pass, fail or inconclusive", examples=["pass"])
    candidate: str = Field(description="Identity of the candidate build")
    baseline: str = Field(description="Identity of the baseline build")
    gates: int = Field(description="Number of gates")
    gates_failed: int
    gates_inconclusive: int
    frames: int = Field(description="Number of frames processed by both builds")
    frames_needed: int | None = Field(
        description="Number of frames needed to decide every gate over the suite; null if unknown"
    )
    created: UtcTime
