"""Entities of plans: constraints, candidates, windows, whole plans, standing requests."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, ConfigDict, Field, model_validator

from ground_service.http.model import Entity, InstanceName, Paging, RequestModel, RequestTime, SpacecraftNumber, UtcTime
from ground_service.planning import core
from ground_service.planning.core import Constraints
from ground_service.toml import LINE_PATTERN_JSON
from lunar.constants import NS

Finite = Annotated[float, Field(allow_inf_nan=False)]
Name = Annotated[str, Field(min_length=1, max_length=200, pattern=LINE_PATTERN_JSON)]
Time = Annotated[RequestTime, AfterValidator(lambda time: UtcTime(time.utc_ns // 1000 * 1000))]
"""Time of a plan, in whole microseconds, so that an exported plan states it exactly."""

WindowState = Literal[
    "draft", "approved", "uplinked", "cancelling", "executing", "executed", "downlinked", "processed", "failed"
]
Decision = Literal["draft", "approved", "failed"]


@dataclass(frozen=True, slots=True)
class WindowEntry:
    """Request of a window."""

    name: str
    start_utc_ns: int
    stop_utc_ns: int
    cadence_s: float
    spacecraft_id: int
    instance: str = "flight"
    predecessor_id: int | None = None
    ephemeris_id: int | None = None


class Limits(RequestModel):
    """A minimum and a maximum."""

    min: Finite = Field(examples=[30.0])
    max: Finite = Field(examples=[100.0])

    @model_validator(mode="after")
    def ordered(self) -> Limits:
        if self.min > self.max:
            raise ValueError("expected min not above max")
        return self

    def scaled(self, factor: float) -> tuple[float, float]:
        """Return both values times a factor."""
        return self.min * factor, self.max * factor


class WindowSearch(RequestModel):
    """Constraints that a window must fulfil throughout; a constraint that is not stated does not apply."""

    start: Time | None = Field(default=None, description="Default: where the ephemeris begins")
    stop: Time | None = Field(default=None, description="Default: where the ephemeris ends")
    ephemeris_id: int | None = Field(default=None, ge=1, le=2**31 - 1)
    spacecraft_id: int | None = Field(
        default=None, ge=0, le=1023, description="Count with the storage its windows claim", examples=[76]
    )
    instance: InstanceName = "flight"
    cadence_s: Finite = Field(default=15.0, ge=0.1, le=3600.0)
    step_s: Finite = Field(default=30.0, ge=1.0, le=600.0)
    altitude_km: Limits | None = Field(default=None, examples=[{"min": 30.0, "max": 100.0}])
    sun_elevation_deg: Limits | None = Field(default=None, examples=[{"min": 5.0, "max": 40.0}])
    latitude_deg: Limits | None = None
    craters_per_frame: Finite | None = Field(default=None, ge=0.0, le=10_000.0, examples=[5.0])
    crater_diameter_km: Limits = Limits(min=5.0, max=30.0)
    terrain: Literal["mare", "highland"] | None = None
    sunlit: bool = Field(default=False, description="The spacecraft has to be in full sunlight")
    minimum_duration_s: Finite = Field(default=300.0, ge=0.0, le=86_400.0)
    maximum_duration_s: Finite = Field(default=2400.0, ge=30.0, le=86_400.0)
    first_coast_m: Finite | None = Field(
        default=None,
        ge=500.0,
        le=1e6,
        description="Along-track error, 1 sigma, that a coast of one revolution after a first window may end with: the "
        "window has to be as long as this requires",
    )
    minimum_battery: Finite | None = Field(default=None, ge=0.0, le=1.0, description="Share of its capacity")
    needs_contact: bool = Field(default=False, description="Its data must be downlinked within the span")

    def constraints(self) -> Constraints:
        """Return the value for the planner."""

        def angles(limits: Limits | None) -> tuple[float, float] | None:
            return None if limits is None else limits.scaled(math.pi / 180.0)

        needed_s = 0.0 if self.first_coast_m is None else core.COAST_M_S / self.first_coast_m
        return Constraints(
            altitude_m=None if self.altitude_km is None else self.altitude_km.scaled(1e3),
            sun_elevation_rad=angles(self.sun_elevation_deg),
            latitude_rad=angles(self.latitude_deg),
            craters_per_frame=self.craters_per_frame,
            crater_diameter_m=self.crater_diameter_km.scaled(1e3),
            mare=None if self.terrain is None else self.terrain == "mare",
            sunlit=self.sunlit,
            minimum_duration_s=max(self.minimum_duration_s, needed_s),
            maximum_duration_s=self.maximum_duration_s,
            minimum_battery=self.minimum_battery,
            needs_contact=self.needs_contact,
        )


class Span(Entity):
    """Minimum and maximum over a window."""

    min: float
    max: float

    @classmethod
    def degrees(cls, limits_rad: tuple[float, float]) -> Span:
        """Return limits in radians as degrees."""
        return cls(min=math.degrees(limits_rad[0]), max=math.degrees(limits_rad[1]))


class WindowPrediction(Entity):
    """Prediction of a window; the conditions are unknown if no reference ephemeris covers it."""

    # Rows of earlier versions also state resources.
    model_config = ConfigDict(extra="ignore")

    frames: int | None = None
    start: UtcTime | None = None
    stop: UtcTime | None = None
    altitude_km: Span | None = None
    sun_elevation_deg: Span | None = None
    latitude_deg: Span | None = None
    sunlit_share: float | None = None
    craters_per_frame: Span | None = None
    mare_share: float | None = None
    first_coast_m: float | None = Field(
        default=None,
        description="Along-track error, 1 sigma, after a coast of one revolution, if this is the first window",
    )
    data_octets: int | None = None
    energy_wh: float | None = None
    battery_minimum: float | None = Field(
        default=None, description="Minimum charge of the battery, share of its capacity"
    )
    storage_peak_octets: int | None = None
    downlinked_by: UtcTime | None = Field(
        default=None, description="Time of the downlink of its data; null: not within the contacts"
    )


class Candidate(WindowPrediction):
    """A window that fulfils the constraints, with its predicted conditions."""

    start: UtcTime
    stop: UtcTime
    altitude_km: Span
    sun_elevation_deg: Span

    @classmethod
    def from_core(cls, found: core.Candidate) -> Candidate:
        """Return the entity of a candidate of the planner."""
        craters = found.craters_per_frame
        duration_s = (found.stop_utc_ns - found.start_utc_ns) / NS
        return cls.of(
            asdict(found),
            first_coast_m=core.COAST_M_S / duration_s,
            altitude_km=Span(min=found.altitude_m[0] / 1e3, max=found.altitude_m[1] / 1e3),
            sun_elevation_deg=Span.degrees(found.sun_elevation_rad),
            latitude_deg=Span.degrees(found.latitude_rad),
            craters_per_frame=None if craters is None else Span(min=craters[0], max=craters[1]),
        )


class Contact(Entity):
    """An interval in which a station sees the spacecraft."""

    station: str
    start: UtcTime
    stop: UtcTime


class RejectedSpan(Entity):
    """A span that fulfils the constraints but is no candidate, and why."""

    start: UtcTime
    stop: UtcTime
    reason: str = Field(examples=["too short"])


class SearchResult(Entity):
    """Candidate windows in order of time."""

    ephemeris_id: int
    data: list[str]
    candidates: list[Candidate]
    contacts: list[Contact]
    rejected: list[RejectedSpan] = Field(description="Spans that were left out, in order of time")
    reason: str | None = Field(
        default=None, description="Without a span: the constraints that exclude all, and the nearest relaxation"
    )


class WindowConflict(Entity):
    """Conflict of a planned window."""

    window_id: int
    reasons: list[str]


class PlanForecast(Entity):
    """Conditions and resources of the plan of a spacecraft on a grid of time, in columns of equal length.

    The columns are empty if no reference ephemeris covers the interval; `reason` states it.
    """

    spacecraft_id: int
    instance: str
    ephemeris_id: int | None
    reason: str | None = Field(description="Reason of missing values, in the whole interval or in a part of it")
    data: list[str]
    step_s: float
    time_s: list[float] = Field(description="UTC, POSIX seconds at the middle of each step")
    latitude_deg: list[float]
    longitude_deg: list[float]
    altitude_km: list[float]
    sun_elevation_deg: list[float] = Field(description="At the sub-satellite point")
    sunlit: list[float] = Field(description="Share of the Sun's disc that the spacecraft sees")
    battery_share: list[float] = Field(description="Charge at the end of the step, share of the capacity")
    assumed: list[str] = Field(description="Resources that the mission description does not state")
    battery_floor: float = Field(description="Minimum share of the mission description or of the planner")
    stored_octets: list[int] = Field(description="Data on board at the end of the step")
    storage_octets: int = Field(description="Capacity of the storage")
    sent_octets: list[int] = Field(description="Data downlinked in the step")
    downlink_octets: list[int] = Field(description="Data that contacts can take in the step")
    conflicts: list[WindowConflict] = Field(description="Conflicts of the plan, drafts included")


class CraterDensity(Entity):
    """Craters per 10,000 km2 in cells of the map; rows from south to north, cells from 180 W to 180 E."""

    source: str | None = Field(description="Name of the catalogue")
    reason: str | None = Field(description="Reason of a missing density")
    cell_deg: float
    diameter_km: Span
    rows: list[list[float]]


class WindowIn(RequestModel):
    """A window to be planned."""

    name: Name = Field(default="observation", examples=["evening pass"])
    start: Time
    stop: Time
    cadence_s: Finite = Field(default=15.0, ge=0.1, le=3600.0)
    spacecraft_id: SpacecraftNumber
    instance: InstanceName = "flight"
    predecessor_id: int | None = Field(default=None, ge=1, le=2**31 - 1)
    ephemeris_id: int | None = Field(default=None, ge=1, le=2**31 - 1)

    def entry(self) -> WindowEntry:
        """Return the requested window."""
        stated = self.model_dump(exclude={"start", "stop"})
        return WindowEntry(start_utc_ns=self.start.utc_ns, stop_utc_ns=self.stop.utc_ns, **stated)


class WindowChange(RequestModel):
    """Changes of a draft, or a decision on a window; fields that are not stated do not change."""

    name: Name | None = None
    start: Time | None = None
    stop: Time | None = None
    cadence_s: Finite | None = Field(default=None, ge=0.1, le=3600.0)
    predecessor_id: int | None = Field(default=None, ge=1, le=2**31 - 1)
    state: Decision | None = Field(default=None, examples=["approved"])
    reason: str | None = Field(default=None, max_length=500, pattern=LINE_PATTERN_JSON)

    def changes(self) -> dict[str, Any]:
        """Return the changed fields of the `WindowEntry`."""
        given = {name: getattr(self, name) for name in self.model_fields_set - {"state", "reason"}}
        return {
            f"{name}_utc_ns" if isinstance(value, UtcTime) else name: value.utc_ns
            if isinstance(value, UtcTime)
            else value
            for name, value in given.items()
            if value is not None or name == "predecessor_id"
        }


@dataclass(frozen=True, slots=True)
class AssessedWindow:
    """Requested window without conflicts, and its prediction."""

    entry: WindowEntry
    data_octets: int
    predicted: WindowPrediction


class Window(Entity):
    """A planned window and its state."""

    id: int = Field(examples=[1])
    name: str
    start: UtcTime
    stop: UtcTime
    cadence_s: float
    state: WindowState
    reason: str | None
    spacecraft_id: int
    instance: str
    predecessor_id: int | None
    ephemeris_id: int | None
    pass_id: int | None = Field(description="The pass of its telemetry, once received")
    data_octets: int
    predicted: WindowPrediction
    telecommands: list[int]
    request_id: int | None = Field(description="The standing request that it was planned for")
    version: int
    created_by: str
    created: UtcTime
    decided_by: str | None = Field(description="Person who approved it, made it a draft again or declared it failed")
    changed: UtcTime


class UploadedState(Entity):
    """State that the estimators of a window start from, Moon-centred ICRF."""

    utc: UtcTime
    position_icrf_m: tuple[float, float, float]
    velocity_icrf_m_s: tuple[float, float, float]


class UploadedBurn(Entity):
    """Manoeuvre that was announced to the estimators of a window."""

    utc: UtcTime
    delta_v_icrf_m_s: tuple[float, float, float]
    sigma_m_s: float


class StartedOrbit(Entity):
    """Orbit of the experiment that a window starts from."""

    orbit_error_m: float = Field(description="1 sigma per axis")
    orbit_age_h: float | None = Field(description="From the begin of the arc of its ephemeris to the window")


class WindowUploads(Entity):
    """Tables that the telecommands of a window load on board, as in the manifest of a pass."""

    start_state: UploadedState | None = None
    burns: list[UploadedBurn] | None = None
    experiment: StartedOrbit | None = None


class WindowRecord(Window):
    """A window with the fields that only the service uses."""

    vehicle_id: int
    mission_id: int | None
    closed: bool
    uploads: WindowUploads | None
    decision: Literal["draft", "approved", "cancelling", "failed"]
    edited_by: str

    def entry(self) -> WindowEntry:
        """Return the request of the window."""
        stated = self.model_dump(include=set(WindowIn.model_fields) - {"start", "stop"})
        return WindowEntry(start_utc_ns=self.start.utc_ns, stop_utc_ns=self.stop.utc_ns, **stated)


class PlannedTelecommand(Entity):
    """A telecommand of a window before its release."""

    time: UtcTime | None = Field(description="Time of execution on board; null: on reception")
    name: str = Field(examples=["perform_function"])
    text: str = Field(description="Its arguments with names and units")


class WindowFilter(Paging):
    """Windows to list."""

    state: list[WindowState] | None = Field(default=None, description="Default: any state")


RequestState = Literal["active", "paused"]


class Region(RequestModel):
    """Sub-satellite points between two latitudes and two longitudes; from `min` to the east to `max`."""

    latitude_deg: Limits = Limits(min=-90.0, max=90.0)
    west_deg: Annotated[Finite, Field(ge=-180.0, le=360.0)] = -180.0
    east_deg: Annotated[Finite, Field(ge=-180.0, le=360.0)] = 180.0


class RequestTerms(RequestModel):
    """Terms of a request; a constraint that is not stated does not apply."""

    windows: int = Field(ge=1, le=1000, description="Windows in each period", examples=[10])
    period_days: Finite = Field(default=7.0, ge=0.1, le=366.0)
    horizon_days: Finite = Field(default=3.0, ge=0.1, le=31.0, description="Days ahead that are planned")
    start: Time | None = Field(default=None, description="Begin of the first period; default: when it was added")
    stop: Time | None = Field(default=None, description="No windows from this time on")
    priority: int = Field(default=0, ge=-1000, le=1000, description="Requests with a higher number come first")
    regions: list[Region] | None = Field(default=None, min_length=1, max_length=50)
    sun_elevation_deg: Limits | None = Field(
        default=None,
        description="Default: the Sun above the horizon, unless the mission description needs no daylight",
        examples=[{"min": 5.0, "max": 40.0}],
    )
    altitude_km: Limits | None = None
    minimum_duration_s: Finite = Field(default=300.0, ge=10.0, le=86_400.0)
    maximum_duration_s: Finite = Field(default=1500.0, ge=30.0, le=86_400.0)
    cadence_s: Finite = Field(default=15.0, ge=0.1, le=3600.0)
    minimum_battery: Finite = Field(default=0.3, ge=0.0, le=1.0, description="Share of its capacity")
    needs_contact: bool = Field(default=True, description="Data must be down within a day")

    def constraints(self) -> Constraints:
        """Return the value for the window search."""
        sun = self.sun_elevation_deg
        radians = math.pi / 180.0
        regions = [
            (one.latitude_deg.scaled(radians), (one.west_deg * radians, one.east_deg * radians))
            for one in self.regions or ()
        ]
        return Constraints(
            altitude_m=None if self.altitude_km is None else self.altitude_km.scaled(1e3),
            sun_elevation_rad=None if sun is None else sun.scaled(radians),
            regions_rad=tuple(regions),
            minimum_duration_s=self.minimum_duration_s,
            maximum_duration_s=self.maximum_duration_s,
        )


class StandingRequestIn(RequestTerms):
    """A standing request to be added."""

    name: Name = Field(examples=["mare at low Sun"])
    spacecraft_id: SpacecraftNumber
    instance: InstanceName = "flight"

    def terms(self) -> RequestTerms:
        """Return what is requested."""
        return RequestTerms(**{name: getattr(self, name) for name in RequestTerms.model_fields})


class StandingRequestChange(RequestModel):
    """Changes of a standing request; what is not stated does not change."""

    state: RequestState | None = None
    terms: RequestTerms | None = None


class StandingRequest(Entity):
    """A standing request with the numbers of its windows."""

    id: int = Field(examples=[1])
    name: str
    spacecraft_id: int
    instance: str
    state: RequestState
    terms: RequestTerms
    windows: dict[str, int] = Field(description="Number of windows by state", examples=[{"processed": 8}])
    version: int
    planned: UtcTime | None = Field(description="Mission time of the last plan")
    created_by: str
    created: UtcTime
    changed: UtcTime


class PlannedCandidate(Entity):
    """A candidate window of the last plan: planned, or rejected with the reason."""

    start: UtcTime
    stop: UtcTime
    outcome: Literal["planned", "rejected"]
    window_id: int | None
    reason: str | None


class RequestPlan(Entity):
    """The last plan of a standing request."""

    request_id: int
    planned: UtcTime | None
    until: UtcTime | None = Field(description="End of the planned time")
    reason: str | None = Field(description="Reason of an empty plan, or one shorter than the horizon")
    basis: str = Field(description="Hash of what the plan depends on, except time")
    candidates: list[PlannedCandidate]
    replaced: list[dict[str, Any]] = Field(
        description="Failed windows of the request", examples=[[{"window_id": 7, "reason": "a telecommand failed"}]]
    )
