"""The terrain of a scenario by name."""

from __future__ import annotations

from typing import TYPE_CHECKING

from payload_emulator.errors import TerrainError

if TYPE_CHECKING:
    from lunar.datafolder import DataFolder
    from payload_emulator.sim.terrain.tiles import TiledTerrain

KINDS = ("auto", "raster", "procedural", "catalogue")

SLDEM_RESOLUTION_M = 150.0
"""SLDEM2015 resolves about 60 m at the equator (Barker et al. 2016); at 256 pixels per degree its pixels limit it."""


def open_terrain(
    kind: str,
    data: DataFolder,
    seed: int,
    *,
    registration_north_east_m: tuple[float, ...] = (),
    **options: object,
) -> TiledTerrain:
    """The terrain of a kind.

    ``raster``: real heights and catalogue of the data folder; ``procedural``: a seeded Moon; ``auto``: the first where
    the data allow it, else the second; ``catalogue``: the craters of the data folder's catalogue on a procedural base.
    `registration_north_east_m` shifts height rasters instead of the shift that belongs to them.
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
            raise TerrainError(
                f"terrain: expected a crater catalogue in {data.root or 'a data folder'}, found none"
            )
        from lunar.catalogue import load_catalogue
        from payload_emulator.sim.terrain.procedural import ProceduralTerrain

        return ProceduralTerrain(seed, catalogue=load_catalogue(catalogue_path), **options)  # type: ignore[arg-type]
    if kind == "procedural" or not (tiles and catalogue_path):
        from payload_emulator.sim.terrain.procedural import ProceduralTerrain

        return ProceduralTerrain(seed, **options)  # type: ignore[arg-type]
    from lunar.catalogue import load_catalogue
    from payload_emulator.sim.terrain.raster import RasterTerrain

    assert catalogue_path is not None
    chosen: dict[str, object] = {"name": "LROC WAC GLD100"}
    if data.dem_sldem:
        # The shift and the smoothing are GLD100's; nothing is known against SLDEM2015 as it stands.
        chosen = {
            "name": "SLDEM2015",
            "registration_north_m": 0.0,
            "smoothing_pixels": 0.0,
            "effective_resolution_m": SLDEM_RESOLUTION_M,
        }
    if registration_north_east_m:
        north_m, east_m = registration_north_east_m
        chosen |= {"registration_north_m": north_m, "registration_east_m": east_m}
    albedo = data.albedo_tiles or ((data.albedo,) if data.albedo else ())
    return RasterTerrain(
        tiles,
        load_catalogue(catalogue_path),
        coarse_paths=(data.dem_global,) if data.dem_global else (),
        albedo_paths=albedo,
        data_names=_names(data),
        seed=seed,
        **(chosen | options),  # type: ignore[arg-type]
    )


def _names(data: DataFolder) -> tuple[str, ...]:
    """Which products of the folder a raster terrain is made of."""
    heights = "height model SLDEM2015" if data.dem_sldem else "height model LROC"
    coarse = "height model LROC WAC GLD100, 16" if data.dem_global else "-"
    catalogue = "crater catalogue LU" if data.catalogue_lu else "crater catalogue"
    return tuple(name for name in data.names() if name.startswith((heights, coarse, catalogue, "albedo")))
