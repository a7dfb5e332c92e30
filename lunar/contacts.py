"""Spans of shadow, night side, occultation and contacts of an orbit."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lunar.arrays import BoolArray, IntArray
from lunar.constants import NS
from lunar.ephemeris import Ephemeris
from lunar.frames import Orientation
from lunar.third_bodies import earth_position_icrf_m, sun_position_icrf_m
from lunar.timescales import tdb_s_from_utc_ns
from lunar.visibility import GroundStation, find_windows, link, subsatellite, sun_elevation_azimuth, sunlit_fraction

Span = tuple[int, int]

_LIGHT_TIME_NS = 2 * NS
"""Margin of the ephemeris before a reception time: the transmission was up to 1.4 s earlier."""


@dataclass(frozen=True, slots=True)
class VisibilitySpans:
    """Spans of UTC (ns) within one stretch of an ephemeris.

    ``eclipse``: less than half of the Sun's disc is seen; ``night``: the Sun is below the horizon of the sub-satellite
    point; ``occultation``: the Moon's limb hides the Earth's centre; ``contacts``: by station, seen over its horizon.
    ``range_m`` and ``light_time_s`` are the smallest and the largest to the Earth's centre.
    """

    start_utc_ns: int
    stop_utc_ns: int
    eclipse: tuple[Span, ...]
    night: tuple[Span, ...]
    occultation: tuple[Span, ...]
    contacts: dict[str, tuple[Span, ...]]
    range_m: tuple[float, float]
    light_time_s: tuple[float, float]


def visibility_spans(
    ephemeris: Ephemeris, orientation: Orientation, stations: tuple[GroundStation, ...] = (), step_s: float = 60.0
) -> VisibilitySpans:
    """Return what sees what over a whole ephemeris, to a second.

    Spans shorter than ``step_s`` may be missed. The first two seconds are left out: the light of a link is that old.

    Raises
    ------
    EphemerisCoverageError
        Where the ephemeris has a gap.
    LunarError
        Where it is shorter than two seconds, or the step is not positive.
    """
    start, stop = ephemeris.start_utc_ns + _LIGHT_TIME_NS, ephemeris.stop_utc_ns

    def eclipsed(utc_ns: IntArray) -> BoolArray:
        tdb_s = tdb_s_from_utc_ns(utc_ns)
        share = sunlit_fraction(ephemeris.at(utc_ns)[0], sun_position_icrf_m(tdb_s), earth_position_icrf_m(tdb_s))
        return np.asarray(share < 0.5)

    def night(utc_ns: IntArray) -> BoolArray:
        tdb_s = tdb_s_from_utc_ns(utc_ns)
        latitude, longitude, _ = subsatellite(ephemeris.at(utc_ns)[0], tdb_s, orientation)
        sun = np.einsum("nij,nj->ni", orientation.mcmf_from_icrf(tdb_s), sun_position_icrf_m(tdb_s))
        return np.asarray(sun_elevation_azimuth(latitude, longitude, sun)[0] < 0.0)

    def hidden(utc_ns: IntArray) -> BoolArray:
        return ~link(ephemeris, utc_ns).visible

    def spans(condition: Callable[[IntArray], BoolArray]) -> tuple[Span, ...]:
        return tuple(find_windows(condition, start, stop, step_s))

    def seen_from(station: GroundStation) -> Callable[[IntArray], BoolArray]:
        return lambda utc_ns: link(ephemeris, utc_ns, station).visible

    found = {station.name: spans(seen_from(station)) for station in stations}
    whole = link(ephemeris, np.linspace(start, stop, 1 + int((stop - start) // (600 * NS)) + 1).astype(np.int64))
    return VisibilitySpans(
        start,
        stop,
        spans(eclipsed),
        spans(night),
        spans(hidden),
        found,
        (float(whole.range_m.min()), float(whole.range_m.max())),
        (float(whole.light_time_s.min()), float(whole.light_time_s.max())),
    )
