"""Life cycle of alarms: raised from new packets, acknowledged and shelved by operators, cleared.

New packets are examined once, in the order in which they were stored. What an alarm says does not depend on the order
in which packets arrive: its times, count and severity are those of all its packets, and whether it is active follows
from the newest housekeeping packet.
"""

from collections.abc import Set
from dataclasses import asdict, dataclass
from typing import Any, cast

import numpy as np
from sqlalchemy import Connection, and_, func, insert, or_, select, update
from sqlalchemy.engine import RowMapping

from ground_service.access.service import audit
from ground_service.clock import mission_now_ns, utc_now_ns
from ground_service.errors import Conflict, InvalidInput, NotFound
from ground_service.ground import Ground
from ground_service.http.model import PageOf, UtcTime
from ground_service.missions.store import mission_in_force
from ground_service.missions.timekeeping.core import ticks_of_utc_ns, utc_ns_of_ticks
from ground_service.missions.timekeeping.store import load_correlations
from ground_service.passes.alarms import core
from ground_service.passes.alarms.core import Condition
from ground_service.passes.alarms.model import SHELVED_DAYS_LIMIT, Alarm, AlarmChange, AlarmDetail, AlarmFilter
from ground_service.store import models, states
from ground_service.store.event_kinds import AlarmChanged, publish
from ground_service.store.repository import VEHICLES, Row, add_new, page
from ground_service.store.states import StateMachine
from ground_service.store.vehicles import FLOWN, lock_vehicle, vehicle_id
from ground_service.telemetry import store as telemetry
from ground_service.telemetry import values as parameters
from lunar.constants import DAY_NS
from lunar.timescales import format_utc
from tmtc.dictionary.payload import STRUCTURES

_ALARMS = models.ALARMS
_CHANGES = models.ALARM_CHANGES
_POSITIONS = models.ALARM_POSITIONS

OPEN = 1
"""Value of the column `open` of an alarm that is not cleared, NULL for others: one open alarm for each cause."""

ALARM = StateMachine("alarm", _ALARMS, {"raised": ("acknowledged", "cleared"), "acknowledged": ("raised", "cleared")})

SEVERITY_CODES = {"warning": 1, "alarm": 2}


@dataclass(frozen=True, slots=True)
class AlarmRow:
    """A stored alarm with its spacecraft."""

    id: int
    vehicle_id: int
    spacecraft_id: int
    instance: str
    source: str
    name: str
    severity: int
    state: str
    active: bool
    count: int
    value: float | None
    first_ticks: int
    last_ticks: int
    raised_utc_ns: int
    acknowledged_by: str | None
    acknowledged_utc_ns: int | None
    shelved_by: str | None
    shelved_until_utc_ns: int | None
    cleared_utc_ns: int | None


def position(connection: Connection, vehicle: int) -> int:
    """Return the id of the last packet of a vehicle that has been examined, 0 for none."""
    query = select(_POSITIONS.c.packet_id).where(_POSITIONS.c.vehicle_id == vehicle)
    return int(connection.execute(query).scalar() or 0)


def advance(connection: Connection, vehicle: int, packet_id: int) -> None:
    """Store the id of the last packet that has been examined; the caller holds the lock of the vehicle."""
    done = connection.execute(update(_POSITIONS).where(_POSITIONS.c.vehicle_id == vehicle).values(packet_id=packet_id))
    if done.rowcount == 0:
        connection.execute(insert(_POSITIONS).values(vehicle_id=vehicle, packet_id=packet_id))


def begin_again(connection: Connection, vehicle: int) -> None:
    """Forget which packets of a vehicle were examined, and what the alarms of its telemetry counted."""
    connection.execute(update(_POSITIONS).where(_POSITIONS.c.vehicle_id == vehicle).values(packet_id=0))
    mine = _ALARMS.c.vehicle_id == vehicle, _ALARMS.c.source != "operations"
    connection.execute(update(_ALARMS).where(*mine).values(count=0))
    unseen = {"first_ticks": 2**62, "last_ticks": -1}
    connection.execute(update(_ALARMS).where(*mine, _ALARMS.c.open == OPEN).values(**unseen))


def open_alarms(connection: Connection, vehicle: int) -> list[AlarmRow]:
    """Return the alarms of a vehicle that are not cleared, locked until the transaction ends."""
    query = _select().where(_ALARMS.c.vehicle_id == vehicle, _ALARMS.c.open == OPEN)
    rows = connection.execute(query.order_by(_ALARMS.c.id).with_for_update(of=_ALARMS)).mappings()
    return [_row(row) for row in rows]


def has_open_alarms(connection: Connection, vehicle: int) -> bool:
    """Return whether a vehicle has alarms that are not cleared."""
    query = select(_ALARMS.c.id).where(_ALARMS.c.vehicle_id == vehicle, _ALARMS.c.open == OPEN).limit(1)
    return connection.execute(query).first() is not None


def last_cleared(connection: Connection, vehicle: int, source: str, name: str) -> AlarmRow | None:
    """Return the cleared alarm of a cause with the latest on-board time."""
    query = (
        _select()
        .where(
            _ALARMS.c.vehicle_id == vehicle,
            _ALARMS.c.source == source,
            _ALARMS.c.name == name,
            _ALARMS.c.open.is_(None),
        )
        .order_by(_ALARMS.c.last_ticks.desc())
        .limit(1)
    )
    row = connection.execute(query).mappings().first()
    return None if row is None else _row(row)


def add(connection: Connection, vehicle: int, condition: Condition, *, active: bool, now_utc_ns: int) -> int:
    """Add an open alarm and return its id."""
    key = add_new(
        connection,
        _ALARMS,
        vehicle_id=vehicle,
        source=condition.source,
        name=condition.name,
        open=OPEN,
        state="raised",
        active=int(active),
        raised_utc_ns=now_utc_ns,
        **_found(condition),
    )
    assert key is not None, "the caller holds the lock of the vehicle"
    return int(key)


def note_condition(connection: Connection, alarm_id: int, condition: Condition) -> None:
    """Store what the packets of an alarm have in common."""
    connection.execute(update(_ALARMS).where(_ALARMS.c.id == alarm_id).values(**_found(condition)))


def set_active(connection: Connection, alarm_id: int, active: bool) -> None:
    """Store whether the condition of an alarm is still true."""
    connection.execute(update(_ALARMS).where(_ALARMS.c.id == alarm_id).values(active=int(active)))


def move(connection: Connection, row: AlarmRow, state: str, **values: Any) -> None:
    """Change the state of an open alarm.

    Raises
    ------
    StateConflict
        The state of the alarm is no longer that of `row`.
    """
    if state == "cleared":
        values["open"] = None
    states.move(connection, ALARM, row.id, state, expected=(row.state,), **values)


def shelve(connection: Connection, alarm_id: int, actor: str | None, until_utc_ns: int | None) -> bool:
    """Shelve an open alarm until a time, or end this with None; return whether the alarm is open."""
    where = and_(_ALARMS.c.id == alarm_id, _ALARMS.c.open == OPEN)
    values = {"shelved_by": actor, "shelved_until_utc_ns": until_utc_ns}
    return connection.execute(update(_ALARMS).where(where).values(**values)).rowcount == 1


def note_change(
    connection: Connection, alarm_id: int, now_utc_ns: int, actor: str, change: str, comment: str = ""
) -> None:
    """Add a change to the alarm_history of an alarm."""
    connection.execute(
        insert(_CHANGES).values(alarm_id=alarm_id, utc_ns=now_utc_ns, actor=actor, change=change, comment=comment)
    )


def get(connection: Connection, alarm_id: int) -> AlarmRow:
    row = connection.execute(_select().where(_ALARMS.c.id == alarm_id)).mappings().first()
    if row is None:
        raise NotFound("alarm", alarm_id)
    return _row(row)


def alarm_history(connection: Connection, alarm_id: int) -> list[AlarmChange]:
    """Return the changes of an alarm, oldest first."""
    query = select(_CHANGES).where(_CHANGES.c.alarm_id == alarm_id).order_by(_CHANGES.c.id)
    return [
        AlarmChange(time=UtcTime(row["utc_ns"]), actor=row["actor"], change=row["change"], comment=row["comment"])
        for row in connection.execute(query).mappings()
    ]


def select_alarms(connection: Connection, asked: AlarmFilter, now_utc_ns: int) -> tuple[list[AlarmRow], int]:
    """Return a page of the alarms, open ones first and the latest first, and their number."""
    query = _select()
    if asked.state:
        shelved = func.coalesce(_ALARMS.c.shelved_until_utc_ns, 0) > now_utc_ns
        plain = [state for state in asked.state if state != "shelved"]
        among = [and_(_ALARMS.c.state.in_(plain), or_(~shelved, _ALARMS.c.open.is_(None)))]
        if "shelved" in asked.state:
            among.append(and_(shelved, _ALARMS.c.open == OPEN))
        query = query.where(or_(*among))
    if asked.severity is not None:
        query = query.where(_ALARMS.c.severity == SEVERITY_CODES[asked.severity])
    order = (_ALARMS.c.open.is_(None), _ALARMS.c.last_ticks.desc(), _ALARMS.c.id.desc())
    rows, total = page(connection, query, asked, *order, others=("state", "severity"))
    return [_row(row) for row in rows], total


def _select() -> Any:
    columns = [column for column in _ALARMS.c if column.name != "open"]
    return select(*columns, VEHICLES.c.ccsds_id.label("spacecraft_id"), VEHICLES.c.instance).join(
        VEHICLES, VEHICLES.c.id == _ALARMS.c.vehicle_id
    )


def _row(row: Row | RowMapping) -> AlarmRow:
    return AlarmRow(**{**row, "active": bool(row["active"])})


def _found(condition: Condition) -> dict[str, Any]:
    return {
        "severity": condition.severity,
        "first_ticks": condition.first_ticks,
        "last_ticks": condition.last_ticks,
        "count": condition.count,
        "value": condition.value,
    }


TELEMETRY = "telemetry"
"""Name of the cause of changes that no user has made."""

BATCH = 2000
"""Packets that are examined in one transaction."""

QUIET = 200
"""Packets without any alarm that are examined again with later ones, which saves a transaction for each piece."""


def examine_packets(ground: Ground, vehicle: int) -> int:
    """Raise and clear alarms from the packets of a vehicle that have not been examined; return their number."""
    examined = 0
    while True:
        ground.check_stopping()
        with ground.database.reading() as connection:
            packets = parameters.packets_after(
                connection, vehicle, position(connection, vehicle), core.WATCHED_APIDS, BATCH
            )
            quiet = len(packets.ids) < QUIET and not has_open_alarms(connection, vehicle)
        if not packets.ids or (quiet and not core.conditions_in(b"".join(packets.octets))):
            return examined
        with ground.database.writing() as connection:
            # Ids of packets that other transactions are storing may be smaller than those already visible.
            lock_vehicle(connection, vehicle)
            packets = parameters.packets_after(
                connection, vehicle, position(connection, vehicle), core.WATCHED_APIDS, BATCH
            )
            if not packets.ids:
                return examined
            newest = (telemetry.newest_packet(connection, vehicle, one.apid) for one in STRUCTURES.values())
            broken = core.broken_limits(b"".join(octets for octets in newest if octets is not None))
            _update(connection, vehicle, core.conditions_in(b"".join(packets.octets)), broken)
            advance(connection, vehicle, packets.ids[-1])
        examined += len(packets.ids)


def list_alarms(connection: Connection, asked: AlarmFilter) -> PageOf[Alarm]:
    """List the alarms of all spacecraft, open ones first and the latest first."""
    now = mission_now_ns()
    rows, total = select_alarms(connection, asked, now)
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
        vehicle = get(connection, alarm_id).vehicle_id
        row = next((one for one in open_alarms(connection, vehicle) if one.id == alarm_id), None)
        if row is None or row.state != "raised":
            found = get(connection, alarm_id)
            by = f" by {found.acknowledged_by}" if found.acknowledged_by else ""
            raise Conflict(f"alarm {alarm_id}: expected state raised, found {found.state}{by}")
        state = "acknowledged" if row.active else "cleared"
        _move(connection, row, state, now, acknowledged_by=actor, acknowledged_utc_ns=now)
        note_change(connection, alarm_id, now, actor, "acknowledged", comment)
        if state == "cleared":
            note_change(connection, alarm_id, now, TELEMETRY, "cleared", "the condition had ended")
        audit(connection, actor, "acknowledge alarm", f"alarm {alarm_id}", {"name": row.name, "comment": comment})
        return get_alarm(connection, alarm_id)


def shelve_alarm(ground: Ground, alarm_id: int, until_utc_ns: int, comment: str, *, actor: str) -> AlarmDetail:
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
            "alarm", "until", f"a time within {SHELVED_DAYS_LIMIT} days of the mission time {format_utc(now)}", found
        )
    ends = until_utc_ns <= now
    with ground.database.writing() as connection:
        row = get(connection, alarm_id)
        if not shelve(connection, alarm_id, None if ends else actor, None if ends else until_utc_ns):
            raise Conflict(f"alarm {alarm_id}: expected an open alarm, found cleared")
        change = "unshelved" if ends else "shelved"
        note_change(connection, alarm_id, utc_now_ns(), actor, change, comment)
        detail = {"name": row.name, "until": format_utc(until_utc_ns), "comment": comment}
        audit(connection, actor, "shelve alarm" if not ends else "unshelve alarm", f"alarm {alarm_id}", detail)
        _publish(connection, row, change)
        return get_alarm(connection, alarm_id)


def note_operations(ground: Ground, spacecraft_id: int, lasting: Set[str], holding: Set[str]) -> None:
    """Raise the alarms of lasting conditions that stop operations, and end those whose conditions hold no more."""
    with ground.database.writing() as connection:
        vehicle = vehicle_id(connection, spacecraft_id, FLOWN)
        lock_vehicle(connection, vehicle)
        rows = open_alarms(connection, vehicle)
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
        rows = open_alarms(connection, vehicle)
        active = {row.name for row in rows if row.source == core.OPERATIONS and row.active}
        ticks = ticks_of_utc_ns(mission_now_ns(), load_correlations(connection, vehicle))
        found = Condition(core.OPERATIONS, name, core.WARNING, ticks, ticks, count, value)
        _update(connection, vehicle, (found,), active, is_operations=True)


def examine_again(ground: Ground, vehicle: int) -> None:
    """Examine all packets of a vehicle again, after some were removed; alarms without packets are cleared."""
    with ground.database.writing() as connection:
        lock_vehicle(connection, vehicle)
        begin_again(connection, vehicle)
    examine_packets(ground, vehicle)
    now = utc_now_ns()
    with ground.database.writing() as connection:
        for row in open_alarms(connection, vehicle):
            if row.count == 0:
                _move(connection, row, "cleared", now)
                note_change(connection, row.id, now, TELEMETRY, "cleared", "its packets were withdrawn")


def _update(
    connection: Connection, vehicle: int, found: tuple[Condition, ...], broken: Set[str], *, is_operations: bool = False
) -> None:
    """Apply new conditions to the alarms of a vehicle, which the caller has locked; those in `broken` continue."""
    now = utc_now_ns()
    known = {
        (row.source, row.name): row
        for row in open_alarms(connection, vehicle)
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
            alarm_id = add(connection, vehicle, condition, active=active, now_utc_ns=now)
            note_change(connection, alarm_id, now, TELEMETRY, "raised")
            _publish(connection, get(connection, alarm_id), "raised")
            continue
        note_condition(connection, row.id, core.joined(_condition(row), condition))
        if condition.severity > row.severity:
            worse.add(key)
    for cause, row in known.items():
        active = row.source != "event" and row.name in broken
        if active != row.active:
            set_active(connection, row.id, active)
        state = core.state_after(row.state, active=active, worse=cause in worse)
        if state != row.state:
            _move(connection, row, state, now)
            note_change(connection, row.id, now, TELEMETRY, state)
        elif active != row.active:
            _publish(connection, row, "condition returned" if active else "condition ended")


def _cleared_later(connection: Connection, vehicle: int, condition: Condition) -> AlarmRow | None:
    """Return the cleared alarm that late packets belong to: they are older than its last one."""
    row = last_cleared(connection, vehicle, condition.source, condition.name)
    return row if row is not None and condition.last_ticks <= row.last_ticks else None


def _move(connection: Connection, row: AlarmRow, state: str, now: int, **values: int | str) -> None:
    if state == "cleared":
        values["cleared_utc_ns"] = now
    move(connection, row, state, **values)
    _publish(connection, row, state)


def _publish(connection: Connection, row: AlarmRow, state: str) -> None:
    event = AlarmChanged(
        id=row.id, vehicle_id=row.vehicle_id, name=row.name, severity=core.SEVERITIES[row.severity], state=state
    )
    publish(connection, event)


def _condition(row: AlarmRow) -> Condition:
    return Condition(
        cast("core.Source", row.source), row.name, row.severity, row.first_ticks, row.last_ticks, row.count, row.value
    )


def get_alarm(connection: Connection, alarm_id: int) -> AlarmDetail:
    """Return an alarm with its history and the procedure of the mission description."""
    alarm = _alarm(connection, get(connection, alarm_id), mission_now_ns())
    mission = mission_in_force(connection, alarm.spacecraft_id)
    procedure = None if mission is None else mission.procedures.get(alarm.name)
    history = alarm_history(connection, alarm_id)
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
