"""Entities of passes and their telemetry."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from ground_service.http.model import Entity, InstanceName, Paging, RequestModel, RequestTime, SpacecraftNumber, UtcTime
from ground_service.store.vehicles import FLOWN
from ground_service.toml import LINE_PATTERN_JSON

if TYPE_CHECKING:
    from reports.values import PacketAccounting

CorrelationId = Annotated[int, Field(description="Time correlation used; 0 is an ideal clock")]


def _known(value: Any) -> Any:
    return None if isinstance(value, float) and math.isnan(value) else value


EventSeverity = Literal["info", "low", "medium", "high"]


class PassRecord(Entity):
    """A stored pass: see `store.models.PASSES`; times are UTC, ns."""

    id: int
    vehicle_id: int
    name: str
    start_utc_ns: int
    stop_utc_ns: int
    archive_digest: str | None
    manifest: dict[str, Any]
    ephemeris_id: int | None
    catalogue_sha256: str | None
    attitude_sha256: str | None
    mission_id: int | None
    created_utc_ns: int


class PassSummary(Entity):
    """A pass in a list."""

    id: int = Field(examples=[1])
    name: str = Field(examples=["selenita pass 1"])
    start: UtcTime
    stop: UtcTime
    spacecraft_id: int = Field(examples=[76])
    instance: str = Field(examples=["flight"])


class PassDetail(PassSummary):
    """A pass."""

    archive_sha256: str | None
    mission: str | None = Field(examples=["selenita"])
    mission_revision: str | None = Field(description="Revision of the mission description in force")
    manifest: dict[str, Any]
    reports: list[str] = Field(description="Ids of the newest reports")


class PassDefinition(RequestModel):
    """An interval of a spacecraft's time to be kept as a pass."""

    name: str = Field(min_length=1, max_length=200, pattern=LINE_PATTERN_JSON, examples=["evening pass"])
    start: RequestTime
    stop: RequestTime
    spacecraft_id: SpacecraftNumber
    instance: InstanceName = "flight"


class ApidCompleteness(Entity):
    """Packets of one APID."""

    apid: int = Field(examples=[161])
    name: str = Field(examples=["detections"])
    packets: int
    lost: int = Field(description="Missing between received packets, by sequence count")
    lost_at_edges: int | None = Field(description="Missing before the first and after the last packet, by the plan")
    duplicates: int | None = Field(description="Received again with the same octets; null: not computed")
    conflicts: int
    crc_errors: int | None = Field(description="Received with a wrong checksum; null: not computed")


class Reception(Entity):
    """Link quality of one received file; null: unknown."""

    station: str = Field(examples=["madrid"], description="Empty: not stated")
    source: str = Field(description="Origin of the link settings: stated (by the sender), mission or default")
    frames: int
    frames_good: int
    symbols_corrected: int
    bit_error_rate: float | None = Field(description="Of what could be corrected, a lower bound")
    lock_losses: int
    octets: int
    octets_other: int = Field(description="Octets outside frames and station records")
    first_received: UtcTime | None
    last_received: UtcTime | None


class Completeness(Entity):
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
    receptions: list[Reception]
    by_apid: list[ApidCompleteness]

    @classmethod
    def of_accounting(cls, found: PacketAccounting) -> Completeness:
        """Return the entity of a packet accounting."""
        by_apid = [ApidCompleteness.of(asdict(one), apid=apid) for apid, one in sorted(found.by_apid.items())]
        receptions = [
            Reception.of(asdict(one), first_received=one.first_utc_ns, last_received=one.last_utc_ns)
            for one in found.receptions
        ]
        names = set(cls.model_fields) - {"by_apid", "receptions"}
        figures = {name: getattr(found, name) for name in names}
        return cls(**figures, receptions=receptions, by_apid=by_apid)


class Detection(Entity):
    """One detection of one frame; pixel centres are at whole numbers."""

    frame_number: int
    time: UtcTime
    u_px: float
    v_px: float
    diameter_px: float
    score: float
    size_class: int = Field(description="0: 5-10 km, 1: 10-15 km, 2: 15-30 km, 3: 3-5 km, -1: none")
    correlation_id: CorrelationId


class Crater(Entity):
    """A crater of the catalogue of a pass."""

    id: int
    latitude_deg: float
    longitude_deg: float = Field(description="East, -180 to 180")
    diameter_m: float


class Bucket(Entity):
    """An interval of a series: minimum, maximum and mean of its samples."""

    start: UtcTime
    stop: UtcTime
    count: int
    min: float
    max: float
    mean: float
    after_gap: bool = Field(description="A gap precedes the interval: draw no line across it")


class ParameterSeries(Entity):
    """A series of one parameter, reduced to intervals."""

    name: str = Field(examples=["altitude_m"])
    unit: str = Field(examples=["m"])
    samples: int
    correlation_id: CorrelationId
    buckets: list[Bucket]


class States(Entity):
    """Series of one estimator's states."""

    estimator: str = Field(examples=["spherical"])
    series: list[ParameterSeries]


class Event(Entity):
    """An event report of the payload."""

    time: UtcTime
    severity: str = Field(examples=["info"])
    name: str = Field(examples=["observation_stopped"])
    detail: str
    correlation_id: CorrelationId


class Image(Entity):
    """An image of the payload: a downlinked thumbnail, or a full frame from a pass archive."""

    frame_number: int
    time: UtcTime
    source: Literal["thumbnail", "archive"]
    pass_id: int | None = Field(description="Pass of the archive; null for a thumbnail")
    address: str = Field(description="Address of the image as PNG", examples=["/api/v1/passes/1/images/12"])
    overlay: str | None = Field(
        description="Address of the image with the detections of the payload; null: they, or the camera, are not known"
    )


class SpacecraftEvent(Event):
    """An event report of a spacecraft, and the pass that it belongs to."""

    pass_id: int | None = Field(description="null: in no pass")


class Trend(Entity):
    """Statistics, slope and limit state of a housekeeping parameter over an interval."""

    parameter: str = Field(examples=["temperature_c"])
    unit: str
    samples: int
    low: float
    high: float
    mean: float
    slope_per_day: Annotated[float | None, BeforeValidator(_known)] = Field(
        description="By least squares; null: too few samples"
    )
    limit_state: str = Field(description="Worst found: within, warning or alarm", examples=["within"])


ExportFormat = Literal["json", "csv", "parquet"]


class ParameterInfo(Entity):
    """Parameter with a series."""

    name: str = Field(description="Name in addresses; with the packet where several packets have the parameter")
    packet: str = Field(description="Packet, or XTCE container", examples=["housekeeping"])
    source: str = Field(description="`dictionary`, or the name of the packets in the mission description")
    description: str
    unit: str
    labels: dict[str, str] = Field(description="Names of codes")
    warning: tuple[float | None, float | None] | None = Field(description="Least and greatest value without warning")
    alarm: tuple[float | None, float | None] | None = Field(description="Least and greatest value without alarm")


class SpacecraftInstance(Entity):
    """A spacecraft in one instance: flown, emulated or replayed."""

    spacecraft_id: int = Field(examples=[76])
    instance: str = Field(examples=["flight"])
    name: str | None = Field(description="Name in the mission description; null: not stated", examples=["SelenITA"])


class LiveValue(Entity):
    """Value of a parameter, with its state by the limits."""

    name: str = Field(examples=["temperature_c"])
    value: Annotated[float | None, BeforeValidator(_known)] = Field(description="Null: not known")
    text: str = Field(description="Value as people read it: the name of a code, or the number")
    limit_state: Literal["none", "within", "warning", "alarm"] = Field(description="none: no limits")


class NewestPacket(Entity):
    """Values of the newest packet of one kind of a spacecraft, by on-board time: the live message ``values``."""

    spacecraft_id: int
    instance: str
    packet: str
    time: UtcTime = Field(description="Spacecraft time of the packet")
    age_s: float = Field(description="Time since then by the clock of the service or the newest packet")
    values: tuple[LiveValue, ...]


class LiveParameter(LiveValue):
    """Value of a parameter in the newest packet of its APID, by on-board time."""

    packet: str = Field(examples=["housekeeping"])
    description: str
    unit: str = Field(examples=["degC"])
    limits: str = Field(description="Warning limits, else alarm limits; empty: none", examples=["-20 to 60"])
    time: UtcTime = Field(description="Spacecraft time of the packet")
    age_s: float = Field(description="Time since then by the clock of the service or the newest packet", examples=[4.2])


class PacketInfo(Entity):
    """Packets of one kind in a pass."""

    packet: str
    source: str
    packets: int = Field(description="Packets in the pass, by their on-board time")


class PassParameters(Entity):
    """Parameters of a pass, and the packets that the mission description defines."""

    parameters: tuple[ParameterInfo, ...]
    packets: tuple[PacketInfo, ...]
    outcomes: dict[str, dict[str, int]] = Field(
        description="Packets of the spacecraft by APID and outcome of decoding with the mission description"
    )


class PassFilter(Paging):
    """Passes to list."""

    search: str | None = Field(default=None, min_length=1, max_length=200, description="Part of the name, in any case")
    spacecraft_id: SpacecraftNumber | None = None
    instance: InstanceName | None = None
    verdict: Literal["met", "not met", "unknown", "none"] | None = Field(
        default=None, description="Verdict of the newest report; none: without a report"
    )


class EventFilter(Paging):
    """Event reports of a spacecraft to list."""

    spacecraft_id: SpacecraftNumber
    instance: InstanceName = FLOWN
    severity: list[EventSeverity] | None = Field(default=None, description="Default: any severity")
    name: str | None = Field(default=None, min_length=1, max_length=100, description="Part of the name of the event")
    start: RequestTime | None = None
    stop: RequestTime | None = None
