"""`linna catalogue stats | curate | register | add | landmarks`: crater catalogues."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from linna.commands._choices import CATALOGUE_HELP, open_catalogue, parse_region
from linna.commands._table import Command, Commands, CustomCommand, Option
from linna.data import data_directory, data_folder
from linna.errors import UsageError
from linna.output import add_json_flag, emit, finish
from linna.parser import number, option

if TYPE_CHECKING:
    from lunar.arrays import FloatArray


def _configure_stats(stats: argparse.ArgumentParser) -> None:
    option(stats, "catalogue FILE", str, CATALOGUE_HELP, nargs="?")
    option(stats, "--seed", int, "seed of a synthetic catalogue", 1)
    finish(stats, run_stats)


def _configure_curate(curate: argparse.ArgumentParser) -> None:
    option(curate, "catalogue CATALOGUE", str, "crater list (CSV, plain or gzip)")
    option(
        curate,
        "--terrain F",
        Path,
        "height rasters in any projection (default: the 128 px/deg tiles of the available data)",
        nargs="+",
    )
    option(
        curate,
        "--out F",
        Path,
        "table to write: *.csv as text, without uncertainties; any other name as the table that is uploaded",
        required=True,
    )
    option(curate, "--region W,E,S,N", str, "degrees, longitude east", "0,360,-80,80")
    option(curate, "--min-diameter KM", number(least=0.5, below=30), "default: 3 km", 3.0)
    finish(curate, run_curate)


def run_stats(arguments: argparse.Namespace) -> int:
    from lunar.catalogue import PAPER_CLASS_COUNTS, catalogue_words, class_counts

    catalogue = open_catalogue(arguments.catalogue, arguments.seed)
    counts = [int(count) for count in class_counts(catalogue)]
    figures = {
        "class_counts": counts,
        "class_counts_paper": list(PAPER_CLASS_COUNTS),
        "class_share": [count / max(sum(counts), 1) for count in counts],
        "total": len(catalogue),
        "diameter_km": _range(catalogue.diameter_m / 1e3),
        "source": catalogue.source,
        "data": [f"crater catalogue {catalogue.source}"],
    }
    lines = [f"{catalogue.source}: {catalogue_words(catalogue)}"]
    names = ("5-10 km", "10-15 km", "15-30 km")
    lines += [
        f"class {k} ({name}): {count} (paper {paper})"
        for k, (name, count, paper) in enumerate(zip(names, counts, PAPER_CLASS_COUNTS, strict=True))
    ]
    return emit(arguments, figures, text="\n".join(lines)) or int(not len(catalogue))


def run_curate(arguments: argparse.Namespace) -> int:
    import numpy as np

    from lunar.catalogue import catalogue_words, format_catalogue, load_catalogue
    from payload_emulator.sim.terrain.curation import CurationRules, RasterHeights, curate
    from tmtc.dictionary.tables import pack_catalogue_table, table_hash

    region = parse_region(arguments.region)
    paths = arguments.terrain
    if paths is None:
        paths = [path for path in data_folder().dem_tiles if "128ppd" in path.name]
        if not paths:
            raise UsageError(
                "--terrain: expected height rasters, found none named and no tiles of 128 px/deg in the data folder"
            )
    rules = CurationRules(smallest_m=1e3 * arguments.min_diameter)
    listed = load_catalogue(arguments.catalogue)
    heights = RasterHeights(paths, data_folder().dem_global)
    curation = curate(listed, heights, region, rules)
    table = curation.table
    octets = pack_catalogue_table(table)
    if arguments.out.suffix == ".csv":
        written = format_catalogue(curation.catalogue(f"curated {listed.source}")).encode("ascii")
    else:
        written = octets
    if len(table):
        arguments.out.write_bytes(written)
    shift_m = np.hypot(*curation.shift_m.T)
    figures = {
        "kept": len(table),
        "dropped": curation.dropped,
        "registration_m": {"east": curation.offset_m[0], "north": curation.offset_m[1]},
        "registration_rims": int(curation.registration.rims.sum()),
        "registration_sigma_m": curation.offset_sigma_m,
        "height_correction_m": curation.height_correction_m,
        "pixels_per_degree": heights.pixels_per_degree,
        "terrain": heights.readings,
        "median_shift_m": float(np.median(shift_m)) if len(table) else None,
        "median_sigma_m": np.median(table.sigma_m, axis=0) if len(table) else None,
        "octets": len(octets),
        "table_hash": f"{table_hash(octets):08x}",
        "out": str(arguments.out),
        "data": [f"crater catalogue {listed.source}", *sorted({path.name.split("_")[0] for path in paths})],
    }
    lines = [
        f"{len(table)} craters kept of {len(table) + sum(curation.dropped.values())}; dropped: "
        + ", ".join(f"{reason} {count}" for reason, count in curation.dropped.items()),
        f"rims lie {curation.offset_m[0]:.0f} m east, {curation.offset_m[1]:.0f} m north of the list on average "
        f"(+- {curation.offset_sigma_m:.0f} m, by place from {curation.registration.rims.sum()} rims); "
        f"{heights.pixels_per_degree:g} px/deg, rim heights raised by {curation.height_correction_m:.0f} m",
        f"{listed.source}: {catalogue_words(listed)}",
        *(heights.readings if arguments.terrain else ()),
        f"{arguments.out}: {len(written)} octets, table {table_hash(octets):08x}"
        if len(table)
        else f"{arguments.out}: not written, no crater is kept",
    ]
    return emit(arguments, figures, text="\n".join(lines)) or int(not len(table))


def _range(values: FloatArray) -> dict[str, float]:
    if len(values) == 0:
        return {"min": float("nan"), "max": float("nan")}
    return {"min": float(values.min()), "max": float(values.max())}


def _configure_register(parser: argparse.ArgumentParser) -> None:
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
    finish(parser, run_catalogue_register)


def run_catalogue_register(arguments: argparse.Namespace) -> int:
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


def _configure_landmarks(landmarks: argparse.ArgumentParser) -> None:
    option(landmarks, "downlink FILE", Path, "downlink (CADUs or packets)")
    option(landmarks, "--catalogue F", str, "catalogue to compare with (default: the available one)")
    add_json_flag(landmarks)
    landmarks.set_defaults(handler=run_catalogue_landmarks, seed=1)


def run_catalogue_landmarks(arguments: argparse.Namespace) -> int:
    from ground_service.evaluation.fixes import compare_map, latest, mapped_craters
    from tmtc.dictionary.payload import DICTIONARY
    from tmtc.downlink import decode

    decoded = decode(arguments.downlink.read_bytes())
    table = DICTIONARY.unpack_many(decoded.buffer, decoded.cut).get("landmarks")
    catalogue = open_catalogue(arguments.catalogue, arguments.seed)
    reports = mapped_craters(table)
    mapped = latest(reports)
    result = compare_map(mapped, catalogue)
    figures = {
        "landmarks": len(mapped),
        "reports": len(reports),
        "in_catalogue": result.known,
        "new": len(mapped) - result.known,
        "median_horizontal_m": result.median_horizontal_m,
        "median_offset_m": dict(zip(("east", "north", "up"), result.median_offset_m, strict=True)),
        "normalised_square": result.normalised_square,
        "catalogue": catalogue.source,
    }
    text = f"{len(mapped)} landmarks mapped on board; {result.known} of them in {catalogue.source}"
    if result.known:
        text += (
            f", {result.median_horizontal_m:.0f} m from it (median); east and north squared over the claimed sigma: "
            f"{result.normalised_square:.2f}"
        )
    return emit(arguments, figures, text=text) or int(not mapped)


CATALOGUE: Commands = {
    "stats": CustomCommand("size classes of a crater catalogue", _configure_stats),
    "curate": CustomCommand("make the on-board anchoring catalogue from a crater list and terrain", _configure_curate),
    "register": CustomCommand("fit the registration of a crater list to terrain, by place", _configure_register),
    "add": Command(
        "add_catalogue",
        "have the ground service hold a catalogue, which a mission description names by its hash",
        lambda held: f"{held.name}: {held.sha256}",
        options={"file": Option("CSV, plain or gzip", "FILE")},
    ),
    "landmarks": CustomCommand("compare the map made by the payload with a catalogue", _configure_landmarks),
}
