"""Contacts of a station with a spacecraft, and the decisions of a link, on plain values."""

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from lunar.constants import NS
from lunar.ephemeris import Ephemeris
from lunar.visibility import GroundStation, find_windows, link

STEP_S = 120.0
"""A contact behind the limb lasts an hour and more; shorter ones than this may be missed."""

EDGE_S = 1.0
BLOCK_NS = 6 * 3600 * NS
"""Visibility is computed once for each block of time; a query is a cut of blocks."""

LIGHT_MARGIN_NS = 3 * NS
"""A contact is evaluated at reception, so the ephemeris has to reach back by the light time (1.3 s)."""

CLOCK_LIMIT_S = 60.0
"""Difference of reception times from mission time above which the clock of the station is reported as wrong."""

FIRST_WAIT_S, LONGEST_WAIT_S = 0.5, 30.0

Span = tuple[int, int]
"""Start and stop, UTC in ns."""


@dataclass(frozen=True, slots=True)
class PredictedContact:
    """Span in which a station sees the spacecraft."""

    station: str
    start_utc_ns: int
    stop_utc_ns: int


def predict_contacts(
    ephemeris: Ephemeris,
    stations: Sequence[GroundStation],
    start_utc_ns: int,
    stop_utc_ns: int,
    outages: Mapping[str, Sequence[Span]] | None = None,
) -> tuple[PredictedContact, ...]:
    """Return the contacts of stations between two times as far as the ephemeris reaches, in order of time.

    Parameters
    ----------
    outages
        Spans without contacts, by station.
    """
    begin = max(start_utc_ns, ephemeris.start_utc_ns + LIGHT_MARGIN_NS)
    end = min(stop_utc_ns, ephemeris.stop_utc_ns)
    if end <= begin:
        return ()
    found = []
    for station in stations:
        closed = (outages or {}).get(station.name, ())
        for span in _visible_spans(ephemeris, station, begin, end):
            found += [PredictedContact(station.name, *part) for part in without(span, closed)]
    return tuple(sorted(found, key=lambda one: (one.start_utc_ns, one.station)))


def _visible_spans(ephemeris: Ephemeris, station: GroundStation, start_utc_ns: int, stop_utc_ns: int) -> list[Span]:
    """Return the spans between two times in which a station sees the spacecraft, in order of time."""
    spans: list[Span] = []
    for block in range(start_utc_ns // BLOCK_NS, -(-stop_utc_ns // BLOCK_NS)):
        for first, last in _spans_of_block(ephemeris, station, block):
            begin, end = max(first, start_utc_ns), min(last, stop_utc_ns)
            if begin >= end:
                continue
            if spans and spans[-1][1] >= begin:  # a span across the edge of two blocks
                spans[-1] = (spans[-1][0], end)
            else:
                spans.append((begin, end))
    return spans


@functools.lru_cache(maxsize=256)
def _spans_of_block(ephemeris: Ephemeris, station: GroundStation, block: int) -> tuple[Span, ...]:
    """Return the spans in which a station sees the spacecraft in a block, as far as the ephemeris reaches."""
    first = max(block * BLOCK_NS, ephemeris.start_utc_ns + LIGHT_MARGIN_NS)
    last = min((block + 1) * BLOCK_NS, ephemeris.stop_utc_ns)
    if last <= first:
        return ()
    return tuple(find_windows(lambda epochs: link(ephemeris, epochs, station).visible, first, last, STEP_S, EDGE_S))


def without(span: Span, closed: Sequence[Span]) -> list[Span]:
    """Return the parts of a span that are outside all closed spans."""
    parts = [span]
    for start, stop in closed:
        parts = [
            part
            for first, last in parts
            for part in ((first, min(last, start)), (max(first, stop), last))
            if part[0] < part[1]
        ]
    return parts


def contact_at(contacts: Sequence[PredictedContact], utc_ns: int, margin_ns: int = 0) -> PredictedContact | None:
    """Return the contact that contains a time, the margin before and after included; None without any."""
    for one in contacts:
        if one.start_utc_ns - margin_ns <= utc_ns <= one.stop_utc_ns + margin_ns:
            return one
    return None


def is_silent(heard_utc_ns: int, now_utc_ns: int, silence_s: float) -> bool:
    """Return whether a contact has ended: nothing was received for this time."""
    return now_utc_ns - heard_utc_ns > silence_s * NS


def next_wait_s(wait_s: float) -> float:
    """Return the wait before the next attempt to connect; 0 is the wait before the first."""
    return min(max(2.0 * wait_s, FIRST_WAIT_S), LONGEST_WAIT_S)


def clock_fault(offset_ns: int | None) -> str | None:
    """Return what is wrong with the clock of a station; None if its offset is small or unknown."""
    if offset_ns is None or abs(offset_ns) <= CLOCK_LIMIT_S * NS:
        return None
    return (
        f"the clock of the station differs by {offset_ns / NS:+.0f} s from mission time, expected at most "
        f"{CLOCK_LIMIT_S:.0f} s; telemetry is stored as usual"
    )
