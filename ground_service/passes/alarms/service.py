"""Life cycle of alarms: raised from new packets, acknowledged and shelved by operators, cleared.

New packets are examined once, in the order in which they were stored. What an alarm says does not depend on the order
in which packets arrive: its times, count and severity are those of all its packets, and whether it is active follows
from the newest housekeeping packet.
"""

from __future__ import annotations

from collections.abc import Set
from dataclasses import asdict
from typing import cast

import numpy as np
from sqlalchemy import Connection

from ground_service.access.service import audit
from ground_service.clock import mission_now_ns, utc_now_ns
from ground_service.errors import Conflict, InvalidInput
from ground_service.events import AlarmChanged, publish
from ground_service.ground import Ground
from ground_service.http.model import PageOf
from ground_service.missions.store import mission_in_force
from ground_service.missions.timekeeping.core import ticks_of_utc_ns, utc_ns_of_ticks
from ground_service.missions.timekeeping.store import load_correlations
from ground_service.passes.alarms import core, store
from ground_service.passes.alarms.core import Condition
from ground_service.passes.alarms.model import SHELVED_DAYS_LIMIT, Alarm, AlarmDetail, AlarmFilter
from ground_service.passes.alarms.store import AlarmRow
from ground_service.store import parameters, telemetry
from ground_service.store.vehicles import FLOWN, lock_vehicle, vehicle_id
from lunar.timescales import format_utc
from tmtc.dictionary.payload import STRUCTURES

TELEMETRY = "telemetry"
"""Name of the cause of changes that no user has made."""

BATCH = 2000
"""Packets that are examined in one transaction."""

QUIET = 200
"""Packets without any alarm that are examined again with later ones, which saves a transaction for each piece."""

DAY_NS = 86_400_000_000_000


def examine_packets(ground: Ground, vehicle: int) -> int:
    """Raise and clear alarms from the packets of a vehicle that have not been examined; return their number."""
    examined = 0
    while True:
        ground.check_stopping()
        with ground.database.reading() as connection:
            packets = parameters.packets_after(
                connection, vehicle, store.position(connection, vehicle), core.WATCHED_APIDS, BATCH
            )
            quiet = len(packets.ids) < QUIET and not store.has_open_alarms(connection, vehicle)
        if not packets.ids or (quiet and not core.conditions_in(b"".join(packets.octets))):
            return examined
        with ground.database.writing() as connection:
            # Ids of packets that other transactions are storing may be smaller than those already visible.
            lock_vehicle(connection, vehicle)
            packets = parameters.packets_after(
                connection, vehicle, store.position(connection, vehicle), core.WATCHED_APIDS, BATCH
            )
            if not packets.ids:
                return examined
            newest = (telemetry.newest_packet(connection, vehicle, one.apid) for one in STRUCTURES.values())
            broken = core.broken_limits(b"".join(octets for octets in newest if octets is not None))
            _update(connection, vehicle, core.conditions_in(b"".join(packets.octets)), broken)
            store.advance(connection, vehicle, packets.ids[-1])
        examined += len(packets.ids)


def list_alarms(connection: Connection, asked: AlarmFilter) -> PageOf[Alarm]:
    """List the alarms of all spacecraft, open ones first and the latest first."""
    now = mission_now_ns()
    rows, total = store.list_alarms(connection, asked, now)
    return asked.page([_alarm(connection, row, now) for row in rows], total)


def acknowledge_alarm(ground: Ground, alarm_id: int, comment: str, *, actor: str) -> AlarmDetail:
    """Acknowledge an alarm; it is cleared if its condition has ended.

    Raises
    ------
    NotFound
        There is no such alarm.
    Conflict
        Another user has acknowledged it already.
    """
    now = utc_now_ns()
    with ground.database.writing() as connection:
        vehicle = store.get(connection, alarm_id).vehicle_id
        row = next((one for one in store.open_alarms(connection, vehicle) if one.id == alarm_id), None)
        if row is None or row.state != "raised":
            found = store.get(connection, alarm_id)
            by = f" by {found.acknowledged_by}" if found.acknowledged_by else ""
            raise Conflict(f"alarm {alarm_id}: expected state raised, found {found.state}{by}")
        state = "acknowledged" if row.active else "cleared"
        _move(connection, row, state, now, acknowledged_by=actor, acknowledged_utc_ns=now)
        store.note_change(connection, alarm_id, now, actor, "acknowledged", comment)
        if state == "cleared":
            store.note_change(connection, alarm_id, now, TELEMETRY, "cleared", "the condition had ended")
        audit(
            connection,
            actor,
            "acknowledge alarm",
            f"alarm {alarm_id}",
            {"name": row.name, "comment": comment},
        )
        return get_alarm(connection, alarm_id)


def shelve_alarm(
    ground: Ground, alarm_id: int, until_utc_ns: int, comment: str, *, actor: str
) -> AlarmDetail:
    """Suppress an open alarm until a mission time, or end its suppression with one in the past.

    Raises
    ------
    NotFound
        There is no such alarm.
    Conflict
        The alarm is cleared.
    InvalidInput
        The time is more than `SHELVED_DAYS_LIMIT` days ahead.
    """
    now = mission_now_ns()
    if until_utc_ns > now + SHELVED_DAYS_LIMIT * DAY_NS:
        found = format_utc(until_utc_ns)
        raise InvalidInput(
            "alarm",
            "until",
            f"a time within {SHELVED_DAYS_LIMIT} days of the mission time {format_utc(now)}",
            found,
        )
    ends = until_utc_ns <= now
    with ground.database.writing() as connection:
        row = store.get(connection, alarm_id)
        if not store.shelve(connection, alarm_id, None if ends else actor, None if ends else until_utc_ns):
            raise Conflict(f"alarm {alarm_id}: expected an open alarm, found cleared")
        change = "unshelved" if ends else "shelved"
        store.note_change(connection, alarm_id, utc_now_ns(), actor, change, comment)
        detail = {"name": row.name, "until": format_utc(until_utc_ns), "comment": comment}
        audit(
            connection, actor, "shelve alarm" if not ends else "unshelve alarm", f"alarm {alarm_id}", detail
        )
        _publish(connection, row, change)
        return get_alarm(connection, alarm_id)


def note_operations(ground: Ground, spacecraft_id: int, lasting: Set[str], holding: Set[str]) -> None:
    """Raise the alarms of lasting conditions that stop operations, and end those whose conditions hold no more."""
    with ground.database.writing() as connection:
        vehicle = vehicle_id(connection, spacecraft_id, FLOWN)
        lock_vehicle(connection, vehicle)
        rows = store.open_alarms(connection, vehicle)
        known = {row.name for row in rows if row.source == core.OPERATIONS and row.active}
        names = lasting | (known & holding)
        if known != names:
            ticks = ticks_of_utc_ns(mission_now_ns(), load_correlations(connection, vehicle))
            new = sorted(names - known)
            found = tuple(Condition(core.OPERATIONS, one, core.ALARM, ticks, ticks, 1) for one in new)
            _update(connection, vehicle, found, names, is_operations=True)


def note_finding(ground: Ground, vehicle: int, name: str, count: int = 1, value: float | None = None) -> None:
    """Raise an alarm of something implausible that was received, at the mission time."""
    with ground.database.writing() as connection:
        lock_vehicle(connection, vehicle)
        rows = store.open_alarms(connection, vehicle)
        active = {row.name for row in rows if row.source == core.OPERATIONS and row.active}
        ticks = ticks_of_utc_ns(mission_now_ns(), load_correlations(connection, vehicle))
        found = Condition(core.OPERATIONS, name, core.WARNING, ticks, ticks, count, value)
        _update(connection, vehicle, (found,), active, is_operations=True)


def examine_again(ground: Ground, vehicle: int) -> None:
    """Examine all packets of a vehicle again, after some were removed; alarms without packets are cleared."""
    with ground.database.writing() as connection:
        lock_vehicle(connection, vehicle)
        store.begin_again(connection, vehicle)
    examine_packets(ground, vehicle)
    now = utc_now_ns()
    with ground.database.writing() as connection:
        for row in store.open_alarms(connection, vehicle):
            if row.count == 0:
                _move(connection, row, "cleared", now)
                store.note_change(connection, row.id, now, TELEMETRY, "cleared", "its packets were withdrawn")


def _update(
    connection: Connection,
    vehicle: int,
    found: tuple[Condition, ...],
    broken: Set[str],
    *,
    is_operations: bool = False,
) -> None:
    """Apply new conditions to the alarms of a vehicle, which the caller has locked; those in `broken` continue."""
    now = utc_now_ns()
    known = {
        (row.source, row.name): row
        for row in store.open_alarms(connection, vehicle)
        if (row.source == core.OPERATIONS) == is_operations
    }
    worse: set[tuple[str, str]] = set()
    for condition in found:
        key: tuple[str, str] = (condition.source, condition.name)
        row = known.get(key)
        if row is None and not is_operations:
            row = _cleared_later(connection, vehicle, condition)
        if row is None:
            active = condition.source != "event" and condition.name in broken
            alarm_id = store.add(connection, vehicle, condition, active=active, now_utc_ns=now)
            store.note_change(connection, alarm_id, now, TELEMETRY, "raised")
            _publish(connection, store.get(connection, alarm_id), "raised")
            continue
        store.note_condition(connection, row.id, core.joined(_condition(row), condition))
        if condition.severity > row.severity:
            worse.add(key)
    for cause, row in known.items():
        active = row.source != "event" and row.name in broken
        if active != row.active:
            store.set_active(connection, row.id, active)
        state = core.state_after(row.state, active=active, worse=cause in worse)
        if state != row.state:
            _move(connection, row, state, now)
            store.note_change(connection, row.id, now, TELEMETRY, state)
        elif active != row.active:
            _publish(connection, row, "condition returned" if active else "condition ended")


def _cleared_later(connection: Connection, vehicle: int, condition: Condition) -> AlarmRow | None:
    """Return the cleared alarm that late packets belong to: they are older than its last one."""
    row = store.last_cleared(connection, vehicle, condition.source, condition.name)
    return row if row is not None and condition.last_ticks <= row.last_ticks else None


def _move(connection: Connection, row: AlarmRow, state: str, now: int, **values: int | str) -> None:
    if state == "cleared":
        values["cleared_utc_ns"] = now
    store.move(connection, row, state, **values)
    _publish(connection, row, state)


def _publish(connection: Connection, row: AlarmRow, state: str) -> None:
    event = AlarmChanged(
        id=row.id,
        vehicle_id=row.vehicle_id,
        name=row.name,
        severity=core.SEVERITIES[row.severity],
        state=state,
    )
    publish(connection, event)


def _condition(row: AlarmRow) -> Condition:
    return Condition(
        cast(core.Source, row.source),
        row.name,
        row.severity,
        row.first_ticks,
        row.last_ticks,
        row.count,
        row.value,
    )


def get_alarm(connection: Connection, alarm_id: int) -> AlarmDetail:
    """Return an alarm with its history and the procedure of the mission description."""
    alarm = _alarm(connection, store.get(connection, alarm_id), mission_now_ns())
    mission = mission_in_force(connection, alarm.spacecraft_id)
    procedure = None if mission is None else mission.procedures.get(alarm.name)
    history = store.history(connection, alarm_id)
    return AlarmDetail(**alarm.model_dump(), procedure=procedure, history=history)


def _alarm(connection: Connection, row: AlarmRow, now: int) -> Alarm:
    correlations = load_correlations(connection, row.vehicle_id)
    first, last = utc_ns_of_ticks(np.array([row.first_ticks, row.last_ticks]), correlations)[0].tolist()
    shelved = row.shelved_until_utc_ns is not None and row.shelved_until_utc_ns > now
    field = next((one for one in core.limited_parameters() if one.name == row.name), None)
    return Alarm.of(
        asdict(row),
        severity=core.SEVERITIES[row.severity],
        state="shelved" if shelved and row.state != "cleared" else row.state,
        first=first,
        last=last,
        unit="" if field is None else field.unit,
        limits="" if field is None else _limits(field.warning or field.alarm),
    )


def _limits(limits: tuple[float, float] | None) -> str:
    return "" if limits is None else f"{limits[0]:g} to {limits[1]:g}"
