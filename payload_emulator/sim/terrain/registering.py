"""Registrations as files: found for a terrain, checked against its files, fitted and written."""

import functools
import hashlib
from collections.abc import Sequence
from dataclasses import replace
from importlib import resources
from pathlib import Path

import numpy as np

from lunar.catalogue import CraterCatalogue, load_catalogue
from lunar.datafolder import DataFolder
from payload_emulator.errors import TerrainError
from payload_emulator.sim.terrain.curation import RasterHeights, Region, measured_rims
from payload_emulator.sim.terrain.rasters import open_layers
from payload_emulator.sim.terrain.registration import (
    LATTICE_DEG,
    Registration,
    fit_registration,
    format_registration,
    parse_registration,
)

PRODUCT = "registration.json"
"""Name in the data folder."""

_SHIPPED = "lu1319381-gld100.json"
_EDGE_DEG = 1e-4
"""Nodes up to this beyond the edge of a raster lie on it."""


def find_registration(data: DataFolder, catalogue: Path, terrain: Sequence[Path]) -> Registration | None:
    """Return the registration of a catalogue file to height rasters; None where none was made of these files.

    That of the data folder comes first and must be of these files; the shipped one applies where it is. It holds on
    the rasters that it was made of, nowhere else.

    Raises
    ------
    TerrainError
        The registration of the data folder is damaged, or of other files than those of the same name.
    """
    path = None if data.root is None else data.root / PRODUCT
    if path is not None and path.is_file():
        registration = parse_registration(path.read_text(encoding="utf-8"), str(path))
        wrong = _other_file(registration, catalogue, terrain)
        if wrong:
            raise TerrainError(f"{path}: expected {wrong}; make it again (linna catalogue register)")
        return _on_rasters(registration, terrain)
    shipped = _shipped()
    return None if _other_file(shipped, catalogue, terrain) else _on_rasters(shipped, terrain)


def register(
    catalogue: Path, terrain: Sequence[Path], made_utc: str, region: Region, relief: Path | None = None
) -> Registration:
    """Return the registration of a catalogue file to height rasters, with its provenance.

    Raises
    ------
    TerrainError
        No clear rim of the catalogue lies on the rasters.
    """
    heights = RasterHeights(terrain, relief)
    rims = measured_rims(load_catalogue(catalogue), heights, region)
    if not len(rims):
        raise TerrainError(
            f"{catalogue}: expected clear rims of 4 to 16 km on {len(terrain)} rasters in the region, found none"
        )
    hashes = {path.name: file_sha256(path) for path in heights.files}
    return replace(fit_registration(rims), catalogue=file_sha256(catalogue), terrain=hashes, made_utc=made_utc)


def fitted(catalogue: CraterCatalogue, terrain: Sequence[Path]) -> Registration | None:
    """Return the registration of a catalogue to height rasters without provenance; None without a clear rim."""
    rims = measured_rims(catalogue, RasterHeights(terrain), Region())
    return fit_registration(rims) if len(rims) else None


def _on_rasters(registration: Registration, terrain: Sequence[Path]) -> Registration:
    """Return the nodes of a registration that lie on rasters that it was made of."""
    present = [path for path in terrain if path.name in registration.terrain]
    if len(present) == len(registration.terrain):
        return registration
    latitude, longitude = registration.row * LATTICE_DEG, registration.column * LATTICE_DEG
    edge = (-_EDGE_DEG, _EDGE_DEG)
    held = np.any(
        [
            layer.holds(np.radians(latitude + north), np.radians(longitude + east))
            for layer in open_layers(present)
            for north in edge
            for east in edge
        ],
        axis=0,
    )
    return registration.select(held)


def save_registration(path: Path, registration: Registration) -> None:
    """Write a product."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(format_registration(registration), encoding="utf-8")


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of a file; remembered as long as the file keeps its size and time."""
    known = path.stat()
    return _hashed(str(path.resolve()), known.st_size, known.st_mtime_ns)


@functools.lru_cache(maxsize=1024)
def _hashed(path: str, _octets: int, _modified_ns: int) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@functools.cache
def _shipped() -> Registration:
    text = resources.files(__package__).joinpath(_SHIPPED).read_text(encoding="utf-8")
    return parse_registration(text, _SHIPPED)


def _other_file(registration: Registration, catalogue: Path, terrain: Sequence[Path]) -> str:
    """Return what differs from the files that a registration was made of, "" where it applies."""
    if file_sha256(catalogue) != registration.catalogue:
        return f"a catalogue with SHA-256 {registration.catalogue[:12]}, found {catalogue}"
    listed = [path for path in terrain if path.name in registration.terrain]
    if not listed:
        return f"height rasters such as {next(iter(registration.terrain), 'none')}, found {terrain[0].name}"
    for path in listed:
        if file_sha256(path) != registration.terrain[path.name]:
            return f"{path.name} with SHA-256 {registration.terrain[path.name][:12]}, found another file"
    return ""
