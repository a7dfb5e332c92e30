"""`linna orbit`: propagate a scenario to an ephemeris; compare, interpolate and summarise ephemerides."""

from __future__ import annotations

import argparse
import math
import os
import time
from pathlib import Path
from typing import Any

from linna.commands._orbit_ephemeris import (
    configure_compare,
    configure_convert,
    configure_interpolate,
    configure_stats,
)
from linna.commands._orbit_visibility import configure_visibility
from linna.output import emit, finish, log
from linna.parser import option


def configure(parser: argparse.ArgumentParser) -> None:
    commands = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    propagate = commands.add_parser("propagate", help="propagate a scenario's orbit, write it as OEM")
    option(propagate, "scenario", str, "scenario file, or the name of a shipped one")
    option(propagate, "--days D", _positive, "span in days", 30.0)
    option(propagate, "--step S", _positive, "seconds between states", 30.0)
    option(propagate, "--out F.oem", Path, "ephemeris to write", required=True)
    option(propagate, "--gravity FILE", str, "coefficient file, or 'builtin'")
    option(propagate, "--degree N", int, "degree of the gravity field")
    option(propagate, "--integrator", ("rkn86", "dop853"), "another one than the scenario's")
    option(propagate, "--no-maneuvers", bool, "let the orbit drift freely")
    option(propagate, "--free-drift", bool, "report also when the orbit would hit the ground without burns")
    option(
        propagate,
        "--count-within-deg LAT",
        _positive,
        "count the states whose sub-satellite latitude is within this of the equator; may be repeated",
        [],
        action="append",
    )
    finish(propagate, run_propagate)
    configure_compare(commands)
    configure_interpolate(commands)
    configure_stats(commands)
    configure_convert(commands)
    configure_visibility(commands)


def run_propagate(arguments: argparse.Namespace) -> int:
    from linna.data import data_folder
    from lunar.messages.oem import save_oem
    from payload_emulator.session.orbit import force_model, free_impact, propagate_scenario, sample
    from payload_emulator.session.scenario import load_scenario

    out: Path = arguments.out
    if not out.parent.is_dir():
        raise FileNotFoundError(2, os.strerror(2), str(out.parent))
    scenario = _with_choices(load_scenario(arguments.scenario), arguments)
    data = data_folder()
    model = force_model(scenario, data)
    started = time.perf_counter()
    duration_s = arguments.days * 86_400.0
    orbit = propagate_scenario(scenario, model, duration_s)
    propagated = time.perf_counter()
    ephemeris, states = sample(orbit, arguments.step)
    part = out.with_name(out.name + ".part")
    try:
        save_oem(ephemeris, part)
        os.replace(part, out)
    finally:
        part.unlink(missing_ok=True)
    wall_s = time.perf_counter() - started
    log(
        f"propagated in {propagated - started:.2f} s, sampled and written in {wall_s - (propagated - started):.2f} s"
    )
    figures = _figures(orbit, states, wall_s)
    if arguments.count_within_deg:
        figures["states_within_deg"] = _states_within(orbit, states, arguments)
    figures["data"] = list(data.names()) or ["built-in gravity and IAU orientation only"]
    if arguments.free_drift:
        figures["free_drift"] = _impact_figures(free_impact(scenario, model, duration_s))
    figures["out"] = str(out)
    return emit(arguments, figures, _text(figures))


def _positive(text: str) -> float:
    value = float(text)
    if not (value > 0.0 and math.isfinite(value)):
        raise argparse.ArgumentTypeError(f"expected a number over 0, found {text!r}")
    return value


def _with_choices(scenario: Any, arguments: argparse.Namespace) -> Any:
    import dataclasses

    changes = {"gravity": arguments.gravity, "degree": arguments.degree, "integrator": arguments.integrator}
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


def _states_within(orbit: Any, states: Any, arguments: argparse.Namespace) -> dict[str, int]:
    """Number of states within each latitude of the equator: frames of a camera with the step as its interval."""
    import numpy as np

    from lunar.frames import spherical_from_mcmf
    from lunar.timescales import tdb_s_from_utc_ns

    step_ns = arguments.step * 1e9
    utc_ns = orbit.epoch_utc_ns + np.rint(np.arange(len(states)) * step_ns).astype(np.int64)
    rotation = orbit.model.orientation.mcmf_from_icrf(np.asarray(tdb_s_from_utc_ns(utc_ns), dtype=np.float64))
    latitude, _, _ = spherical_from_mcmf(np.einsum("nij,nj->ni", rotation, states[:, :3]))
    within = np.abs(np.degrees(latitude))
    return {f"{limit:g}": int(np.count_nonzero(within <= limit)) for limit in arguments.count_within_deg}


def _elements(elements: Any) -> dict[str, float]:
    return {
        "semi_major_axis_km": elements.semi_major_axis_m / 1e3,
        "eccentricity": elements.eccentricity,
        "inclination_deg": math.degrees(elements.inclination_rad),
        "raan_deg": math.degrees(elements.raan_rad),
        "argument_of_perilune_deg": math.degrees(elements.argument_of_perilune_rad),
        "true_anomaly_deg": math.degrees(elements.true_anomaly_rad),
    }


def _impact_figures(impact: Any) -> dict[str, Any]:
    from lunar.timescales import format_utc

    if impact is None:
        return {"impact": None}
    return {
        "impact": format_utc(impact.utc_ns),
        "latitude_deg": math.degrees(impact.latitude_rad),
        "longitude_deg": math.degrees(impact.longitude_rad) % 360.0,
    }


def _text(figures: dict[str, Any]) -> str:
    altitude, burns = figures["altitude_km"], figures["maneuvers"]
    lines = [
        f"{figures['forces']}, orientation {figures['orientation']}",
        f"altitude mean {altitude['mean']:.2f} km, min {altitude['min']:.2f} km, max {altitude['max']:.2f} km",
        f"{len(burns)} burns, {figures['delta_v_total_m_s']:.2f} m/s",
    ]
    lines += [
        f"{count} of {figures['states']} states within {limit} deg of the equator"
        for limit, count in figures.get("states_within_deg", {}).items()
    ]
    lines += [
        f"  {burn['epoch']}  {burn['delta_v_m_s']:.3f} m/s at {burn['place']}: "
        f"a {burn['before']['semi_major_axis_km']:.3f} -> {burn['after']['semi_major_axis_km']:.3f} km, "
        f"e {burn['before']['eccentricity']:.6f} -> "
        f"{burn['after']['eccentricity']:.6f}"
        for burn in burns
    ]
    if "free_drift" in figures:
        drift = figures["free_drift"]
        lines.append(
            f"without burns it hits the Moon at {drift['impact']}, latitude {drift['latitude_deg']:.2f} deg, longitude "
            f"{drift['longitude_deg']:.2f} deg E"
            if drift["impact"]
            else "without burns it stays above ground"
        )
    lines.append(f"{figures['states']} states in {figures['wall_s']:.2f} s -> {figures['out']}")
    return "\n".join(lines)
