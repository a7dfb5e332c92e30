"""On-board time interval of a pass: what its event reports say, and the housekeeping around it."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from sqlalchemy import Connection

from ground_service.missions.timekeeping.core import TimeCorrelation, ticks_of_utc_ns, utc_ns_of_ticks
from ground_service.missions.timekeeping.store import load_correlations
from ground_service.passes import store
from ground_service.passes.model import PassRecord
from ground_service.telemetry import store as telemetry
from ground_service.telemetry.decoding import readable_version
from lunar.arrays import IntArray
from tmtc.dictionary.codes import EVENTS

_EVENT_CODES = {name: code for code, name in EVENTS}
STARTED, STOPPED = _EVENT_CODES["observation_started"], _EVENT_CODES["observation_stopped"]

HOUSEKEEPING_NS = 60_001_000_000
"""Housekeeping this far before and after the observations of a pass belongs to it, if no other observation is near: a
minute, and what time correlations differ by."""

REACH_NS = 3_600_000_000_000
"""Event reports this far outside the planned time of a pass are read."""

LAST_TICKS = (1 << 48) - 1


@dataclass(frozen=True, slots=True)
class PassSpan:
    """On-board time interval of a pass, its correlation with UTC, and its dictionary version."""

    vehicle: int
    start_ticks: int
    stop_ticks: int
    correlations: tuple[TimeCorrelation, ...]
    dictionary_version: int

    @property
    def where(self) -> telemetry.Where:
        """Place of the samples."""
        return self.vehicle, self.start_ticks, self.stop_ticks, self.dictionary_version

    def utc_ns(self, ticks: Sequence[int] | IntArray) -> IntArray:
        """Return the correlated UTC (n,) of on-board ticks."""
        return utc_ns_of_ticks(np.array(ticks, dtype=np.int64), self.correlations)[0]


@dataclass(frozen=True, slots=True)
class ObservationSpan:
    """An observation by its event reports, on-board time; None where a report is missing, `planned` 0 if not stated."""

    start: int | None
    stop: int | None
    planned: int = 0


@dataclass(frozen=True, slots=True)
class Planned:
    """Planned on-board time of a window or pass; `window_id` None: a pass that was defined without a window."""

    start: int
    stop: int
    window_id: int | None = None


def observations(events: Iterable[tuple[int, int, int]]) -> list[ObservationSpan]:
    """Return the observations of event reports (on-board time, event, planned end), in order of time.

    A start during an observation begins another one: the payload takes the new end and cadence from then on.
    """
    found: list[ObservationSpan] = []
    going: ObservationSpan | None = None
    for ticks, event, planned in sorted(events, key=lambda one: (one[0], one[1] == STARTED)):
        if event == STARTED:
            if going is not None:
                found.append(ObservationSpan(going.start, ticks - 1, going.planned))
            going = ObservationSpan(ticks, None, planned)
        else:
            start, planned = (None, 0) if going is None else (going.start, going.planned)
            found.append(ObservationSpan(start, ticks, planned))
            going = None
    return found if going is None else [*found, going]


def belongs_to(one: ObservationSpan, mine: Planned, others: Sequence[Planned], margin: int) -> bool:
    """Return whether an observation is of `mine`, and not of one of the other windows.

    An observation has one window: that with the nearest start and end, of equally near ones the last entered. A pass
    without a window has every observation whose middle it contains.

    Parameters
    ----------
    margin
        Largest distance of an observation from the planned time of its window, ticks.
    """

    def apart(window: Planned) -> tuple[int, int]:
        planned = one.planned or window.stop
        if one.start is None:
            return abs((one.stop or planned) - window.stop), -(window.window_id or 0)
        return abs(one.start - window.start) + abs(planned - window.stop), -(window.window_id or 0)

    if one.start is None:
        least = mine.start if mine.window_id is None else (mine.start + mine.stop) // 2
        inside = least <= (one.stop or 0) <= mine.stop + margin
    elif mine.window_id is None:
        return mine.start <= (one.start + (one.stop or one.planned or one.start)) // 2 <= mine.stop
    else:
        inside = mine.start - margin <= one.start <= mine.stop + margin
    return inside and all(apart(mine) <= apart(other) for other in others)


def observation_events(connection: Connection, span: PassSpan) -> list[tuple[int, int, int]]:
    """Return on-board time, event and planned end of the reports of start and end of observations in an interval."""
    found = telemetry.samples(connection, "events", span.where, ("ticks", "event_id", "value_1"))
    rows = zip(found["ticks"], found["event_id"], found["value_1"], strict=True)
    return [(ticks, event, int(planned or 0)) for ticks, event, planned in rows if event in (STARTED, STOPPED)]


def vehicle_span(connection: Connection, vehicle: int, start_utc_ns: int | None, stop_utc_ns: int | None) -> PassSpan:
    """Return an interval of a vehicle's on-board time; None: without an end."""
    correlations = load_correlations(connection, vehicle)
    return PassSpan(
        vehicle,
        0 if start_utc_ns is None else ticks_of_utc_ns(start_utc_ns, correlations),
        LAST_TICKS if stop_utc_ns is None else ticks_of_utc_ns(stop_utc_ns, correlations),
        correlations,
        readable_version(connection, vehicle),
    )


def pass_span(connection: Connection, record: PassRecord) -> PassSpan:
    """Return the interval of a pass."""
    window_id = record.manifest.get("window_id")
    return observed_span(connection, record.vehicle_id, record.start_utc_ns, record.stop_utc_ns, window_id)


def observed_span(
    connection: Connection, vehicle: int, start_utc_ns: int, stop_utc_ns: int, window_id: int | None
) -> PassSpan:
    """Return the interval of the observations of a window, or of a pass without one, with the housekeeping around them.

    Its limits are the event reports of start and end. A missing start is the planned one; a missing end is the one that
    the start states, or the planned one, and a minute later. Housekeeping around is left out where frames or events
    of other observations are.
    """
    times = start_utc_ns - REACH_NS, stop_utc_ns + REACH_NS
    near = vehicle_span(connection, vehicle, *times)

    def ticks_of(utc_ns: int) -> int:
        return ticks_of_utc_ns(utc_ns, near.correlations)

    mine = Planned(ticks_of(start_utc_ns), ticks_of(stop_utc_ns), window_id)
    start, stop = ticks_of(start_utc_ns - HOUSEKEEPING_NS), ticks_of(stop_utc_ns + HOUSEKEEPING_NS)
    others = [
        Planned(ticks_of(first), ticks_of(last), key)
        for key, first, last in store.approved_windows(connection, vehicle, *times)
        if key != window_id
    ]
    found = observations(observation_events(connection, near))
    own = [one for one in found if belongs_to(one, mine, others, stop - mine.stop)]
    rest = set(found) - set(own)
    foreign = [ticks for one in rest for ticks in (one.start, one.stop) if ticks is not None]
    begin, end = (own[0].start, own[-1].stop) if own else (None, None)
    if begin is None:
        begin = max([start, *(ticks + 1 for ticks in foreign if ticks < (mine.start + mine.stop) // 2)])
    if end is None:
        end = ((own and own[-1].planned) or mine.stop) + stop - mine.stop
        end = min([end, *(ticks - 1 for ticks in foreign if ticks > begin)])

    def is_free(first: int, last: int) -> bool:
        """Return whether no event and no frame lies between two times, both included."""
        return not any(first <= ticks <= last for ticks in foreign) and not store.received_frames(
            connection, vehicle, near.dictionary_version, first, last
        )

    if start < begin and not is_free(start, begin - 1):
        start = begin
    if stop > end and not is_free(end + 1, stop):
        stop = end
    return replace(near, start_ticks=min(start, begin), stop_ticks=max(stop, end))
