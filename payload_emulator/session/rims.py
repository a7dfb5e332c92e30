"""Craters with the heights of their rims, kept on disk: to measure them makes all the ground on which they lie."""

from __future__ import annotations

import functools
import hashlib
from contextlib import suppress
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from kernels import cache_folder, keep, kept
from lunar.arrays import IntArray
from lunar.catalogue import CraterCatalogue
from lunar.datafolder import DataFolder
from payload_emulator.session.scenario import Scenario
from payload_emulator.sim.terrain.tiles import TiledTerrain

KEPT = 32
"""Sets of craters that are kept, up to 2 MB each."""

CODE = ("payload_emulator.sim.terrain", "lunar", "kernels")
"""Packages that decide what is measured."""


def sources_of(scenario: Scenario, data: DataFolder) -> str:
    """Return a text that changes with anything that the terrain of a scenario is made of."""
    files = [*data.dem_tiles, *data.dem_sldem, *([data.dem_global] if data.dem_global else [])]
    files += [(data.root or Path()) / name for name in scenario.terrain.heights]
    parts = sorted({part for file in files for part in file.parent.glob(f"{file.stem}.*")})
    stated = [(str(part), part.stat().st_size, part.stat().st_mtime_ns) for part in parts]
    return repr((scenario.terrain, scenario.seed, stated))


def rims_of(scenario: Scenario, terrain: TiledTerrain, craters: IntArray) -> CraterCatalogue:
    """Return the craters of useful size with the heights of their rims: on the sphere, or measured on the ground."""
    listed, navigation = terrain.catalogue, scenario.navigation
    diameter_m = listed.diameter_m[craters]
    least_km, most_km = navigation.catalogue_min_diameter_km, navigation.catalogue_max_diameter_km
    useful = craters[(diameter_m >= 1e3 * least_km) & (diameter_m <= 1e3 * most_km)]
    if scenario.has_flat_ground:
        return replace(listed.select(useful), rim_height_m=np.zeros(len(useful)))
    if not terrain.sources:
        return terrain.measured(useful)
    places = (listed.latitude_rad, listed.longitude_rad, listed.diameter_m, listed.depth_m, useful)
    key = hashlib.sha256(f"{_code()} {terrain.sources}".encode())
    for part in places:
        key.update(part.tobytes())
    name = f"rims-{key.hexdigest()}"
    octets = kept(name)
    if octets is not None:
        terrain.take_measurements(useful, np.frombuffer(octets).reshape(-1, 4))
        return terrain.measured(useful)
    found = terrain.measured(useful)
    keep(name, terrain.measurements(useful).tobytes())
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
    for package in CODE:
        spec = find_spec(package)
        assert spec is not None and spec.origin is not None
        for file in sorted(Path(spec.origin).parent.glob("*.py")):
            key.update(file.read_bytes())
    return key.hexdigest()
