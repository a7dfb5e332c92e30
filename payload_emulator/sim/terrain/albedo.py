"""Albedo of the Moon from a picture of its whole surface or from georeferenced tiles, relative to the mean."""

import math
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from lunar.arrays import FloatArray
from payload_emulator.errors import TerrainError
from payload_emulator.sim.terrain.rasters import RasterLayer, open_layers

Picture = npt.NDArray[np.unsignedinteger]

LEAST, GREATEST = 0.3, 2.0
"""Bounds of relative albedo: craters' rays and the darkest plains stay within."""

SAMPLES = 128
"""Rows and columns of each tile looked at to find the mean of tiles."""


class AlbedoMap:
    """A picture of the whole Moon without shading, from the north pole and 180 degrees west."""

    def __init__(self, path: Path) -> None:
        self._picture, self._albedo = load_albedo_map(path)

    def relative(self, latitude_rad: FloatArray, longitude_rad: FloatArray) -> FloatArray:
        """Albedo over its mean on a grid of places, (rows, columns)."""
        return _sample_map(self._picture, self._albedo, latitude_rad, longitude_rad)


class AlbedoTiles:
    """Georeferenced reflectance (LROC WAC mosaics), averaged over the steps of the grid asked for.

    The mean is the median of the available tiles; ground without data has it.
    """

    def __init__(self, paths: Sequence[Path | str]) -> None:
        self._layers: list[RasterLayer] = open_layers(paths, heights=False)
        self._mean = _median(self._layers)

    def relative(self, latitude_rad: FloatArray, longitude_rad: FloatArray) -> FloatArray:
        """Albedo over its mean on a grid of places, (rows, columns)."""
        out = np.full((latitude_rad.size, longitude_rad.size), np.nan)
        for layer in reversed(self._layers):
            out = np.where(np.isnan(out), _averaged(layer, latitude_rad, longitude_rad), out)
        return np.asarray(np.clip(np.nan_to_num(out / self._mean, nan=1.0), LEAST, GREATEST))


def open_albedo(paths: Sequence[Path | str]) -> AlbedoMap | AlbedoTiles:
    """The albedo in files: one picture of the whole Moon that has no georeference, or georeferenced tiles.

    Raises
    ------
    TerrainError
        A file is missing or damaged, or is neither.
    """
    if len(paths) == 1 and not _is_georeferenced(Path(paths[0])):
        return AlbedoMap(Path(paths[0]))
    return AlbedoTiles(paths)


def _is_georeferenced(path: Path) -> bool:
    import rasterio

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
            with rasterio.open(path) as source:
                return source.crs is not None
    except rasterio.errors.RasterioError as error:
        raise TerrainError(f"{path}: expected an albedo map, found {error}") from None


def _median(layers: Sequence[RasterLayer]) -> float:
    """Median of values spread over all files."""
    values = []
    for file in (file for layer in layers for file in layer.files):
        with file.opened() as source:
            shape = min(SAMPLES, file.rows), min(SAMPLES, file.columns)
            part = source.read(1, out_shape=shape).astype(np.float64)
        good = np.isfinite(part) & (part > 0.0)
        if file.reading.nodata is not None:
            good &= part != file.reading.nodata
        values.append(part[good])
    found = np.concatenate(values)
    if not found.size:
        raise TerrainError(f"{layers[0].files[0].path}: expected reflectance above zero, found none")
    return float(np.median(found))


def _averaged(layer: RasterLayer, latitude: FloatArray, longitude: FloatArray) -> FloatArray:
    """Means of a layer over cells of the grid's step about each place, (rows, columns); NaN without data."""
    rows = (90.0 - np.degrees(latitude)) * layer.pixels_per_degree - layer.north_offset
    columns = np.degrees(longitude) * layer.pixels_per_degree - layer.west_offset
    half_row, half_column = (max(0.5 * float(c[1] - c[0]), 0.5) for c in (rows, columns))
    top, left = math.floor(rows[0] - half_row), math.floor(columns[0] - half_column)
    height = math.ceil(rows[-1] + half_row) + 1 - top
    width = math.ceil(columns[-1] + half_column) + 1 - left
    source = layer.read(top, left, height, width).astype(np.float64)
    good = source > 0.0
    total = np.zeros((2, height + 1, width + 1))
    total[0, 1:, 1:] = np.where(good, source, 0.0).cumsum(axis=0).cumsum(axis=1)
    total[1, 1:, 1:] = good.cumsum(axis=0).cumsum(axis=1)
    i, k = (np.rint(rows + side * half_row - top).astype(np.int64) for side in (-1.0, 1.0))
    j, m = (np.rint(columns + side * half_column - left).astype(np.int64) for side in (-1.0, 1.0))
    k, m = np.maximum(k, i + 1), np.maximum(m, j + 1)
    boxes = total[:, k][:, :, m] - total[:, i][:, :, m] - total[:, k][:, :, j] + total[:, i][:, :, j]
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(boxes[1] > 0.5, boxes[0] / np.maximum(boxes[1], 1.0), np.nan))


def load_albedo_map(path: Path) -> tuple[Picture, npt.NDArray[np.float32]]:
    """Picture of the whole Moon, (rows, columns) from the north pole and 180 degrees west; relative albedo by value.

    The stretch of the picture is compressed; its 2nd and 98th percentiles are spread over the span that normal
    albedo has on the Moon, 0.5 to 1.5 of the mean (1).
    """
    import rasterio

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
            with rasterio.open(path) as source:
                picture = source.read(1)
    except rasterio.errors.RasterioError as error:
        raise TerrainError(f"{path}: expected an albedo map, found {error}") from None
    rows, columns = picture.shape
    if columns != 2 * rows or picture.dtype not in (np.uint8, np.uint16):
        raise TerrainError(
            f"{path}: expected a map of the whole Moon in 8 or 16 bits, twice as wide as high, "
            f"found {columns} x {rows} pixels of {picture.dtype}"
        )
    middle = picture[rows // 6 : -rows // 6].astype(np.float32)
    low, mean, high = np.percentile(middle, 2), float(middle.mean()), np.percentile(middle, 98)
    values = np.arange(np.iinfo(picture.dtype).max + 1, dtype=np.float32)
    darker, brighter = (mean - values) / (mean - low), (values - mean) / (high - mean)
    scaled = np.where(values < mean, 1.0 - 0.5 * darker, 1.0 + 0.5 * brighter)
    return picture, np.asarray(np.clip(scaled, 0.3, 2.0), dtype=np.float32)


def _sample_map(
    picture: Picture, albedo: npt.NDArray[np.float32], latitude: FloatArray, longitude: FloatArray
) -> FloatArray:
    """Bilinear values (rows, columns) of a whole-Moon map that starts at the north pole and 180 degrees west."""
    height, width = picture.shape
    row = np.clip((0.5 - latitude / math.pi) * height - 0.5, 0.0, height - 1.001)
    column = ((np.degrees(longitude) + 180.0) % 360.0) / 360.0 * width - 0.5
    i, j = np.floor(row).astype(np.int64), np.floor(column).astype(np.int64)
    fi, fj = (row - i)[:, None], (column - j)[None, :]
    west, east = j % width, (j + 1) % width
    top = albedo[picture[np.ix_(i, west)]] * (1.0 - fj) + albedo[picture[np.ix_(i, east)]] * fj
    low = albedo[picture[np.ix_(i + 1, west)]] * (1.0 - fj) + albedo[picture[np.ix_(i + 1, east)]] * fj
    return np.asarray(top * (1.0 - fi) + low * fi)
