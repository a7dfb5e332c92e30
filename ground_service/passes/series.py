"""Series read for plots: from samples where there are few, from roll-ups where there are many."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Protocol

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
from lunar.arrays import FloatArray

__all__ = ["PARAMETERS", "STATE_VALUES", "KindSamples", "Series", "SeriesReading", "series_document"]

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


class SampleSource(Protocol):
    """Samples that a series is read from, and their roll-ups: `code`, `version` and `part` of these."""

    @property
    def code(self) -> int: ...
    @property
    def version(self) -> int: ...
    @property
    def part(self) -> int: ...

    def index(self, name: str) -> int:
        """Return the place of a value in the roll-ups."""

    def arrays(
        self, connection: Connection, span: PassSpan, names: tuple[str, ...]
    ) -> dict[str, NDArray[Any]]:
        """Return ``ticks`` and values (n,) in a span, in order of time."""

    def aggregates(self, connection: Connection, span: PassSpan, name: str, width_ticks: int) -> FloatArray:
        """Return stretches of a value as `telemetry.sample_aggregates` does."""


@dataclass(frozen=True, slots=True)
class KindSamples:
    """Samples of one kind (a table) decoded with one dictionary version; of one estimator where `part` is one."""

    kind: str
    version: int
    part: int = 0

    @property
    def code(self) -> int:
        """Code of the kind in the roll-ups."""
        return rollups.KINDS[self.kind][0]

    def index(self, name: str) -> int:
        """Return the place of a value in the roll-ups."""
        return rollups.KINDS[self.kind][2].index(name)

    def arrays(
        self, connection: Connection, span: PassSpan, names: tuple[str, ...]
    ) -> dict[str, NDArray[Any]]:
        """Return ``ticks`` and values (n,) in a span."""
        where = (span.vehicle, span.start_ticks, span.stop_ticks, self.version)
        return telemetry.sample_arrays(connection, self.kind, *where, ("ticks", *names), **self._equal)

    def aggregates(self, connection: Connection, span: PassSpan, name: str, width_ticks: int) -> FloatArray:
        """Return stretches of a value, aggregated by the database."""
        where = (span.vehicle, span.start_ticks, span.stop_ticks, self.version)
        return telemetry.sample_aggregates(connection, self.kind, *where, name, width_ticks, **self._equal)

    @property
    def _equal(self) -> dict[str, int]:
        column = rollups.KINDS[self.kind][1]
        return {} if column is None else {column: self.part}


@dataclass(frozen=True, slots=True)
class SeriesReading:
    """Reads values of one source over a span of on-board time."""

    connection: Connection
    span: PassSpan
    source: SampleSource
    max_points: int

    def series(self, units: Mapping[str, str]) -> list[Series]:
        """Values of the samples, named with their units, all read at once."""
        level, length = self._level()
        if length is None:
            columns = self.source.arrays(self.connection, self.span, tuple(units))
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
        return [self._long_series(name, unit, level, length) for name, unit in units.items()]

    def _long_series(self, name: str, unit: str, level: int | None, length: float) -> Series:
        found, correlation = self._grouped(name, length) if level is None else self._aggregates(name, level)
        return Series(
            name, unit, int(found.rows.sum()), correlation, downsample_aggregates(found, self.max_points)
        )

    def _level(self) -> tuple[int | None, float | None]:
        """The coarsest level of roll-ups that is fine enough, None where there is none; on-board ticks to a point.

        No ticks to a point where samples are few.
        """
        key = (self.source.code, self.span.vehicle, self.source.version, self.source.part)
        count, first, last = rollups.rolled_extent(
            self.connection, *key, self.span.start_ticks, self.span.stop_ticks
        )
        if count <= FEW_ROWS:
            return None, None
        wanted = (min(last, self.span.stop_ticks) - max(first, self.span.start_ticks)) / self.max_points
        if rollups.width_ticks(0) > COARSE * wanted:
            return None, wanted
        fine = [level for level in range(rollups.LEVELS) if rollups.width_ticks(level) <= wanted]
        return (fine[-1] if fine else 0), wanted

    def _grouped(self, name: str, length: float) -> tuple[Aggregates, int]:
        """Stretches of half the length (ticks), put together by the database from the samples."""
        width = max(int(length / 2.0), 1)
        found = self.source.aggregates(self.connection, self.span, name, width)
        first, last, rows, count = found[:, :4].astype(np.int64).T
        begin, used = utc_ns_of_ticks(first, self.span.correlations)
        end, _ = utc_ns_of_ticks(last, self.span.correlations)
        grouped = Aggregates(begin, end, rows, count, *found[:, 4:].T)
        return grouped, int(used[-1]) if len(used) else IDEAL_CLOCK

    def _aggregates(self, name: str, level: int) -> tuple[Aggregates, int]:
        """Whole buckets from the roll-ups; the samples of the two that the span cuts."""
        width = rollups.width_ticks(level)
        start, stop = self.span.start_ticks, self.span.stop_ticks
        first, last = -(-start // width), (stop + 1) // width - 1
        rows = rollups.rollup_rows(
            self.connection,
            self.source.code,
            self.span.vehicle,
            self.source.version,
            self.source.part,
            level,
            first,
            last,
            self.source.index(name),
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
        columns = self.source.arrays(self.connection, span, (name,))
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
