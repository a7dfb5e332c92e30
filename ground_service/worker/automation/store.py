"""Database access for automation rules and recorded actions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sqlalchemy import Connection, func, select, update

from ground_service.events import AutomationChanged, publish
from ground_service.http.model import PageOf
from ground_service.missions.model import Mission
from ground_service.missions.rules import Channel, Rule
from ground_service.missions.store import get_mission, keys_in_force, newest_of_spacecraft
from ground_service.planning import store as planning
from ground_service.planning.progress import HEARD_TICKS, span_of
from ground_service.store import repository
from ground_service.store.states import AUTOMATION_ACTION, move
from ground_service.worker.automation.core import Occurrence, PlannedAction
from ground_service.worker.automation.model import ActionFilter, AutomationAction

ACTIONS = repository.AUTOMATION_ACTIONS


def mission_of_vehicle(connection: Connection, vehicle: int | None) -> tuple[int | None, Mission | None]:
    """Return id and document of the description whose rules apply to a vehicle; None without any.

    Descriptions that were imported with archives have no effect on the automation.
    """
    if vehicle is None:
        return None, None
    row = repository.find(connection, repository.VEHICLES, id=vehicle)
    if row is None:
        return None, None
    key = newest_of_spacecraft(connection, int(row["ccsds_id"]))
    return (None, None) if key is None else (key, get_mission(connection, key))


def missions_in_force(connection: Connection) -> list[tuple[int, int, Mission]]:
    """Return the spacecraft, the id and the document of all descriptions in force."""
    found = keys_in_force(connection).items()
    return [(spacecraft, key, get_mission(connection, key)) for spacecraft, key in found]


def window_of(connection: Connection, window_id: int) -> Occurrence | None:
    """Return the subject of an event of a window; None if the window was deleted."""
    windows = repository.WINDOWS
    row = connection.execute(select(windows).where(windows.c.id == window_id)).mappings().first()
    if row is None:
        return None
    return Occurrence(
        trigger="",
        vehicle_id=row["vehicle_id"],
        pass_id=row["pass_id"],
        window_id=row["id"],
        window_state=row["state"],
        text=f"window {row['id']} ({row['name']}) {row['state']}",
    )


def delivered_windows(connection: Connection, vehicle: int, until_utc_ns: int) -> list[Occurrence]:
    """Return the windows of a vehicle before a time that have telemetry and are not processed.

    Telemetry from after their end was received, so that the rest of theirs is not expected any more.
    """
    found = []
    for window in planning.open_windows(connection, vehicle):
        if window.pass_id is None or window.stop.utc_ns > until_utc_ns:
            continue
        after = span_of(connection, window).stop_ticks
        if planning.has_reports_between(connection, vehicle, after, after + HEARD_TICKS):
            occurrence = window_of(connection, window.id)
            if occurrence is not None and occurrence.window_state in ("executed", "downlinked"):
                found.append(occurrence)
    return found


def window_of_pass(connection: Connection, pass_id: int) -> int | None:
    """Return the window that a pass belongs to; None without any."""
    windows = repository.WINDOWS
    found = connection.execute(select(windows.c.id).where(windows.c.pass_id == pass_id)).scalar()
    return None if found is None else int(found)


def spacecraft_vehicle(connection: Connection, ccsds_id: int, instance: str) -> int | None:
    """Return the id of a vehicle; None if it is not known."""
    row = repository.find(connection, repository.VEHICLES, ccsds_id=ccsds_id, instance=instance)
    return None if row is None else int(row["id"])


def report_summary(connection: Connection, report_id: str) -> dict[str, Any]:
    """Return the figures of a report."""
    return dict(repository.get(connection, repository.REPORTS, report_id, "report")["summary"])


def add_action(
    connection: Connection, event: int, planned: PlannedAction, mission_id: int | None, now_utc_ns: int
) -> int | None:
    """Record an action; return its id, or None if it is recorded already."""
    occurrence = planned.occurrence
    if occurrence.pass_id is not None:
        subject = f"pass {occurrence.pass_id}"
    else:
        subject = f"vehicle {occurrence.vehicle_id}" if occurrence.vehicle_id else f"mission {mission_id}"
    state = "waiting" if planned.rule.approval else "queued"
    key = repository.add_new(
        connection,
        ACTIONS,
        event_number=event,
        trigger=planned.rule.on,
        rule=planned.rule.name,
        position=planned.position,
        action=planned.action,
        subject=subject,
        vehicle_id=occurrence.vehicle_id,
        pass_id=occurrence.pass_id,
        window_id=occurrence.window_id,
        mission_id=mission_id,
        text=occurrence.text,
        state=state,
        attempts=0,
        created_utc_ns=now_utc_ns,
        changed_utc_ns=now_utc_ns,
    )
    if key is not None:
        changed = AutomationChanged(id=int(key), event=event, action=planned.action, state=state)
        publish(connection, changed)
    return None if key is None else int(key)


def get_action(connection: Connection, action_id: int) -> AutomationAction:
    """Return an action."""
    return _action(repository.get(connection, ACTIONS, action_id, "automation action"))


def actions_of_event(connection: Connection, event: int) -> list[AutomationAction]:
    """Return the actions that an event caused, by rule and subject, in the order of the rule."""
    query = (
        select(ACTIONS)
        .where(ACTIONS.c.event_number == event)
        .order_by(ACTIONS.c.rule, ACTIONS.c.subject, ACTIONS.c.position)
    )
    return [_action(dict(row)) for row in connection.execute(query).mappings()]


def list_automation_actions(connection: Connection, asked: ActionFilter) -> PageOf[AutomationAction]:
    """List the actions of rules with their causes and results, newest first."""
    rows, total = repository.newest(connection, ACTIONS, asked)
    return asked.page(map(_action, rows), total)


def rules_of_revision(connection: Connection, mission_id: int | None) -> tuple[Rule, ...]:
    """Return the stated rules of a revision; none for None."""
    return () if mission_id is None else get_mission(connection, mission_id).automation.rules or ()


def channels_of_revision(connection: Connection, mission_id: int | None) -> Mapping[str, Channel]:
    """Return the channels of notifications of a revision; none for None."""
    return {} if mission_id is None else get_mission(connection, mission_id).automation.channels or {}


def last_result(connection: Connection, action: AutomationAction) -> dict[str, Any] | None:
    """Return the result of the newest finished action of the same kind on the same vehicle before an action."""
    query = (
        select(ACTIONS.c.result)
        .where(
            ACTIONS.c.action == action.action,
            ACTIONS.c.vehicle_id == action.vehicle_id,
            ACTIONS.c.state == "done",
            ACTIONS.c.id < action.id,
        )
        .order_by(ACTIONS.c.id.desc())
        .limit(1)
    )
    return connection.execute(query).scalar()


def change_state(
    connection: Connection,
    /,
    action: AutomationAction,
    state: str,
    *,
    now_utc_ns: int,
    expected: tuple[str, ...] = (),
    **values: Any,
) -> None:
    """Change the state of an action, which must be in one of the `expected` states if any are given.

    Raises
    ------
    NotFound
        There is no such action.
    StateConflict
        Its state does not permit that.
    """
    move(
        connection,
        AUTOMATION_ACTION,
        action.id,
        state,
        expected=expected,
        changed_utc_ns=now_utc_ns,
        **values,
    )
    publish(
        connection,
        AutomationChanged(id=action.id, event=action.event, action=action.action, state=state),
    )


def note_attempt(
    connection: Connection, action: AutomationAction, *, error: str, now_utc_ns: int, next_utc_ns: int
) -> None:
    """Count a failed attempt of a queued action, which is done again from a time on."""
    connection.execute(
        update(ACTIONS)
        .where(ACTIONS.c.id == action.id, ACTIONS.c.state == "queued")
        .values(
            attempts=action.attempts + 1,
            error=error,
            next_attempt_utc_ns=next_utc_ns,
            changed_utc_ns=now_utc_ns,
        )
    )


def events_to_repeat(connection: Connection, now_utc_ns: int) -> list[tuple[int, int]]:
    """Return the events with queued actions that are due again, each with the largest number of failed attempts."""
    query = (
        select(ACTIONS.c.event_number, func.max(ACTIONS.c.attempts))
        .where(ACTIONS.c.state == "queued", ACTIONS.c.next_attempt_utc_ns <= now_utc_ns)
        .group_by(ACTIONS.c.event_number)
        .order_by(ACTIONS.c.event_number)
    )
    return [(int(event), int(attempts)) for event, attempts in connection.execute(query)]


def _action(row: repository.Row) -> AutomationAction:
    return AutomationAction.of(row, event=row["event_number"])
