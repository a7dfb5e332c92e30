"""Entities of landmarks learned from flight."""

from typing import Literal

from pydantic import Field

from ground_service.http.model import Entity, Paging, RequestModel, SpacecraftNumber, UtcTime
from ground_service.toml import LINE_PATTERN_JSON

LandmarkState = Literal["seen", "proposed", "accepted", "rejected"]


class Sighting(Entity):
    """A detection of a landmark in one frame."""

    frame_number: int
    time: UtcTime
    u_px: float
    v_px: float
    diameter_px: float
    score: float
    image: str | None = Field(default=None, description="Address of the image, if one was received")


class PassSightings(Entity):
    """Place of a landmark as one pass has seen it; without sightings the pass looked at it in vain."""

    pass_id: int
    looks: int = Field(description="Frames in which the place was in view")
    latitude_deg: float
    longitude_deg: float
    height_m: float
    sigma_east_m: float
    sigma_north_m: float
    sigma_up_m: float
    diameter_m: float
    diameter_sigma_m: float
    score: float
    frame_width_px: int = Field(description="Size of the frames that the detections refer to")
    frame_height_px: int
    controls: int = Field(description="Catalogued craters that calibrate the pass; below 5 it is not calibrated")
    sightings: list[Sighting]


class Landmark(Entity):
    """A place at which detections recur that no catalogued crater explains."""

    id: int
    spacecraft_id: int
    state: LandmarkState = Field(
        description="seen: not often enough; proposed: waits for a decision; accepted; rejected"
    )
    latitude_deg: float
    longitude_deg: float
    height_m: float = Field(description="Above the sphere of 1737.4 km")
    sigma_east_m: float
    sigma_north_m: float
    sigma_up_m: float
    diameter_m: float
    diameter_sigma_m: float
    passes: int = Field(description="Passes that have seen it")
    sightings: int = Field(description="Frames that have seen it")
    looks: int = Field(description="Frames in which it was in view, on all passes")
    score: float = Field(description="Mean score of its detections")
    decided_by: str | None
    decided: UtcTime | None
    reason: str | None
    created: UtcTime
    changed: UtcTime


class LandmarkDetail(Landmark):
    """A landmark with its sightings."""

    evidence: list[PassSightings]


class LandmarkDecision(RequestModel):
    """Reason for accepting or rejecting a landmark."""

    reason: str = Field(default="", max_length=500, pattern=LINE_PATTERN_JSON, examples=["crater in all images"])


class LandmarkUpdate(Entity):
    """Contribution of a pass to the landmarks."""

    pass_id: int
    detections: int
    unmatched: int = Field(description="Detections that no catalogued crater explains")
    places: int = Field(description="New places that at least two frames have seen")
    listed: int = Field(
        description="Further places: craters that the catalogue of the pass lacks and the full list has"
    )
    controls: int = Field(description="Catalogued craters that calibrate the pass")
    offset_east_m: float | None = Field(description="Offset of these craters that was removed; null: none was")
    offset_north_m: float | None
    added: int
    proposed: int = Field(description="Landmarks that wait for a decision now")


class LandmarkFilter(Paging):
    """Landmarks to list."""

    spacecraft_id: SpacecraftNumber | None = None
    state: LandmarkState | None = None
