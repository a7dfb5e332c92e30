"""Use cases of the automation: actions that an event causes, rules in force, approval by persons."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from sqlalchemy import Connection

from ground_service.access.service import audit
from ground_service.clock import utc_now_ns
from ground_service.events import (
    AlarmChanged,
    ArchiveImported,
    ContactEnded,
    ContactStarted,
    CorrelationChanged,
    LimitsBroken,
    PassEvaluated,
    RegressionJudged,
    TelemetryReceived,
    WindowChanged,
)
from ground_service.ground import Ground
from ground_service.missions.model import Mission
from ground_service.missions.rules import DEFAULT_RULES, Rule
from ground_service.store.events import LoggedEvent
from ground_service.worker.automation import store
from ground_service.worker.automation.core import Occurrence, planned_actions
from ground_service.worker.automation.model import AutomationAction, RuleInForce

ENDED = ("executed", "downlinked", "failed")


def _of_window(connection: Connection, logged: LoggedEvent) -> list[Occurrence]:
    event = WindowChanged.of(logged)
    trigger = "window processed" if event.state == "processed" else "window ended"
    if event.state != "processed" and event.state not in ENDED:
        return []
    found = store.window_of(connection, event.id)
    return [] if found is None else [replace(found, trigger=trigger, window_state=event.state)]


def _of_telemetry(_connection: Connection, logged: LoggedEvent) -> list[Occurrence]:
    event = TelemetryReceived.of(logged)
    return [Occurrence("telemetry received", event.vehicle_id, text=f"{event.packets} packets received")]


def _of_correlation(_connection: Connection, logged: LoggedEvent) -> list[Occurrence]:
    event = CorrelationChanged.of(logged)
    return [Occurrence("correlation changed", event.vehicle_id, text=f"{event.segments} segments")]


def _of_archive(connection: Connection, logged: LoggedEvent) -> list[Occurrence]:
    event = ArchiveImported.of(logged)
    text = f"archive of pass {event.pass_id} imported"
    return [Occurrence("archive imported", event.vehicle_id, event.pass_id, text=text)]


def _of_report(connection: Connection, logged: LoggedEvent) -> list[Occurrence]:
    event = PassEvaluated.of(logged)
    summary = store.report_summary(connection, event.report_id)
    return [
        Occurrence(
            "report done",
            event.vehicle_id,
            event.pass_id,
            store.window_of_pass(connection, event.pass_id),
            verdict=summary.get("verdict_level"),
            requirement_failed=any(one["status"] == "not met" for one in summary.get("requirements", ())),
            reevaluation=event.event is not None,
            frames=summary.get("frames"),
            text=f"report of pass {event.pass_id}: {summary.get('verdict') or 'no verdict'}",
        )
    ]


def _of_gate(_connection: Connection, logged: LoggedEvent) -> list[Occurrence]:
    event = RegressionJudged.of(logged)
    return [Occurrence("gate done", verdict=event.verdict, text=f"regression {event.id}: {event.verdict}")]


def _of_raised(_connection: Connection, logged: LoggedEvent) -> list[Occurrence]:
    event = AlarmChanged.of(logged)
    if event.state != "raised":
        return []
    return [Occurrence("alarm", event.vehicle_id, text=f"{event.name} ({event.severity})")]


def _of_alarm(connection: Connection, logged: LoggedEvent) -> list[Occurrence]:
    broken: dict[int, list[str]] = {}
    for one in LimitsBroken.of(logged).broken:
        vehicle = store.spacecraft_vehicle(connection, int(one["spacecraft_id"]), str(one["instance"]))
        if vehicle is not None:
            broken.setdefault(vehicle, []).append(f"{one['parameter']} {one['limit_state']}")
    return [Occurrence("alarm", vehicle, text="; ".join(texts)) for vehicle, texts in broken.items()]


def _of_contact_start(_connection: Connection, logged: LoggedEvent) -> list[Occurrence]:
    event = ContactStarted.of(logged)
    return [
        Occurrence("contact started", event.vehicle_id, text=f"contact with {event.station or event.link}")
    ]


def _of_contact(connection: Connection, logged: LoggedEvent) -> list[Occurrence]:
    """Return the contact, and the windows before it whose telemetry and that of the time after them was received."""
    event = ContactEnded.of(logged)
    text = f"contact with {event.station or event.link} ended"
    found = [Occurrence("contact ended", event.vehicle_id, text=text)]
    if event.vehicle_id is not None:
        found += [
            replace(one, trigger="contact ended", of_contact=True)
            for one in store.delivered_windows(connection, event.vehicle_id, event.stop_utc_ns)
        ]
    return found


OCCURRENCES: Mapping[str, Callable[[Connection, LoggedEvent], list[Occurrence]]] = {
    WindowChanged.event_kind: _of_window,
    TelemetryReceived.event_kind: _of_telemetry,
    CorrelationChanged.event_kind: _of_correlation,
    ArchiveImported.event_kind: _of_archive,
    PassEvaluated.event_kind: _of_report,
    RegressionJudged.event_kind: _of_gate,
    LimitsBroken.event_kind: _of_alarm,
    AlarmChanged.event_kind: _of_raised,
    ContactStarted.event_kind: _of_contact_start,
    ContactEnded.event_kind: _of_contact,
}
"""What rules see of each kind of event."""


def has_actions(ground: Ground, event: LoggedEvent) -> bool:
    """Return whether rules have actions for an event."""
    with ground.database.reading() as connection:
        return bool(_due(connection, event))


def record_actions(ground: Ground, event: LoggedEvent) -> None:
    """Record the actions that an event causes; recording the same event again changes nothing."""
    with ground.database.writing() as connection:
        now = utc_now_ns()
        for mission_id, rules, occurrence in _due(connection, event):
            for planned in planned_actions(rules, [occurrence]):
                store.add_action(connection, event.number, planned, mission_id, now)


def _due(connection: Connection, event: LoggedEvent) -> list[tuple[int | None, tuple[Rule, ...], Occurrence]]:
    """Return the occurrences of an event for which rules have actions, with the rules and their revision."""
    found = []
    for occurrence in OCCURRENCES[event.kind](connection, event):
        for mission_id, rules in _rules_for(connection, occurrence):
            if next(planned_actions(rules, [occurrence]), None) is not None:
                found.append((mission_id, rules, occurrence))
    return found


def _rules_for(connection: Connection, occurrence: Occurrence) -> list[tuple[int | None, tuple[Rule, ...]]]:
    """Return the rules that apply to an occurrence; to one without a vehicle those of all missions."""
    if occurrence.vehicle_id is None:
        return [
            (key, mission.automation.rules_in_force)
            for _, key, mission in store.missions_in_force(connection)
        ]
    key, mission = store.mission_of_vehicle(connection, occurrence.vehicle_id)
    return [(key, DEFAULT_RULES if mission is None else mission.automation.rules_in_force)]


def list_rules(ground: Ground) -> list[RuleInForce]:
    """Return the rules in force of every spacecraft, and the default rules of all others."""
    missions = ground.read(store.missions_in_force)
    stated = [
        _in_force(rule, spacecraft, mission)
        for spacecraft, _, mission in missions
        for rule in mission.automation.rules_in_force
    ]
    return [*stated, *(_in_force(rule, None, None) for rule in DEFAULT_RULES)]


def _in_force(rule: Rule, spacecraft: int | None, mission: Mission | None) -> RuleInForce:
    return RuleInForce(
        spacecraft_id=spacecraft,
        mission=None if mission is None else mission.name,
        default=mission is None or rule not in (mission.automation.rules or ()),
        name=rule.name,
        on=rule.on,
        when=rule.when.model_dump(mode="json", exclude_none=True),
        do=list(rule.do),
        approval=rule.approval,
        notify=list(rule.notify or ()),
    )


def decide(ground: Ground, action_id: int, *, approve: bool, actor: str) -> AutomationAction:
    """Approve or refuse an action that waits for it, and the actions after it in the same rule.

    Raises
    ------
    NotFound
        There is no such action.
    StateConflict
        It does not wait for approval.
    """
    state = "queued" if approve else "refused"
    with ground.database.writing() as connection:
        now = utc_now_ns()
        action = store.get_action(connection, action_id)
        waiting: dict[str, Any] = {"expected": ("waiting",), "now_utc_ns": now, "decided_by": actor}
        for one in [action, *_following(connection, action, "waiting")]:
            store.change_state(connection, one, state, **waiting)
        verb = "approve" if approve else "refuse"
        detail = action.model_dump(include={"action", "rule", "event"})
        audit(connection, actor, f"{verb} automation", str(action_id), detail)
        return store.get_action(connection, action_id)


def repeat(ground: Ground, action_id: int, *, actor: str) -> AutomationAction:
    """Queue a failed action again, and those of its rule that were skipped after it; return it.

    An action that is queued already is returned unchanged, so that the same request has one effect.

    Raises
    ------
    NotFound
        There is no such action.
    StateConflict
        It has not failed.
    """
    with ground.database.writing() as connection:
        now = utc_now_ns()
        action = store.get_action(connection, action_id)
        if action.state == "queued":
            return action
        again: dict[str, Any] = {"attempts": 0, "next_attempt_utc_ns": None, "error": None}
        store.change_state(connection, action, "queued", now_utc_ns=now, expected=("failed",), **again)
        for other in _following(connection, action, "skipped"):
            store.change_state(connection, other, "queued", now_utc_ns=now, **again)
        detail = action.model_dump(include={"action", "rule", "event", "error"})
        audit(connection, actor, "repeat automation", str(action_id), detail)
        return store.get_action(connection, action_id)


def _following(connection: Connection, action: AutomationAction, state: str) -> list[AutomationAction]:
    """Return the actions in a state that come after one in the same rule, for the same event and subject."""
    return [
        one
        for one in store.actions_of_event(connection, action.event)
        if (one.rule, one.subject, one.state) == (action.rule, action.subject, state)
        and one.position > action.position
    ]
