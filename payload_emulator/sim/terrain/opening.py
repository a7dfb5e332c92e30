"""The terrain of a scenario by name."""

from __future__ import annotations

from typing import TYPE_CHECKING

from payload_emulator.errors import TerrainError

if TYPE_CHECKING:
    from lunar.datafolder import DataFolder
    from payload_emulator.sim.terrain.tiles import TiledTerrain

KINDS = ("auto", "raster", "procedural", "catalogue")


def open_terrain(kind: str, data: DataFolder, seed: int, **options: object) -> TiledTerrain:
    """The terrain of a kind.

    ``raster``: real heights and catalogue of the data folder; ``procedural``: a seeded Moon; ``auto``: the first where
    the data allow it, else the second; ``catalogue``: the craters of the data folder's catalogue on a procedural base.

    Raises
    ------
    TerrainError
        An unknown kind, or rasters or a catalogue asked for where the data folder has none.
    """
    if kind not in KINDS:
        raise TerrainError(f"terrain: expected one of {', '.join(KINDS)}, found {kind!r}")
    catalogue_path = data.catalogue_lu or data.catalogue_composite
    if kind == "raster" and not (data.dem_tiles and catalogue_path):
        raise TerrainError(
            f"terrain: expected height rasters and a crater catalogue in {data.root or 'a data folder'}, found "
            f"{len(data.dem_tiles)} rasters and {'a' if catalogue_path else 'no'} catalogue"
        )
    if kind == "catalogue":
        if catalogue_path is None:
            raise TerrainError(
                f"terrain: expected a crater catalogue in {data.root or 'a data folder'}, found none"
            )
        from lunar.catalogue import load_catalogue
        from payload_emulator.sim.terrain.procedural import ProceduralTerrain

        return ProceduralTerrain(seed, catalogue=load_catalogue(catalogue_path), **options)  # type: ignore[arg-type]
    if kind == "procedural" or not (data.dem_tiles and catalogue_path):
        from payload_emulator.sim.terrain.procedural import ProceduralTerrain

        return ProceduralTerrain(seed, **options)  # type: ignore[arg-type]
    from lunar.catalogue import load_catalogue
    from payload_emulator.sim.terrain.raster import RasterTerrain

    assert catalogue_path is not None
    names = tuple(
        name for name in data.names() if name.startswith(("height model", "crater catalogue LU", "albedo"))
    )
    return RasterTerrain(
        data.dem_tiles,
        load_catalogue(catalogue_path),
        coarse_paths=(data.dem_global,) if data.dem_global else (),
        albedo_path=data.albedo,
        name="LROC WAC GLD100",
        data_names=names,
        seed=seed,
        **options,  # type: ignore[arg-type]
    )
