"""Series read for plots, with their cache: from samples where there are few, from roll-ups where there are many."""

from __future__ import annotations

import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Hashable, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, TypeVar
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, Engine

from ground_service.ground import Ground
from ground_service.missions.timekeeping.core import IDEAL_CLOCK, utc_ns_of_ticks
from ground_service.passes.core import Aggregates, Buckets, aggregate, downsample, downsample_aggregates, join
from ground_service.passes.span import LAST_TICKS, PassSpan
from ground_service.passes.store import decoding_state
from ground_service.store.event_kinds import CorrelationChanged, TelemetryReceived
from ground_service.store.events import LoggedEvent, newest_event, read_events
from ground_service.telemetry import rollups
from ground_service.telemetry import store as telemetry
from ground_service.telemetry.rollups import HOUSEKEEPING_VALUES as PARAMETERS
from ground_service.telemetry.rollups import STATE_VALUES
from lunar.timescales import utc_texts

if TYPE_CHECKING:
    from collections.abc import Iterator


__all__ = ["PARAMETERS", "STATE_VALUES", "SampleSource", "Series", "SeriesReading", "kind_samples", "series_document"]

FEW_ROWS = 50_000
"""Up to this many samples are read one by one, which is exact to the sample and quick enough."""

COARSE = 8
"""Roll-ups are used where they give at least an eighth of the points that were asked for."""


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """A series of one value, made short, with the id of the time correlation used."""

    name: str
    unit: str
    samples: int
    correlation_id: int
    buckets: Buckets


@dataclass(frozen=True, slots=True, eq=False)
class SampleSource:
    """Samples that a series is read from, and their roll-ups.

    `code`, `version` and `part` are those of the roll-ups, and `places` the places of the values there, by name. `read`
    returns ``ticks`` and the named values (n,) in a span, in order of time.
    """

    code: int
    version: int
    part: int
    places: Mapping[str, int]
    read: Callable[[Connection, PassSpan, tuple[str, ...]], dict[str, NDArray[Any]]]


def kind_samples(kind: str, version: int, part: int = 0) -> SampleSource:
    """Return the samples of one kind (a table) decoded with one dictionary version; of one estimator by `part`."""
    code, column, values = rollups.KINDS[kind]
    equal = {} if column is None else {column: part}

    def read(connection: Connection, span: PassSpan, names: tuple[str, ...]) -> dict[str, NDArray[Any]]:
        where = (span.vehicle, span.start_ticks, span.stop_ticks, version)
        return telemetry.sample_arrays(connection, kind, where, ("ticks", *names), **equal)

    return SampleSource(code, version, part, {name: k for k, name in enumerate(values)}, read)


@dataclass(frozen=True, slots=True)
class SeriesReading:
    """Reads values of one source over a span of on-board time."""

    connection: Connection
    span: PassSpan
    source: SampleSource
    max_points: int

    def series(self, units: Mapping[str, str]) -> list[Series]:
        """Values of the samples, named with their units, all read at once."""
        level = self._level()
        if level is None:
            columns = self.source.read(self.connection, self.span, tuple(units))
            utc_ns, used = utc_ns_of_ticks(columns["ticks"], self.span.correlations)
            correlation = int(used[-1]) if len(used) else IDEAL_CLOCK
            return [
                Series(
                    name,
                    unit,
                    len(utc_ns),
                    correlation,
                    downsample(utc_ns, columns[name].astype(np.float64), self.max_points),
                )
                for name, unit in units.items()
            ]
        long = []
        for name, unit in units.items():
            found, correlation = self._aggregates(name, level)
            buckets = downsample_aggregates(found, self.max_points)
            long.append(Series(name, unit, int(found.rows.sum()), correlation, buckets))
        return long

    def _key(self) -> tuple[int, int, int, int]:
        return self.source.code, self.span.vehicle, self.source.version, self.source.part

    def _level(self) -> int | None:
        """The coarsest level of roll-ups that is fine enough; None where samples are few or all are coarse."""
        count, first, last = rollups.rolled_extent(
            self.connection, *self._key(), self.span.start_ticks, self.span.stop_ticks
        )
        if count <= FEW_ROWS:
            return None
        wanted = (min(last, self.span.stop_ticks) - max(first, self.span.start_ticks)) / self.max_points
        if rollups.width_ticks(0) > COARSE * wanted:
            return None
        fine = [level for level in range(rollups.LEVELS) if rollups.width_ticks(level) <= wanted]
        return fine[-1] if fine else 0

    def _aggregates(self, name: str, level: int) -> tuple[Aggregates, int]:
        """Whole buckets from the roll-ups; the samples of the two that the span cuts."""
        width = rollups.width_ticks(level)
        start, stop = self.span.start_ticks, self.span.stop_ticks
        first, last = -(-start // width), (stop + 1) // width - 1
        rows = rollups.rollup_rows(self.connection, *self._key(), level, first, last, self.source.places[name])
        begin, used = utc_ns_of_ticks(rows[0], self.span.correlations)
        end, _ = utc_ns_of_ticks(rows[1], self.span.correlations)
        count, total, low, high = rows[3].T
        middle = Aggregates(begin, end, rows[2], count.astype(np.int64), total, low, high)
        pieces = [self._edge(name, start, first * width - 1), middle, self._edge(name, (last + 1) * width, stop)]
        return join(pieces), int(used[-1]) if len(used) else IDEAL_CLOCK

    def _edge(self, name: str, start: int, stop: int) -> Aggregates:
        span = replace(self.span, start_ticks=start, stop_ticks=stop)
        columns = self.source.read(self.connection, span, (name,))
        utc_ns = utc_ns_of_ticks(columns["ticks"], self.span.correlations)[0]
        return aggregate(utc_ns, columns[name].astype(np.float64))


def series_document(series: Series) -> dict[str, Any]:
    """Return a series as the JSON values of `model.ParameterSeries`, formatting all times at once."""
    buckets = series.buckets
    columns = (
        utc_texts(buckets.start_utc_ns, "us"),
        utc_texts(buckets.stop_utc_ns, "us"),
        buckets.count.tolist(),
        buckets.low.tolist(),
        buckets.high.tolist(),
        buckets.mean.tolist(),
        buckets.after_gap.tolist(),
    )
    names = ("start", "stop", "count", "min", "max", "mean", "after_gap")
    return {
        "name": series.name,
        "unit": series.unit,
        "samples": series.samples,
        "correlation_id": series.correlation_id,
        "buckets": [dict(zip(names, values, strict=True)) for values in zip(*columns, strict=True)],
    }


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
