"""`linna orbit`: propagate a scenario to an ephemeris; compare, interpolate and convert ephemerides."""

import argparse
import math
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from linna.data import data_folder, load_orbit
from linna.errors import UsageError
from linna.output import emit, finish, log, save
from linna.parser import ABOVE_ZERO, option

if TYPE_CHECKING:
    from lunar.ephemeris import Ephemeris


def configure_orbit(parser: argparse.ArgumentParser) -> None:
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

    compare = commands.add_parser("compare", help="difference of two ephemerides on common epochs")
    option(compare, "a A", Path, "ephemeris file; its orbit gives the axes")
    option(compare, "b B", Path, "ephemeris file (OEM, STK .e, Horizons CSV)")
    option(compare, "--step S", ABOVE_ZERO, "seconds between epochs (default: the states of A)")
    finish(compare, run_compare)

    interpolate = commands.add_parser("interpolate", help="states of an ephemeris at given UTC epochs")
    option(interpolate, "ephemeris F", Path, "ephemeris file (OEM, STK .e, Horizons CSV)")
    option(interpolate, "--epochs FILE", str, "UTC epochs, one a line (- reads standard input)", required=True)
    finish(interpolate, run_interpolate)

    convert = commands.add_parser("convert", help="an ephemeris as OEM, SPK, STK .e, CSV or TUM")
    option(convert, "ephemeris F", Path, "OEM (text or XML), STK .e, Horizons CSV (all also as .gz or .zip), or SPK")
    option(convert, "--out FILE", Path, "ending in .oem, .xml, .bsp, .e, .csv or .tum", required=True)
    option(convert, "--spice-id N", int, "SPICE number of the spacecraft in an SPK, such as -85")
    option(convert, "--step S", ABOVE_ZERO, "seconds between states (default: the states of the file)")
    option(convert, "--type N", ("3", "13"), "type of an SPK: 3 (polynomials) or 13 (states); default: 3 if exact")
    finish(convert, run_convert)


def run_compare(arguments: argparse.Namespace) -> int:
    from lunar.comparison import compare
    from lunar.timescales import format_utc

    first, second = load_orbit(arguments.a), load_orbit(arguments.b)
    epochs = _epochs(arguments.step, first)
    if epochs is not None:
        epochs = epochs[second.covers(epochs)]
    difference = compare(first, second, epochs if epochs is not None and len(epochs) else None)
    figures: dict[str, Any] = {
        "max_m": difference.max_m,
        "rms_m": difference.rms_m,
        "mean_rtn_m": list(difference.mean_rtn_m),
        "rms_rtn_m": list(difference.rms_rtn_m),
        "samples": difference.samples,
        "start": format_utc(int(difference.utc_ns[0])),
        "stop": format_utc(int(difference.utc_ns[-1])),
        "a": first.words,
        "b": second.words,
    }
    rows = [
        f"{name:<4} radial {radial:.6g} m, transverse {transverse:.6g} m, normal {normal:.6g} m"
        for name, (radial, transverse, normal) in (("mean", difference.mean_rtn_m), ("rms", difference.rms_rtn_m))
    ]
    text = (
        f"A: {figures['a']}; B: {figures['b']}\n"
        f"{difference.samples} epochs from {figures['start']} to {figures['stop']}\n"
        f"distance: max {difference.max_m:.6g} m, rms {difference.rms_m:.6g} m\n" + "\n".join(rows)
    )
    return emit(arguments, figures, text=text)


def run_interpolate(arguments: argparse.Namespace) -> int:
    import numpy as np

    from lunar.datafolder import default_orientation
    from lunar.timescales import format_tai, tdb_s_from_tai_ns
    from lunar.visibility import subsatellite

    ephemeris = load_orbit(arguments.ephemeris)
    epochs = np.array(_read_epochs(arguments.epochs), dtype=np.int64)
    orientation = default_orientation(data_folder())
    position_m, velocity_m_s = ephemeris.at_tai(epochs)
    latitude, longitude, altitude_m = subsatellite(position_m, tdb_s_from_tai_ns(epochs), orientation)
    states = [
        {
            "epoch": format_tai(int(epoch), 9 if epoch % 1_000_000 else 3),
            "position_km": (position_m[k] / 1e3).tolist(),
            "velocity_km_s": (velocity_m_s[k] / 1e3).tolist(),
            "latitude_deg": float(np.degrees(latitude[k])),
            "longitude_deg": float(np.degrees(longitude[k])) % 360.0,
            "altitude_km": float(altitude_m[k]) / 1e3,
        }
        for k, epoch in enumerate(epochs)
    ]
    lines = ["epoch,x_km,y_km,z_km,vx_km_s,vy_km_s,vz_km_s,latitude_deg,longitude_deg,altitude_km"]
    lines += [
        ",".join(
            [
                state["epoch"],
                *(f"{v:.9f}" for v in state["position_km"]),
                *(f"{v:.12f}" for v in state["velocity_km_s"]),
                f"{state['latitude_deg']:.8f},{state['longitude_deg']:.8f},{state['altitude_km']:.6f}",
            ]
        )
        for state in states
    ]
    return emit(
        arguments,
        {
            "states": states,
            "file": ephemeris.words,
            "frame": "ICRF, Moon-centred",
            "orientation": orientation.name,
            "data": [f"lunar orientation {orientation.name}"],
        },
        text="\n".join(lines),
    )


def run_convert(arguments: argparse.Namespace) -> int:
    from lunar.datafolder import default_orientation
    from lunar.ephemeris import resampled
    from lunar.messages.oem import format_oem
    from lunar.messages.oem_xml import format_oem_xml
    from lunar.messages.spice import spk_kernel
    from lunar.messages.stk import format_csv, format_stk, format_tum

    writers: dict[str, Callable[[Ephemeris], Any]] = {
        ".oem": format_oem,
        ".xml": format_oem_xml,
        ".bsp": lambda states: spk_kernel(states, _spice_id(arguments), int(arguments.type or 0) or None),
        ".e": format_stk,
        ".csv": lambda states: format_csv(states, default_orientation(data_folder())),
        ".tum": format_tum,
    }
    out: Path = arguments.out
    if out.suffix.lower() not in writers:
        raise UsageError(f"--out: expected a name ending in {', '.join(writers)}, found {out.name!r}")
    ephemeris = load_orbit(arguments.ephemeris, arguments.spice_id, arguments.step)
    words = ephemeris.words
    if arguments.step or out.suffix.lower() in (".e", ".csv", ".tum"):
        ephemeris = resampled(ephemeris, arguments.step)
    written = writers[out.suffix.lower()](ephemeris)
    figures: dict[str, Any] = {
        "out": str(out),
        "states": sum(len(segment.utc_ns) for segment in ephemeris.segments),
        "segments": len(ephemeris.segments),
        "file": words,
        "frame": "ICRF, Moon-centred",
    }
    text = f"{figures['states']} states in {figures['segments']} segments, {figures['frame']}"
    if out.suffix.lower() == ".bsp":
        figures |= {"states": written.states, "spk_type": written.data_type, "error_m": written.error_m}
        text = f"SPK of type {written.data_type}, {written.states} states, {figures['frame']}"
        if written.error_m is not None:
            text = text.replace("states", "records of polynomials") + f", within {written.error_m:.1e} m"
        written = written.octets
    save(out, written if isinstance(written, bytes) else written.encode())
    return emit(arguments, figures, text=f"{words}: {text} -> {out}")


def _spice_id(arguments: argparse.Namespace) -> int:
    if arguments.spice_id is None or arguments.spice_id >= 0:  # others are those of planets, the Moon and small bodies
        found = "none" if arguments.spice_id is None else arguments.spice_id
        raise UsageError(f"--spice-id: expected the SPICE number of the spacecraft, such as -85, found {found}")
    return int(arguments.spice_id)


def _epochs(step_s: float | None, ephemeris: Any) -> Any:
    from lunar.visibility import even_epochs

    return None if step_s is None else even_epochs(ephemeris, step_s)


def _read_epochs(name: str) -> list[int]:
    """TAI of UTC epochs in a file, one a line; blank lines and what follows a # are left out."""
    from lunar.ephemeris import read_text
    from lunar.errors import DataFileError, TimeFormatError
    from lunar.timescales import parse_tai

    text = sys.stdin.read() if name == "-" else read_text(name, "a list of UTC epochs")
    epochs = []
    for number, line in enumerate(text.splitlines(), start=1):
        wanted = line.partition("#")[0].strip()
        if not wanted:
            continue
        try:
            epochs.append(parse_tai(wanted))
        except TimeFormatError:
            expected = "a UTC epoch like 2029-08-07T00:00:00.000Z"
            raise DataFileError(name, f"line {number}", expected, repr(wanted)) from None
    if not epochs:
        raise DataFileError(name, "", "at least one UTC epoch", "none")
    return epochs


def run_propagate(arguments: argparse.Namespace) -> int:
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
