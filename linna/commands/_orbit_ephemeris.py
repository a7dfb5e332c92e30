"""`linna orbit compare`, `interpolate` and `stats`: what is done with ephemeris files."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from linna.output import emit, finish
from linna.parser import option

if TYPE_CHECKING:
    from lunar.ephemeris import Ephemeris


def configure_compare(commands: Any) -> None:
    """Add `compare` to the subparsers of `linna orbit`."""
    compare = commands.add_parser("compare", help="difference of two ephemerides on common epochs")
    option(compare, "a A", Path, "ephemeris file; its orbit gives the axes")
    option(compare, "b B", Path, "ephemeris file (OEM, STK .e, Horizons CSV)")
    option(compare, "--step S", float, "seconds between epochs (default: the states of A)")
    option(compare, "--plot FILE", Path, "differences as a picture (png, svg or pdf)")
    finish(compare, run_compare)


def configure_interpolate(commands: Any) -> None:
    """Add `interpolate` to the subparsers of `linna orbit`."""
    interpolate = commands.add_parser("interpolate", help="states of an ephemeris at given UTC epochs")
    option(interpolate, "ephemeris F", Path, "ephemeris file (OEM, STK .e, Horizons CSV)")
    option(
        interpolate, "--epochs FILE", str, "UTC epochs, one a line (- reads standard input)", required=True
    )
    finish(interpolate, run_interpolate)


def configure_stats(commands: Any) -> None:
    """Add `stats` to the subparsers of `linna orbit`."""
    stats = commands.add_parser("stats", help="altitudes, passes and period of an ephemeris")
    option(stats, "ephemeris F", Path, "ephemeris file (OEM, STK .e, Horizons CSV)")
    option(stats, "--step S", float, "seconds between epochs (default: the states of the file)")
    option(stats, "--plot FILE", Path, "altitudes as a picture (png, svg or pdf)")
    finish(stats, run_stats)


def configure_convert(commands: Any) -> None:
    """Add `convert` to the subparsers of `linna orbit`."""
    convert = commands.add_parser("convert", help="an ephemeris as OEM, SPK, STK .e, CSV or TUM")
    option(
        convert,
        "ephemeris F",
        Path,
        "OEM (text or XML), STK .e, Horizons CSV (all also as .gz or .zip), or SPK",
    )
    option(convert, "--out FILE", Path, "ending in .oem, .xml, .bsp, .e, .csv or .tum", required=True)
    option(convert, "--spice-id N", int, "SPICE number of the spacecraft in an SPK, such as -85")
    option(convert, "--step S", float, "seconds between states (default: the states of the file)")
    finish(convert, run_convert)


def run_compare(arguments: argparse.Namespace) -> int:
    from lunar.comparison import compare
    from lunar.messages.ephemeris_files import load_ephemeris
    from lunar.timescales import format_utc

    first, second = load_ephemeris(arguments.a), load_ephemeris(arguments.b)
    epochs = _epochs(arguments.step, first)
    if epochs is not None:
        epochs = epochs[second.covers(epochs)]
    difference = compare(first, second, epochs if epochs is not None and len(epochs) else None)
    figures: dict[str, Any] = {
        "max_m": difference.max_m,
        "rms_m": difference.rms_m,
        "rms_rtn_m": list(difference.rms_rtn_m),
        "samples": difference.samples,
        "start": format_utc(int(difference.utc_ns[0])),
        "stop": format_utc(int(difference.utc_ns[-1])),
    }
    if arguments.plot is not None:
        from reports.studies import save_difference_plot

        names = (arguments.a.name, arguments.b.name)
        caption = f"{difference.samples} epochs, greatest distance {difference.max_m:.6g} m"
        save_difference_plot(arguments.plot, difference.utc_ns, difference.position_rtn_m, names, caption)
        figures["plot"] = str(arguments.plot)
    radial, transverse, normal = difference.rms_rtn_m
    text = (
        f"{difference.samples} epochs from {figures['start']} to {figures['stop']}\n"
        f"distance: max {difference.max_m:.6g} m, rms {difference.rms_m:.6g} m\n"
        f"rms radial {radial:.6g} m, transverse {transverse:.6g} m, normal {normal:.6g} m"
    )
    return emit(arguments, figures, text=text)


def run_interpolate(arguments: argparse.Namespace) -> int:
    import numpy as np

    from linna.data import data_folder
    from lunar.datafolder import default_orientation
    from lunar.ground_track import ground_track
    from lunar.messages.ephemeris_files import load_ephemeris
    from lunar.timescales import format_utc

    ephemeris = load_ephemeris(arguments.ephemeris)
    epochs = np.array(_read_epochs(arguments.epochs), dtype=np.int64)
    orientation = default_orientation(data_folder())
    position_m, velocity_m_s = ephemeris.at(epochs)
    track = ground_track(ephemeris, orientation, epochs)
    states = [
        {
            "epoch": format_utc(int(epoch), 9 if epoch % 1_000_000 else 3),
            "position_km": (position_m[k] / 1e3).tolist(),
            "velocity_km_s": (velocity_m_s[k] / 1e3).tolist(),
            "latitude_deg": float(np.degrees(track.latitude_rad[k])),
            "longitude_deg": float(np.degrees(track.longitude_rad[k])),
            "altitude_km": float(track.altitude_m[k]) / 1e3,
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
            "frame": "ICRF, Moon-centred",
            "orientation": orientation.name,
            "data": [f"lunar orientation {orientation.name}"],
        },
        text="\n".join(lines),
    )


def run_stats(arguments: argparse.Namespace) -> int:
    import numpy as np

    from linna.data import data_folder
    from lunar.datafolder import default_orientation
    from lunar.ground_track import ground_track, track_statistics
    from lunar.messages.ephemeris_files import load_ephemeris
    from lunar.timescales import format_utc

    ephemeris = load_ephemeris(arguments.ephemeris)
    orientation = default_orientation(data_folder())
    track = ground_track(ephemeris, orientation, _epochs(arguments.step, ephemeris))
    numbers = track_statistics(ephemeris, track)
    figures: dict[str, Any] = {
        "states": numbers.states,
        "start": format_utc(int(track.utc_ns[0])),
        "stop": format_utc(int(track.utc_ns[-1])),
        "segments": len(ephemeris.segments),
        "altitude_km": {
            "mean": numbers.altitude_mean_m / 1e3,
            "min": numbers.altitude_min_m / 1e3,
            "max": numbers.altitude_max_m / 1e3,
        },
        "speed_km_s": numbers.speed_mean_m_s / 1e3,
        "ground_speed_km_s": numbers.ground_speed_mean_m_s / 1e3,
        "period_min": numbers.period_s / 60.0,
        "passes_within_60_deg": numbers.passes,
        "share_within_60_deg": numbers.share_inside,
        "orientation": orientation.name,
        "data": [f"lunar orientation {orientation.name}"],
    }
    if arguments.plot is not None:
        from reports.studies import save_altitude_plot

        save_altitude_plot(
            arguments.plot,
            track.utc_ns,
            track.altitude_m / 1e3,
            np.degrees(track.latitude_rad),
            f"{arguments.ephemeris.name}: {numbers.states} states; orientation {orientation.name}",
            [segment.start_utc_ns for segment in ephemeris.segments[1:]],
        )
        figures["plot"] = str(arguments.plot)
    altitude = figures["altitude_km"]
    text = (
        f"{numbers.states} states from {figures['start']} to {figures['stop']}, {len(ephemeris.segments)} segments\n"
        f"altitude: mean {altitude['mean']:.2f}, min {altitude['min']:.2f}, max {altitude['max']:.2f} km\n"
        f"speed {figures['speed_km_s']:.3f} km/s, over ground {figures['ground_speed_km_s']:.3f} km/s, "
        f"period {figures['period_min']:.2f} min\n"
        f"within 60 deg of the equator: {numbers.share_inside:.1%} of the time in {numbers.passes} passes"
    )
    return emit(arguments, figures, text=text)


def run_convert(arguments: argparse.Namespace) -> int:
    import os

    from linna.data import data_folder
    from linna.errors import UsageError
    from lunar.datafolder import default_orientation
    from lunar.ephemeris import ephemeris_from_states
    from lunar.messages.ephemeris_files import is_spk, load_ephemeris
    from lunar.messages.oem import format_oem
    from lunar.messages.oem_xml import format_oem_xml
    from lunar.messages.spice import READ_STEP_S, load_spk, spk_octets
    from lunar.messages.stk import format_stk
    from lunar.messages.tabular import format_csv, format_tum

    writers: dict[str, Callable[[Ephemeris], str | bytes]] = {
        ".oem": format_oem,
        ".xml": format_oem_xml,
        ".bsp": lambda states: spk_octets(states, _spice_id(arguments)),
        ".e": format_stk,
        ".csv": lambda states: format_csv(states, default_orientation(data_folder())),
        ".tum": format_tum,
    }
    out: Path = arguments.out
    if out.suffix.lower() not in writers:
        raise UsageError(f"--out: expected a name ending in {', '.join(writers)}, found {out.name!r}")
    if is_spk(arguments.ephemeris):
        ephemeris = load_spk(arguments.ephemeris, arguments.spice_id, arguments.step or READ_STEP_S)
    else:
        ephemeris = load_ephemeris(arguments.ephemeris)
    epochs = _epochs(arguments.step, ephemeris)
    if epochs is not None:
        name = ephemeris.segments[0].object_name
        ephemeris = ephemeris_from_states(epochs, *ephemeris.at(epochs), object_name=name)
    written = writers[out.suffix.lower()](ephemeris)
    part = out.with_name(out.name + ".part")
    try:
        part.write_bytes(written if isinstance(written, bytes) else written.encode())
        os.replace(part, out)
    finally:
        part.unlink(missing_ok=True)
    figures = {"out": str(out), "states": len(ephemeris.utc_ns), "segments": len(ephemeris.segments)}
    return emit(arguments, figures, text=f"{figures['states']} states -> {out}")


def _spice_id(arguments: argparse.Namespace) -> int:
    from linna.errors import UsageError

    if arguments.spice_id is None:
        raise UsageError("--spice-id: expected the SPICE number of the spacecraft, such as -85, found none")
    return int(arguments.spice_id)


def _epochs(step_s: float | None, ephemeris: Any) -> Any:
    from linna.errors import UsageError
    from lunar.ground_track import even_epochs

    if step_s is None:
        return None
    if not step_s > 0.0:
        raise UsageError(f"--step: expected seconds above 0, found {step_s:g}")
    return even_epochs(ephemeris, step_s)


def _read_epochs(name: str) -> list[int]:
    """UTC epochs of a file, one a line; blank lines and what follows a # are left out."""
    from lunar.ephemeris import read_text
    from lunar.errors import DataFileError, TimeFormatError
    from lunar.timescales import parse_utc

    text = sys.stdin.read() if name == "-" else read_text(name, "a list of UTC epochs")
    epochs = []
    for number, line in enumerate(text.splitlines(), start=1):
        wanted = line.partition("#")[0].strip()
        if not wanted:
            continue
        try:
            epochs.append(parse_utc(wanted))
        except TimeFormatError:
            expected = "a UTC epoch like 2029-08-07T00:00:00.000Z"
            raise DataFileError(name, f"line {number}", expected, repr(wanted)) from None
    if not epochs:
        raise DataFileError(name, "", "at least one UTC epoch", "none")
    return epochs
