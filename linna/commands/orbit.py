"""`linna orbit`: propagate a scenario to an ephemeris; compare, interpolate and convert ephemerides."""

import argparse
import math
import os
import time
from pathlib import Path
from typing import Any

from linna.commands._orbit_ephemeris import configure_compare, configure_convert, configure_interpolate
from linna.output import emit, finish, log, save
from linna.parser import ABOVE_ZERO, option


def configure(parser: argparse.ArgumentParser) -> None:
    commands = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    propagate = commands.add_parser("propagate", help="propagate a scenario's orbit, write it as OEM")
    option(propagate, "scenario", str, "scenario file, or the name of a shipped one")
    option(propagate, "--days D", ABOVE_ZERO, "span in days", 30.0)
    option(propagate, "--step S", ABOVE_ZERO, "seconds between states", 30.0)
    option(propagate, "--out F.oem", Path, "ephemeris to write", required=True)
    option(propagate, "--gravity FILE", str, "coefficient file, or 'builtin'")
    option(propagate, "--degree N", int, "degree of the gravity field")
    option(propagate, "--no-maneuvers", bool, "let the orbit drift freely")
    finish(propagate, run_propagate)
    configure_compare(commands)
    configure_interpolate(commands)
    configure_convert(commands)
    configure_visibility(commands)


def run_propagate(arguments: argparse.Namespace) -> int:
    from linna.data import data_folder
    from lunar.messages.oem import format_oem
    from payload_emulator.session.scenario import load_scenario
    from payload_emulator.session.world.orbit import force_model, propagate_to_impact, sample

    out: Path = arguments.out
    if not out.parent.is_dir():
        raise FileNotFoundError(2, os.strerror(2), str(out.parent))
    scenario = _with_choices(load_scenario(arguments.scenario), arguments)
    data = data_folder()
    model = force_model(scenario, data)
    started = time.perf_counter()
    duration_s = arguments.days * 86_400.0
    orbit, impact = propagate_to_impact(scenario, model, duration_s)
    propagated = time.perf_counter()
    ephemeris, states = sample(orbit, arguments.step)
    save(out, format_oem(ephemeris).encode())
    wall_s = time.perf_counter() - started
    log(f"propagated in {propagated - started:.2f} s, sampled and written in {wall_s - (propagated - started):.2f} s")
    figures = _figures(orbit, states, wall_s)
    figures["data"] = list(data.names()) or ["built-in gravity and IAU orientation only"]
    figures["out"] = str(out)
    figures["ends"] = "" if impact is None else f"{impact}: states until then"
    return emit(arguments, figures, _text(figures))


def _with_choices(scenario: Any, arguments: argparse.Namespace) -> Any:
    import dataclasses

    changes = {"gravity": arguments.gravity, "degree": arguments.degree}
    dynamics = dataclasses.replace(
        scenario.dynamics, **{key: value for key, value in changes.items() if value is not None}
    )
    maneuvers = dataclasses.replace(
        scenario.maneuvers, enabled=scenario.maneuvers.enabled and not arguments.no_maneuvers
    )
    return dataclasses.replace(scenario, dynamics=dynamics, maneuvers=maneuvers)


def _figures(orbit: Any, states: Any, wall_s: float) -> dict[str, Any]:
    import numpy as np

    from lunar.constants import MOON_RADIUS_M
    from lunar.timescales import format_utc

    altitude_km = (np.linalg.norm(states[:, :3], axis=1) - MOON_RADIUS_M) / 1e3
    return {
        "altitude_km": {
            "mean": float(altitude_km.mean()),
            "min": float(altitude_km.min()),
            "max": float(altitude_km.max()),
        },
        "maneuvers": [
            {
                "epoch": format_utc(burn.utc_ns),
                "delta_v_m_s": burn.delta_v_m_s,
                "place": burn.place,
                "before": _elements(burn.before),
                "after": _elements(burn.after),
            }
            for burn in orbit.maneuvers
        ],
        "delta_v_total_m_s": float(sum(burn.delta_v_m_s for burn in orbit.maneuvers)),
        "states": len(states),
        "wall_s": wall_s,
        "forces": orbit.model.name,
        "orientation": orbit.model.orientation.name,
        "evaluations": orbit.trajectory.evaluations,
    }


def _elements(elements: Any) -> dict[str, float]:
    return {
        "semi_major_axis_km": elements.semi_major_axis_m / 1e3,
        "eccentricity": elements.eccentricity,
        "inclination_deg": math.degrees(elements.inclination_rad),
        "raan_deg": math.degrees(elements.raan_rad),
        "argument_of_perilune_deg": math.degrees(elements.argument_of_perilune_rad),
        "true_anomaly_deg": math.degrees(elements.true_anomaly_rad),
    }


def _text(figures: dict[str, Any]) -> str:
    altitude, burns = figures["altitude_km"], figures["maneuvers"]
    lines = [
        f"{figures['forces']}, orientation {figures['orientation']}",
        f"altitude mean {altitude['mean']:.2f} km, min {altitude['min']:.2f} km, max {altitude['max']:.2f} km",
        f"{len(burns)} burns, {figures['delta_v_total_m_s']:.2f} m/s",
    ]
    lines += [
        f"  {burn['epoch']}  {burn['delta_v_m_s']:.3f} m/s at {burn['place']}: "
        f"a {burn['before']['semi_major_axis_km']:.3f} -> {burn['after']['semi_major_axis_km']:.3f} km, "
        f"e {burn['before']['eccentricity']:.6f} -> "
        f"{burn['after']['eccentricity']:.6f}"
        for burn in burns
    ]
    lines += [figures["ends"]] if figures["ends"] else []
    lines.append(f"{figures['states']} states in {figures['wall_s']:.2f} s -> {figures['out']}")
    return "\n".join(lines)


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
    option(visibility, "--step S", ABOVE_ZERO, "seconds between looks", 60.0)
    finish(visibility, run_visibility)


def run_visibility(arguments: argparse.Namespace) -> int:
    from linna.data import data_folder, load_orbit
    from linna.errors import UsageError
    from lunar.contacts import visibility_spans
    from lunar.datafolder import default_orientation
    from lunar.timescales import format_utc

    stations = tuple(_station(text) for text in arguments.station)
    if len({one.name for one in stations}) < len(stations):
        raise UsageError(f"--station: expected names of their own, found {', '.join(one.name for one in stations)}")
    orientation = default_orientation(data_folder())
    ephemeris = load_orbit(arguments.ephemeris)
    found = visibility_spans(ephemeris, orientation, stations, arguments.step)

    def listed(spans: tuple[tuple[int, int], ...]) -> list[dict[str, Any]]:
        return [
            {"start": format_utc(start), "stop": format_utc(stop), "duration_s": round((stop - start) / 1e9, 3)}
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
        "eclipses": figures["eclipses"],
        "nights below": figures["nights"],
        "occultations": figures["occultations"],
        **{f"contacts {name}": spans for name, spans in figures["contacts"].items()},
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
    return GroundStation(name, math.radians(values[0]), math.radians(values[1]), height_m, math.radians(elevation_deg))
