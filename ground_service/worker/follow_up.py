"""Follow-up work of events: what happens after telemetry, ephemerides, uplinks and reports.

A consumer of the event log with one durable position in the database. Every process has one (one-shot commands, the
server, workers): it handles the events of a commit before the caller continues, one process at a time. Long work is a
job, which runs in the process or, with a broker, in the Celery workers. Work is derived from the state of the database,
so that doing it again gives the same result: events that a killed process has left are handled by the next process, and
an event that two processes handle changes nothing twice.
"""

import hashlib
import logging
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress

import numpy as np
from sqlalchemy import Connection

from ground_service.errors import PASSING, NotFound, fault_of
from ground_service.ground import Ground
from ground_service.ingest.doubt_store import needs_review, review_times
from ground_service.ingest.service import undecoded_vehicles
from ground_service.jobs.service import add_job, queued_arguments
from ground_service.missions.timekeeping.core import ticks_of_times
from ground_service.missions.timekeeping.recorrelation import recorrelate
from ground_service.missions.timekeeping.store import load_correlations, vehicles_with_receptions
from ground_service.passes.alarms.service import examine_again, examine_packets, note_finding
from ground_service.passes.span import REACH_NS, pass_span
from ground_service.passes.store import get_pass, reported_times, reported_without_ephemeris
from ground_service.planning.progress import advance_windows
from ground_service.planning.standing import needs_plan, planned_with
from ground_service.planning.store import get_record
from ground_service.store import events
from ground_service.store.event_kinds import (
    ClockDoubted,
    CommandsSent,
    ContactEnded,
    ContactMissed,
    CorrelationChanged,
    EphemerisAdded,
    FollowUpFailed,
    MissionAdded,
    PassEvaluated,
    ReceptionsEntered,
    RequestChanged,
    TelemetryReceived,
    TelemetryWithdrawn,
    TimesDoubted,
    WindowChanged,
    publish,
)
from ground_service.store.events import LoggedEvent
from ground_service.worker.actions import MESSAGES, STEPS, messages_after, steps_after
from ground_service.worker.jobs import run_job

log = logging.getLogger(__name__)

CONSUMER = "follow-up"
BATCH = 1000
WAIT_S = 0.05

Work = tuple[str, int]
"""Name of the work and the id of the vehicle, pass or window that it is for."""

Following = Callable[[Ground, LoggedEvent], Iterator[Work]]
"""Function that returns the work after an event."""

Start = Callable[[str], object]
"""Function that runs a job, or has it run."""


def _after_telemetry(_ground: Ground, logged: LoggedEvent) -> Iterator[Work]:
    event: TelemetryReceived | TelemetryWithdrawn
    if logged.kind == TelemetryWithdrawn.event_kind:
        event = TelemetryWithdrawn.of(logged)
        yield "decode", event.vehicle_id
        yield "alarms again", event.vehicle_id
    else:
        event = TelemetryReceived.of(logged)
    if _ground.read(needs_review, event.vehicle_id, event.first_ticks):
        yield "review times", event.vehicle_id
    yield "recorrelate", event.vehicle_id
    yield "alarms", event.vehicle_id
    yield "advance windows", event.vehicle_id
    yield from _again(_ground, event)


def _after_correlation(ground: Ground, logged: LoggedEvent) -> Iterator[Work]:
    event = CorrelationChanged.of(logged)
    yield "advance windows", event.vehicle_id
    yield from _again(ground, event)


def _again(ground: Ground, event: TelemetryReceived | TelemetryWithdrawn | CorrelationChanged) -> Iterator[Work]:
    """Yield the evaluation of the passes with a report that contain the on-board times of an event."""
    if event.first_ticks is not None and event.last_ticks is not None:
        with ground.database.reading() as connection:
            found = _reported_passes(connection, event.vehicle_id, event.first_ticks, event.last_ticks)
        yield from (("re-evaluate", pass_id) for pass_id in found)


def _after_doubt(_ground: Ground, logged: LoggedEvent) -> Iterator[Work]:
    yield "note finding", logged.number
    if logged.kind == TimesDoubted.event_kind:
        yield "review times", TimesDoubted.of(logged).vehicle_id


def _of_vehicle(work: str) -> Following:
    """Return work for the vehicle of an event, and for no other: its plan does not depend on the others' contacts."""
    return lambda _ground, logged: iter([(work, int(logged.payload["vehicle_id"]))])


def _after_ephemeris(ground: Ground, logged: LoggedEvent) -> Iterator[Work]:
    event = EphemerisAdded.of(logged)
    with ground.database.reading() as connection:
        vehicles = vehicles_with_receptions(connection, event.start_utc_ns, event.stop_utc_ns)
        passes = reported_without_ephemeris(connection, event.start_utc_ns, event.stop_utc_ns)
    for vehicle in vehicles:
        yield "recorrelate", vehicle
    for pass_id in passes:
        yield "re-evaluate", pass_id
    for vehicle in planned_with(ground, event.id):
        yield "plan", vehicle


def _after_mission(ground: Ground, logged: LoggedEvent) -> Iterator[Work]:
    event = MissionAdded.of(logged)
    if event.spacecraft_id is not None:
        for vehicle in undecoded_vehicles(ground, event.spacecraft_id):
            yield "decode", vehicle
        yield "plan", 0


def _after_window(ground: Ground, logged: LoggedEvent) -> Iterator[Work]:
    event = WindowChanged.of(logged)
    if event.state == "failed":
        with suppress(NotFound):
            yield "plan", ground.read(get_record, event.id).vehicle_id


FOLLOWING: Mapping[str, Following] = {
    TelemetryReceived.event_kind: _after_telemetry,
    TelemetryWithdrawn.event_kind: _after_telemetry,
    TimesDoubted.event_kind: _after_doubt,
    ClockDoubted.event_kind: _after_doubt,
    ReceptionsEntered.event_kind: _of_vehicle("recorrelate"),
    CorrelationChanged.event_kind: _after_correlation,
    EphemerisAdded.event_kind: _after_ephemeris,
    CommandsSent.event_kind: _of_vehicle("advance windows"),
    PassEvaluated.event_kind: _of_vehicle("advance windows"),
    MissionAdded.event_kind: _after_mission,
    WindowChanged.event_kind: _after_window,
    ContactEnded.event_kind: _of_vehicle("plan"),
    ContactMissed.event_kind: _of_vehicle("plan"),
    RequestChanged.event_kind: lambda _ground, _logged: iter([("plan", 0)]),
}
"""The work that keeps derived data up to date after an event, by its kind."""

KINDS = frozenset({*FOLLOWING, *STEPS, *MESSAGES})
"""Kinds of events that are read: those with such work, and those with jobs or notifications."""


def _work_of(ground: Ground, event: LoggedEvent) -> Iterator[Work]:
    """Yield the work that follows an event; passes are evaluated after derived data are up to date."""
    if event.kind in FOLLOWING:
        yield from FOLLOWING[event.kind](ground, event)
    with ground.database.reading() as connection:
        if any(True for _ in steps_after(connection, event)):
            yield "act", event.number
        if any(True for _ in messages_after(connection, event)):
            yield "notify", event.number


def _review(ground: Ground, vehicle: int, _event: int) -> None:
    review_times(ground, vehicle)


def _note_finding(ground: Ground, number: int, _event: int) -> None:
    [logged] = ground.read(events.read_events, number - 1, 1)
    if logged.kind == TimesDoubted.event_kind:
        times = TimesDoubted.of(logged)
        note_finding(ground, times.vehicle_id, "implausible_time", times.packets)
    else:
        clock = ClockDoubted.of(logged)
        note_finding(ground, clock.vehicle_id, f"station_clock {clock.station}"[:64], value=clock.difference_s)


def _alarms_again(ground: Ground, vehicle: int, _event: int) -> None:
    examine_again(ground, vehicle)


def _recorrelate(ground: Ground, vehicle: int, _event: int) -> None:
    recorrelate(ground, vehicle)


def _alarms(ground: Ground, vehicle: int, _event: int) -> None:
    examine_packets(ground, vehicle)


def _advance(ground: Ground, vehicle: int, _event: int) -> None:
    advance_windows(ground, vehicle)


def _reevaluate(ground: Ground, pass_id: int, event: int) -> str | None:
    """Add the job of a re-evaluation, unless one waits already, which will find the same data."""
    with ground.database.writing() as connection:
        waiting = queued_arguments(connection, "re-evaluation")
        if any(arguments["pass_id"] == pass_id for arguments in waiting):
            return None
        identity = _job_id("re-evaluation", pass_id, event)
        return add_job(connection, "re-evaluation", {"pass_id": pass_id, "event": event}, job_id=identity)


def _decode(ground: Ground, vehicle: int, event: int) -> str:
    """Add the job that decodes the packets of a vehicle with a new mission description."""
    return ground.write(add_job, "redecode", {"vehicle_id": vehicle}, job_id=_job_id("decode", vehicle, event))


def _add_job_of_event(kind: str) -> Callable[[Ground, int, int], str]:
    """Return a function that adds a job of an event."""

    def add(ground: Ground, number: int, event: int) -> str:
        return ground.write(add_job, kind, {"event": number}, job_id=_job_id(kind, number, event))

    return add


def _plan(ground: Ground, vehicle: int, event: int) -> str | None:
    """Add the job that brings the plan of a vehicle up to date, 0: of all, if there is anything to plan."""
    if not needs_plan(ground):
        return None
    with ground.database.writing() as connection:
        arguments = {"vehicle_id": vehicle} if vehicle else {}
        return add_job(connection, "plan", arguments, job_id=_job_id("plan", vehicle, event))


DOING: Mapping[str, Callable[[Ground, int, int], str | None]] = {
    "review times": _review,
    "note finding": _note_finding,
    "recorrelate": _recorrelate,
    "alarms again": _alarms_again,
    "alarms": _alarms,
    "advance windows": _advance,
    "re-evaluate": _reevaluate,
    "decode": _decode,
    "act": _add_job_of_event("automation"),
    "notify": _add_job_of_event("notification"),
    "plan": _plan,
}
"""Functions of the work in the order in which they run; each returns the id of a job to start, or None."""

_ORDER = {name: number for number, name in enumerate(DOING)}


_here = threading.local()


def _draining() -> set[int]:
    """Return the grounds whose events this thread handles now; waiting for itself, it would wait for ever."""
    if not hasattr(_here, "grounds"):
        _here.grounds = set()
    grounds: set[int] = _here.grounds
    return grounds


class FollowUp:
    """Consumer of the event log in this process."""

    def __init__(self, ground: Ground, start: Start | None = None) -> None:
        self._ground = ground
        self._start = start or (lambda job_id: run_job(ground, job_id))
        self._lock = threading.Lock()

    def __call__(self, kinds: frozenset[str]) -> None:
        """Handle the events of a commit; the commit has succeeded, so errors are logged."""
        if not kinds.isdisjoint(KINDS):
            self.drain()

    def drain(self) -> None:
        """Handle all events so far, or wait until another thread or process has handled them."""
        if id(self._ground) in _draining():
            return  # an event of the work itself, which the loop below handles, also that of another consumer
        try:
            for job_id in self._drained():
                self._start(job_id)
        except PASSING as error:
            log.warning("follow-up work will be repeated: %s", error)

    def _drained(self) -> list[str]:
        jobs: list[str] = []
        database = self._ground.database
        with database.reading() as connection:
            last = events.last_number(connection)
        while True:
            with self._lock, database.alone("events") as alone:
                if alone:
                    _draining().add(id(self._ground))
                    try:
                        while self._handle_batch(jobs):
                            pass
                    finally:
                        _draining().discard(id(self._ground))
                    return jobs
            with database.reading() as connection:
                if events.position_of(connection, CONSUMER) >= last:
                    return jobs
            self._ground.check_stopping()
            time.sleep(WAIT_S)

    def _handle_batch(self, jobs: list[str]) -> bool:
        """Handle the next events, equal work once; return whether there were any."""
        ground = self._ground
        with ground.database.reading() as connection:
            position = events.position_of(connection, CONSUMER)
            batch = events.read_events(connection, position, BATCH, KINDS)
        work: dict[Work, list[int]] = {}
        failed = []
        for event in batch:
            with fault_of(f"work of event {event.number} ({event.kind})") as faults:
                for one in _work_of(ground, event):
                    work.setdefault(one, []).append(event.number)
            failed += [FollowUpFailed(work=event.kind, events=(event.number,), error=one) for one in faults]
        for one in sorted(work, key=lambda one: (_ORDER[one[0]], one[1])):
            ground.check_stopping()
            name = f"{one[0]} {one[1]}"
            with fault_of(f"follow-up work {name}") as faults:
                job_id = DOING[one[0]](ground, one[1], work[one][-1])
                if job_id is not None:
                    jobs.append(job_id)
            failed += [FollowUpFailed(work=name, events=tuple(work[one]), error=fault) for fault in faults]
        if batch:
            with ground.database.writing() as connection:
                events.advance(connection, CONSUMER, batch[-1].number)
                for fault in failed:
                    publish(connection, fault)
        return bool(batch)


def follow_in_process(ground: Ground, start: Start | None = None) -> FollowUp:
    """Handle the events of this process in the committing thread; return the consumer.

    Parameters
    ----------
    start
        Function that starts a job of the follow-up work; None: run it before the commit's caller continues.
    """
    follow_up = FollowUp(ground, start)
    ground.database.listeners.add(follow_up)
    return follow_up


def _reported_passes(connection: Connection, vehicle: int, first_ticks: int, last_ticks: int) -> list[int]:
    """Return the passes of a vehicle that have a report and that contain on-board times of an interval."""
    keys, start_ns, stop_ns = np.array(reported_times(connection, vehicle), dtype=np.int64).reshape(-1, 3).T
    correlations = load_correlations(connection, vehicle)
    start_ticks = ticks_of_times(start_ns - REACH_NS, correlations)
    stop_ticks = ticks_of_times(stop_ns + REACH_NS, correlations)
    near = keys[(start_ticks <= last_ticks) & (first_ticks <= stop_ticks)].tolist()
    spans = ((key, pass_span(connection, get_pass(connection, key))) for key in near)
    return [key for key, span in spans if span.start_ticks <= last_ticks and first_ticks <= span.stop_ticks]


def _job_id(kind: str, key: int, event: int) -> str:
    """Return the id of the job of an event: the same event again adds the same job."""
    return hashlib.blake2b(f"{kind} {key} {event}".encode(), digest_size=16).hexdigest()
