"""Events that the capabilities publish, each defined once.

A capability publishes an event in the transaction of its change and does not know what follows. `worker.follow_up`
decides that; pages and WebSockets show the same log.
"""

from typing import Any, ClassVar, Self

from pydantic import BaseModel, ConfigDict
from sqlalchemy import Connection

from ground_service.store import events as log
from ground_service.store.database import Database
from ground_service.store.events import LoggedEvent

KNOWN_LIMIT = 1_000_000


class Event(BaseModel):
    """Event of the kind `event_kind`; its fields are the payload in the log."""

    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)

    event_kind: ClassVar[str]

    @classmethod
    def of(cls, logged: LoggedEvent) -> Self:
        """Return the event of a log entry of this kind."""
        return cls.model_validate(logged.payload)


class TelemetryReceived(Event):
    """New packets of a vehicle were stored; `first_ticks` and `last_ticks` are None if no packet has a time.

    `kinds` are the kinds of samples in the packets: housekeeping, states, events, and so on. `first_sample_ticks` and
    `last_sample_ticks` are the times of samples before and after those of all packets; None without such samples.
    """

    event_kind = "telemetry"
    vehicle_id: int
    packets: int
    first_ticks: int | None = None
    last_ticks: int | None = None
    first_sample_ticks: int | None = None
    last_sample_ticks: int | None = None
    kinds: tuple[str, ...] = ()


class TimesDoubted(Event):
    """Packets of a vehicle have an implausible on-board time and are kept apart."""

    event_kind = "times doubted"
    vehicle_id: int
    ingest_id: int
    packets: int


class TelemetryWithdrawn(Event):
    """Packets of a vehicle with these on-board times were removed from the archive."""

    event_kind = "telemetry withdrawn"
    vehicle_id: int
    packets: int
    first_ticks: int
    last_ticks: int


class ReceptionsEntered(Event):
    """Reception times of time reports of a vehicle were entered."""

    event_kind = "receptions"
    vehicle_id: int
    reports: int


class CorrelationChanged(Event):
    """The time correlations of a vehicle were replaced, which moved the UTC of these on-board times; None: none."""

    event_kind = "correlation"
    vehicle_id: int
    segments: int
    first_ticks: int | None = None
    last_ticks: int | None = None


class ClockDoubted(Event):
    """The clock of a station disagrees with others or with the on-board clock: its time reports do not count."""

    event_kind = "clock doubted"
    vehicle_id: int
    station: str
    difference_s: float


class EphemerisAdded(Event):
    """A reference ephemeris was added or withdrawn."""

    event_kind = "ephemeris"
    id: int
    start_utc_ns: int
    stop_utc_ns: int


class CommandsSent(Event):
    """Released telecommands of a vehicle were handed over for transmission."""

    event_kind = "uplink"
    vehicle_id: int
    telecommands: tuple[int, ...]


class CommandStateChanged(Event):
    """A telecommand was entered, decided, sent, or has timed out."""

    event_kind = "telecommand"
    id: int
    state: str


class WindowChanged(Event):
    """A planned window was entered, decided, or changed its state."""

    event_kind = "window"
    id: int
    state: str


class PassEvaluated(Event):
    """A report of a pass was made; `event` is the event that caused it, None for a report on request."""

    event_kind = "report"
    report_id: str
    pass_id: int
    vehicle_id: int
    event: int | None = None


class RegressionJudged(Event):
    """A candidate build was judged."""

    event_kind = "regression"
    id: str
    verdict: str


class MissionAdded(Event):
    """A revision of a mission description was added or taken over by a person."""

    event_kind = "mission"
    id: int
    mission: str
    spacecraft_id: int | None = None


class LinkChanged(Event):
    """The state of a link to a ground station changed."""

    event_kind = "link"
    link: str
    state: str
    reason: str | None = None


class ContactStarted(Event):
    """The first telemetry of a contact of a vehicle was received over a link; times are mission time."""

    event_kind = "contact started"
    contact_id: int
    link: str
    station: str
    vehicle_id: int
    start_utc_ns: int


class ContactEnded(ContactStarted):
    """A contact has ended, and the telemetry received in it is in the archive."""

    event_kind = "contact ended"
    stop_utc_ns: int
    octets: int
    telecommands: int


class ContactMissed(ContactStarted):
    """No telemetry was received in a predicted contact."""

    event_kind = "contact missed"
    stop_utc_ns: int
    reason: str


class RequestChanged(Event):
    """A standing request was added, changed or deleted."""

    event_kind = "request"
    id: int
    state: str


class PlanChanged(Event):
    """The planner added windows for a standing request, or replaced failed ones."""

    event_kind = "plan"
    request_id: int
    windows_added: tuple[int, ...]
    windows_failed: tuple[int, ...] = ()


class JobChanged(Event):
    """A job was added, started or has ended."""

    event_kind = "job"
    id: str
    kind: str
    state: str
    result: dict[str, Any] | None = None


class ArchiveImported(Event):
    """A pass archive was imported with its telemetry."""

    event_kind = "archive imported"
    pass_id: int
    vehicle_id: int


class LandmarkChanged(Event):
    """Landmarks of a spacecraft were found in a pass or decided; `proposed` of them wait for a decision."""

    event_kind = "landmarks"
    spacecraft_id: int
    pass_id: int | None
    proposed: int


class LimitsBroken(Event):
    """Trends of housekeeping parameters are outside their limits."""

    event_kind = "limits"
    broken: list[dict[str, Any]]


class AlarmChanged(Event):
    """An alarm was raised, acknowledged, shelved, unshelved or cleared, or its condition ended or returned."""

    event_kind = "alarm"
    id: int
    vehicle_id: int
    name: str
    severity: str
    state: str


class HandoverChanged(Event):
    """The note of a shift or the hold of a spacecraft was changed."""

    event_kind = "handover"
    spacecraft_id: int
    instance: str
    held_by: str | None = None


class FollowUpFailed(Event):
    """Follow-up work of events failed and is not repeated."""

    event_kind = "follow-up failed"
    work: str
    events: tuple[int, ...]
    error: str


def publish(connection: Connection, event: Event) -> None:
    """Publish an event in the write transaction of this connection."""
    log.publish(connection, event.event_kind, event.model_dump(mode="json", exclude_none=True))


def publish_once(connection: Connection, event: Event) -> None:
    """Publish an event as `publish` does, unless an equal one is in the log; for kinds of rare events."""
    payload = event.model_dump(mode="json", exclude_none=True)
    known = log.read_events(connection, 0, KNOWN_LIMIT, {event.event_kind})
    if all(one.payload != payload for one in known):
        publish(connection, event)


def read_events(database: Database, after: int, limit: int = 200) -> list[LoggedEvent]:
    """Return the events with numbers above `after`, in order."""
    with database.reading() as connection:
        return log.read_events(connection, after, limit)


def last_number(database: Database) -> int:
    """Return the number of the newest event; 0 without events."""
    with database.reading() as connection:
        return log.last_number(connection)
