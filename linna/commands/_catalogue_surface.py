"""`linna catalogue surface`: how well crater rims give the ground below the laser altimeter."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from typing import TYPE_CHECKING

from linna.output import add_json_flag, emit, log

if TYPE_CHECKING:
    from studies.surface_error import SurfaceErrors


def configure(surface: argparse.ArgumentParser) -> None:
    surface.add_argument(
        "scenario",
        nargs="?",
        default="altimeter",
        help="scenario of catalogue and terrain (default: altimeter)",
    )
    surface.add_argument(
        "--longitudes-deg",
        type=float,
        nargs="+",
        metavar="E",
        help="meridians (default: nine of training ground)",
    )
    surface.add_argument(
        "--latitude-limit-deg", type=float, default=60.0, help="both sides of the equator (default: 60)"
    )
    surface.add_argument("--spacing-km", type=float, default=2.0, help="distance of places (default: 2)")
    add_json_flag(surface)
    surface.set_defaults(handler=run)


def run(arguments: argparse.Namespace) -> int:
    from linna.data import data_folder
    from linna.errors import UsageError
    from payload_emulator.flight.instruments.altimeter import AltimeterParameters
    from payload_emulator.session.scenario import load_scenario
    from payload_emulator.sim.terrain.opening import open_terrain
    from studies.surface_error import TRACKS_DEG, study_surface

    if not 0.0 < arguments.latitude_limit_deg <= 75.0:
        raise UsageError(
            f"--latitude-limit-deg: expected above 0 and up to 75, found {arguments.latitude_limit_deg:g}"
        )
    if not 0.1 <= arguments.spacing_km <= 50.0:
        raise UsageError(f"--spacing-km: expected 0.1 to 50, found {arguments.spacing_km:g}")
    scenario = load_scenario(arguments.scenario)
    terrain = open_terrain(scenario.terrain.source, data_folder(), scenario.seed)
    parameters = AltimeterParameters() if terrain.is_real else AltimeterParameters(rim_height_share=0.0)
    longitudes = tuple(arguments.longitudes_deg or TRACKS_DEG)
    log(f"{len(longitudes)} meridians over {terrain.name}")
    found = study_surface(
        terrain, scenario, parameters, longitudes, arguments.latitude_limit_deg, 1e3 * arguments.spacing_km
    )
    level = "3s: real terrain, also used in training" if terrain.is_real else "2: procedural Moon"
    figures = {
        **asdict(found),
        "parameters": asdict(parameters),
        "scenario": scenario.name,
        "seed": scenario.seed,
        "level": f"level {level}",
        "data": list(terrain.data_names),
    }
    emit(arguments, figures, text="\n".join([*_lines(found), f"level {level}"]))
    return 0


def _lines(found: SurfaceErrors) -> list[str]:
    lines = [f"{'longitude':>10}{'places':>8}{'known':>8}{'mean m':>9}{'rms m':>8}"]
    lines += [
        f"{track.longitude_deg:>10.1f}{track.places:>8}{100.0 * track.known_share:>7.1f}%"
        f"{track.mean_m:>9.0f}{track.sigma_m:>8.0f}"
        for track in found.tracks
    ]
    lines.append(
        f"all: mean {found.bias_m:.0f} m, rms {found.sigma_m:.0f} m, {found.calm_sigma_m:.0f} m where the rims scatter "
        f"least (a quarter of the places); rms of error over claimed sigma {found.scaled_rms:.2f}"
    )
    pairs = ", ".join(
        f"{value:.2f} over {distance / 1e3:g} km" for distance, value in found.correlation.items()
    )
    return [*lines, f"correlation of errors: {pairs}"]
