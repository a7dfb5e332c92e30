"""The terrain of a scenario by name."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from payload_emulator.errors import TerrainError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from lunar.datafolder import DataFolder
    from payload_emulator.sim.terrain.tiles import Terrain

KINDS = ("auto", "raster", "procedural", "catalogue", "photograph")

SLDEM_RESOLUTION_M = 150.0
"""SLDEM2015 resolves about 60 m at the equator (Barker et al. 2016); at 256 pixels per degree its pixels limit it."""


def open_terrain(
    kind: str,
    data: DataFolder,
    seed: int,
    *,
    registration_north_east_m: tuple[float, ...] = (),
    photographs: tuple[str, ...] = (),
    heights: tuple[str, ...] = (),
    **options: Any,
) -> Terrain:
    """The terrain of a kind.

    ``raster``: real heights and catalogue of the data folder; ``procedural``: a seeded Moon; ``auto``: the first where
    the data allow it, else the second; ``catalogue``: the craters of the data folder's catalogue on a procedural base.
    ``photograph``: the light of georeferenced photographs over height rasters; both are files of the data folder, or
    absolute paths. Without `heights`, the rasters of the data folder are used.
    The catalogue is registered to height rasters by the product that was made of the same files: that of the data
    folder, or the one shipped for the tiles and the catalogue of the project. `registration_north_east_m` moves the
    rasters on the ground, away from the catalogue.
    Of the height models SLDEM2015 is preferred to GLD100, of the albedos georeferenced mosaics to pictures.

    Raises
    ------
    TerrainError
        An unknown kind, or rasters or a catalogue asked for where the data folder has none.
    """
    if kind not in KINDS:
        raise TerrainError(f"terrain: expected one of {', '.join(KINDS)}, found {kind!r}")
    catalogue_path = data.catalogue_lu or data.catalogue_composite or data.catalogue_robbins
    tiles = data.dem_sldem or data.dem_tiles
    if kind == "raster" and not (tiles and catalogue_path):
        raise TerrainError(
            f"terrain: expected height rasters and a crater catalogue in {data.root or 'a data folder'}, found "
            f"{len(tiles)} rasters and {'a' if catalogue_path else 'no'} catalogue"
        )
    if kind == "catalogue":
        if catalogue_path is None:
            raise TerrainError(f"terrain: expected a crater catalogue in {data.root or 'a data folder'}, found none")
        from lunar.catalogue import load_catalogue
        from payload_emulator.sim.terrain.procedural import ProceduralTerrain

        return ProceduralTerrain(seed, catalogue=load_catalogue(catalogue_path), **options)
    if kind == "photograph":
        return _open_photograph(data, catalogue_path, photographs, heights, registration_north_east_m)
    if kind == "procedural" or not (tiles and catalogue_path):
        from payload_emulator.sim.terrain.procedural import ProceduralTerrain

        return ProceduralTerrain(seed, **options)
    from lunar.catalogue import load_catalogue
    from payload_emulator.sim.terrain.raster import RasterTerrain

    assert catalogue_path is not None
    chosen: dict[str, Any] = {"name": data.own_heights or "LROC WAC GLD100", **_moved(registration_north_east_m)}
    if data.dem_sldem:
        # The smoothing is GLD100's; nothing is known against SLDEM2015 as it stands.
        chosen |= {"name": "SLDEM2015", "smoothing_pixels": 0.0, "effective_resolution_m": SLDEM_RESOLUTION_M}
    albedo = data.albedo_tiles or ((data.albedo,) if data.albedo else ())
    terrain = RasterTerrain(
        tiles,
        load_catalogue(catalogue_path),
        coarse_paths=(data.dem_global,) if data.dem_global else (),
        albedo_paths=albedo,
        data_names=_names(data),
        seed=seed,
        **(chosen | options),
    )
    return _registered(terrain, data, catalogue_path, tiles)


def _open_photograph(
    data: DataFolder,
    catalogue_path: Path | None,
    photographs: tuple[str, ...],
    heights: tuple[str, ...],
    registration_north_east_m: tuple[float, ...],
) -> Terrain:
    from lunar.catalogue import load_catalogue
    from payload_emulator.sim.terrain.photograph import PhotographTerrain

    pictures = [_found(name, data, "photograph") for name in photographs]
    rasters = [_found(name, data, "height raster") for name in heights] or list(data.dem_tiles)
    if not (pictures and rasters and catalogue_path):
        raise TerrainError(
            f"terrain: expected photographs, height rasters and a crater catalogue, found {len(pictures)} photographs, "
            f"{len(rasters)} rasters and {'a' if catalogue_path else 'no'} catalogue"
        )
    names = ", ".join(path.name for path in pictures)
    terrain = PhotographTerrain(
        rasters,
        pictures,
        load_catalogue(catalogue_path),
        coarse_paths=(data.dem_global,) if data.dem_global else (),
        name=f"photograph {names}",
        data_names=(
            *(f"photograph {path.name}" for path in pictures),
            *(f"height raster {path.name}" for path in rasters if heights),
            *(
                name
                for name in _names(data)
                if not heights or not name.startswith(("height model LROC WAC GLD100 (", "own heights"))
            ),
        ),
        **_moved(registration_north_east_m),
    )
    return _registered(terrain, data, catalogue_path, rasters)


def _moved(north_east_m: tuple[float, ...]) -> dict[str, float]:
    return dict(zip(("registration_north_m", "registration_east_m"), north_east_m, strict=False))


def _registered(terrain: Terrain, data: DataFolder, catalogue: Path, rasters: Sequence[Path]) -> Terrain:
    from payload_emulator.sim.terrain.registering import find_registration

    registration = find_registration(data, catalogue, rasters)
    if registration is not None:
        terrain.register(registration)
    return terrain


def _found(name: str, data: DataFolder, what: str) -> Path:
    """A file of the data folder or an absolute path."""
    path = (data.root or Path()) / name
    if not path.is_file():
        raise TerrainError(f"terrain: expected the {what} {path}, found none")
    return path


def _names(data: DataFolder) -> tuple[str, ...]:
    """Return which products of the folder a raster terrain is made of."""
    heights = "height model SLDEM2015" if data.dem_sldem else data.own_heights or "height model LROC"
    coarse = "height model LROC WAC GLD100, 16" if data.dem_global else "-"
    catalogue = "crater catalogue LU" if data.catalogue_lu else "crater catalogue"
    return tuple(name for name in data.names() if name.startswith((heights, coarse, catalogue, "albedo")))
