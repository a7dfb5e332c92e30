"""Event log: numbered events in the order of commits, and the position up to which each consumer has read.

Events are collected during a write transaction and inserted by its last statements, so an event exists if and only if
the change that it reports was committed. On PostgreSQL a lock orders the numbers by commit; SQLite has one writer.
Numbers have no gaps.
"""

import threading
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, bindparam, func, insert, select, text, update

from ground_service.clock import utc_now_ns
from ground_service.store.models import EVENT_LOG, EVENT_POSITIONS

PENDING = "linna_events"
"""Execution option of a write transaction: the list of events to insert at its end."""

LOCK = 7602

_EVENTS = EVENT_LOG
_POSITIONS = EVENT_POSITIONS

_APPEND = insert(_EVENTS).from_select(
    ["id", "utc_ns", "kind", "payload"],
    select(
        func.coalesce(func.max(_EVENTS.c.id), 0) + 1,
        *(bindparam(name, type_=_EVENTS.c[name].type) for name in ("utc_ns", "kind", "payload")),
    ),
)
"""Insert one event with the next number."""

Notify = Callable[[frozenset[str]], None]
"""Function that is called with the kinds of the events of a committed transaction."""


@dataclass(frozen=True, slots=True)
class LoggedEvent:
    """Event of the log; `number` is its position, from 1 without gaps."""

    number: int
    utc_ns: int
    kind: str
    payload: dict[str, Any]


class Listeners:
    """Functions that are called in the committing thread after events were committed."""

    def __init__(self) -> None:
        self._functions: list[Notify] = []
        self._held = threading.local()

    def add(self, function: Notify) -> None:
        """Call a function after each commit with events."""
        self._functions.append(function)

    def notify(self, kinds: frozenset[str]) -> None:
        """Call all functions with the kinds of committed events, or at the end of `held`."""
        waiting: set[str] | None = getattr(self._held, "kinds", None)
        if waiting is not None:
            waiting.update(kinds)
        elif kinds:
            for function in self._functions:
                function(kinds)

    @contextmanager
    def held(self) -> Iterator[None]:
        """Delay the calls for the commits of this thread to the end of the block, also if the block fails."""
        if getattr(self._held, "kinds", None) is not None:
            yield
            return
        kinds: set[str] = set()
        self._held.kinds = kinds
        try:
            yield
        finally:
            self._held.kinds = None
            self.notify(frozenset(kinds))


def publish(connection: Connection, kind: str, payload: Mapping[str, Any]) -> None:
    """Publish an event at the end of the write transaction of this connection (`Database.writing`).

    Raises
    ------
    RuntimeError
        If the connection is not in such a transaction, because the event would be lost.
    """
    pending = connection.get_execution_options().get(PENDING)
    if pending is None:
        raise RuntimeError("events are published inside Database.writing()")
    pending.append((kind, dict(payload)))


def append_pending(connection: Connection) -> frozenset[str]:
    """Insert the events of a transaction, by its last statements; return their kinds."""
    pending: list[tuple[str, dict[str, Any]]] = connection.get_execution_options().get(PENDING, [])
    if not pending:
        return frozenset()
    if connection.dialect.name == "postgresql":
        connection.execute(text("SELECT pg_advisory_xact_lock(:key)"), {"key": LOCK})
    now = utc_now_ns()
    if len(pending) == 1:
        kind, payload = pending[0]
        connection.execute(_APPEND, {"utc_ns": now, "kind": kind, "payload": payload})
        return frozenset((kind,))
    number = last_number(connection)
    connection.execute(
        insert(_EVENTS),
        [
            {"id": number + k, "utc_ns": now, "kind": kind, "payload": payload}
            for k, (kind, payload) in enumerate(pending, start=1)
        ],
    )
    return frozenset(kind for kind, _ in pending)


def read_events(
    connection: Connection, after: int, limit: int = 200, kinds: Collection[str] | None = None
) -> list[LoggedEvent]:
    """Return the events with numbers above `after` in order; only those of `kinds` if given."""
    query = select(_EVENTS).where(_EVENTS.c.id > after).order_by(_EVENTS.c.id).limit(limit)
    if kinds is not None:
        query = query.where(_EVENTS.c.kind.in_(sorted(kinds)))
    return [LoggedEvent(*row) for row in connection.execute(query)]


def last_number(connection: Connection) -> int:
    """Return the number of the newest event; 0 without events."""
    return int(connection.execute(select(func.max(_EVENTS.c.id))).scalar() or 0)


def newest_event(connection: Connection) -> LoggedEvent | None:
    """Return the newest event; None without events."""
    row = connection.execute(select(_EVENTS).order_by(_EVENTS.c.id.desc()).limit(1)).first()
    return None if row is None else LoggedEvent(*row)


def position_of(connection: Connection, consumer: str) -> int:
    """Return the number of the last event that a consumer has handled; 0 before its first."""
    query = select(_POSITIONS.c.number).where(_POSITIONS.c.consumer == consumer)
    return int(connection.execute(query).scalar() or 0)


def advance(connection: Connection, consumer: str, number: int) -> None:
    """Record that a consumer has handled all events up to `number`; a position never decreases."""
    mine = _POSITIONS.c.consumer == consumer
    if connection.execute(select(_POSITIONS.c.number).where(mine)).first() is None:
        connection.execute(insert(_POSITIONS).values(consumer=consumer, number=number))
        return
    connection.execute(update(_POSITIONS).where(mine, _POSITIONS.c.number < number).values(number=number))


def delete_before(connection: Connection, utc_ns: int) -> int:
    """Delete handled events older than a time; return their number. The newest event stays, for the next number."""
    handled = connection.execute(select(func.min(_POSITIONS.c.number))).scalar()
    last = last_number(connection)
    removable = _EVENTS.c.id < last if handled is None else _EVENTS.c.id <= min(int(handled), last - 1)
    return connection.execute(_EVENTS.delete().where(_EVENTS.c.utc_ns < utc_ns, removable)).rowcount
