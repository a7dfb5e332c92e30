"""`linna camera`: the choice of the field of view."""

import argparse
from pathlib import Path

from linna.commands._choices import CATALOGUE_HELP, open_catalogue
from linna.data import data_folder, load_orbit
from linna.output import emit, finish, log
from linna.parser import ABOVE_ZERO, number, option

FIGURES = (
    "selected_fov_deg", "selected_every_altitude_deg", "needed", "threshold", "positions", "positions_covered",
    "craters",
)  # fmt: skip
"""Values of a study of the field of view that are printed as they are."""


def configure(parser: argparse.ArgumentParser) -> None:
    commands = parser.add_subparsers(title="commands", metavar="COMMAND")
    study = commands.add_parser("fov-study", help="probability of craters in the footprint over the field of view")
    option(study, "--ephemeris F", Path, "ephemeris file (OEM, STK .e, Horizons CSV)", required=True)
    option(study, "--catalogue F", str, CATALOGUE_HELP)
    option(study, "--seed", int, "seed of a synthetic catalogue", 1)
    option(study, "--step S", ABOVE_ZERO, "seconds between positions (default: every state of the file)")
    option(study, "--needed N", number(int, least=1, most=50), "craters needed", 3)
    option(study, "--threshold P", number(least=0, below=1), "probability to exceed", 0.9)
    finish(study, run_fov_study)


def run_fov_study(arguments: argparse.Namespace) -> int:
    import numpy as np

    from lunar.datafolder import default_orientation
    from lunar.fov_study import PAPER_COUNTS, study_field_of_view
    from lunar.frames import mcmf_from_spherical
    from lunar.ground_track import even_epochs, ground_track

    ephemeris = load_orbit(arguments.ephemeris)
    catalogue = open_catalogue(arguments.catalogue, arguments.seed)
    orientation = default_orientation(data_folder())
    epochs = None if arguments.step is None else even_epochs(ephemeris, arguments.step)
    track = ground_track(ephemeris, orientation, epochs)
    log(f"{len(track.utc_ns)} positions, {len(catalogue)} craters of {catalogue.source}")
    study = study_field_of_view(
        mcmf_from_spherical(track.latitude_rad, track.longitude_rad, track.altitude_m),
        catalogue,
        np.arange(10.0, 160.0 + 1e-9, 10.0).tolist(),
        tuple(sorted({*PAPER_COUNTS, arguments.needed})),
        arguments.needed,
        arguments.threshold,
    )
    figures = {
        "fov_deg": study.fov_deg,
        "probability_at_least": {str(n): values for n, values in study.probability_at_least.items()},
        **{name: getattr(study, name) for name in FIGURES},
        "altitude_km": {
            "min": float(track.altitude_m.min()) / 1e3,
            "mean": float(track.altitude_m.mean()) / 1e3,
            "max": float(track.altitude_m.max()) / 1e3,
        },
        "source": study.source,
        "orientation": orientation.name,
        "data": [f"crater catalogue {study.source}", f"lunar orientation {orientation.name}"],
    }
    covered = f"{study.positions_covered} of {study.positions} positions lie where the catalogue is complete"
    counts = list(study.probability_at_least)
    lines = ["  FoV  " + "  ".join(f"P(>={n:2d})" for n in counts)]
    for k, fov_deg in enumerate(study.fov_deg):
        row = "  ".join(f"{study.probability_at_least[n][k]:7.4f}" for n in counts)
        lines.append(f"{fov_deg:5g}  {row}")
    chosen = "none" if np.isnan(study.selected_fov_deg) else f"{study.selected_fov_deg:g} deg"
    lines.append(f"smallest with P(>={study.needed}) > {study.threshold:g}: {chosen}; {covered}; {study.source}")
    return emit(arguments, figures, text="\n".join(lines))
