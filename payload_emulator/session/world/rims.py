"""Craters with the heights of their rims, kept on disk: to measure them makes all the ground on which they lie."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from kernels import keep, kept
from lunar.arrays import IntArray
from lunar.catalogue import CraterCatalogue
from lunar.datafolder import DataFolder
from lunar.plausible import CRATER_DEPTH, HEIGHT_M
from payload_emulator.session.scenario import Scenario
from payload_emulator.sim.terrain.tiles import Terrain, ground_hash

Watched = Callable[[list[IntArray]], Iterable[IntArray]]
"""Function that yields the parts of a long work and shows its progress."""

PART = 2000
"""Craters of a part."""

KEPT = 32
"""Sets of craters that are kept, up to 2 MB each."""


def sources_of(scenario: Scenario, data: DataFolder) -> str:
    """Return a text that changes with anything that the terrain of a scenario is made of."""
    files = [*data.dem_tiles, *data.dem_sldem, *([data.dem_global] if data.dem_global else [])]
    files += [(data.root or Path()) / name for name in scenario.terrain.heights]
    parts = sorted({part for file in files for part in file.parent.glob(f"{file.stem}.*")})
    stated = [(str(part), part.stat().st_size, part.stat().st_mtime_ns) for part in parts]
    return repr((scenario.terrain, scenario.seed, stated))


def rims_of(scenario: Scenario, terrain: Terrain, craters: IntArray, watched: Watched = iter) -> CraterCatalogue:
    """Return the craters of useful size with the heights of their rims: on the sphere, or measured on the ground.

    `watched` yields the parts of a long measurement and shows its progress.
    """
    listed, navigation = terrain.catalogue, scenario.navigation
    diameter_m = listed.diameter_m[craters]
    least_km, most_km = navigation.catalogue_min_diameter_km, navigation.catalogue_max_diameter_km
    useful = craters[(diameter_m >= 1e3 * least_km) & (diameter_m <= 1e3 * most_km)]
    if scenario.has_flat_ground:
        return replace(listed.select(useful), rim_height_m=np.zeros(len(useful)))
    places = (listed.latitude_rad, listed.longitude_rad, listed.diameter_m, listed.depth_m, useful)
    name = f"rims-{ground_hash(terrain.sources, *places)}"
    octets = kept(name) if terrain.sources else None
    if octets is not None:
        terrain.take_measurements(useful, np.frombuffer(octets).reshape(-1, 4))
    elif useful.size:
        # From west to east, as the terrain is made.
        eastward = useful[np.argsort(listed.longitude_rad[useful], kind="stable")]
        for part in watched(np.array_split(eastward, 1 + useful.size // PART)):
            terrain.measured(part)
    found = terrain.measured(useful)
    if octets is None and terrain.sources:
        keep(name, terrain.measurements_m(useful).tobytes(), KEPT)
    # The ground of the procedural Moon is in places beyond all of the Moon's: such a rim counts as unknown.
    height_m, depth_m = found.rim_height_m, found.depth_m
    known = HEIGHT_M.holds(height_m) & CRATER_DEPTH.holds(np.nan_to_num(depth_m / found.diameter_m))
    return replace(found, rim_height_m=np.where(known, height_m, np.nan), depth_m=np.where(known, depth_m, np.nan))
