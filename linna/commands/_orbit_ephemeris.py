"""`linna orbit compare`, `interpolate` and `convert`: what is done with ephemeris files."""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from linna.output import emit, finish, save
from linna.parser import ABOVE_ZERO, option

if TYPE_CHECKING:
    from lunar.ephemeris import Ephemeris


def configure_compare(commands: Any) -> None:
    """Add `compare` to the subparsers of `linna orbit`."""
    compare = commands.add_parser("compare", help="difference of two ephemerides on common epochs")
    option(compare, "a A", Path, "ephemeris file; its orbit gives the axes")
    option(compare, "b B", Path, "ephemeris file (OEM, STK .e, Horizons CSV)")
    option(compare, "--step S", ABOVE_ZERO, "seconds between epochs (default: the states of A)")
    finish(compare, run_compare)


def configure_interpolate(commands: Any) -> None:
    """Add `interpolate` to the subparsers of `linna orbit`."""
    interpolate = commands.add_parser("interpolate", help="states of an ephemeris at given UTC epochs")
    option(interpolate, "ephemeris F", Path, "ephemeris file (OEM, STK .e, Horizons CSV)")
    option(interpolate, "--epochs FILE", str, "UTC epochs, one a line (- reads standard input)", required=True)
    finish(interpolate, run_interpolate)


def configure_convert(commands: Any) -> None:
    """Add `convert` to the subparsers of `linna orbit`."""
    convert = commands.add_parser("convert", help="an ephemeris as OEM, SPK, STK .e, CSV or TUM")
    option(convert, "ephemeris F", Path, "OEM (text or XML), STK .e, Horizons CSV (all also as .gz or .zip), or SPK")
    option(convert, "--out FILE", Path, "ending in .oem, .xml, .bsp, .e, .csv or .tum", required=True)
    option(convert, "--spice-id N", int, "SPICE number of the spacecraft in an SPK, such as -85")
    option(convert, "--step S", ABOVE_ZERO, "seconds between states (default: the states of the file)")
    option(convert, "--type N", ("3", "13"), "type of an SPK: 3 (polynomials) or 13 (states); default: 3 if exact")
    finish(convert, run_convert)


def run_compare(arguments: argparse.Namespace) -> int:
    from linna.data import load_orbit
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

    from linna.data import data_folder, load_orbit
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
    from linna.data import data_folder, load_orbit
    from linna.errors import UsageError
    from lunar.datafolder import default_orientation
    from lunar.ephemeris import resampled
    from lunar.messages.oem import format_oem
    from lunar.messages.oem_xml import format_oem_xml
    from lunar.messages.spice import spk_kernel
    from lunar.messages.stk import format_stk
    from lunar.messages.tabular import format_csv, format_tum

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
    from linna.errors import UsageError

    if arguments.spice_id is None:
        raise UsageError("--spice-id: expected the SPICE number of the spacecraft, such as -85, found none")
    return int(arguments.spice_id)


def _epochs(step_s: float | None, ephemeris: Any) -> Any:
    from lunar.ground_track import even_epochs

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
