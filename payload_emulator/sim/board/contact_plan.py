"""Contacts of a spacecraft with ground stations from their geometry: elevation, the Moon's limb, outages, light time.

One station at a time has the contact: the one that will see the spacecraft longest, until it sets.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from lunar.arrays import BoolArray, FloatArray, IntArray
from lunar.constants import NS
from lunar.ephemeris import Ephemeris
from lunar.errors import LunarError
from lunar.timescales import parse_utc
from lunar.visibility import GroundStation, find_windows, link
from payload_emulator.errors import ScenarioError
from payload_emulator.sim.board.link import STATIONS, station

_LIGHT_NS = 1_500_000_000
_STEP_S = 60.0
_TOLERANCE_S = 0.5
_LIGHT_STEP_NS = 60 * NS


class Geometry(Protocol):
    """Settings of a link that decide about its contacts (`LinkSection`)."""

    @property
    def stations(self) -> tuple[str, ...]: ...
    @property
    def minimum_elevation_deg(self) -> float: ...
    @property
    def outages(self) -> tuple[str, ...]: ...
    @property
    def missed(self) -> tuple[str, ...]: ...


@dataclass(frozen=True, slots=True)
class Outage:
    """Span in which a station does not listen."""

    station: str
    start_utc_ns: int
    stop_utc_ns: int


@dataclass(frozen=True, slots=True, eq=False)
class StationContact:
    """Contact of one station, by the time of emission at the spacecraft.

    `light_time_s` (n,) is the one-way light time at the instants `light_utc_ns` (n,).
    """

    station: str
    start_utc_ns: int
    stop_utc_ns: int
    light_utc_ns: IntArray
    light_time_s: FloatArray

    def light_s(self, utc_ns: int) -> float:
        """Return the one-way light time at an instant, in s."""
        # A minute of an orbit about the Moon bends the range by less than a kilometre, 2 us of light time.
        return float(np.interp(utc_ns, self.light_utc_ns, self.light_time_s))


def parse_outage(text: str) -> Outage:
    """Return the outage written as `STATION START STOP`.

    Raises
    ------
    ScenarioError
        The text has another form, or names no known station.
    """
    words = text.split()
    fault = f"link.outages: expected STATION START STOP (UTC) with one of {', '.join(STATIONS)}, found {text!r}"
    if len(words) != 3 or words[0] not in STATIONS:
        raise ScenarioError(fault)
    try:
        start, stop = parse_utc(words[1]), parse_utc(words[2])
    except LunarError:
        raise ScenarioError(fault) from None
    if start >= stop:
        raise ScenarioError(f"link.outages: expected a stop after the start, found {text!r}")
    return Outage(words[0], start, stop)


def parse_clock_error(text: str) -> tuple[str, int]:
    """Return station and error in ns of the clock written as `STATION SECONDS`.

    Raises
    ------
    ScenarioError
        The text has another form, or names no known station.
    """
    name, _, seconds = text.partition(" ")
    try:
        error_ns = round(float(seconds) * NS)
    except (ValueError, OverflowError):
        error_ns = None
    if error_ns is None or name not in STATIONS:
        raise ScenarioError(
            f"link.clock_errors: expected STATION SECONDS with one of {', '.join(STATIONS)}, found {text!r}"
        )
    return name, error_ns


def plan_contacts(ephemeris: Ephemeris, section: Geometry, start_utc_ns: int, stop_utc_ns: int) -> list[StationContact]:
    """Return the contacts between two instants in order of time, one station at a time."""
    outages = [parse_outage(text) for text in (*section.outages, *section.missed)]
    seen: list[tuple[int, int, GroundStation]] = []
    for name in section.stations:
        place = station(name, section.minimum_elevation_deg)
        own = [one for one in outages if one.station == name]

        def listens(utc_ns: IntArray, place: GroundStation = place, own: Sequence[Outage] = own) -> BoolArray:
            # Reception comes later than emission by the light time, within a third of a second of this.
            held = link(ephemeris, utc_ns + _LIGHT_NS, place).visible.copy()
            for one in own:
                held &= (utc_ns < one.start_utc_ns) | (utc_ns >= one.stop_utc_ns)
            return held

        seen += [
            (first, last, place)
            for first, last in find_windows(listens, start_utc_ns, stop_utc_ns, _STEP_S, _TOLERANCE_S)
        ]
    return [_with_light(ephemeris, first, last, place) for first, last, place in _one_at_a_time(seen)]


def _one_at_a_time(seen: Sequence[tuple[int, int, GroundStation]]) -> list[tuple[int, int, GroundStation]]:
    """Return spans that do not overlap: at each instant the station that sees longest, kept until it sets."""
    chosen: list[tuple[int, int, GroundStation]] = []
    now = min((first for first, _, _ in seen), default=0)
    while left := [one for one in seen if one[1] > now]:
        present = [one for one in left if one[0] <= now]
        if not present:
            now = min(one[0] for one in left)
            continue
        _, last, place = max(present, key=lambda one: one[1])
        chosen.append((now, last, place))
        now = last
    return chosen


def _with_light(ephemeris: Ephemeris, first: int, last: int, place: GroundStation) -> StationContact:
    times = np.append(np.arange(first, last, _LIGHT_STEP_NS, dtype=np.int64), np.int64(last))
    light_s = link(ephemeris, times + _LIGHT_NS, place).light_time_s
    # Of the reception that answers an emission at these instants.
    for _ in range(2):
        light_s = link(ephemeris, times + np.rint(light_s * NS).astype(np.int64), place).light_time_s
    return StationContact(place.name, first, last, times, np.asarray(light_s))
