"""Georeferenced files as layers of pixels on one global grid of longitude and latitude, read piece by piece.

GeoTIFF, JPEG 2000 and PDS3 images with their labels come through GDAL.  Values are metres above the map sphere for
heights, whatever unit and offset the file has; pixels are areas; no-data becomes NaN.
"""

from __future__ import annotations

import math
import re
import warnings
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lunar.arrays import BoolArray, FloatArray
from lunar.constants import MOON_RADIUS_M
from payload_emulator.errors import TerrainError, install_hint
from payload_emulator.sim.terrain.tiles import Heights

CHUNK_PIXELS = 1024
CHUNK_LIMIT_OCTETS = 48 << 20
"""Decoded pixels that a terrain keeps of all its files: those under some consecutive frames."""

RADIUS_TOLERANCE = 0.01
"""A file whose sphere differs from the Moon's by more is of another body."""

SAME_LATTICE_PIXELS = 0.1
"""Files whose pixels lie on lattices that differ by less (pixels of 100 m do not divide the degree) are one layer."""

LABEL_OCTETS = 65_536
NO_DATA_BELOW = -1.0e30
"""Special values of floating-point PDS3 images (missing, saturated) all lie at the negative end of the range."""


@dataclass(frozen=True, eq=False, slots=True)
class RasterFile:
    """One georeferenced file: its place on the pixel lattice of its layer; metres are ``raw * scale_m + offset_m``."""

    path: Path
    first_row: int
    first_column: int
    rows: int
    columns: int
    scale_m: float
    offset_m: float
    nodata: float | None


class ChunkCache:
    """Decoded chunks of the layers of one terrain; the oldest in use are dropped above `CHUNK_LIMIT_OCTETS`."""

    def __init__(self) -> None:
        self.octets = 0
        self._chunks: OrderedDict[tuple[int, int, int, int], Heights] = OrderedDict()

    def get(self, key: tuple[int, int, int, int]) -> Heights | None:
        """Return a chunk and note its use; None if it is not kept."""
        found = self._chunks.get(key)
        if found is not None:
            self._chunks.move_to_end(key)
        return found

    def put(self, key: tuple[int, int, int, int], chunk: Heights) -> None:
        """Keep a chunk; the newest is kept whatever its size."""
        self._chunks[key] = chunk
        self.octets += chunk.nbytes
        while self.octets > CHUNK_LIMIT_OCTETS and len(self._chunks) > 1:
            self.octets -= self._chunks.popitem(last=False)[1].nbytes

    def clear(self) -> None:
        """Drop all chunks."""
        self._chunks.clear()
        self.octets = 0


class RasterLayer:
    """Files of one resolution on one global pixel lattice, read in chunks as they are needed."""

    def __init__(
        self,
        pixels_per_degree: float,
        north_offset: float,
        west_offset: float,
        files: Sequence[RasterFile],
        chunks: ChunkCache,
    ) -> None:
        """The lattice has pixel centres at latitude ``90 - (row + 0.5 + north_offset) / ppd``, likewise longitude."""
        self.pixels_per_degree = pixels_per_degree
        self.north_offset = north_offset
        self.west_offset = west_offset
        self.files = tuple(files)
        self.turn = round(360.0 * pixels_per_degree)
        self._chunks = chunks

    def read(self, first_row: int, first_column: int, rows: int, columns: int) -> Heights:
        """Heights (rows, columns) in metres of a window of the lattice; NaN where no file has data."""
        out = np.full((rows, columns), np.nan, np.float32)
        for number, file in enumerate(self.files):
            top = max(first_row, file.first_row)
            bottom = min(first_row + rows, file.first_row + file.rows)
            if top >= bottom:
                continue
            turns = {
                math.floor((first_column - file.first_column) / self.turn),
                math.floor((first_column + columns - 1 - file.first_column) / self.turn),
            }
            for turn in turns:
                west = file.first_column + turn * self.turn
                left, right = max(first_column, west), min(first_column + columns, west + file.columns)
                if left < right:
                    self._copy(
                        number, file, out, (top, bottom), (left, right), (first_row, first_column), west
                    )
        return out

    def holds(self, latitude_rad: FloatArray, longitude_rad: FloatArray) -> BoolArray:
        """Whether a file spans each place."""
        row = (90.0 - np.degrees(latitude_rad)) * self.pixels_per_degree - self.north_offset
        column = np.degrees(longitude_rad) * self.pixels_per_degree - self.west_offset
        held = np.zeros(row.shape, dtype=bool)
        for file in self.files:
            east = (column - file.first_column) % self.turn
            held |= (row >= file.first_row) & (row <= file.first_row + file.rows) & (east <= file.columns)
        return held

    def _copy(
        self,
        number: int,
        file: RasterFile,
        out: Heights,
        rows: tuple[int, int],
        columns: tuple[int, int],
        origin: tuple[int, int],
        west: int,
    ) -> None:
        top, bottom = rows[0] - file.first_row, rows[1] - file.first_row
        left, right = columns[0] - west, columns[1] - west
        for i in range(top // CHUNK_PIXELS, (bottom - 1) // CHUNK_PIXELS + 1):
            for j in range(left // CHUNK_PIXELS, (right - 1) // CHUNK_PIXELS + 1):
                chunk = self._chunk(number, file, i, j)
                a, b = max(top, i * CHUNK_PIXELS), min(bottom, i * CHUNK_PIXELS + chunk.shape[0])
                c, d = max(left, j * CHUNK_PIXELS), min(right, j * CHUNK_PIXELS + chunk.shape[1])
                part = chunk[
                    a - i * CHUNK_PIXELS : b - i * CHUNK_PIXELS, c - j * CHUNK_PIXELS : d - j * CHUNK_PIXELS
                ]
                row = a + file.first_row - origin[0]
                column = c + west - origin[1]
                place = out[row : row + part.shape[0], column : column + part.shape[1]]
                np.copyto(place, part, where=~np.isnan(part))

    def _chunk(self, number: int, file: RasterFile, i: int, j: int) -> Heights:
        key = (id(self), number, i, j)
        found = self._chunks.get(key)
        if found is not None:
            return found
        import rasterio
        from rasterio.windows import Window

        top, left = i * CHUNK_PIXELS, j * CHUNK_PIXELS
        window = Window(left, top, min(CHUNK_PIXELS, file.columns - left), min(CHUNK_PIXELS, file.rows - top))
        try:
            with rasterio.open(file.path) as source:
                raw = source.read(1, window=window)
        except rasterio.errors.RasterioError as error:
            raise TerrainError(f"{file.path}: expected readable raster data, found {error}") from None
        values: Heights = raw.astype(np.float32)
        if file.nodata is not None:
            values[raw == file.nodata] = np.nan
        if np.issubdtype(raw.dtype, np.floating):
            values[raw < NO_DATA_BELOW] = np.nan
        if file.scale_m != 1.0:
            values *= np.float32(file.scale_m)
        if file.offset_m != 0.0:
            values += np.float32(file.offset_m)
        self._chunks.put(key, values)
        return values


def open_layers(
    paths: Sequence[Path | str], heights: bool = True, chunks: ChunkCache | None = None
) -> list[RasterLayer]:
    """Files grouped by resolution into layers, coarsest first; reads headers only.

    ``heights``: values are brought to metres above the map sphere; else they are left as they are. ``chunks``: the
    cache that the layers share with others; None: one of their own.

    Raises
    ------
    TerrainError
        A file is missing, has no georeference, is of another body, is neither in longitude and latitude nor in the
        equirectangular projection, is rotated, or has uneven pixels.
    """
    groups: dict[tuple[float, float, float], list[RasterFile]] = {}
    for path in paths:
        key, file = _open_header(Path(path), heights)
        groups.setdefault(key, []).append(file)
    shared = ChunkCache() if chunks is None else chunks
    layers = [RasterLayer(ppd, north, west, files, shared) for (ppd, north, west), files in groups.items()]
    return sorted(layers, key=lambda layer: layer.pixels_per_degree)


def _open_header(path: Path, heights: bool) -> tuple[tuple[float, float, float], RasterFile]:
    try:
        import rasterio
    except ImportError:
        raise TerrainError(
            f"{path}: expected rasterio, which reads height rasters, found it not installed: {install_hint('terrain')}"
        ) from None

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
            with rasterio.open(path) as source:
                profile: dict[str, Any] = dict(source.profile)
                crs, transform = source.crs, source.transform
                unit, scale, offset = source.units[0], source.scales[0], source.offsets[0]
    except rasterio.errors.RasterioError as error:
        raise TerrainError(f"{path}: expected a raster, found {error}") from None
    if crs is None:
        raise TerrainError(f"{path}: expected a georeferenced raster, found no coordinate system")
    pixel_deg, west_deg, north_deg = _lattice(path, crs, transform)
    ppd = round(1.0 / pixel_deg, 6)
    row, column = (90.0 - north_deg) * ppd, west_deg * ppd
    # Half a pixel off the lattice always counts as plus a half.
    first_row, first_column = math.ceil(row - 0.5 - 1e-6), math.ceil(column - 0.5 - 1e-6)
    steps = 1.0 / SAME_LATTICE_PIXELS
    offsets = (
        round((row - first_row) * steps) / steps + 0.0,
        round((column - first_column) * steps) / steps + 0.0,
    )
    scale_m, offset_m = (
        _to_metres(path, profile, unit, scale or 1.0, offset or 0.0) if heights else (1.0, 0.0)
    )
    file = RasterFile(
        path,
        first_row,
        first_column,
        profile["height"],
        profile["width"],
        scale_m,
        offset_m,
        profile.get("nodata"),
    )
    return (ppd, *offsets), file


def _lattice(path: Path, crs: Any, transform: Any) -> tuple[float, float, float]:
    """Pixel size, west edge and north edge in degrees of a file on longitude and latitude or equirectangular."""
    named = re.search(r'(?:SPHEROID|ELLIPSOID)\["[^"]*",\s*([0-9.]+)', crs.to_wkt())
    radius_m = float(named.group(1)) if named else MOON_RADIUS_M
    if abs(radius_m / MOON_RADIUS_M - 1.0) > RADIUS_TOLERANCE:
        raise TerrainError(
            f"{path}: expected a raster of the Moon (radius {MOON_RADIUS_M / 1e3:.1f} km), "
            f"found a body of {radius_m / 1e3:.1f} km"
        )
    values = crs.to_dict()
    west, north = transform.c, transform.f
    if crs.is_geographic:
        across = down = 1.0
        middle_deg = 0.0
    elif values.get("proj") == "eqc" and values.get("lat_0", 0.0) == 0.0:
        metres = math.radians(radius_m)
        across, down = metres * math.cos(math.radians(values.get("lat_ts", 0.0))), metres
        middle_deg = float(values.get("lon_0", 0.0))
        west, north = west - values.get("x_0", 0.0), north - values.get("y_0", 0.0)
    else:
        raise TerrainError(
            f"{path}: expected longitude and latitude in degrees or the equirectangular projection, found the "
            f"projection {values.get('proj') or crs.to_string()[:60]}"
        )
    wide, high = transform.a / across, -transform.e / down
    if transform.b or transform.d or wide <= 0.0 or abs(wide - high) > 1e-6 * wide:
        raise TerrainError(
            f"{path}: expected square pixels in degrees, north up, found the transform {tuple(transform)[:6]}"
        )
    return wide, middle_deg + west / across, north / down


def _to_metres(
    path: Path, profile: dict[str, Any], unit: str | None, scale: float, offset: float
) -> tuple[float, float]:
    """Scale and offset that bring a file's values to metres above the map sphere.

    Offsets near the Moon's radius (PDS3 labels of LOLA and LROC have them) say that values are radii from there, and
    in which unit.
    """
    if unit is None and profile["driver"] == "PDS":
        unit = _label_unit(path)
    kilometres = (unit or "").strip().lower() in ("km", "kilometer", "kilometers", "kilometre", "kilometres")
    if abs(offset * 1e3 / MOON_RADIUS_M - 1.0) < RADIUS_TOLERANCE:
        kilometres = True
    factor = 1000.0 if kilometres else 1.0
    offset_m = factor * offset
    if abs(offset_m / MOON_RADIUS_M - 1.0) < RADIUS_TOLERANCE:
        offset_m -= MOON_RADIUS_M
    return factor * scale, offset_m


def _label_unit(path: Path) -> str | None:
    """What a PDS3 label says in UNIT; GDAL does not hand it on."""
    with path.open("rb") as file:
        text = file.read(LABEL_OCTETS).decode("latin-1")
    found = re.search(r'^\s*UNIT\s*=\s*"?([A-Za-z]+)', text, re.MULTILINE)
    return found.group(1) if found else None
