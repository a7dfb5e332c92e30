"""Georeferenced files as layers of pixels on one global grid of longitude and latitude, read piece by piece.

GeoTIFF, JPEG 2000, PDS3, PDS4 and ISIS images come through GDAL, which resamples every projection that is not a grid of
longitude and latitude.  Values are metres above the map sphere for heights, whatever unit and zero the file has; they
are compared with what the Moon can have (`lunar.plausible`).  Pixels are areas; no-data becomes NaN.
"""

from __future__ import annotations

import hashlib
import math
import re
import warnings
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from kernels import keep, kept
from lunar.arrays import BoolArray, FloatArray, IntArray
from lunar.constants import MOON_RADIUS_M
from lunar.plausible import (
    HEIGHT_M,
    RADIUS_M,
    RASTER_PIXEL_M,
    RELIEF_M,
    SLOPE_BASE_M,
    SLOPE_DEG,
    SPHERE_TOLERANCE,
    STEEP_SHARE,
)
from payload_emulator.errors import TerrainError, install_hint
from payload_emulator.sim.terrain.tiles import Heights

CHUNK_PIXELS = 1024
CHUNK_LIMIT_OCTETS = 24 << 20
"""Decoded pixels that a terrain keeps in memory of all its files: those under neighbouring tiles."""

KEPT_PIXELS = 128
"""Chunks of 2 MB of decoded pixels that are kept on disk: those under a pole-to-pole pass, whose rims are measured
before its frames are taken."""

SAME_LATTICE_PIXELS = 0.1
"""Files whose pixels lie on lattices that differ by less (pixels of 100 m do not divide the degree) are one layer."""

LABEL_OCTETS = 65_536
NO_DATA_BELOW = -1.0e30
"""Special values of floating-point PDS3 images (missing, saturated) all lie at the negative end of the range."""

UNITS_M = {
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), 1.0),
    **dict.fromkeys(("km", "kilometer", "kilometers", "kilometre", "kilometres"), 1e3),
    **dict.fromkeys(("ft", "foot", "feet"), 0.3048),
    **dict.fromkeys(("us-ft", "us survey foot", "foot_us"), 1200.0 / 3937.0),
    **dict.fromkeys(("dm", "decimeter", "decimetre"), 0.1),
    **dict.fromkeys(("cm", "centimeter", "centimetre"), 0.01),
    **dict.fromkeys(("mm", "millimeter", "millimetre"), 1e-3),
}
_NOT_STATED = ("", "none", "unknown", "n/a", "na")
_STATE_IT = "state the unit in the file (gdal_edit.py -units m FILE, or km)"

_WHOLE_PIXEL = 1e-3
"""Share of a pixel below which files are on one lattice, and no value is interpolated."""

_SPIKES = 0.01
"""Share of implausible heights of a chunk, above which the unit and not a few pixels are wrong."""

_RELIEF_SPAN_M = 20e3
_NARROW = 0.05
"""Cosine of the latitude beyond which columns are too narrow for slopes to the east."""

_LIKENESS = 0.9
"""Correlation with the coarse relief from which scale and zero are compared."""
_SCALES = (0.7, 1.4)
_ZERO_M = 300.0


@dataclass(frozen=True, slots=True)
class Reading:
    """Conversion of the values of a file: ``raw * scale_m + offset_m``.

    `unit` is what the file states, in lower case; `is_radius`: whether its zero is the Moon's centre, as it states.
    """

    unit: str = ""
    scale_m: float = 1.0
    offset_m: float = 0.0
    nodata: float | None = None
    words: str = ""
    is_radius: bool = False


@dataclass(frozen=True, slots=True)
class Warp:
    """Grid of longitude and latitude that GDAL resamples a file to, and the coordinates of the file's own pixels."""

    crs: Any
    pixel_from_crs: Any
    sphere: str
    transform: Any


@dataclass(frozen=True, slots=True, eq=False)
class RasterFile:
    """One georeferenced file; `row` and `column` are the place of its edge in pixels from the pole and the meridian."""

    path: Path
    row: float
    column: float
    rows: int
    columns: int
    is_heights: bool
    reading: Reading
    warp: Warp | None = None
    shape: tuple[int, int] = (0, 0)

    @contextmanager
    def opened(self) -> Iterator[Any]:
        """Open the file as a data set of GDAL in longitude and latitude."""
        import rasterio
        from rasterio.vrt import WarpedVRT

        try:
            with rasterio.open(self.path) as source:
                if self.warp is None:
                    yield source
                    return
                grid = {"transform": self.warp.transform, "width": self.columns, "height": self.rows}
                nodata = {"src_nodata": self.reading.nodata, "nodata": math.nan, "dtype": "float32"}
                with WarpedVRT(
                    source, crs=self.warp.sphere, resampling=rasterio.enums.Resampling.cubic, **grid, **nodata
                ) as warped:
                    yield warped
        except rasterio.errors.RasterioError as error:
            raise TerrainError(f"{self.path}: expected readable raster data, found {error}") from None

    def holds(self, row: FloatArray, column: FloatArray, turn: float) -> BoolArray:
        """Return whether the file spans places, in pixels from the pole and the meridian."""
        east = (column - self.column) % turn
        inside = (row >= self.row) & (row <= self.row + self.rows) & (east <= self.columns)
        if self.warp is None or not inside.any():
            return np.asarray(inside)
        x, y = _applied(self.warp.transform, east[inside], row[inside] - self.row)
        column_px, row_px = _applied(self.warp.pixel_from_crs, *_transformed(self.warp.sphere, self.warp.crs, x, y))
        inside[inside] = (row_px >= 0) & (row_px <= self.shape[0]) & (column_px >= 0) & (column_px <= self.shape[1])
        return np.asarray(inside)


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
        files: Sequence[RasterFile],
        chunks: ChunkCache,
        relief: RasterLayer | None = None,
    ) -> None:
        """The lattice has pixel centres at latitude ``90 - (row + 0.5 + north_offset) / ppd``, likewise longitude."""
        self.pixels_per_degree = pixels_per_degree
        self.north_offset, self.west_offset = _offset(files[0].row), _offset(files[0].column)
        self.files = tuple(files)
        self.turn = 360.0 * pixels_per_degree
        self._chunks = chunks
        self._relief = relief
        self._readings: dict[int, Reading] = {}

    @property
    def readings(self) -> list[str]:
        """Return the stated and the used interpretation of the values of each file."""
        return [f"{self.files[k].path.name}: {one.words}" for k, one in sorted(self._readings.items())]

    def read(self, first_row: int, first_column: int, rows: int, columns: int) -> Heights:
        """Heights (rows, columns) in metres of a window of the lattice; NaN where no file has data."""
        out = np.full((rows, columns), np.nan, np.float32)
        for number, file in enumerate(self.files):
            north, west = file.row - self.north_offset, file.column - self.west_offset
            top, bottom = _lattice_span(north, file.rows, first_row, rows)
            turns = {
                math.floor((first_column - west + 0.5) / self.turn),
                math.floor((first_column + columns - 0.5 - west) / self.turn),
            }
            for turn in turns if top < bottom else ():
                east = west + turn * self.turn
                left, right = _lattice_span(east, file.columns, first_column, columns)
                if left < right:
                    rows_px = np.arange(top, bottom, dtype=np.float64) - north
                    columns_px = np.arange(left, right, dtype=np.float64) - east
                    part = self._part(number, rows_px, columns_px)
                    place = out[top - first_row : bottom - first_row, left - first_column : right - first_column]
                    np.copyto(place, part, where=~np.isnan(part))
        return out

    def holds(self, latitude_rad: FloatArray, longitude_rad: FloatArray) -> BoolArray:
        """Return whether a file spans each place."""
        row = (90.0 - np.degrees(latitude_rad)) * self.pixels_per_degree
        column = np.degrees(longitude_rad) * self.pixels_per_degree
        held = np.zeros(row.shape, dtype=bool)
        for file in self.files:
            held |= file.holds(row, column, self.turn)
        return held

    def _part(self, number: int, rows: FloatArray, columns: FloatArray) -> Heights:
        """Return values at pixel coordinates of a file: its pixels, or linear between two where the lattices differ."""
        file = self.files[number]
        (top, below, down), (left, right, across) = _between(rows, file.rows), _between(columns, file.columns)
        block = self._block(number, top[0], left[0], below[-1] + 1 - top[0], right[-1] + 1 - left[0])
        if down:
            block = _mixed(block[top - top[0]], block[below - top[0]], down)
        if across:
            block = _mixed(block[:, left - left[0]], block[:, right - left[0]], across)
        return block

    def _block(self, number: int, top: int, left: int, rows: int, columns: int) -> Heights:
        out = np.empty((rows, columns), np.float32)
        for i in range(top // CHUNK_PIXELS, (top + rows - 1) // CHUNK_PIXELS + 1):
            for j in range(left // CHUNK_PIXELS, (left + columns - 1) // CHUNK_PIXELS + 1):
                chunk, y, x = self._chunk(number, i, j), i * CHUNK_PIXELS - top, j * CHUNK_PIXELS - left
                part = chunk[max(-y, 0) : rows - y, max(-x, 0) : columns - x]
                y, x = max(y, 0), max(x, 0)
                out[y : y + part.shape[0], x : x + part.shape[1]] = part
        return out

    def _chunk(self, number: int, i: int, j: int) -> Heights:
        key, file = (id(self), number, i, j), self.files[number]
        found = self._chunks.get(key)
        if found is not None:
            return found
        from rasterio.windows import Window

        top, left = i * CHUNK_PIXELS, j * CHUNK_PIXELS
        window = Window(left, top, min(CHUNK_PIXELS, file.columns - left), min(CHUNK_PIXELS, file.rows - top))
        raw = _decoded(file, window)
        is_wide = (raw.dtype.kind != "f" and raw.dtype.itemsize > 2) or raw.dtype == np.float64
        values = np.ma.filled(raw.astype(np.float64 if is_wide else np.float32), np.nan)
        if file.reading.nodata is not None:
            values[np.asarray(raw) == file.reading.nodata] = np.nan
        if np.issubdtype(raw.dtype, np.floating):
            values[values < NO_DATA_BELOW] = np.nan
        chunk = self._heights(number, values, (top, left)) if file.is_heights else values.astype(np.float32)
        self._chunks.put(key, chunk)
        return chunk

    def _heights(self, number: int, raw: Heights | FloatArray, corner: tuple[int, int]) -> Heights:
        """Return raw values in metres above the map sphere; how they are taken follows from the first ones read."""
        file = self.files[number]
        reading = self._readings.get(number)
        if reading is None and not np.isfinite(raw).any():
            return raw.astype(np.float32)
        chosen = reading or _plausible(file, raw)
        values = _scaled(raw, chosen)
        extremes = np.array([np.fmin.reduce(values, axis=None), np.fmax.reduce(values, axis=None)])
        if not HEIGHT_M.holds(extremes).all():
            with np.errstate(invalid="ignore"):
                wrong = ~HEIGHT_M.holds(values) & np.isfinite(values)
            constant, count = np.unique(raw[wrong]), np.count_nonzero(np.isfinite(values))
            if constant.size > 1 and np.count_nonzero(wrong) > _SPIKES * count:
                raise _implausible(file, values)
            values[wrong] = np.nan
            if reading is None and constant.size == 1:
                chosen = replace(chosen, words=f"{chosen.words}; {constant[0]:g} (not stated) as no data")
        if reading is None and np.isfinite(values).any():
            pixel_m = math.radians(MOON_RADIUS_M / self.pixels_per_degree)
            _require_relief(file, chosen, values, pixel_m)
            latitude_deg = 90.0 - (file.row + corner[0] + 0.5 * len(values)) / self.pixels_per_degree
            _require_slopes(file, chosen, values, pixel_m, math.cos(math.radians(latitude_deg)))
            like = self._compared(file, values, corner)
            ppd = self.pixels_per_degree
            north, west = 90.0 - file.row / ppd, file.column / ppd
            found = (
                f"; {north - file.rows / ppd:.4g} to {north:.4g} deg north, {west:.4g} to "
                f"{west + file.columns / ppd:.4g} deg east, heights of {np.nanmin(values):.4g} to "
                f"{np.nanmax(values):.4g} m"
            )
            self._readings[number] = replace(chosen, words=f"{chosen.words}{found}{like}")
        return values

    def _compared(self, file: RasterFile, values: Heights, corner: tuple[int, int]) -> str:
        """Compare heights with the coarse relief of the Moon, where there is one; return words about it."""
        if self._relief is None:
            return ""
        coarse, ppd = self._relief, self.pixels_per_degree
        step = max(1, round(ppd / coarse.pixels_per_degree))
        rows, columns = values.shape[0] // step, values.shape[1] // step
        if rows * columns < 100:
            return ""
        means = values[: rows * step, : columns * step].reshape(rows, step, columns, step).mean(axis=(1, 3))
        latitude = 90.0 - (file.row + corner[0] + (np.arange(rows) + 0.5) * step) / ppd
        longitude = (file.column + corner[1] + (np.arange(columns) + 0.5) * step) / ppd
        row = np.rint((90.0 - latitude) * coarse.pixels_per_degree - 0.5 - coarse.north_offset).astype(np.int64)
        column = np.rint(longitude * coarse.pixels_per_degree - 0.5 - coarse.west_offset).astype(np.int64)
        window = coarse.read(row[0], column[0], row[-1] + 1 - row[0], column[-1] + 1 - column[0])
        relief = window[np.ix_(row - row[0], column - column[0])]
        good = np.isfinite(means) & np.isfinite(relief)
        if np.count_nonzero(good) < 100 or min(means[good].std(), relief[good].std()) == 0.0:
            return ""
        here, there = means[good].astype(np.float64), relief[good].astype(np.float64)
        likeness = float(np.corrcoef(here, there)[0, 1])
        name = coarse.files[0].path.name
        if likeness < _LIKENESS:
            return f"; unlike {name} (correlation {likeness:.2f})"
        scale, zero_m = float(here.std() / there.std()), float(np.median(here - there))
        if not _SCALES[0] <= scale <= _SCALES[1] or abs(zero_m) > _ZERO_M:
            raise TerrainError(
                f"{file.path}: expected heights like those of {name}, found {scale:.3g} times their relief, "
                f"{zero_m:.0f} m above them: a wrong unit, scale or zero; {_STATE_IT}"
            )
        return f"; {scale:.2f} times the relief of {name}, {zero_m:+.0f} m"


def open_layers(
    paths: Sequence[Path | str],
    heights: bool = True,
    chunks: ChunkCache | None = None,
    relief: RasterLayer | None = None,
) -> list[RasterLayer]:
    """Files grouped by resolution into layers, coarsest first; reads headers only.

    ``heights``: values are brought to metres above the map sphere; else they are left as they are. ``chunks``: the
    cache that the layers share with others; None: one of their own. ``relief``: coarse heights to compare with.

    Raises
    ------
    TerrainError
        A file is missing, has no georeference or none that GDAL knows, or is of another body, another ellipsoid, or
        of longitudes to the west.
    """
    groups: dict[tuple[float, float, float], list[RasterFile]] = {}
    for path in paths:
        ppd, file = _open_header(Path(path), heights)
        steps = 1.0 / SAME_LATTICE_PIXELS
        north, west = (round(_offset(edge) * steps) / steps + 0.0 for edge in (file.row, file.column))
        groups.setdefault((ppd, north, west), []).append(file)
    shared = ChunkCache() if chunks is None else chunks
    layers = [RasterLayer(key[0], files, shared, relief) for key, files in groups.items()]
    return sorted(layers, key=lambda layer: layer.pixels_per_degree)


def _offset(edge: float) -> float:
    """Return the offset of an edge from the lattice, -0.5 to 0.5; half a pixel off always counts as plus a half."""
    return round(edge - math.ceil(edge - 0.5 - 1e-6), 6) + 0.0


def _lattice_span(edge: float, count: int, first: int, wanted: int) -> tuple[int, int]:
    """Return first and last (exclusive) pixel of a window whose centre lies on a file from ``edge`` on."""
    slack = 0.5 + _WHOLE_PIXEL
    return max(first, math.ceil(edge - slack)), min(first + wanted, math.ceil(edge + count - slack))


def _between(place: FloatArray, count: int) -> tuple[IntArray, IntArray, float]:
    """Return the two pixels about each place, at most ``count``, and the share of the second."""
    before = np.floor(place + _WHOLE_PIXEL).astype(np.int64)
    share = float(place[0] - before[0])
    share = share if share > _WHOLE_PIXEL else 0.0
    first = np.clip(before, 0, count - 1)
    return first, np.clip(before + 1, 0, count - 1) if share else first, share


def _mixed(first: Heights, second: Heights, share: float) -> Heights:
    return np.asarray(first + np.float32(share) * (second - first))


def _scaled(raw: Heights | FloatArray, reading: Reading) -> Heights:
    """Return heights in single precision; radii are differences of double precision."""
    if raw.dtype == np.float64 or abs(reading.offset_m) > HEIGHT_M.high:
        return np.asarray(raw * np.float64(reading.scale_m) + reading.offset_m, dtype=np.float32)
    values = np.array(raw, dtype=np.float32)
    if reading.scale_m != 1.0:
        values *= np.float32(reading.scale_m)
    return values + np.float32(reading.offset_m) if reading.offset_m else values


def _plausible(file: RasterFile, raw: Heights | FloatArray) -> Reading:
    """Return how the values of a file are taken: as it states, or as radii where that is all that they can be."""
    stated = file.reading
    values = _scaled(raw, stated)[np.isfinite(raw)].astype(np.float64)
    for words, factor in (("radii in metres", 1.0), ("radii in kilometres", 1e3)):
        if np.mean(RADIUS_M.holds(values * factor)) > 0.5 and (factor == 1.0 or not stated.unit):
            scale_m, offset_m = stated.scale_m * factor, stated.offset_m * factor - MOON_RADIUS_M
            words = f"{stated.words}; values of {np.median(values):.7g} as {words}"
            return replace(stated, scale_m=scale_m, offset_m=offset_m, words=words)
    return stated


def _implausible(file: RasterFile, values: Heights) -> TerrainError:
    low, high = np.nanmin(values), np.nanmax(values)
    return TerrainError(
        f"{file.path}: expected heights of {HEIGHT_M} or radii of {RADIUS_M}, found {low:.6g} to {high:.6g} "
        f"({file.reading.words}): a wrong unit, scale or zero; {_STATE_IT}"
    )


def _require_relief(file: RasterFile, reading: Reading, values: Heights, pixel_m: float) -> None:
    """Refuse heights without a unit over much ground that are flatter than any ground of the Moon."""
    good = values[np.isfinite(values)].astype(np.float64)
    spread = float(good.std())
    if reading.unit or not 0.0 < spread < RELIEF_M or math.sqrt(good.size) * pixel_m < _RELIEF_SPAN_M:
        return
    raise TerrainError(
        f"{file.path}: expected heights that differ by {RELIEF_M:g} m (1 sigma) or more over "
        f"{_RELIEF_SPAN_M / 1e3:g} km, found {spread:.3g} ({good.min():.4g} to {good.max():.4g}, no unit stated): "
        f"kilometres? {_STATE_IT}"
    )


def _require_slopes(file: RasterFile, reading: Reading, values: Heights, pixel_m: float, narrow: float) -> None:
    """Refuse heights without a unit that are steeper than ground of the Moon is; columns are ``narrow`` pixels wide."""
    if reading.unit or pixel_m < SLOPE_BASE_M or min(values.shape) < 2 or narrow < _NARROW:
        return
    south, east = (np.gradient(values, pixel_m, axis=axis) for axis in (0, 1))
    square = south * south + east * east / np.float32(narrow * narrow)
    good = np.isfinite(square)
    share = float(np.mean(square[good] > math.tan(math.radians(SLOPE_DEG)) ** 2)) if good.any() else 0.0
    if share > STEEP_SHARE:
        raise TerrainError(
            f"{file.path}: expected at most {STEEP_SHARE:.1%} of the pixels steeper than {SLOPE_DEG:g} deg, found "
            f"{share:.1%} (heights of {np.nanmin(values):.4g} to {np.nanmax(values):.4g} m, no unit stated): half "
            f"metres, feet or another scale? {_STATE_IT}"
        )


def _decoded(file: RasterFile, window: Any) -> Any:
    """Return the pixels of a window; those of 16 bits of JPEG 2000, slow to decode, are decoded once for all runs."""
    from rasterio import __gdal_version__

    def decode() -> Any:
        with file.opened() as source:
            return source.read(1, window=window, masked=_has_mask(source))

    if file.path.suffix.lower() != ".jp2" or file.warp is not None:
        return decode()
    state = file.path.stat()
    key = repr((str(file.path.resolve()), state.st_size, state.st_mtime_ns, str(window), __gdal_version__))
    name = f"pixels-{hashlib.sha256(key.encode()).hexdigest()}"
    octets, size = kept(name), int(window.height * window.width)
    if octets is not None and len(octets) == 2 * size:
        return np.frombuffer(octets, np.int16).reshape(int(window.height), -1)
    raw = decode()
    if raw.dtype == np.int16 and not np.ma.isMaskedArray(raw):
        keep(name, raw.tobytes(), KEPT_PIXELS)
    return raw


def _has_mask(source: Any) -> bool:
    """Return whether a file has a mask or an alpha band that marks pixels without data."""
    return "per_dataset" in {flag.name for flag in source.mask_flag_enums[0]}


def _open_header(path: Path, heights: bool) -> tuple[float, RasterFile]:
    """Return the pixels per degree of a file and its place."""
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
                crs, transform, shape = source.crs, source.transform, source.shape
                if crs is None:
                    raise TerrainError(f"{path}: expected a georeferenced raster, found no coordinate system")
                reading = _stated(path, source, heights)
    except rasterio.errors.RasterioError as error:
        raise TerrainError(f"{path}: expected a raster, found {error}") from None
    file = RasterFile(path, 0.0, 0.0, shape[0], shape[1], heights, reading, None, shape)
    with rasterio.Env():  # has the data of PROJ
        return _placed(file, crs, transform, _sphere(file, crs))


def _stated(path: Path, source: Any, heights: bool) -> Reading:
    """Return what a file states of its values; offsets near the Moon's radius (PDS3, in any unit) say radii."""
    label = _label(path) if source.driver in ("PDS", "PDS4", "ISIS2", "ISIS3", "VICAR") else ""
    if found := re.search(
        r'(?i)positive_?longitude_?direction\W+"?(positive\s*)?west|_direction>\s*positive west|'
        r"longitudedirection\W+positivewest",
        label,
    ):
        raise TerrainError(
            f"{path}: expected longitudes to the east, found {' '.join(found.group().split())!r}: GDAL reads them as "
            "longitudes to the east; project the image again with longitudes to the east"
        )
    if (found := re.search(r"MAP_PROJECTION_ROTATION\s*=\s*([-0-9.eE+]+)", label)) and float(found.group(1)) % 360.0:
        raise TerrainError(f"{path}: expected MAP_PROJECTION_ROTATION = 0, which GDAL takes, found {found.group(1)}")
    nodata, kind = source.nodata, np.dtype(source.dtypes[0])
    if not heights:
        return Reading(nodata=nodata)
    if source.count != 1 or kind.itemsize < 2:
        raise TerrainError(
            f"{path}: expected one band of heights of 16 bits or more, found {source.count} of {kind}: a picture?"
        )
    unit = (source.units[0] or "").strip()
    if not unit and source.driver == "PDS":
        found = re.search(r'^\s*UNIT\s*=\s*"?([A-Za-z/]+)', label, re.MULTILINE)
        unit = found.group(1) if found else ""
    unit = "" if unit.lower() in _NOT_STATED else unit.lower()
    scale, offset = source.scales[0] or 1.0, source.offsets[0] or 0.0
    words = f"unit {unit or 'not stated'}, scale {scale:g}, zero {offset:.8g}, no data {nodata}"
    if unit and unit not in UNITS_M:
        raise TerrainError(f"{path}: expected heights in a unit of length ({', '.join(UNITS_M)}), found {unit!r}")
    if nodata is None and kind.kind == "i":
        nodata = float(np.iinfo(kind).min)  # no height of the Moon in any unit
    factor = UNITS_M.get(unit, 1.0)
    if RADIUS_M.holds(1e3 * offset) and factor == 1.0:
        factor = 1e3
    is_radius = bool(RADIUS_M.holds(factor * offset))
    offset_m = factor * offset - is_radius * MOON_RADIUS_M
    return Reading(unit, factor * scale, offset_m, nodata, words, is_radius)


def _label(path: Path) -> str:
    """Return the label of a planetary image, the start of its file."""
    with path.open("rb") as file:
        return file.read(LABEL_OCTETS).decode("latin-1")


def _sphere(file: RasterFile, crs: Any) -> float:
    """Return the radius of the sphere of a coordinate system, which must be one of the Moon."""
    path = file.path
    text = crs.to_wkt()
    named = re.search(r'(?:SPHEROID|ELLIPSOID)\["[^"]*",\s*([0-9.eE+]+),\s*([0-9.eE+]+)', text)
    radius_m, flattening = map(float, named.groups()) if named else (MOON_RADIUS_M, 0.0)
    if abs(radius_m / MOON_RADIUS_M - 1.0) > SPHERE_TOLERANCE:
        raise TerrainError(
            f"{path}: expected a raster of the Moon (radius {MOON_RADIUS_M / 1e3:.1f} km), "
            f"found a body of {radius_m / 1e3:.1f} km"
        )
    polar_m = radius_m * (1.0 - 1.0 / flattening) if flattening else radius_m
    if abs(polar_m - radius_m) > 1.0:
        raise TerrainError(
            f"{path}: expected a sphere ({MOON_RADIUS_M / 1e3:.1f} km), found an ellipsoid of {radius_m / 1e3:.1f} by "
            f"{polar_m / 1e3:.1f} km, whose latitudes are others"
        )
    if file.is_heights and not file.reading.is_radius and abs(radius_m - MOON_RADIUS_M) > 1.0:
        raise TerrainError(
            f"{path}: expected heights above a sphere of {MOON_RADIUS_M / 1e3:.1f} km, found one of "
            f"{radius_m / 1e3:.3f} km"
        )
    if re.search(r'AXIS\["[^"]*longitude[^"]*",\s*WEST', text, re.IGNORECASE):
        raise TerrainError(f"{path}: expected longitudes to the east, found an axis to the west")
    return radius_m


def _placed(file: RasterFile, crs: Any, transform: Any, radius_m: float) -> tuple[float, RasterFile]:
    """Return pixels per degree and a file at its place, as it is or resampled to longitude and latitude."""
    values, degree = crs.to_dict(), math.radians(radius_m)
    across = down = 0.0
    middle_deg = float(values.get("pm", 0.0)) + float(values.get("lon_0", 0.0))
    west, north = transform.c, transform.f
    if crs.is_geographic:
        across = down = math.radians(1.0) / crs.units_factor[1]
    elif values.get("proj") == "eqc" and values.get("lat_0", 0.0) == 0.0:
        unit_m = _unit_m(values)
        down = degree / unit_m
        across = down * math.cos(math.radians(values.get("lat_ts", 0.0)))
        west, north = west - values.get("x_0", 0.0) / unit_m, north - values.get("y_0", 0.0) / unit_m
    if across and not transform.b and not transform.d:
        wide, high = transform.a / across, -transform.e / down
        if wide > 0.0 and abs(wide - high) <= 1e-6 * wide:
            _require_pixel(file, math.radians(MOON_RADIUS_M * wide))
            ppd = round(1.0 / wide, 6)
            west_deg = (middle_deg + west / across) % 360.0
            return ppd, replace(file, row=(90.0 - north / down) * ppd, column=west_deg * ppd)
    return _warped(file, crs, transform, radius_m)


def _require_pixel(file: RasterFile, pixel_m: float) -> None:
    if not RASTER_PIXEL_M.holds(pixel_m):
        raise TerrainError(
            f"{file.path}: expected pixels of {RASTER_PIXEL_M}, found {pixel_m:.3g} m: coordinates in another unit?"
        )


def _unit_m(values: dict[str, Any]) -> float:
    """Return the unit of the coordinates of a projection, as PROJ names it."""
    return float(values.get("to_meter", UNITS_M.get(str(values.get("units", "m")), 1.0)))


def _warped(file: RasterFile, crs: Any, transform: Any, radius_m: float) -> tuple[float, RasterFile]:
    """Return a file as GDAL resamples it, on a grid of longitude and latitude with pixels of its own size."""
    from rasterio import Affine

    sphere = f"+proj=longlat +R={radius_m!r} +no_defs"
    rows, columns = file.shape
    pixel = math.sqrt(abs(transform.determinant))
    pixel_deg = pixel if crs.is_geographic else pixel * _unit_m(crs.to_dict()) / math.radians(radius_m)
    _require_pixel(file, math.radians(MOON_RADIUS_M * pixel_deg))
    ppd = round(1.0 / pixel_deg, 6)
    y, x = np.meshgrid(np.linspace(0, rows, 65), np.linspace(0, columns, 65), indexing="ij")
    east, north = _transformed(crs, sphere, *_applied(transform, x.ravel(), y.ravel()))
    poles = [
        _applied(~transform, *_transformed(sphere, crs, np.array([0.0]), np.array([side * 90.0])))
        for side in (1.0, -1.0)
    ]
    known = np.isfinite(east) & np.isfinite(north)
    if not known.any():
        raise TerrainError(f"{file.path}: expected a raster with a place on the Moon, found {crs}")
    east, north = east[known], north[known]
    middle = float(np.degrees(np.angle(np.exp(1j * np.radians(east)).mean())))
    turned = (east - middle + 180.0) % 360.0 - 180.0
    west, width = middle + float(turned.min()), float(np.ptp(turned))
    low, high = float(north.min()), float(north.max())
    held = [0 <= px[0] <= columns and 0 <= py[0] <= rows for px, py in poles]
    if any(held) or width > 330.0:
        west, width = 0.0, 360.0
    high, low = (90.0 if held[0] else high), (-90.0 if held[1] else low)
    spare = 0 if width == 360.0 else 2
    first_row, first_column = math.floor((90.0 - high) * ppd), math.floor(west % 360.0 * ppd) - spare
    size = math.ceil((90.0 - low) * ppd) - first_row, math.ceil(width * ppd) + 2 * spare
    grid = Affine(1.0 / ppd, 0.0, first_column / ppd, 0.0, -1.0 / ppd, 90.0 - first_row / ppd)
    warp = Warp(crs, ~transform, sphere, grid)
    row, column = float(first_row), float(first_column)
    return ppd, replace(file, row=row, column=column, rows=size[0], columns=size[1], warp=warp)


def _transformed(source: Any, target: Any, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return coordinates (n,) in another coordinate system; infinity where it has no such place."""
    from rasterio._err import CPLE_BaseError
    from rasterio.warp import transform

    try:
        east, north = transform(source, target, x.tolist(), y.tolist())
    except CPLE_BaseError:
        if x.size == 1:
            return np.array([math.inf]), np.array([math.inf])
        halves = [
            _transformed(source, target, *part) for part in zip(np.array_split(x, 2), np.array_split(y, 2), strict=True)
        ]
        east, north = (np.concatenate(part) for part in zip(*halves, strict=True))
    return np.asarray(east), np.asarray(north)


def _applied(transform: Any, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return coordinates (n,) under an affine transform."""
    with np.errstate(invalid="ignore"):
        return (transform.a * x + transform.b * y + transform.c, transform.d * x + transform.e * y + transform.f)
