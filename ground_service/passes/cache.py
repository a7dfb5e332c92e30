"""Cache of repeated archive queries, invalidated by new data that can change the results.

An answer depends on the data of one vehicle in an interval of on-board time. The event log tells which data are new, so
a downlink invalidates only the answers on what it contains. An answer that several callers need at the same time is
made by one of them.
"""

from __future__ import annotations

import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Hashable
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeVar
from weakref import WeakKeyDictionary

from sqlalchemy import Connection, Engine

from ground_service.events import CorrelationChanged, TelemetryReceived
from ground_service.ground import Ground
from ground_service.passes.span import LAST_TICKS
from ground_service.passes.store import decoding_state
from ground_service.store.events import LoggedEvent, newest_event, read_events

if TYPE_CHECKING:
    from collections.abc import Iterator

KEPT = 64
"""Answers kept of a database."""

CHANGES_KEPT = 1024
"""Changes of the data that are remembered, and the largest number of new events that are looked at."""

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class _Change:
    """New data of a vehicle by the event of a number, from one on-board time to another."""

    number: int
    vehicle: int
    start_ticks: int
    stop_ticks: int


@dataclass(frozen=True, slots=True)
class _Answer:
    """Answer on the data of a vehicle in an interval, as of an event; `state` is what else it depends on."""

    value: Any
    state: Hashable
    number: int
    vehicle: int
    start_ticks: int
    stop_ticks: int

    def is_changed_by(self, change: _Change) -> bool:
        return (
            change.number > self.number
            and change.vehicle == self.vehicle
            and change.start_ticks <= self.stop_ticks
            and change.stop_ticks >= self.start_ticks
        )


@dataclass(slots=True)
class _Turn:
    """Right to make an answer, and the number of threads that have it or wait for it."""

    lock: threading.Lock = field(default_factory=threading.Lock)
    threads: int = 0


class _Answers:
    """Answers of one database, and the changes of its data up to the newest event seen."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._answers: OrderedDict[Hashable, _Answer] = OrderedDict()
        self._changes: deque[_Change] = deque(maxlen=CHANGES_KEPT)
        self._complete_from = 0
        self._newest: LoggedEvent | None = None
        self._turns: dict[Hashable, _Turn] = {}

    def look(self, connection: Connection) -> int:
        """Take account of the events that a connection sees; return the number of the newest one."""
        before = self._newest
        after = 0 if before is None else before.number - 1
        found = [] if before is None else read_events(connection, after, CHANGES_KEPT)
        if before is None or found[:1] != [before] or len(found) == CHANGES_KEPT:
            return self._begin_again(newest_event(connection))
        with self._lock:
            for event in found[1:]:
                self._note(event)
        return found[-1].number

    def _begin_again(self, newest: LoggedEvent | None) -> int:
        """Forget all answers: the changes since the newest event seen are not known."""
        with self._lock:
            self._answers.clear()
            self._changes.clear()
            self._newest = newest
            self._complete_from = 0 if newest is None else newest.number
        return self._complete_from

    def _note(self, event: LoggedEvent) -> None:
        if self._newest is None or event.number <= self._newest.number:
            return
        self._newest = event
        change = _change_of(event)
        if change is None:
            return
        if len(self._changes) == CHANGES_KEPT:
            self._complete_from = self._changes[0].number
        self._changes.append(change)
        for key in [key for key, one in self._answers.items() if one.is_changed_by(change)]:
            del self._answers[key]

    def find(self, key: Hashable, state: Hashable) -> _Answer | None:
        with self._lock:
            found = self._answers.get(key)
            if found is None or found.state != state:
                return None
            self._answers.move_to_end(key)
            return found

    def keep(self, key: Hashable, answer: _Answer) -> None:
        """Keep an answer unless newer data can have changed it."""
        with self._lock:
            if answer.number < self._complete_from or any(map(answer.is_changed_by, self._changes)):
                return
            self._answers[key] = answer
            self._answers.move_to_end(key)
            while len(self._answers) > KEPT:
                self._answers.popitem(last=False)

    @contextmanager
    def turn(self, key: Hashable) -> Iterator[None]:
        """Wait until no other thread makes an answer."""
        with self._lock:
            mine = self._turns.setdefault(key, _Turn())
            mine.threads += 1
        try:
            with mine.lock:
                yield
        finally:
            with self._lock:
                mine.threads -= 1
                if not mine.threads:
                    del self._turns[key]


_databases: WeakKeyDictionary[Engine, _Answers] = WeakKeyDictionary()
_lock = threading.Lock()


class Cache:
    """Cached answers on the data of one vehicle, as a connection sees them when this is made."""

    def __init__(self, ground: Ground, connection: Connection, vehicle: int) -> None:
        with _lock:
            self._answers = _databases.setdefault(ground.database.engine, _Answers())
        self._vehicle = vehicle
        self._number = self._answers.look(connection)
        self._decoding = decoding_state(connection, vehicle)

    def answer(
        self,
        key: Hashable,
        make: Callable[[], T],
        *,
        start_ticks: int = 0,
        stop_ticks: int = LAST_TICKS,
        state: Hashable = None,
    ) -> T:
        """Return what `make` gives, made again only if data of the interval, or `state`, are new.

        The interval includes the changes of time correlations and decodings of the vehicle in any case. What is stored
        while `make` reads belongs to a newer event than the one noted, so that the answer is made again the next time.
        """
        key, state = (self._vehicle, key), (self._decoding, state)
        found = self._answers.find(key, state)
        if found is None:
            with self._answers.turn(key):
                found = self._answers.find(key, state)
                if found is None:
                    value = make()
                    found = _Answer(value, state, self._number, self._vehicle, start_ticks, stop_ticks)
                    self._answers.keep(key, found)
        answer: T = found.value
        return answer


def _change_of(event: LoggedEvent) -> _Change | None:
    """Return the data that an event reports; an interval without an end if their times are unknown."""
    if event.kind == CorrelationChanged.event_kind:
        return _Change(event.number, CorrelationChanged.of(event).vehicle_id, 0, LAST_TICKS)
    if event.kind != TelemetryReceived.event_kind:
        return None
    new = TelemetryReceived.of(event)
    if new.first_ticks is None or new.last_ticks is None:
        return _Change(event.number, new.vehicle_id, 0, LAST_TICKS)
    first = new.first_ticks if new.first_sample_ticks is None else new.first_sample_ticks
    last = new.last_ticks if new.last_sample_ticks is None else new.last_sample_ticks
    return _Change(event.number, new.vehicle_id, first, last)
