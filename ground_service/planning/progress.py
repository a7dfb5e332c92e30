"""Windows brought up to date with what came down: called after every ingest, uplink and report.

The state is worked out afresh from the archive each time (`planning.window_states`), so telemetry may come in any
order. A window that has telemetry is given a pass, which its report is then made of.
"""

from typing import Any

from sqlalchemy import Connection

from ground_service.clock import mission_now_ns, utc_now_ns
from ground_service.contacts.commanding.store import views_of_window
from ground_service.ground import Ground
from ground_service.missions import store as missions
from ground_service.passes.downlink_accounting import account_sequence
from ground_service.passes.span import STARTED, STOPPED, PassSpan, observation_events, observed_span
from ground_service.passes.store import received_frames
from ground_service.planning import store
from ground_service.planning.model import WindowRecord
from ground_service.planning.window_states import WindowEvidence, state_of
from ground_service.store.event_kinds import WindowChanged, publish
from ground_service.store.vehicles import lock_spacecraft
from ground_service.telemetry import store as telemetry

REASON_LENGTH = 500
DELETE = "delete_activity"
HEARD_TICKS = 7 * 86_400 << 16
AWAITED_TICKS = 12 * 3600 << 16
"""On-board time for which missing packets of a window without images are expected after its end."""

NEAR_TICKS = 6 * 3600 << 16
"""Packets this far before and after a window show whether packets between them are missing."""


def advance_windows(ground: Ground, vehicle: int) -> int:
    """Bring the approved windows of a vehicle up to date; how many changed their state."""
    with ground.database.reading() as connection:
        if not store.open_windows(connection, vehicle):
            return 0
    changed: list[tuple[int, str]] = []
    with ground.database.writing() as connection:
        lock_spacecraft(connection, vehicle)
        for window in store.open_windows(connection, vehicle):
            state = _advance(connection, window)
            if state is not None:
                changed.append((window.id, state))
        for window_id, state in changed:
            publish(connection, WindowChanged(id=window_id, state=state))
    return len(changed)


def close_window(ground: Ground, window_id: int) -> str:
    """Do not wait for packets of a window that are missing; return its state then.

    A window that was reported and that telemetry from after its end has followed is processed.
    """
    with ground.database.writing() as connection:
        store.close_window(connection, window_id)
        vehicle = store.get_record(connection, window_id).vehicle_id
    advance_windows(ground, vehicle)
    with ground.database.reading() as connection:
        return store.get_window(connection, window_id).state


def note_reason(ground: Ground, window_id: int, reason: str) -> None:
    """Record why a window does not get its telecommands, or is not processed; its next state replaces the reason."""
    with ground.database.writing() as connection:
        window = store.get_record(connection, window_id)
        if window.state in ("approved", "executed", "downlinked"):
            store.change_window(connection, window, reason=reason[:REASON_LENGTH])


def _advance(connection: Connection, window: WindowRecord) -> str | None:
    """Return the new state of a window; None if it has not changed, or the window was decided meanwhile."""
    evidence = _evidence(connection, window)
    state, reason = state_of(evidence)
    values: dict[str, Any] = {}
    if evidence.frames > 0 and window.pass_id is None and state != "failed":
        mission_id = window.mission_id or missions.in_force(connection, window.vehicle_id)
        pass_id = store.add_pass(connection, window, mission_id, utc_now_ns())
        values |= {"pass_id": pass_id, "mission_id": mission_id}
    is_remarked = window.decision == "cancelling" and reason not in (None, window.reason)
    if state != window.state or is_remarked:
        values |= {"state": state, "reason": reason, "changed_utc_ns": utc_now_ns()}
    if values and not store.change_window(connection, window, **values):
        return None
    return None if state == window.state else state


def span_of(connection: Connection, window: WindowRecord) -> PassSpan:
    """Return the interval of on-board time of a window."""
    return observed_span(connection, window.vehicle_id, window.start.utc_ns, window.stop.utc_ns, window.id)


def _evidence(connection: Connection, window: WindowRecord) -> WindowEvidence:
    vehicle, predecessor = window.vehicle_id, window.predecessor_id
    span = span_of(connection, window)
    start, stop = span.start_ticks, span.stop_ticks
    events = {event for _, event, _ in observation_events(connection, span)}
    frames = received_frames(connection, vehicle, span.dictionary_version, start, stop)
    received_after = store.has_reports_between(connection, vehicle, stop, stop + HEARD_TICKS)
    awaited = (
        frames == 0
        and received_after
        and not store.has_reports_between(connection, vehicle, stop + AWAITED_TICKS, stop + HEARD_TICKS)
        and _is_interrupted(connection, vehicle, start, stop)
    )
    views = views_of_window(connection, window.id, utc_now_ns())
    commands = [one for one in views if (one.record.name == DELETE) == (window.decision == "cancelling")]
    failed = (f"{view.record.name} {view.remark}" for view in commands if view.state == "failed")
    return WindowEvidence(
        decision=window.decision,
        replaced=store.is_replaced(connection, window),
        predecessor_failed=predecessor is not None and store.get_window(connection, predecessor).state == "failed",
        command_states=tuple(view.state for view in commands),
        deletion_states=tuple(view.state for view in commands if view.record.name == DELETE),
        failure=next(failed, ""),
        frames=frames,
        started=STARTED in events,
        stopped=STOPPED in events,
        received_after=received_after,
        ended=mission_now_ns() >= window.stop.utc_ns,
        awaited=awaited,
        lost=_lost(connection, vehicle, start, stop) if frames else None,
        reported=window.pass_id is not None and store.has_report(connection, window.pass_id),
        closed=window.closed,
    )


def _is_interrupted(connection: Connection, vehicle: int, start_ticks: int, stop_ticks: int) -> bool:
    """Return whether packets are missing between the last ones before a span and the first ones after it."""
    headers = telemetry.packet_headers(connection, vehicle, start_ticks - NEAR_TICKS, stop_ticks + NEAR_TICKS)
    for apid in set(headers["apid"].tolist()):
        mine = headers["apid"] == apid
        ticks, counts = headers["ticks"][mine], headers["sequence_count"][mine]
        first = ticks[ticks < start_ticks].max(initial=start_ticks - NEAR_TICKS)
        last = ticks[ticks > stop_ticks].min(initial=stop_ticks + NEAR_TICKS)
        here = (ticks >= first) & (ticks <= last)
        if account_sequence(ticks[here], counts[here]).lost:
            return True
    return False


def _lost(connection: Connection, vehicle: int, start_ticks: int, stop_ticks: int) -> int:
    """Return the number of lost packets of a span."""
    headers = telemetry.packet_headers(connection, vehicle, start_ticks, stop_ticks)
    return sum(
        account_sequence(headers["ticks"][here], headers["sequence_count"][here]).lost
        for here in (headers["apid"] == apid for apid in set(headers["apid"].tolist()))
    )
