"""`linna orbit visibility`: shadow, night, occultation and contacts along an ephemeris."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from linna.output import emit, finish
from linna.parser import option


def configure_visibility(commands: Any) -> None:
    """Add `visibility` to the subparsers of `linna orbit`."""
    visibility = commands.add_parser(
        "visibility", help="eclipses, nights, occultations and station contacts of an ephemeris"
    )
    option(visibility, "ephemeris F", Path, "ephemeris file (OEM, STK .e, Horizons CSV)")
    option(
        visibility,
        "--station NAME=LAT,LON[,HEIGHT_M[,MIN_ELEVATION]]",
        str,
        "ground station in degrees and metres, WGS 84; may be given several times",
        [],
        action="append",
    )
    option(visibility, "--step S", float, "seconds between looks", 60.0)
    finish(visibility, run_visibility)


def run_visibility(arguments: argparse.Namespace) -> int:
    from linna.data import data_folder
    from linna.errors import UsageError
    from lunar.contacts import visibility_spans
    from lunar.datafolder import default_orientation
    from lunar.messages.ephemeris_files import load_ephemeris
    from lunar.timescales import format_utc

    if not arguments.step > 0.0:
        raise UsageError(f"--step: expected seconds above 0, found {arguments.step:g}")
    stations = tuple(_station(text) for text in arguments.station)
    orientation = default_orientation(data_folder())
    ephemeris = load_ephemeris(arguments.ephemeris)
    found = visibility_spans(ephemeris, orientation, stations, arguments.step)

    def listed(spans: tuple[tuple[int, int], ...]) -> list[dict[str, Any]]:
        return [
            {
                "start": format_utc(start),
                "stop": format_utc(stop),
                "duration_s": round((stop - start) / 1e9, 3),
            }
            for start, stop in spans
        ]

    figures: dict[str, Any] = {
        "start": format_utc(found.start_utc_ns),
        "stop": format_utc(found.stop_utc_ns),
        "eclipses": listed(found.eclipse),
        "nights": listed(found.night),
        "occultations": listed(found.occultation),
        "contacts": {name: listed(spans) for name, spans in found.contacts.items()},
        "range_km": {"min": found.range_m[0] / 1e3, "max": found.range_m[1] / 1e3},
        "light_time_s": {"min": found.light_time_s[0], "max": found.light_time_s[1]},
        "orientation": orientation.name,
        "data": [f"lunar orientation {orientation.name}"],
    }
    kinds = {
        "eclipses": listed(found.eclipse),
        "nights below": listed(found.night),
        "occultations": listed(found.occultation),
        **{f"contacts {name}": listed(spans) for name, spans in found.contacts.items()},
    }
    whole_s = (found.stop_utc_ns - found.start_utc_ns) / 1e9
    lines = [f"{figures['start']} to {figures['stop']}, orientation {orientation.name}"]
    for name, spans in kinds.items():
        total_s = sum(span["duration_s"] for span in spans)
        lines.append(f"{name:<24} {len(spans):4d}, {total_s / 3600.0:8.2f} h, {total_s / whole_s:6.1%}")
    lines.append(
        f"range {figures['range_km']['min']:.0f} to {figures['range_km']['max']:.0f} km, "
        f"light time {found.light_time_s[0]:.3f} to {found.light_time_s[1]:.3f} s"
    )
    return emit(arguments, figures, text="\n".join(lines))


def _station(text: str) -> Any:
    import math

    from linna.errors import UsageError
    from lunar.visibility import GroundStation

    name, found, numbers = text.partition("=")
    try:
        values = [float(number) for number in numbers.split(",")]
    except ValueError:
        values = []
    good = bool(name and found) and 2 <= len(values) <= 4 and all(math.isfinite(value) for value in values)
    if not good or abs(values[0]) > 90.0:
        raise UsageError(
            f"--station: expected NAME=LATITUDE,LONGITUDE[,HEIGHT_M[,MIN_ELEVATION]] in degrees, found {text!r}"
        )
    height_m = values[2] if len(values) > 2 else 0.0
    elevation_deg = values[3] if len(values) > 3 else 10.0
    return GroundStation(
        name, math.radians(values[0]), math.radians(values[1]), height_m, math.radians(elevation_deg)
    )
