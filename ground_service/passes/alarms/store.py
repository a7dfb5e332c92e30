"""SQL of alarms: the alarms, their changes, and the packets that have been examined."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, and_, func, insert, or_, select, update
from sqlalchemy.engine import RowMapping

from ground_service.errors import NotFound
from ground_service.http.model import UtcTime
from ground_service.passes.alarms.core import Condition
from ground_service.passes.alarms.model import AlarmChange, AlarmFilter
from ground_service.store import models, states
from ground_service.store.repository import VEHICLES, Row, add_new, page
from ground_service.store.states import StateMachine

_ALARMS = models.ALARMS
_CHANGES = models.ALARM_CHANGES
_POSITIONS = models.ALARM_POSITIONS

OPEN = 1
"""Value of the column `open` of an alarm that is not cleared, NULL for others: one open alarm for each cause."""

ALARM = StateMachine(
    "alarm", _ALARMS, {"raised": ("acknowledged", "cleared"), "acknowledged": ("raised", "cleared")}
)

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
    done = connection.execute(
        update(_POSITIONS).where(_POSITIONS.c.vehicle_id == vehicle).values(packet_id=packet_id)
    )
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
    """Add a change to the history of an alarm."""
    connection.execute(
        insert(_CHANGES).values(
            alarm_id=alarm_id, utc_ns=now_utc_ns, actor=actor, change=change, comment=comment
        )
    )


def get(connection: Connection, alarm_id: int) -> AlarmRow:
    """Return an alarm."""
    row = connection.execute(_select().where(_ALARMS.c.id == alarm_id)).mappings().first()
    if row is None:
        raise NotFound("alarm", alarm_id)
    return _row(row)


def history(connection: Connection, alarm_id: int) -> list[AlarmChange]:
    """Return the changes of an alarm, oldest first."""
    query = select(_CHANGES).where(_CHANGES.c.alarm_id == alarm_id).order_by(_CHANGES.c.id)
    return [
        AlarmChange(
            time=UtcTime(row["utc_ns"]), actor=row["actor"], change=row["change"], comment=row["comment"]
        )
        for row in connection.execute(query).mappings()
    ]


def list_alarms(connection: Connection, asked: AlarmFilter, now_utc_ns: int) -> tuple[list[AlarmRow], int]:
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
