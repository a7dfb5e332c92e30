"""What goes over the wire: pydantic models with examples. Times are RFC 3339 UTC with nanoseconds kept."""

from __future__ import annotations

from typing import Any, Generic, TypeVar

from pydantic import BaseModel, Field

from ground_service.http.model import Given, Schema
from ground_service.text import LINE_PATTERN_JSON

Item = TypeVar("Item")


class Problem(BaseModel):
    """An RFC 9457 problem document."""

    type: str = Field(examples=["about:blank"])
    title: str = Field(examples=["not found"])
    status: int = Field(examples=[404])
    detail: str = Field(examples=["pass 7: not found"])
    instance: str | None = Field(default=None, examples=["/api/v1/passes/7"])
    request_id: str | None = Field(default=None, description="Id of the request in the log")
    errors: list[dict[str, str]] | None = Field(default=None, description="What is wrong, one by one")
    state: str | None = Field(default=None, description="For a conflict: the state found instead")


class PageOf(Schema, Generic[Item]):
    """A page of a list."""

    items: list[Item]
    total: int = Field(description="Number of items in all pages", examples=[1])
    limit: int = Field(examples=[100])
    offset: int = Field(examples=[0])


class Ephemeris(Schema):
    """A reference ephemeris."""

    id: int = Field(examples=[1])
    name: str = Field(examples=["reference of pass 12"])
    object_name: str = Field(examples=["SELENITA"])
    frame: str = Field(examples=["ICRF"])
    start: str = Field(examples=["2029-08-07T00:00:00.000000000Z"])
    stop: str = Field(examples=["2029-08-07T01:00:00.000000000Z"])
    states: int = Field(examples=[241])
    precedence: int = Field(examples=[0])
    sha256: str


class IngestAccepted(Schema):
    """An upload that was taken and will be ingested."""

    ingest_id: int = Field(examples=[1])
    job_id: str
    sha256: str
    octets: int


class Ingest(Schema):
    """One ingest of one file."""

    id: int = Field(examples=[1])
    state: str = Field(examples=["done"], description="queued, running, done or failed")
    sha256: str
    received: str
    finished: str | None
    error: str | None
    dictionary_version: int = Field(examples=[1])
    accounting: dict[str, Any]


class PassSummary(Schema):
    """A pass in a list."""

    id: int = Field(examples=[1])
    name: str = Field(examples=["selenita pass 1"])
    start: str
    stop: str


class PassDetail(PassSummary):
    """A pass."""

    spacecraft_id: int = Field(examples=[76])
    instance: str = Field(examples=["flight"])
    archive_sha256: str | None
    mission: str | None = Field(examples=["selenita"])
    mission_revision: str | None = Field(description="Revision of the mission description in force")
    manifest: dict[str, Any]
    reports: list[str]


class PassDefinition(Given):
    """An interval of a spacecraft's time to be kept as a pass."""

    name: str = Field(min_length=1, max_length=200, pattern=LINE_PATTERN_JSON, examples=["evening pass"])
    start: str = Field(examples=["2029-08-07T06:00:00Z"], max_length=40)
    stop: str = Field(examples=["2029-08-07T06:37:00Z"], max_length=40)
    spacecraft_id: int = Field(ge=0, le=1023, examples=[76])
    instance: str = Field(
        default="flight", min_length=1, max_length=96, pattern=r"^[A-Za-z0-9._@-]+$", examples=["flight"]
    )


class ApidCompleteness(Schema):
    """Packets of one APID."""

    apid: int = Field(examples=[161])
    name: str = Field(examples=["detections"])
    packets: int
    lost: int = Field(description="Missing between received packets, by sequence count")
    lost_at_edges: int | None = Field(
        description="Missing before the first and after the last packet, by the plan"
    )
    duplicates: int | None = Field(description="Received again with the same octets; null: not computed")
    conflicts: int
    crc_errors: int | None = Field(description="Received with a wrong checksum; null: not computed")


class Completeness(Schema):
    """Received and missing packets of a pass; null: not computed."""

    packets: int
    expected: int = Field(description="Received packets plus packets known to be missing")
    lost: int
    lost_at_edges: int | None
    duplicates: int | None
    conflicts: int
    crc_errors: int | None
    octets_skipped: int | None
    frames: int | None
    frames_bad: int | None
    symbols_corrected: int | None
    by_apid: list[ApidCompleteness]


class DetectionItem(Schema):
    """One detection of one frame; pixel centres are at whole numbers."""

    frame_number: int
    time: str
    u_px: float
    v_px: float
    diameter_px: float
    score: float
    size_class: int = Field(description="0: 5-10 km, 1: 10-15 km, 2: 15-30 km, 3: 3-5 km, -1: none")
    correlation_id: int = Field(description="Time correlation used; 0 is an ideal clock")


class Bucket(Schema):
    """A stretch of a series: least, greatest and mean value of the samples in it."""

    start: str
    stop: str
    count: int
    min: float
    max: float
    mean: float
    after_gap: bool = Field(description="A silence lies before it: draw no line to it")


class SeriesOut(Schema):
    """A series made short."""

    name: str = Field(examples=["altitude_m"])
    unit: str = Field(examples=["m"])
    samples: int
    correlation_id: int = Field(description="Time correlation used; 0 is an ideal clock")
    buckets: list[Bucket]


class States(Schema):
    """Series of one estimator's states."""

    estimator: str = Field(examples=["spherical"])
    series: list[SeriesOut]


class EventItem(Schema):
    """An event report."""

    time: str
    severity: str = Field(examples=["info"])
    name: str = Field(examples=["observation_stopped"])
    detail: str
    correlation_id: int = Field(description="Time correlation used; 0 is an ideal clock")


class CommandEntry(Given):
    """A telecommand to be queued."""

    name: str = Field(max_length=64, examples=["perform_function"])
    arguments: dict[str, Any] = Field(
        default_factory=dict,
        examples=[{"function_id": "start_observation", "argument_1": 0, "argument_2": 15}],
    )
    spacecraft_id: int = Field(ge=0, le=1023, examples=[76])
    instance: str = Field(default="flight", min_length=1, max_length=96, pattern=r"^[A-Za-z0-9._@-]+$")
    timeout_s: int = Field(default=600, ge=1, le=86_400 * 30)


class Rejection(Given):
    """Why a telecommand is not to be sent."""

    reason: str = Field(min_length=1, max_length=500, pattern=LINE_PATTERN_JSON, examples=["wrong cadence"])


class CommandReport(Schema):
    """A verification report about a telecommand."""

    stage: str = Field(examples=["accepted"])
    ticks: int = Field(description="On-board time of the report, 2^-16 s")
    step: int | None
    failure: str | None


class Telecommand(Schema):
    """Telecommand and its verification state."""

    id: int
    name: str
    arguments: dict[str, Any]
    spacecraft_id: int
    instance: str
    state: str = Field(
        description="queued, carried, released, rejected, sent, accepted, started, completed or failed",
        examples=["queued"],
    )
    critical: bool
    timed_out: bool
    requested_by: str
    requested: str
    decided_by: str | None
    decided: str | None
    reason: str | None
    sequence_count: int | None
    sent: str | None
    window_id: int | None = Field(description="The planned window that it belongs to")
    carrier_id: int | None = Field(description="The telecommand that carries it into the on-board schedule")
    reports: list[CommandReport]


class UplinkChannel(Schema):
    """A telecommand channel as the command link control words of one reception show it; flags are of the last word."""

    virtual_channel: int = Field(ge=0, le=63, examples=[0])
    report_value: int = Field(
        ge=0, le=255, description="Number of the sequence-controlled frame that is expected next"
    )
    farm_b_counter: int = Field(ge=0, le=3, description="Expedited frames accepted, modulo 4", examples=[3])
    lockout: bool
    wait: bool
    retransmit: bool
    no_rf_available: bool
    no_bit_lock: bool
    frames: int = Field(
        description="Frames of the reception that carry a word of the channel", examples=[120]
    )
    changes: int = Field(description="How often the word changed in it")
    frames_lockout: int
    frames_wait: int
    frames_retransmit: int
    frames_no_rf: int
    ingest_id: int = Field(examples=[1])
    received: str = Field(examples=["2029-08-07T06:30:00.000000000Z"])


class UplinkState(Schema):
    """What a spacecraft's telemetry last told of its telecommand receiver; no channels where it tells nothing."""

    spacecraft_id: int = Field(examples=[76])
    instance: str = Field(examples=["flight"])
    channels: list[UplinkChannel]


class Job(Schema):
    """A piece of background work."""

    id: str
    kind: str = Field(examples=["report"])
    state: str = Field(examples=["done"], description="queued, running, done or failed")
    progress: float = Field(ge=0.0, le=1.0)
    attempts: int
    arguments: dict[str, Any]
    result: dict[str, Any] | None
    error: str | None
    created: str
    started: str | None
    finished: str | None


class ReportItem(Schema):
    """A report that was made."""

    id: str
    pass_id: int
    created: str
    summary: dict[str, Any]


class Health(Schema):
    """Whether the service lives."""

    status: str = Field(examples=["ok"])


class TimePointIn(Given):
    """A time report as it was received."""

    ticks: int = Field(ge=0, lt=2**48, description="On-board time, 2^-16 s")
    received: str = Field(max_length=40, examples=["2029-08-07T06:00:01.3Z"], description="On the Earth")
    light_time_s: float = Field(ge=0.0, le=10.0, allow_inf_nan=False, examples=[1.28])
    boot_count: int = Field(default=0, ge=0, le=65_535)


class TimePoints(Given):
    """Time reports of one spacecraft."""

    points: list[TimePointIn] = Field(min_length=1, max_length=10_000)


class ReceptionIn(Given):
    """When a time report came to the Earth; its packet may come in before or after this."""

    packet_ticks: int = Field(ge=0, lt=2**48, description="On-board time in the packet's header, 2^-16 s")
    sequence_count: int = Field(ge=0, lt=2**14, description="Count in the packet's header")
    received: str = Field(max_length=40, examples=["2029-08-07T06:00:01.3Z"])
    station: str = Field(default="", max_length=64, description="Empty: light time to the Earth's centre")


class Receptions(Given):
    """Receptions of time reports of one spacecraft."""

    receptions: list[ReceptionIn] = Field(min_length=1, max_length=10_000)


class TimeReportItem(Schema):
    """A received time report, and what the correlation in force leaves of it."""

    packet_ticks: int
    sequence_count: int
    reported_ticks: int
    received: str
    station: str
    light_time_s: float = Field(examples=[1.28])
    boot_count: int
    correlation_id: int = Field(description="0 is an ideal clock")
    residual_ns: int


class Correlation(Schema):
    """A straight line from on-board time to UTC over one run of the clock."""

    id: int
    boot_count: int | None
    start_ticks: int
    stop_ticks: int
    reference_ticks: int
    reference: str = Field(description="UTC of reference_ticks")
    drift_ppb: float
    residual_rms_ns: float | None
    residual_max_ns: float | None
    points: int
    rejected: int = Field(description="Time reports left out as not believable")
    method: str = Field(examples=["time reports, light time"])
    in_force: bool
    created: str


class Trend(Schema):
    """How a housekeeping parameter moved."""

    parameter: str = Field(examples=["temperature_c"])
    unit: str
    samples: int
    low: float
    high: float
    mean: float
    slope_per_day: float | None
    limit_state: str = Field(description="Worst met: within, warning or alarm", examples=["within"])


class ReportErrors(Schema):
    """The 3-D error of one navigation solution in columns of one length; see `min_m` to `max_m` as a band."""

    name: str = Field(examples=["anchored"])
    kind: str = Field(description="estimate, smoothed or baseline", examples=["estimate"])
    time_s: list[float] = Field(description="UTC, POSIX seconds at the middle of each stretch")
    min_m: list[float]
    max_m: list[float]
    mean_m: list[float]
    after_gap: list[bool] = Field(description="A silence lies before the stretch: no line over it")


class ReportRequirement(Schema):
    """Row of the verdict table: the value must be at most, or at least, the limit."""

    key: str = Field(examples=["accuracy.median"])
    name: str = Field(examples=["median 3-D error"])
    unit: str = Field(examples=["m"])
    value: float | None = Field(description="null: unknown")
    limit: float | None = Field(description="null: not stated in the mission description")
    at_most: bool
    status: str = Field(description="met, not met, unknown or not judged", examples=["met"])
    note: str


class ReportOverview(Schema):
    """The head of a report and its error series made short."""

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
