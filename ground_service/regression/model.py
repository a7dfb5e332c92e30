"""Entities of payload builds, kept pass archives and regressions."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import ConfigDict, Field, model_validator

from ground_service.http.model import Entity, RequestModel, UtcTime
from reports.text import loss_text

UNUSABLE_STATES = ("unusable", "baseline failed")
"""States of a pass that no candidate can be blamed for."""

OK = "ok"
"""Outcome of a successful replay."""

COMPLETE, TO_RENDER, TELEMETRY_ONLY = "complete", "to render", "telemetry only"
"""States of a kept archive: all frames are stored; missing frames are rendered at the first use; no frames."""


LEAST_OVERLAP = 0.5
"""Share of the time of the shorter of two replays during which both ran, from which processor times are compared."""

REASONS_LIMIT = 5
"""Reasons in a list; the verdict has all."""


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
    frames_stored: int = Field(description="Frames with a stored image")
    state: str = Field(
        description="complete: all frames are stored; to render: the missing frames are rendered at the first use; "
        "telemetry only: the frames are not available",
        examples=["complete"],
    )
    reason: str = Field(description="Reason of missing frames; empty: all are available")
    octets: int
    pinned: bool
    kept_since: UtcTime
    pass_id: int | None = Field(default=None, description="The pass of the archive")


class ArchiveRecord(KeptArchive):
    """A kept archive with the hash of its manifest."""

    manifest_sha256: str


class KeptReplay(Entity):
    """A replay of a build over an archive: its outcome, and the hashes of its files."""

    outcome: str
    detail: str
    downlink_sha256: str | None = None
    performance_sha256: str | None = None
    wall_s: float = 0.0
    cpu_s: float = 0.0
    peak_rss_mib: float = 0.0
    isolation: str = ""
    printed: str | None = Field(default=None, description="Last lines printed by a program that failed")
    machine: str
    created_utc_ns: int = 0

    def overlaps(self, other: KeptReplay) -> bool:
        """Return whether both ran on one machine at the same time, for most of the time of the shorter one."""
        if self.machine != other.machine:
            return False
        (first, short), (last, long) = sorted((one.created_utc_ns / 1e9, one.wall_s) for one in (self, other))
        return first - max(first - short, last - long) > LEAST_OVERLAP * min(short, long)


class ArchiveChange(RequestModel):
    """Change of a kept archive."""

    pinned: bool = Field(description="Exempt the archive from removal")


class Pruned(Entity):
    """Archives that were removed."""

    removed: list[str] = Field(description="Identities")


class Comparison(RequestModel):
    """Builds to compare, and the archives to replay."""

    candidate: str = Field(pattern=r"^(current|[0-9a-f]{8,64})$", description="Identity of a build, or current")
    baseline: str = Field(default="current", pattern=r"^(current|[0-9a-f]{8,64})$")
    archives: list[Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]] = Field(
        default_factory=list,
        max_length=1000,
        description="Identities of kept archives; without archives and passes: all kept archives",
    )
    passes: list[Annotated[int, Field(ge=1, le=2**31 - 1)]] = Field(
        default_factory=list, max_length=1000, description="Passes whose archives are replayed"
    )
    workers: int | None = Field(
        default=None, ge=1, le=256, description="Simultaneous replays in one job; default: a job for each replay"
    )


class RegressionRequest(Comparison):
    """Builds to compare, the archives to replay, and the policy of the gates."""

    policy: str | None = Field(
        default=None, max_length=200_000, description="Policy of the gates (TOML); default: the shipped one"
    )
    policy_name: str = Field(default="policy", max_length=300, description="Name of the policy in messages")
    repeat_baseline: bool = Field(
        default=False,
        description="Replay the baseline again with the candidate, so that their processor times are compared",
    )
    placebo: int | None = Field(
        default=None,
        ge=1,
        le=2**31 - 1,
        description="Compare the baseline with itself, with noise of this seed in the images",
    )


class Noise(Entity):
    """Change of a metric between two replays of equal builds."""

    metric: str
    condition: str = Field(default="", description="Terrain and altitude of the pass")
    loss: float | None = Field(default=None, description="On the scale of the test: a difference or a log ratio")
    square: float | None = Field(default=None, description="Square of the loss over its standard error")
    p_value: float
    level: float


class Calibration(Entity):
    """Noise of a metric in placebos, and whether its gate rejects them as rarely as its level allows."""

    metric: str
    condition: str = Field(description="Terrain and altitude; empty: all placebos")
    placebos: int
    rejected: int
    level: float = Field(description="Share that may be rejected")
    spread: float | None = Field(description="Root mean square of the losses")
    mean_square: float | None = Field(description="Of the losses over their standard errors; 1 if these are right")
    calibrated: bool

    @property
    def text(self) -> str:
        """Return the rejections in one line."""
        state = "calibrated" if self.calibrated else "uncalibrated"
        place = f" ({self.condition})" if self.condition else ""
        return f"{state}: {self.metric}{place}: {self.rejected} of {self.placebos} placebos rejected at {self.level:g}"


class JudgedBuild(Entity):
    """A build in a verdict."""

    name: str
    version: str
    digest: str
    flight_code: str | None
    provenance: dict[str, str]

    @property
    def title(self) -> str:
        """Name, version and the beginning of the identity."""
        return " ".join(filter(None, (self.name, self.version, f"({self.digest[:12]})")))


class JudgedPolicy(Entity):
    """The policy of a verdict."""

    version: str
    sha256: str
    fail_level: float | None = Field(default=None, description="null for verdicts of earlier policies")
    inconclusive: str = "failure"
    confidence: float | None = Field(default=None, description="Of verdicts of earlier policies")
    power: float | None = Field(default=None, description="Of verdicts of earlier policies")


class JudgedGate(Entity):
    """Decision of one gate; numbers are null if unknown or infinite."""

    model_config = ConfigDict(validate_by_name=True, serialize_by_alias=True)

    name: str = Field(examples=["detector.recall"])
    pass_id: str | None = Field(alias="pass", description="null: the whole suite")
    outcome: str = Field(
        description="pass, fail, inconclusive, not judged, or informs: a metric that never decides", examples=["pass"]
    )
    passed: bool
    baseline: float | None
    candidate: float | None
    margin: float | None
    limit: float | None
    unit: str
    change_bounds: tuple[float | None, float | None] = Field(description="One-sided 95 % bounds of the loss")
    p_value: float | None
    level: float | None
    resolution: float | None = Field(description="Loss that the frames find with a power of 0.8")
    frames: int
    frames_needed: int | None
    evidence: str = Field(default="", description="Number and name of the units of the evidence")
    reason: str | None
    relative: bool = Field(
        default=False, description="Whether margin, bounds and resolution are shares of the baseline"
    )

    @model_validator(mode="before")
    @classmethod
    def _without_waiver(cls, given: Any) -> Any:
        """Read a gate of an earlier verdict, which could be waived: it did not count."""
        if not isinstance(given, dict) or "waived" not in given:
            return given
        kept = {key: value for key, value in given.items() if key != "waived"}
        waiver = given["waived"]
        return {**kept, "outcome": "not judged", "reason": f"waived: {waiver}"} if waiver else kept

    @property
    def text(self) -> str:
        """The gate as one line: the change, its bounds and its evidence, or the reason of its outcome."""
        place = "" if self.pass_id is None else f" on {self.pass_id}"
        if self.baseline is None or self.candidate is None or self.outcome == "not judged":
            return f"{self.name}{place}: {self.reason or self.outcome}"
        unit = f" {self.unit}" if self.unit else ""
        parts = [f"{self.name}{place}: {self.baseline:.4g} to {self.candidate:.4g}{unit}"]
        low, high = self.change_bounds
        if self.outcome in ("fail", "inconclusive") and low is not None and high is not None:
            loss = [loss_text(one, self.relative) for one in (low, high, self.margin or 0.0)]
            of_what = " of the baseline" if self.relative else ""
            parts.append(f"loss {loss[0]} to {loss[1]}{of_what}, margin {loss[2]}, {self.evidence}")
        if self.reason:
            parts.append(self.reason)
        if self.outcome == "inconclusive" and self.frames_needed is not None:
            parts.append(f"about {self.frames_needed:,} frames decide it, {self.frames:,} compared")
        return ", ".join(parts)


class JudgedReplay(Entity):
    """Replay of a pass by one build; its costs are null if its telemetry was not read."""

    outcome: str
    detail: str
    cpu_s: float
    wall_s: float
    peak_rss_mib: float
    printed: str | None = Field(default=None, description="Last lines printed by a program that failed")
    outcome_shares: dict[str, dict[str, float]] | None = None
    stages_ms: dict[str, float] | None = None
    memory_mib: float | None = None
    undecodable: int | None = None


class JudgedPass(Entity):
    """One pass of a verdict."""

    name: str
    archive: str
    state: str = Field(
        description="judged, telemetry judged (without frames), not judged, candidate failed, baseline failed or "
        "unusable"
    )
    detail: str
    baseline: JudgedReplay | None = None
    candidate: JudgedReplay | None = None
    frames: int | None = None


class Verdict(Entity):
    """Verdict on a candidate build, as `linna regress run --json` prints it."""

    verdict: str = Field(description="pass, fail or inconclusive", examples=["pass"])
    baseline: JudgedBuild
    candidate: JudgedBuild
    policy: JudgedPolicy
    headline: str = Field(default="", description="The change, its size and place, and whether it matters")
    frames: int = Field(description="Number of frames processed by both builds")
    frames_needed: int | None = Field(
        description="Number of frames that decide the inconclusive gates; null if unknown"
    )
    gates: list[JudgedGate]
    passes: list[JudgedPass]
    remarks: list[str]
    noise: list[Noise] = Field(default=[], description="Of a placebo: what equal builds differ by")

    @property
    def exit_status(self) -> int:
        """Return 0 for pass, 1 for fail, 2 if an archive or the baseline cannot be used, 3 for inconclusive."""
        if self.verdict == "inconclusive" and any(one.state in UNUSABLE_STATES for one in self.passes):
            return 2
        return {"pass": 0, "fail": 1}.get(self.verdict, 3)

    def document(self) -> dict[str, Any]:
        """Return the JSON document."""
        return self.model_dump(mode="json", exclude_unset=True)


class Regression(Entity):
    """The verdict on a candidate build."""

    id: str
    verdict: str = Field(description="pass, fail or inconclusive", examples=["pass"])
    created: UtcTime
    result: Verdict

    def reasons(self) -> list[str]:
        """Return why the verdict is not pass: failed and open gates, passes without a comparison."""
        if self.verdict == "pass":
            return []
        gates = [one for one in self.result.gates if one.outcome in ("fail", "inconclusive")]
        gates.sort(key=lambda one: one.outcome != "fail")
        return [
            *(one.text for one in gates),
            *(f"{one.name}: {one.detail or one.state}" for one in self.result.passes if one.state != "judged"),
        ][:REASONS_LIMIT]

    def summary(self) -> RegressionSummary:
        """Return the regression as lists show it."""
        deciding = [gate for gate in self.result.gates if gate.outcome != "informs"]
        counted = [gate.outcome for gate in deciding]
        return RegressionSummary(
            id=self.id,
            verdict=self.verdict,
            candidate=self.result.candidate.digest,
            candidate_title=self.result.candidate.title,
            baseline=self.result.baseline.digest,
            baseline_title=self.result.baseline.title,
            headline=self.result.headline,
            reasons=self.reasons(),
            gates=len(deciding),
            gates_failed=counted.count("fail"),
            gates_inconclusive=counted.count("inconclusive"),
            frames=self.result.frames,
            frames_needed=self.result.frames_needed,
            created=self.created,
        )


class RegressionSummary(Entity):
    """The verdict on a candidate build in a list."""

    id: str
    verdict: str = Field(description="pass, fail or inconclusive", examples=["pass"])
    candidate: str = Field(description="Identity of the candidate build")
    candidate_title: str = Field(description="Name, version and beginning of the identity")
    baseline: str = Field(description="Identity of the baseline build")
    baseline_title: str
    headline: str = Field(description="First line of the verdict")
    reasons: list[str] = Field(description="Reasons of a verdict other than pass, the most important first")
    gates: int = Field(description="Number of gates")
    gates_failed: int
    gates_inconclusive: int
    frames: int = Field(description="Number of frames processed by both builds")
    frames_needed: int | None = Field(
        description="Number of frames needed to decide every gate over the suite; null if unknown"
    )
    created: UtcTime
