"""Entities of standing requests: observation windows that the planner keeps in the plan."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from pydantic import Field

from ground_service.http.model import Entity, Given, InstanceName, SpacecraftNumber, UtcTime
from ground_service.planning.core import Constraints
from ground_service.planning.model import Finite, Limits, Name, Time

RequestState = Literal["active", "paused"]


class Region(Given):
    """Sub-satellite points between two latitudes and two longitudes; from `min` to the east to `max`."""

    latitude_deg: Limits = Limits(min=-90.0, max=90.0)
    west_deg: Annotated[Finite, Field(ge=-180.0, le=360.0)] = -180.0
    east_deg: Annotated[Finite, Field(ge=-180.0, le=360.0)] = 180.0


class RequestTerms(Given):
    """What is requested; a constraint that is not stated does not apply."""

    windows: int = Field(ge=1, le=1000, description="Windows in each period", examples=[10])
    period_days: Finite = Field(default=7.0, ge=0.1, le=366.0)
    horizon_days: Finite = Field(default=3.0, ge=0.1, le=31.0, description="Days ahead that are planned")
    start: Time | None = Field(
        default=None, description="Begin of the first period; default: when it was added"
    )
    stop: Time | None = Field(default=None, description="No windows from this time on")
    priority: int = Field(
        default=0, ge=-1000, le=1000, description="Requests with a higher number come first"
    )
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


class StandingRequestChange(Given):
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
    reason: str | None = Field(description="Why nothing, or less than the horizon, was planned")
    basis: str = Field(description="Hash of what the plan depends on, except time")
    candidates: list[PlannedCandidate]
    replaced: list[dict[str, Any]] = Field(
        description="Failed windows of the request",
        examples=[[{"window_id": 7, "reason": "a telecommand failed"}]],
    )
