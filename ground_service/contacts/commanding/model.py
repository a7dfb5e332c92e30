"""Entities of telecommands and of the telecommand receiver."""

from dataclasses import dataclass
from typing import Any, Literal

from pydantic import Field

from ground_service.contacts.commanding.core import DUPLICATE, OUT_OF_SEQUENCE, STAGES, CommandFate
from ground_service.http.model import Entity, InstanceName, Paging, RequestModel, SpacecraftNumber, UtcTime
from ground_service.toml import LINE_PATTERN_JSON
from lunar.timescales import format_utc, utc_ns_from_ticks
from tmtc.dictionary.arguments import argument_text
from tmtc.dictionary.codes import FAILURES
from tmtc.link.frames import UplinkSeen

_FAILURES = dict(FAILURES)
REMEDY = "; the payload expects other sequence counts: send perform_function resynchronise_commands first"


class CommandEntry(RequestModel):
    """A telecommand to be queued."""

    name: str = Field(max_length=64, examples=["perform_function"])
    arguments: dict[str, Any] = Field(
        default_factory=dict, examples=[{"function_id": "start_observation", "argument_1": 0, "argument_2": 15}]
    )
    spacecraft_id: SpacecraftNumber
    instance: InstanceName = "flight"
    timeout_s: int = Field(default=600, ge=1, le=86_400 * 30)


class Rejection(RequestModel):
    """Reason for the rejection of a telecommand."""

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
    text: str = Field(description="The arguments with names and units", examples=["duration 900 s, cadence 15 s"])
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
    release: UtcTime | None = Field(
        default=None, description="Release by the on-board clock, not corrected; null: not time-tagged"
    )
    reports: list[CommandReport]
    remark: str = Field(description="Reason of failure, rejection or time-out; empty: none of them")


class CommandRecord(Entity):
    """Row of a telecommand; `state` is the stored state: queued, carried, released, rejected or sent."""

    id: int
    vehicle_id: int
    name: str
    arguments: dict[str, Any]
    state: str
    critical: bool
    timeout_s: int
    requested_by: str
    created_utc_ns: int
    decided_by: str | None
    decided_utc_ns: int | None
    reason: str | None
    sequence_count: int | None
    request_id: int | None
    octets: bytes | None
    sent_utc_ns: int | None
    sent_after_ticks: int | None
    timeout_noted_utc_ns: int | None
    window_id: int | None
    carrier_id: int | None
    mission_id: int | None
    send_before_utc_ns: int | None


def onboard_time(ticks: float) -> str:
    """Return the UTC of an on-board clock without error."""
    return format_utc(utc_ns_from_ticks(int(ticks)), 0)


@dataclass(frozen=True, slots=True)
class CommandOctets:
    """Sequence count and octets of a released telecommand, which never change."""

    sequence_count: int
    octets: bytes

    @property
    def request_id(self) -> int:
        """The first four octets, which name the telecommand in verification reports."""
        return int.from_bytes(self.octets[:4], "big")


@dataclass(frozen=True, slots=True)
class CommandView:
    """A telecommand and its verification; `fate` is None before it is sent."""

    record: CommandRecord
    spacecraft_id: int
    instance: str
    fate: CommandFate | None

    @property
    def state(self) -> str:
        """The verification state if the telecommand was sent, else the stored state."""
        return self.record.state if self.fate is None else self.fate.state

    @property
    def remark(self) -> str:
        """Reason why the telecommand failed, was rejected or timed out."""
        if self.fate is None:
            return self.record.reason or ""
        stages = [STAGES.get(report.subtype, str(report.subtype)) for report in self.fate.reports]
        if self.fate.timed_out:
            return f"no report of completion in time, last report: {stages[-1] if stages else 'none'}"
        failed = (
            f"{stage}: {_FAILURES.get(report.failure_code or 0, str(report.failure_code)).replace('_', ' ')}"
            + (REMEDY if report.failure_code == OUT_OF_SEQUENCE else "")
            for stage, report in zip(stages, self.fate.reports, strict=True)
            if report.failure_code not in (None, DUPLICATE)
        )
        return next(failed, "") if self.fate.state == "failed" else ""

    @property
    def telecommand(self) -> Telecommand:
        """The telecommand as an entity."""
        ticks = self.record.arguments.get("release_ticks")
        return Telecommand.of(
            dict(self.record),
            text=argument_text(self.record.name, self.record.arguments, onboard_time),
            spacecraft_id=self.spacecraft_id,
            instance=self.instance,
            state=self.state,
            timed_out=self.fate is not None and self.fate.timed_out,
            requested=self.record.created_utc_ns,
            remark=self.remark,
            release=None if ticks is None else utc_ns_from_ticks(int(ticks)),
            reports=[
                CommandReport(
                    stage=STAGES.get(report.subtype, str(report.subtype)),
                    ticks=report.ticks,
                    step=report.step,
                    failure=None
                    if report.failure_code is None
                    else _FAILURES.get(report.failure_code, str(report.failure_code)),
                )
                for report in (() if self.fate is None else self.fate.reports)
            ],
        )


class Handover(Entity):
    """Handover of a spacecraft to the next shift: a note, and the hold of its telecommands."""

    spacecraft_id: int = Field(examples=[76])
    instance: str = Field(examples=["flight"])
    note: str = ""
    noted_by: str | None = None
    noted: UtcTime | None = None
    held_by: str | None = Field(default=None, description="Person who stopped release and transmission; null: nobody")
    held: UtcTime | None = Field(default=None, description="Since when")
    hold_reason: str = ""


class HandoverNote(RequestModel):
    """Note for the next shift; replaces the one before, which the audit log keeps."""

    note: str = Field(max_length=2000, examples=["Camera warm since orbit 12, see alarm 3."])


class HandoverFilter(Paging):
    """Notes and holds to list."""

    spacecraft_id: SpacecraftNumber | None = None
    instance: InstanceName | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class UplinkChannel(UplinkSeen):
    """A telecommand channel as the newest reception shows it; flags are those of its newest control word.

    `report_value` is the number of the sequence-controlled frame that is expected next, `farm_b_counter` the number of
    accepted expedited frames modulo 4.
    """

    ingest_id: int
    received: UtcTime


class UplinkState(Entity):
    """State of a telecommand receiver according to the newest telemetry; no channels if telemetry does not show it."""

    spacecraft_id: int = Field(examples=[76])
    instance: str = Field(examples=["flight"])
    channels: list[UplinkChannel]


class TelecommandFilter(Paging):
    """Telecommands to list."""

    state: Literal["queued", "carried", "released", "rejected", "sent"] | None = Field(
        default=None, description="Stored state"
    )
    window_id: list[int] | None = Field(default=None, description="Telecommands of these planned windows")
