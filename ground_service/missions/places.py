"""Places and outages of stations, as a mission description states them."""

import math

from ground_service.missions.model import Link, StationLink
from lunar.timescales import parse_utc
from lunar.visibility import GroundStation

DEFAULT_ELEVATION_DEG = 10.0


def stations_of(link: Link) -> tuple[GroundStation, ...]:
    """Return the stations of a mission whose place is stated."""
    found = (station_of(link, name) for name in link.stations or {})
    return tuple(one for one in found if one is not None)


def station_of(link: Link, name: str | None) -> GroundStation | None:
    """Return a station of a mission; None if its place is not stated."""
    stated = (link.stations or {}).get(name or "")
    if name is None or stated is None or stated.latitude_deg is None or stated.longitude_deg is None:
        return None
    elevation_deg = stated.minimum_elevation_deg
    return GroundStation(
        name,
        math.radians(stated.latitude_deg),
        math.radians(stated.longitude_deg),
        stated.height_m or 0.0,
        math.radians(DEFAULT_ELEVATION_DEG if elevation_deg is None else elevation_deg),
    )


def outages_of(link: Link) -> dict[str, list[tuple[int, int]]]:
    """Return the spans without contacts (UTC in ns) by station."""
    return {name: _spans(station) for name, station in (link.stations or {}).items() if station.outages}


def _spans(station: StationLink) -> list[tuple[int, int]]:
    spans = []
    for text in station.outages or ():
        start, _, stop = text.partition("/")
        spans.append((parse_utc(start), parse_utc(stop)))
    return spans
