"""Craters with the heights of their rims, kept on disk: to measure them makes all the ground on which they lie."""

from __future__ import annotations

import functools
import hashlib
import inspect
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from kernels import cache_folder, keep, kept
from lunar import constants
from lunar.arrays import IntArray
from lunar.catalogue import CraterCatalogue
from lunar.datafolder import DataFolder
from payload_emulator.session.scenario import Scenario
from payload_emulator.sim.terrain import tiles

KEPT = 32
"""Sets of craters that are kept, up to 2 MB each."""


def sources_of(scenario: Scenario, data: DataFolder) -> str:
    """Return a text that changes with anything that the terrain of a scenario is made of."""
    files = [*data.dem_tiles, *data.dem_sldem, *([data.dem_global] if data.dem_global else [])]
    files += [(data.root or Path()) / name for name in scenario.terrain.heights]
    parts = sorted({part for file in files for part in file.parent.glob(f"{file.stem}.*")})
    stated = [(str(part), part.stat().st_size, part.stat().st_mtime_ns) for part in parts]
    return repr((scenario.terrain, scenario.seed, stated))


def rims_of(scenario: Scenario, terrain: tiles.Terrain, craters: IntArray) -> CraterCatalogue:
    """Return the craters of useful size with the heights of their rims: on the sphere, or measured on the ground."""
    listed, navigation = terrain.catalogue, scenario.navigation
    diameter_m = listed.diameter_m[craters]
    least_km, most_km = navigation.catalogue_min_diameter_km, navigation.catalogue_max_diameter_km
    useful = craters[(diameter_m >= 1e3 * least_km) & (diameter_m <= 1e3 * most_km)]
    if scenario.has_flat_ground:
        return replace(listed.select(useful), rim_height_m=np.zeros(len(useful)))
    places = (listed.latitude_rad, listed.longitude_rad, listed.diameter_m, listed.depth_m, useful)
    key = hashlib.sha256(f"{_code()} {terrain.sources}".encode())
    for part in places:
        key.update(part.tobytes())
    name = f"rims-{key.hexdigest()}"
    octets = kept(name) if terrain.sources else None
    if octets is not None:
        terrain.take_measurements(useful, np.frombuffer(octets).reshape(-1, 4))
    found = terrain.measured(useful)
    if octets is not None or not terrain.sources:
        return found
    keep(name, terrain.measurements_m(useful).tobytes())
    with suppress(OSError):  # another process has deleted one
        newest = sorted(cache_folder().glob("rims-*"), key=lambda file: file.stat().st_mtime)
        for file in newest[:-KEPT]:
            file.unlink()
    return found


@functools.cache
def _code() -> str:
    """Return the hash of the code that measures, and of the compiler and the processor, which decide the last bit."""
    import llvmlite.binding
    import numba

    key = hashlib.sha256(
        f"{numba.__version__} {np.__version__} {llvmlite.binding.get_host_cpu_name()}".encode()
    )
    for module in (tiles, constants):
        for file in sorted(Path(inspect.getfile(module)).parent.glob("*.py")):
            key.update(file.read_bytes())
    return key.hexdigest()
