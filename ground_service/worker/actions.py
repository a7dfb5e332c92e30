"""Fixed follow-up of events: passes are evaluated and reported, their archives kept, and receivers notified.

A job does what follows one event, derived from the state of the database. A job that is repeated, or that a killed
process left, does all of it again under the same identities, so that it has one result.
"""

import hashlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection

from ground_service.errors import EvaluationError, GroundError, NotFound, fault_of, public_text
from ground_service.evaluation.inputs import align_pass
from ground_service.evaluation.landmarks.service import update_landmarks
from ground_service.evaluation.performance.service import due_report_of_vehicle
from ground_service.evaluation.service import make_report, reevaluate
from ground_service.evaluation.store import get_report, newest_report
from ground_service.ground import Ground
from ground_service.missions import store as missions
from ground_service.missions.automation import Automation, Channel
from ground_service.planning import store as planning
from ground_service.planning.model import WindowRecord
from ground_service.planning.progress import HEARD_TICKS, close_window, note_reason, span_of
from ground_service.regression.pass_archives import keep_pass
from ground_service.store import event_kinds
from ground_service.store.events import LoggedEvent, read_events
from ground_service.store.vehicles import get_vehicle
from ground_service.worker.notifications import NotDelivered, send
from lunar.timescales import format_utc


@dataclass(frozen=True, slots=True)
class Step:
    """Part of the follow-up of an event; `window_id`: the window that states the reason if it fails."""

    name: str
    run: Callable[[Ground], dict[str, Any]]
    window_id: int | None = None


@dataclass(frozen=True, slots=True)
class Message:
    """Notification of an event; `spacecraft_id` is None where it concerns all missions."""

    trigger: str
    text: str
    spacecraft_id: int | None = None
    pass_id: int | None = None
    window_id: int | None = None


def _window_of(connection: Connection, window_id: int) -> WindowRecord | None:
    with suppress(NotFound):
        return planning.get_record(connection, window_id)
    return None


def _settings(connection: Connection, vehicle: int) -> Automation:
    """Return the settings in force of a vehicle; those of descriptions that came with archives have no effect."""
    key = missions.in_force(connection, vehicle)
    return Automation() if key is None else missions.get_mission(connection, key).automation


def _after_window(connection: Connection, logged: LoggedEvent) -> Iterator[Step]:
    event = event_kinds.WindowChanged.of(logged)
    window = _window_of(connection, event.id)
    if window is None or window.pass_id is None:
        return
    settings = _settings(connection, window.vehicle_id)
    if settings.evaluate is False:
        return
    if event.state == "downlinked":
        yield _report_of(window, window.pass_id, logged.number)
    elif event.state == "processed":
        yield _archive_of(window.pass_id)
        yield _monthly_report_of(window.vehicle_id)
        if settings.landmarks:
            yield _landmarks_of(window.pass_id)


def _after_contact(connection: Connection, logged: LoggedEvent) -> Iterator[Step]:
    """Yield the reports of the windows before the end of a contact whose missing telemetry is no longer expected.

    They have telemetry, and telemetry from after their end was received.
    """
    event = event_kinds.ContactEnded.of(logged)
    if event.vehicle_id is None or _settings(connection, event.vehicle_id).evaluate is False:
        return
    for window in planning.open_windows(connection, event.vehicle_id):
        if window.pass_id is None or window.state != "executed" or window.stop.utc_ns > event.stop_utc_ns:
            continue
        after = span_of(connection, window).stop_ticks
        if planning.has_reports_between(connection, event.vehicle_id, after, after + HEARD_TICKS):
            yield _report_of(window, window.pass_id, logged.number, close=True)


def _after_archive(connection: Connection, logged: LoggedEvent) -> Iterator[Step]:
    event = event_kinds.ArchiveImported.of(logged)
    if _settings(connection, event.vehicle_id).evaluate is not False:
        yield _archive_of(event.pass_id)


def _after_report(connection: Connection, logged: LoggedEvent) -> Iterator[Step]:
    """Yield the archive again after late data."""
    event = event_kinds.PassEvaluated.of(logged)
    if event.event is not None and _settings(connection, event.vehicle_id).evaluate is not False:
        yield _archive_of(event.pass_id)


STEPS: Mapping[str, Callable[[Connection, LoggedEvent], Iterator[Step]]] = {
    event_kinds.WindowChanged.event_kind: _after_window,
    event_kinds.ContactEnded.event_kind: _after_contact,
    event_kinds.ArchiveImported.event_kind: _after_archive,
    event_kinds.PassEvaluated.event_kind: _after_report,
}
"""Follow-up by kind of event."""


def steps_after(connection: Connection, event: LoggedEvent) -> Iterator[Step]:
    """Yield the follow-up of an event; none for other kinds, such as those that rules of earlier versions named."""
    if event.kind in STEPS:
        yield from STEPS[event.kind](connection, event)


def run_steps(ground: Ground, number: int) -> dict[str, Any]:
    """Do what follows an event; return the results by name.

    Raises
    ------
    EvaluationError
        A part failed; the others were done.
    """
    done: dict[str, Any] = {"event": number}
    failed = []
    with ground.database.reading() as connection:
        event = _event(connection, number)
        steps = list(steps_after(connection, event))
    for step in steps:
        ground.check_stopping()
        with fault_of(f"{step.name}, event {number}") as faults:
            done[step.name] = step.run(ground)
        failed += [f"{step.name}: {fault}" for fault in faults]
        if faults and step.window_id is not None:
            note_reason(ground, step.window_id, f"{step.name} failed: {faults[0]}")
    if failed:
        raise EvaluationError("; ".join(failed))
    return done


def _event(connection: Connection, number: int) -> LoggedEvent:
    for event in read_events(connection, number - 1, 1):
        if event.number == number:
            return event
    raise NotFound("event", str(number))


def _identity(text: str) -> str:
    """Return the id of what an event makes: the same event again makes the same."""
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def _report_of(window: WindowRecord, pass_id: int, number: int, *, close: bool = False) -> Step:
    """Return the report of a pass: the first one, or a new one if anything in it differs from the last.

    `close`: do not wait for missing packets of the window.
    """
    identity = _identity(f"report {number} {pass_id}")

    def run(ground: Ground) -> dict[str, Any]:
        done = {"pass_id": pass_id, "inputs": align_pass(ground, pass_id)}
        previous = ground.read(newest_report, pass_id, other_than=identity)
        if previous is None:
            done["report_id"] = make_report(ground, pass_id, report_id=identity).report_id
        else:
            again = reevaluate(ground, pass_id, report_id=identity, event=number)
            done["report_id"] = previous.id if again is None else again.report_id
        if close:
            done["window"] = close_window(ground, window.id)
        return done

    return Step(f"report of pass {pass_id}", run, window.id)


def _archive_of(pass_id: int) -> Step:
    def run(ground: Ground) -> dict[str, Any]:
        kept = keep_pass(ground, pass_id)
        return {"archive": kept.digest, "frames": kept.frames, "state": kept.state, "reason": kept.reason}

    return Step(f"archive of pass {pass_id}", run)


def _monthly_report_of(vehicle: int) -> Step:
    """Return the report of the last complete month; late data in that month give a new one."""

    def run(ground: Ground) -> dict[str, Any]:
        made = due_report_of_vehicle(ground, vehicle)
        return {} if made is None else {"report": made.id, "month": made.month, "passes": made.passes}

    return Step("monthly report", run)


def _landmarks_of(pass_id: int) -> Step:
    return Step(
        f"landmarks of pass {pass_id}", lambda ground: update_landmarks(ground, pass_id).model_dump(mode="json")
    )


def _of_failed_window(connection: Connection, logged: LoggedEvent) -> Iterator[Message]:
    event = event_kinds.WindowChanged.of(logged)
    window = _window_of(connection, event.id) if event.state == "failed" else None
    if window is not None:
        text = f"window {window.id} ({window.name}) failed: {window.reason}"
        spacecraft = _spacecraft(connection, window.vehicle_id)
        yield Message("window failed", text, spacecraft, window.pass_id, window.id)


def _of_report(connection: Connection, logged: LoggedEvent) -> Iterator[Message]:
    event = event_kinds.PassEvaluated.of(logged)
    summary = get_report(connection, event.report_id).summary
    text = f"report of pass {event.pass_id}: {summary.get('verdict') or 'no verdict'}"
    yield Message("report done", text, _spacecraft(connection, event.vehicle_id), event.pass_id)


def _of_alarm(connection: Connection, logged: LoggedEvent) -> Iterator[Message]:
    event = event_kinds.AlarmChanged.of(logged)
    if event.state == "raised":
        spacecraft = _spacecraft(connection, event.vehicle_id)
        yield Message("alarm", f"{event.name} ({event.severity})", spacecraft)


def _of_limits(_connection: Connection, logged: LoggedEvent) -> Iterator[Message]:
    broken: dict[int, list[str]] = {}
    for one in event_kinds.LimitsBroken.of(logged).broken:
        broken.setdefault(int(one["spacecraft_id"]), []).append(f"{one['parameter']} {one['limit_state']}")
    for spacecraft, texts in broken.items():
        yield Message("alarm", "; ".join(texts), spacecraft)


def _of_regression(_connection: Connection, logged: LoggedEvent) -> Iterator[Message]:
    event = event_kinds.RegressionJudged.of(logged)
    yield Message("gate done", f"regression {event.id}: {event.verdict}")


def _spacecraft(connection: Connection, vehicle: int) -> int:
    return get_vehicle(connection, vehicle).ccsds_id


MESSAGES: Mapping[str, Callable[[Connection, LoggedEvent], Iterator[Message]]] = {
    event_kinds.WindowChanged.event_kind: _of_failed_window,
    event_kinds.PassEvaluated.event_kind: _of_report,
    event_kinds.AlarmChanged.event_kind: _of_alarm,
    event_kinds.LimitsBroken.event_kind: _of_limits,
    event_kinds.RegressionJudged.event_kind: _of_regression,
}
"""Notifications by kind of event."""


def messages_after(connection: Connection, event: LoggedEvent) -> Iterator[tuple[Message, int, str, Channel]]:
    """Yield the notifications of an event with the spacecraft, name and channel of each receiver in force."""
    channels = missions.channels_in_force(connection) if event.kind in MESSAGES else []
    for message in MESSAGES[event.kind](connection, event) if channels else ():
        for spacecraft, name, channel in channels:
            if message.spacecraft_id in (None, spacecraft):
                yield message, spacecraft, name, channel


def send_messages(ground: Ground, number: int) -> dict[str, Any]:
    """Send the notifications of an event; return the receivers. Each gets it, also if another one fails.

    Raises
    ------
    NotDelivered
        A receiver did not get it.
    """
    with ground.database.reading() as connection:
        event = _event(connection, number)
        messages = list(messages_after(connection, event))
    done: dict[str, Any] = {"event": number}
    failed = []
    for message, spacecraft, name, channel in messages:
        ground.check_stopping()
        identity = f"{_identity(f'notification {number} {spacecraft}')}.{name}"
        subject, content = f"LINNA: {message.text}", _content(message, event, spacecraft)
        receiver = f"{name} of spacecraft {spacecraft}"
        try:
            send(ground.home, channel, identity, subject, content, networks=ground.networks)
            done[receiver] = "delivered"
        except GroundError as error:
            failed.append(f"{receiver}: {public_text(error)}")
    if failed:
        raise NotDelivered("; ".join(failed))
    return done


def _content(message: Message, event: LoggedEvent, spacecraft: int) -> dict[str, Any]:
    return {
        "event": event.number,
        "created": format_utc(event.utc_ns),
        "trigger": message.trigger,
        "text": message.text,
        "spacecraft_id": spacecraft,
        "pass_id": message.pass_id,
        "window_id": message.window_id,
    }
