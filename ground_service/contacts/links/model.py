"""Entities of links to ground stations and of contacts."""

from typing import Literal

from pydantic import Field

from ground_service.http.model import Entity, UtcTime

LinkState = Literal["waiting", "connected", "contact", "failed"]
ContactState = Literal["predicted", "open", "ended", "missed"]


class LinkStatus(Entity):
    """A link that a mission description in force declares, and its state."""

    name: str = Field(examples=["lab"])
    kind: str = Field(examples=["tcp"])
    station: str | None = Field(examples=["madrid"])
    spacecraft_id: int = Field(examples=[76])
    instance: str = Field(examples=["flight"])
    downlink: str | None
    uplink: str | None
    send: str = Field(description="automatic or manual", examples=["automatic"])
    state: LinkState
    reason: str | None = Field(description="Reason of waiting or failure, or fault of a connected station")
    owner: str | None = Field(description="Process that operates the link; null: none does now")
    octets: int = Field(description="Octets received and stored")
    heard: UtcTime | None = Field(description="Mission time of the last reception")
    clock_offset_s: float | None = Field(
        description="Reception time in the records of the station minus mission time; null: without such times"
    )
    unsent: int = Field(description="Released telecommands that wait for transmission")
    unconfirmed: int = Field(description="Transmissions that may not have reached the station")
    changed: UtcTime


class LinkContact(Entity):
    """A predicted, open, ended or missed contact of a link; times are mission time."""

    id: int | None = Field(default=None, description="null: predicted")
    link: str
    station: str
    spacecraft_id: int
    state: ContactState
    reason: str | None = None
    start: UtcTime
    stop: UtcTime | None
    predicted_start: UtcTime | None
    predicted_stop: UtcTime | None
    octets: int = 0
    telecommands: int = 0


class Contacts(Entity):
    """Contacts of all links in order of time, and why contacts of a link cannot be predicted."""

    contacts: list[LinkContact]
    unpredicted: dict[str, str] = Field(
        description="Reason by link", examples=[{"lab": "the mission description states no place of the station"}]
    )
