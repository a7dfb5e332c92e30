"""What goes over the wire about plans: constraints, candidates, windows, whole plans."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from ground_service.http.model import Given, Schema
from ground_service.missions.stations import STATIONS
from ground_service.planning.core import Constraints, Resources
from ground_service.text import LINE_PATTERN_JSON
from lunar.visibility import GroundStation

Finite = Annotated[float, Field(allow_inf_nan=False)]
Name = Annotated[str, Field(min_length=1, max_length=200, pattern=LINE_PATTERN_JSON)]
InstanceName = Annotated[str, Field(min_length=1, max_length=96, pattern=r"^[A-Za-z0-9._@-]+$")]
Time = Annotated[str, Field(min_length=10, max_length=40, examples=["2029-08-07T06:00:00Z"])]
WindowState = Literal[
    "draft", "approved", "uplinked", "executing", "executed", "downlinked", "processed", "failed"
]


class Limits(Given):
    """A least and a greatest value."""

    min: Finite = Field(examples=[30.0])
    max: Finite = Field(examples=[100.0])

    @model_validator(mode="after")
    def ordered(self) -> Limits:
        if self.min > self.max:
            raise ValueError("expected min not above max")
        return self

    def scaled(self, factor: float) -> tuple[float, float]:
        """Both values times a factor."""
        return self.min * factor, self.max * factor


class Station(Given):
    """A ground station."""

    name: Name = Field(examples=["Canberra"])
    latitude_deg: Finite = Field(ge=-90.0, le=90.0, examples=[-35.4])
    longitude_deg: Finite = Field(ge=-360.0, le=360.0, examples=[149.0])
    height_m: Finite = Field(default=0.0, ge=-500.0, le=9000.0)
    minimum_elevation_deg: Finite = Field(default=10.0, ge=0.0, le=90.0)


class ResourcesIn(Given):
    """What the spacecraft and the ground have to offer."""

    storage_mib: Finite = Field(default=64.0, gt=0.0, le=1e6)
    downlink_kbit_s: Finite = Field(default=16.0, ge=0.0, le=1e6)
    battery_wh: Finite = Field(default=75.0, gt=0.0, le=1e5)
    generation_w: Finite = Field(default=30.0, ge=0.0, le=1e4)
    idle_w: Finite = Field(default=12.0, ge=0.0, le=1e4)
    observing_w: Finite = Field(default=8.0, ge=0.0, le=1e4, description="On top of idle_w")
    stations: list[Station] | None = Field(
        default=None, max_length=20, description="Default: Goldstone, Canberra, Madrid"
    )

    def value(self) -> Resources:
        """As the planner takes them."""
        stations: tuple[GroundStation, ...] = STATIONS
        if self.stations is not None:
            stations = tuple(
                GroundStation(
                    one.name,
                    math.radians(one.latitude_deg),
                    math.radians(one.longitude_deg),
                    one.height_m,
                    math.radians(one.minimum_elevation_deg),
                )
                for one in self.stations
            )
        return Resources(
            storage_octets=round(self.storage_mib * (1 << 20)),
            downlink_bit_s=self.downlink_kbit_s * 1e3,
            battery_wh=self.battery_wh,
            generation_w=self.generation_w,
            idle_w=self.idle_w,
            observing_w=self.observing_w,
            stations=stations,
        )


class WindowSearch(Given):
    """Constraints that a window has to fulfil all along; what is left out is not asked for."""

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
    catalogue_pass_id: int | None = Field(
        default=None, ge=1, le=2**31 - 1, description="Take the crater catalogue of this pass"
    )
    terrain: Literal["mare", "highland"] | None = None
    sunlit: bool = Field(default=False, description="The spacecraft has to be in full sunlight")
    minimum_duration_s: Finite = Field(default=300.0, ge=0.0, le=86_400.0)
    maximum_duration_s: Finite = Field(default=2400.0, ge=30.0, le=86_400.0)
    minimum_battery: Finite | None = Field(default=None, ge=0.0, le=1.0, description="Share of its capacity")
    needs_contact: bool = Field(default=False, description="Its data have to be down within the span")
    resources: ResourcesIn = Field(default_factory=ResourcesIn)

    def constraints(self) -> Constraints:
        """As the planner takes them."""

        def angles(limits: Limits | None) -> tuple[float, float] | None:
            return None if limits is None else limits.scaled(math.pi / 180.0)

        return Constraints(
            altitude_m=None if self.altitude_km is None else self.altitude_km.scaled(1e3),
            sun_elevation_rad=angles(self.sun_elevation_deg),
            latitude_rad=angles(self.latitude_deg),
            craters_per_frame=self.craters_per_frame,
            crater_diameter_m=self.crater_diameter_km.scaled(1e3),
            mare=None if self.terrain is None else self.terrain == "mare",
            sunlit=self.sunlit,
            minimum_duration_s=self.minimum_duration_s,
            maximum_duration_s=self.maximum_duration_s,
            minimum_battery=self.minimum_battery,
            needs_contact=self.needs_contact,
        )


class Span(Schema):
    """A least and a greatest value that were found."""

    min: float
    max: float


class CandidateOut(Schema):
    """A window that fulfils the constraints, and what it would be like."""

    start: str
    stop: str
    frames: int
    altitude_km: Span
    sun_elevation_deg: Span
    latitude_deg: Span
    sunlit_share: float
    craters_per_frame: Span | None
    mare_share: float | None
    data_octets: int
    energy_wh: float
    battery_minimum: float = Field(description="Least charge of the battery, share of its capacity")
    storage_peak_octets: int
    downlinked_by: str | None = Field(description="When its data are down; null: not within the contacts")


class ContactOut(Schema):
    """A span in which a station sees the spacecraft."""

    station: str
    start: str
    stop: str


class SearchOut(Schema):
    """Candidate windows in order of time."""

    ephemeris_id: int
    data: list[str]
    candidates: list[CandidateOut]
    contacts: list[ContactOut]
    refused: dict[str, int] = Field(description="Spans left out, by reason")


class WindowIn(Given):
    """A window to be planned."""

    name: Name = Field(default="observation", examples=["evening pass"])
    start: Time
    stop: Time
    cadence_s: Finite = Field(default=15.0, ge=0.1, le=3600.0)
    spacecraft_id: int = Field(ge=0, le=1023, examples=[76])
    instance: InstanceName = "flight"
    predecessor_id: int | None = Field(default=None, ge=1, le=2**31 - 1)
    ephemeris_id: int | None = Field(default=None, ge=1, le=2**31 - 1)
    resources: ResourcesIn = Field(default_factory=ResourcesIn)


class WindowChange(Given):
    """Changes of a draft, or a decision on a window; what is left out stays."""

    name: Name | None = None
    start: Time | None = None
    stop: Time | None = None
    cadence_s: Finite | None = Field(default=None, ge=0.1, le=3600.0)
    predecessor_id: int | None = Field(default=None, ge=1, le=2**31 - 1)
    state: Literal["draft", "approved", "failed"] | None = Field(default=None, examples=["approved"])
    reason: str | None = Field(default=None, max_length=500, pattern=LINE_PATTERN_JSON)


class WindowOut(Schema):
    """A planned window and where it has come."""

    id: int = Field(examples=[1])
    name: str
    start: str
    stop: str
    cadence_s: float
    state: WindowState
    reason: str | None
    spacecraft_id: int
    instance: str
    predecessor_id: int | None
    ephemeris_id: int | None
    pass_id: int | None = Field(description="The pass of its telemetry, once some came down")
    data_octets: int
    predicted: dict[str, Any]
    telecommands: list[int]
    version: int
    created_by: str
    created: str
    changed: str


class PlanWindow(Given):
    """A window in a plan; `key` names it within the plan, `after` the one that comes before it."""

    key: str = Field(min_length=1, max_length=64, pattern=LINE_PATTERN_JSON, examples=["w1"])
    after: str | None = Field(default=None, max_length=64, pattern=LINE_PATTERN_JSON)
    name: Name
    start: Time
    stop: Time
    cadence_s: Finite = Field(ge=0.1, le=3600.0)
    spacecraft_id: int = Field(ge=0, le=1023)
    instance: InstanceName = "flight"


class Plan(Given):
    """Windows as they are exchanged between services."""

    schema_version: Literal[1] = 1
    windows: list[PlanWindow] = Field(max_length=1000)


class Imported(Schema):
    """Windows that a plan became, by their keys."""

    windows: dict[str, int]
