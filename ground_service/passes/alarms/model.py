"""Entities of alarms."""

from typing import Literal

from pydantic import Field

from ground_service.http.model import Entity, InstanceName, Paging, RequestModel, RequestTime, SpacecraftNumber, UtcTime

AlarmState = Literal["raised", "acknowledged", "cleared", "shelved"]
Severity = Literal["warning", "alarm"]
SHELVED_DAYS_LIMIT = 30
"""Longest time for which an alarm can be shelved."""


class Alarm(Entity):
    """A condition that an operator must know of: an event report, a broken limit, or what stops operations."""

    id: int
    spacecraft_id: int = Field(examples=[76])
    instance: str = Field(examples=["flight"])
    source: Literal["event", "parameter", "operations"]
    name: str = Field(description="Event or parameter", examples=["camera_fault"])
    severity: Severity = Field(description="Worst severity found")
    state: AlarmState
    active: bool = Field(description="Whether the newest telemetry still has the condition")
    count: int = Field(description="Packets with the condition", examples=[82])
    value: float | None = Field(description="Value in the last of these packets; null for an event")
    unit: str = Field(examples=["degC"])
    limits: str = Field(description="Limits of the parameter; empty for an event")
    first: UtcTime = Field(description="Spacecraft time of the first packet with the condition")
    last: UtcTime = Field(description="Spacecraft time of the last packet with the condition")
    raised: UtcTime = Field(description="Time of day at which this service raised the alarm")
    acknowledged_by: str | None = None
    acknowledged: UtcTime | None = Field(default=None, description="Time of day")
    shelved_by: str | None = None
    shelved_until: UtcTime | None = Field(default=None, description="Mission time")
    cleared: UtcTime | None = Field(default=None, description="Time of day")


class AlarmChange(Entity):
    """A change in the life of an alarm."""

    time: UtcTime = Field(description="Time of day")
    actor: str = Field(description="User, or 'telemetry'", examples=["eva"])
    change: str = Field(examples=["acknowledged"])
    comment: str


class AlarmDetail(Alarm):
    """An alarm with its history, oldest change first."""

    procedure: str | None = Field(description="Procedure of the mission description in force")
    history: list[AlarmChange]


class Acknowledgement(RequestModel):
    """Acknowledgement of an alarm."""

    comment: str = Field(default="", max_length=500)


class ShelveRequest(RequestModel):
    """Suppression of an alarm until a mission time; one in the past ends it."""

    until: RequestTime
    comment: str = Field(default="", max_length=500)


class AlarmFilter(Paging):
    """Alarms to list."""

    state: list[AlarmState] | None = Field(default=None, description="Default: any state")
    severity: Severity | None = None
    spacecraft_id: SpacecraftNumber | None = None
    instance: InstanceName | None = None
