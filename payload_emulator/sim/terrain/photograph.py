"""Ground whose brightness is that of an orthorectified photograph, over a height model.

The heights give the geometry (parallax, horizon, heights of rims), the photograph the light. Not tested: another
Sun than that of the photograph, whatever the scenario states; ground that the photograph did not see (behind slopes),
which has the brightness of the orthoimage; radiometry, which is as stretched by the publisher. A mosaic and a height
model made from the same images share their errors of position, so a world of both does not test the map.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lunar.arrays import BoolArray, FloatArray
from lunar.catalogue import CraterCatalogue
from lunar.constants import MOON_RADIUS_M
from payload_emulator.errors import TerrainError
from payload_emulator.sim.terrain.raster import RasterTerrain
from payload_emulator.sim.terrain.rasters import RasterLayer, open_layers

Brightness = npt.NDArray[np.float32]

_LARGEST_WINDOW_PX = 20_000  # on a side: a frame that needs more has a photograph far too fine for it


class PhotographTerrain(RasterTerrain):
    """Height rasters and photographs of one ground, both shifted by the registration of the heights."""

    def __init__(
        self, paths: Sequence[Path | str], photographs: Sequence[Path | str], catalogue: CraterCatalogue, **options: Any
    ) -> None:
        if not photographs:
            raise TerrainError("photographic terrain: expected at least one photograph, found none")
        self._photographs: list[RasterLayer] = open_layers(photographs, heights=False)
        self._full_scale = max(_full_scale(Path(path)) for path in photographs)
        super().__init__(paths, catalogue, sharpen=False, **options)

    def covers(self, latitude_rad: npt.ArrayLike, longitude_rad: npt.ArrayLike) -> BoolArray:
        """Return whether a height raster and a photograph span each place."""
        latitude, longitude = np.broadcast_arrays(
            np.asarray(latitude_rad, dtype=np.float64), np.asarray(longitude_rad, dtype=np.float64)
        )
        seen = np.zeros(latitude.shape, dtype=bool)
        for layer in self._photographs:
            seen |= layer.holds(*self._on_raster(latitude, longitude))
        return seen & super().covers(latitude, longitude)

    def brightness(self, latitude_rad: FloatArray, longitude_rad: FloatArray, sample_m: float) -> Brightness:
        """Brightness of places (H, W), 0 to 1; NaN where no photograph has data.

        Parameters
        ----------
        sample_m
            Spacing of the places on the ground; a finer photograph is averaged to it.
        """
        out = np.full(latitude_rad.shape, np.nan, np.float32)
        latitude, longitude = self._on_raster(latitude_rad, longitude_rad)
        for layer in reversed(self._photographs):
            lacking = np.isnan(out) & np.isfinite(latitude)
            if lacking.any():
                out[lacking] = _sampled(layer, latitude[lacking], longitude[lacking], sample_m)
        return np.asarray(out / np.float32(self._full_scale))

    def _on_raster(self, latitude_rad: FloatArray, longitude_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Places as the rasters are georeferenced, of places on the ground of this world."""
        latitude = latitude_rad - math.radians(self._shift_north_deg)
        return latitude, longitude_rad - self._shift_east_m / MOON_RADIUS_M / np.cos(latitude)


def _sampled(layer: RasterLayer, latitude_rad: FloatArray, longitude_rad: FloatArray, sample_m: float) -> Brightness:
    """Values of a layer at places (n,), cubic, after a mean over what one sample covers."""
    from scipy import ndimage

    rows = (90.0 - np.degrees(latitude_rad)) * layer.pixels_per_degree - 0.5 - layer.north_offset
    columns = np.degrees(longitude_rad) * layer.pixels_per_degree - 0.5 - layer.west_offset
    columns = columns[0] + (columns - columns[0] + 0.5 * layer.turn) % layer.turn - 0.5 * layer.turn
    pixel_m = math.radians(MOON_RADIUS_M / layer.pixels_per_degree)
    sigma = 0.45 * sample_m / pixel_m if sample_m > pixel_m else 0.0
    margin = 3 + math.ceil(3.0 * sigma)
    top, left = math.floor(rows.min()) - margin, math.floor(columns.min()) - margin
    height = math.ceil(rows.max()) + margin + 1 - top
    width = math.ceil(columns.max()) + margin + 1 - left
    if max(height, width) > _LARGEST_WINDOW_PX:
        raise TerrainError(
            f"photographic terrain: expected a frame over at most {_LARGEST_WINDOW_PX} pixels of a photograph, "
            f"found {height} x {width}; use a coarser photograph"
        )
    source = layer.read(top, left, height, width)
    hole = np.isnan(source)
    source = np.where(hole, np.float32(0.0), source)
    if sigma > 0.0:
        source = ndimage.gaussian_filter(source, sigma)
    found = ndimage.map_coordinates(source, [rows - top, columns - left], order=3, mode="nearest")
    near = hole[np.rint(rows - top).astype(np.int64), np.rint(columns - left).astype(np.int64)]
    return np.where(near, np.float32(np.nan), np.maximum(found, 0.0)).astype(np.float32)


def _full_scale(path: Path) -> float:
    """The greatest value that a file's type holds; 1 for floating-point numbers."""
    import rasterio

    with rasterio.open(path) as source:
        kind = np.dtype(source.dtypes[0])
    return float(np.iinfo(kind).max) if np.issubdtype(kind, np.integer) else 1.0
