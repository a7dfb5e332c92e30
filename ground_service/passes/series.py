"""Series read for plots: from samples where there are few, from roll-ups where there are many."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection

from ground_service.missions.timekeeping.core import IDEAL_CLOCK, utc_ns_of_ticks
from ground_service.passes.core import (
    Aggregates,
    Buckets,
    aggregate,
    downsample,
    downsample_aggregates,
    join,
)
from ground_service.passes.span import PassSpan
from ground_service.store import rollups, telemetry
from ground_service.store.rollups import HOUSEKEEPING_VALUES as PARAMETERS
from ground_service.store.rollups import STATE_VALUES

__all__ = [
    "PARAMETERS",
    "STATE_VALUES",
    "SampleSource",
    "Series",
    "SeriesReading",
    "kind_samples",
    "series_document",
]

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
        rows = rollups.rollup_rows(
            self.connection, *self._key(), level, first, last, self.source.places[name]
        )
        begin, used = utc_ns_of_ticks(rows[0], self.span.correlations)
        end, _ = utc_ns_of_ticks(rows[1], self.span.correlations)
        count, total, low, high = rows[3].T
        middle = Aggregates(begin, end, rows[2], count.astype(np.int64), total, low, high)
        pieces = [
            self._edge(name, start, first * width - 1),
            middle,
            self._edge(name, (last + 1) * width, stop),
        ]
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
        _time_texts(buckets.start_utc_ns),
        _time_texts(buckets.stop_utc_ns),
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


def _time_texts(utc_ns: Any) -> list[str]:
    """Return the texts of many times, as `http.times.time_text` does."""
    texts = np.datetime_as_string(np.asarray(utc_ns, dtype=np.int64).astype("datetime64[ns]"), unit="us")
    return [f"{text}Z" for text in texts.tolist()]
