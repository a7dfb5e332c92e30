"""`linna catalogue register`: the shift from the craters of a list to the rims on a terrain, by place."""

import argparse
from pathlib import Path

from linna.commands._choices import parse_region
from linna.data import data_directory, data_folder
from linna.errors import UsageError
from linna.output import emit, finish
from linna.parser import option


def configure(parser: argparse.ArgumentParser) -> None:
    option(
        parser,
        "catalogue CATALOGUE",
        Path,
        "crater list (CSV, plain or gzip; default: that of the data folder)",
        nargs="?",
    )
    option(
        parser, "--terrain F", Path, "height rasters in any projection (default: those of the data folder)", nargs="+"
    )
    option(
        parser,
        "--out F",
        Path,
        "product to write (default: registration.json in the data folder, which terrain is then opened with)",
    )
    option(parser, "--region W,E,S,N", str, "degrees, longitude east", "0,360,-80,80")
    finish(parser, run)


def run(arguments: argparse.Namespace) -> int:
    from datetime import UTC, datetime

    from payload_emulator.sim.terrain.registering import PRODUCT, register, save_registration
    from payload_emulator.sim.terrain.registration import by_tile

    data = data_folder()
    catalogue = arguments.catalogue or data.catalogue_lu or data.catalogue_composite or data.catalogue_robbins
    terrain = arguments.terrain or list(data.dem_sldem or data.dem_tiles)
    if catalogue is None or not terrain:
        missing = "--terrain: expected height rasters" if catalogue else "CATALOGUE: expected a crater list"
        raise UsageError(f"{missing}, found none named and none in the data folder")
    made = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
    registration = register(catalogue, terrain, made, parse_region(arguments.region), data.dem_global)
    out = arguments.out or data_directory() / PRODUCT
    save_registration(out, registration)
    tiles = by_tile(registration)
    names = ("south_deg", "west_deg", "east_m", "north_m", "sigma_m", "rims")
    figures = {
        "tiles": [{name: getattr(tile, name) for name in names} for tile in tiles],
        "nodes": int(registration.row.size),
        "rims": int(registration.rims.sum()),
        "out": str(out),
        "data": [f"crater catalogue {catalogue.name}", f"{len(terrain)} height rasters"],
    }
    lines = [
        f"{tile.south_deg:6.1f} {tile.west_deg:6.1f}: {tile.east_m:5.0f} m east, {tile.north_m:5.0f} m north, "
        f"+- {tile.sigma_m:.0f} m, {tile.rims} rims"
        for tile in tiles
    ]
    return emit(
        arguments,
        figures,
        text="\n".join(
            [
                "rims on the terrain compared with the list; south and west edge of tiles of 15 degrees:",
                *lines,
                f"{out}: {registration.row.size} nodes, {registration.rims.sum()} rims",
            ]
        ),
    )
