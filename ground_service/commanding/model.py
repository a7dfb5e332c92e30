"""Entities of telecommands and of the telecommand receiver."""

from __future__ import annotations

from typing import Any

from pydantic import Field

from ground_service.http.model import Entity, Given, InstanceName, SpacecraftNumber
from ground_service.http.times import UtcTime
from ground_service.text import LINE_PATTERN_JSON


class CommandEntry(Given):
    """A telecommand to be queued."""

    name: str = Field(max_length=64, examples=["perform_function"])
    arguments: dict[str, Any] = Field(
        default_factory=dict,
        examples=[{"function_id": "start_observation", "argument_1": 0, "argument_2": 15}],
    )
    spacecraft_id: SpacecraftNumber
    instance: InstanceName = "flight"
    timeout_s: int = Field(default=600, ge=1, le=86_400 * 30)


class Rejection(Given):
    """Why a telecommand is not to be sent."""

    reason: str = Field(min_length=1, max_length=500, pattern=LINE_PATTERN_JSON, examples=["wrong cadence"])


class CommandReport(Entity):
    """A verification report about a telecommand."""

    stage: str = Field(examples=["accepted"])
    ticks: int = Field(description="On-board time of the report, 2^-16 s")
    step: int | None
    failure: str | None


class Telecommand(Entity):
    """A telecommand and its verification state."""

    id: int
    name: str
    arguments: dict[str, Any]
    spacecraft_id: int
    instance: str
    state: str = Field(
        description="queued, carried, released, rejected, sent, accepted, started, completed or failed",
        examples=["queued"],
    )
    critical: bool = Field(description="A second person must release it")
    timed_out: bool
    requested_by: str
    requested: UtcTime
    decided_by: str | None
    decided: UtcTime | None
    reason: str | None
    sequence_count: int | None
    sent: UtcTime | None
    window_id: int | None = Field(description="The planned window that it belongs to")
    carrier_id: int | None = Field(description="The telecommand that carries it into the on-board schedule")
    reports: list[CommandReport]


class UplinkChannel(Entity):
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
    changes: int = Field(description="Number of changes of the word in the reception")
    frames_lockout: int
    frames_wait: int
    frames_retransmit: int
    frames_no_rf: int
    ingest_id: int = Field(examples=[1])
    received: UtcTime


class UplinkState(Entity):
    """State of a telecommand receiver according to the newest telemetry; no channels if telemetry does not show it."""

    spacecraft_id: int = Field(examples=[76])
    instance: str = Field(examples=["flight"])
    channels: list[UplinkChannel]
