"""Terrain as square tiles made on demand and kept in one pool.

The whole Moon is one equirectangular grid of pixels (areas; the first row touches the north pole, the first column the
prime meridian), cut into tiles of 512 x 512.  A tile is a pure function of the source, the seed and its place, so
every window is the same bits whatever was asked before, and no seam can appear at tile edges or at 0/360 degrees.
"""

from __future__ import annotations

import functools
import hashlib
import math
import threading
from abc import ABC, abstractmethod
from collections import OrderedDict
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from kernels import made_once
from lunar import constants
from lunar.arrays import BoolArray, FloatArray, IntArray
from lunar.catalogue import CraterCatalogue
from lunar.constants import MOON_RADIUS_M
from payload_emulator.errors import TerrainError

if TYPE_CHECKING:
    from payload_emulator.sim.terrain.craters import CraterShapes, SmallCraters
    from payload_emulator.sim.terrain.registration import Registration

Heights = npt.NDArray[np.float32]

TILE_SHIFT = 9
TILE_PIXELS = 1 << TILE_SHIFT
APRON = 1
"""Rows and columns of the neighbours that a tile repeats before its own; two more come after.  Slopes need them."""

LEVELS = 6
"""Each level has pixels about 1.41 times as large, made from the source without what is too small for them."""

MEASURE_LEVEL = 2
"""Rims are measured on pixels of 237 m: enough for craters of 2 km and up, and four times quicker to make."""

ALBEDO_SHIFT = 6
"""An albedo tile has 64 x 64 pixels over the same ground."""

MEAN_ALBEDO = 0.12
"""Normal albedo of an average lunar surface (the maps of Hapke 2012 span about 0.06 to 0.2)."""

KEPT_TILES = 16
"""Tiles of 1 MB that are kept for later windows: a pass over new ground needs each in neighbouring frames only, and
reads others again from disk."""

FILED_TILES = 1024
"""Tiles of 1 MB that are kept on disk for later runs: six windows of a pole-to-pole orbit side by side need 650."""

RIM_AZIMUTHS = 48
FLOOR_AZIMUTHS = 16
POLE_LIMIT_RAD = math.radians(84.0)


@dataclass(frozen=True, eq=False, slots=True)
class TerrainPatch:
    """Heights and albedo over one window, as tiles in a shared pool: good until the next patch is asked for.

    Attributes
    ----------
    heights, albedo
        Pools of tiles, float32: heights (slots, 515, 515) in metres above the map sphere, a tile's own pixels
        starting at (1, 1); normal albedo (slots, 65, 65).
    table
        Slot of every tile of the window, int32 (rows, columns); -1 for tiles that were not asked for.
    first_row, first_column
        Grid pixel of the window's north-west corner; the column may be negative or beyond 360 degrees.
    pixels_per_radian
        Of the height grid.
    low_m, high_m
        Bounds of the heights in the window.
    """

    heights: Heights
    albedo: Heights
    table: npt.NDArray[np.int32]
    first_row: int
    first_column: int
    pixels_per_radian: float
    low_m: float
    high_m: float

    def coordinates(self, latitude_rad: FloatArray, longitude_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Pixel coordinates (row, column) of places within the window; integers are pixel centres."""
        rows = (0.5 * math.pi - latitude_rad) * self.pixels_per_radian - 0.5 - self.first_row
        middle = (self.first_column + 0.5 * self.table.shape[1] * TILE_PIXELS) / self.pixels_per_radian
        turn = 2.0 * math.pi
        unwrapped = longitude_rad + turn * np.round((middle - longitude_rad) / turn)
        return rows, unwrapped * self.pixels_per_radian - 0.5 - self.first_column


class Terrain(ABC):
    """Cache of tiles and everything that follows from it; a source only has to make one tile.

    A terrain belongs to one thread, the first that asks it for ground: the tiles of a patch are overwritten by later
    ones.  Other threads are refused; each opens its own terrain, which gives the same bits.
    """

    is_real: bool = False
    """True if the heights are those of the Moon."""
    registration: Registration | None = None
    """Registration of the catalogue to the heights; None if not applicable or unknown."""
    sources: str = ""
    """Sources of the terrain: equal texts and catalogues mean equal ground; empty if unknown."""

    _small: SmallCraters | None = None
    """Craters below the catalogue's limit, where the source draws any."""

    def __init__(
        self,
        name: str,
        data_names: tuple[str, ...],
        catalogue: CraterCatalogue,
        pixels_per_degree: int,
        cache_tiles: int,
    ) -> None:
        if (180 * pixels_per_degree) % TILE_PIXELS:
            raise TerrainError(
                f"terrain {name}: expected pixels per degree so that {TILE_PIXELS} divides the meridian, "
                f"found {pixels_per_degree}"
            )
        self.name = name
        self.data_names = data_names
        self.listed = self.catalogue = catalogue
        self.pixels_per_degree = pixels_per_degree
        self.pixels_per_radian = math.degrees(pixels_per_degree)
        self.pixel_m = MOON_RADIUS_M / self.pixels_per_radian
        finest = 180 * pixels_per_degree // TILE_PIXELS
        self._level_rows = tuple(round(finest / 2 ** (level / 2)) for level in range(LEVELS))
        self.cache_tiles = cache_tiles
        self._room = min(KEPT_TILES, cache_tiles)
        self._pool: Heights | None = None
        self._albedo: Heights | None = None
        self._bounds = np.zeros((cache_tiles, 2))
        self._slots: OrderedDict[tuple[int, int, int], int] = OrderedDict()
        self._row = np.full(len(catalogue), -1, dtype=np.int32)
        self._rims_m = np.zeros((0, 4))
        self._owner: int | None = None

    def register(self, registration: Registration) -> None:
        """Move the listed craters to where the heights show them; before any of them is measured."""
        from payload_emulator.sim.terrain.registration import registered

        assert not len(self._rims_m)
        self.catalogue = registered(self.listed, registration)
        self.registration = registration

    @abstractmethod
    def make_heights(self, latitude_rad: FloatArray, longitude_rad: FloatArray) -> Heights:
        """Heights on a grid of places (rows, columns) at even steps of latitude, north first, and longitude.

        What is too small for the steps is left out.  The value at a place must not depend on the rest of the grid.
        """

    @abstractmethod
    def make_albedo(self, latitude_rad: FloatArray, longitude_rad: FloatArray) -> Heights:
        """Normal albedo on a grid of places (rows, columns)."""

    @abstractmethod
    def covers(self, latitude_rad: npt.ArrayLike, longitude_rad: npt.ArrayLike) -> BoolArray:
        """Return whether the source itself holds each place."""

    def small_craters(self, latitude_rad: FloatArray, longitude_rad: FloatArray) -> CraterShapes:
        """Seeded craters below the catalogue's limit that can touch a window of these latitudes and longitudes."""
        from payload_emulator.sim.terrain.craters import no_craters

        return no_craters() if self._small is None else self._small.around(latitude_rad, longitude_rad)

    def patch(
        self, latitude_rad: FloatArray, longitude_rad: FloatArray, spacing_m: float = 0.0, level: int = 0
    ) -> TerrainPatch:
        """Tiles of a level within ``spacing_m`` (and two pixels) of the given places.

        Raises
        ------
        TerrainError
            Beyond 84 degrees of latitude, where an equirectangular grid is no use, or wider than the cache, or from
            another thread than the one this terrain belongs to.
        """
        thread = threading.get_ident()
        if self._owner is None:
            self._owner = thread
        elif self._owner != thread:
            raise TerrainError(
                f"terrain {self.name}: expected the thread that first asked it for ground, found another "
                f"({threading.current_thread().name}): open a terrain for each thread"
            )
        latitude = np.asarray(latitude_rad, dtype=np.float64).ravel()
        longitude = np.asarray(longitude_rad, dtype=np.float64).ravel()
        worst = int(np.abs(latitude).argmax())
        if not abs(latitude[worst]) < POLE_LIMIT_RAD:
            raise TerrainError(
                f"terrain {self.name}: expected latitudes within {math.degrees(POLE_LIMIT_RAD):.0f} deg, "
                f"found {math.degrees(latitude[worst]):.2f} deg"
            )
        turn = 2.0 * math.pi
        longitude = longitude + turn * np.round((longitude[0] - longitude) / turn)
        scale = self._level_rows[level] * TILE_PIXELS / math.pi
        spare = 2.5 + spacing_m * scale / MOON_RADIUS_M
        wide = 2.5 + spacing_m * scale / MOON_RADIUS_M / np.cos(latitude)
        tile_columns = 2 * self._level_rows[level]
        rows = (0.5 * math.pi - latitude) * scale - 0.5
        columns = longitude * scale - 0.5
        edges = np.stack([rows - spare, rows + spare, columns - wide, columns + wide])
        above, below, before, behind = np.floor(edges / TILE_PIXELS).astype(np.int64)
        top, left = int(above.min()), int(before.min())
        wanted = np.zeros((int(below.max()) - top + 1, int(behind.max()) - left + 1), dtype=bool)
        spans = np.stack([above - top, below - top, before - left, behind - left], axis=1)
        for row, last_row, column, last_column in set(map(tuple, spans.tolist())):
            wanted[row : last_row + 1, column : last_column + 1] = True
        count = int(np.count_nonzero(wanted))
        if count > self.cache_tiles or wanted.shape[1] > tile_columns:
            raise TerrainError(
                f"terrain {self.name}: expected a window of at most {self.cache_tiles} tiles, found {count}: "
                "the view is too wide or too near a pole"
            )
        self._room = max(self._room, count)
        keys = [(level, top + row, (left + column) % tile_columns) for row, column in np.argwhere(wanted).tolist()]
        for key in keys:
            if key in self._slots:
                self._slots.move_to_end(key)
        table = np.full(wanted.shape, -1, np.int32)
        table[wanted] = [self._slots[key] if key in self._slots else self._made(key) for key in keys]
        bounds = self._bounds[table[wanted]]
        assert self._pool is not None and self._albedo is not None
        return TerrainPatch(
            heights=self._pool,
            albedo=self._albedo,
            table=table,
            first_row=top * TILE_PIXELS,
            first_column=left * TILE_PIXELS,
            pixels_per_radian=scale,
            low_m=float(bounds[:, 0].min()),
            high_m=float(bounds[:, 1].max()),
        )

    def level_for(self, sample_m: float) -> int:
        """The finest level whose pixels are no smaller than three quarters of a picture's sample on the ground."""
        sizes = [math.pi * MOON_RADIUS_M / (rows * TILE_PIXELS) for rows in self._level_rows]
        return next((level for level, size in enumerate(sizes) if size >= 0.75 * sample_m), LEVELS - 1)

    def height_m(self, latitude_rad: npt.ArrayLike, longitude_rad: npt.ArrayLike, level: int = 0) -> FloatArray:
        """Height above the map sphere (...) in metres, bilinear on the grid of a level; places may lie far apart."""
        from payload_emulator.sim.terrain import kernels

        latitude, longitude = np.broadcast_arrays(
            np.asarray(latitude_rad, dtype=np.float64), np.asarray(longitude_rad, dtype=np.float64)
        )
        out = np.empty(latitude.size)
        flat_latitude, flat_longitude = latitude.ravel(), longitude.ravel()
        # Blocks of 4 x 4 tiles: few calls, and no window wider than the cache.
        block_row = np.floor((0.5 * math.pi - flat_latitude) * self.pixels_per_radian / (4 * TILE_PIXELS << level))
        block_column = np.floor(flat_longitude * self.pixels_per_radian / (4 * TILE_PIXELS << level))
        blocks, block = np.unique(block_row * 1.0e6 + block_column, return_inverse=True)
        for number in range(blocks.size):
            chosen = block == number
            places = flat_latitude[chosen], flat_longitude[chosen]
            patch = self.patch(*places, level=level)
            values = np.empty(places[0].size)
            kernels.sample_pool(patch.heights, patch.table, TILE_SHIFT, *patch.coordinates(*places), values)
            out[chosen] = values
        return out.reshape(latitude.shape)

    def measured(self, indices: IntArray) -> CraterCatalogue:
        """The craters of these indices, measured: rim height is the mean on the rim circle, depth from it to the floor.

        The floor is the mean within 0.4 radius.  Craters whose surroundings this terrain cannot give keep NaN.
        """
        self._measure(indices[self._row[indices] < 0])
        rims_m = self.measurements_m(indices)
        return replace(self.catalogue.select(indices), rim_height_m=rims_m[:, 0], depth_m=rims_m[:, 1])

    def measurements_m(self, indices: IntArray) -> FloatArray:
        """Rim height, depth, and tilts to the north and to the east, (n, 4); as listed where not measured."""
        listed, row, flat = self.catalogue, self._row[indices], np.zeros(len(indices))
        found = np.column_stack([listed.rim_height_m[indices], listed.depth_m[indices], flat, flat])
        found[row >= 0] = self._rims_m[row[row >= 0]]
        return found

    def take_measurements(self, indices: IntArray, values_m: FloatArray) -> None:
        """Take the measurements that an equal terrain made of these craters."""
        self._row[indices] = len(self._rims_m) + np.arange(len(indices))
        self._rims_m = np.concatenate([self._rims_m, values_m])

    def rim_tilts_m(self, indices: IntArray) -> FloatArray:
        """Return the rise of the rim's best plane over its mean in the north and in the east, (n, 2); 0 if unknown."""
        self._measure(indices[self._row[indices] < 0])
        return self.measurements_m(indices)[:, 2:]

    def _measure(self, indices: IntArray) -> None:
        if indices.size == 0:
            return
        latitude = self.catalogue.latitude_rad[indices]
        indices = indices[np.abs(latitude) < POLE_LIMIT_RAD - 0.05]
        order = np.lexsort((self.catalogue.longitude_rad[indices], np.round(self.catalogue.latitude_rad[indices], 1)))
        parts = np.array_split(indices[order], max(1, indices.size // 256))
        # From west to east, so that each tile and each cell of small craters is made once.
        for part in sorted(parts, key=lambda one: self.catalogue.longitude_rad[one[:1]].tolist()):
            latitude = self.catalogue.latitude_rad[part][:, None]
            longitude = self.catalogue.longitude_rad[part][:, None]
            radius = 0.5 * self.catalogue.diameter_m[part][:, None] / MOON_RADIUS_M
            around = self.height_m(*_circle(latitude, longitude, radius, RIM_AZIMUTHS), MEASURE_LEVEL)
            rim = around.mean(axis=1)
            azimuth = _azimuths(RIM_AZIMUTHS)
            tilt = 2.0 / RIM_AZIMUTHS * around @ np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
            rings = [
                self.height_m(*_circle(latitude, longitude, fraction * radius, FLOOR_AZIMUTHS), MEASURE_LEVEL).mean(
                    axis=1
                )
                for fraction in (0.1, 0.22, 0.34)
            ]
            # Rings stand for equal-width annuli of the inner 0.4 radius: weights are their areas.
            floor = (1.0 * rings[0] + 2.2 * rings[1] + 3.4 * rings[2]) / 6.6
            self.take_measurements(part, np.column_stack([rim, rim - floor, tilt]))

    def release_ground(self) -> None:
        """Drop the tiles; they are made again when they are needed."""
        self._pool = self._albedo = None
        self._room = min(KEPT_TILES, self.cache_tiles)
        self._slots.clear()

    def close(self) -> None:
        """Drop the ground and the craters: nothing is asked of this terrain any more."""
        self.release_ground()
        self.listed = self.catalogue = self.catalogue.select(slice(0))

    def release_thread(self) -> None:
        """Release the thread that has requested ground so far; the next one that requests some owns it."""
        self._owner = None

    def _made(self, key: tuple[int, int, int]) -> int:
        """Put a tile into a slot of the pool, and return the slot."""
        if self._pool is None or self._albedo is None:
            size, small = TILE_PIXELS + 3, (1 << ALBEDO_SHIFT) + 1
            self._pool = np.empty((self.cache_tiles, size, size), np.float32)
            self._albedo = np.empty((self.cache_tiles, small, small), np.float32)
        latitude, longitude = tile_angles(key[1], key[2], self._level_rows[key[0]] * TILE_PIXELS / 180.0)
        heights = self._heights(key, latitude, longitude)
        step = TILE_PIXELS >> ALBEDO_SHIFT
        albedo = self.make_albedo(latitude[APRON::step], longitude[APRON::step])
        slot = self._slots.popitem(last=False)[1] if len(self._slots) >= self._room else len(self._slots)
        self._pool[slot] = heights
        self._albedo[slot] = albedo
        self._bounds[slot] = heights.min(), heights.max()
        self._slots[key] = slot
        return slot

    def _heights(self, key: tuple[int, int, int], latitude: FloatArray, longitude: FloatArray) -> Heights:
        """Return the heights of a tile, made once and read from disk later if it is known what they are made of."""
        if not self.sources:
            return self.make_heights(latitude, longitude)
        name = f"tile-{ground_hash(self._ground_hash, np.array(key))}"
        octets = made_once(name, lambda: self.make_heights(latitude, longitude).tobytes(), FILED_TILES)
        return np.frombuffer(octets, np.float32).reshape(latitude.size, -1)

    @functools.cached_property
    def _ground_hash(self) -> str:
        """Hash of what the heights of tiles are made of."""
        listed = self.listed
        columns = (listed.latitude_rad, listed.longitude_rad, listed.diameter_m, listed.depth_m)
        return ground_hash(f"{self.sources} {self.pixels_per_degree}", *columns)


def ground_hash(sources: str, *arrays: npt.NDArray[np.generic]) -> str:
    """Return the hash of what ground or measurements of it are made of, the code included."""
    key = hashlib.sha256(f"{_code_hash()} {sources}".encode())
    for array in arrays:
        key.update(array.tobytes())
    return key.hexdigest()


@functools.cache
def _code_hash() -> str:
    """Return the hash of the code that makes ground, and of libraries and processor, which decide the last bit."""
    import llvmlite.binding

    key = hashlib.sha256(llvmlite.binding.get_host_cpu_name().encode())
    for package in ("numba", "numpy", "opencv-python-headless", "rasterio"):
        with suppress(PackageNotFoundError):
            key.update(version(package).encode())
    for module in (__file__, constants.__file__):
        for file in sorted(Path(module).parent.glob("*.py")):
            key.update(file.read_bytes())
    return key.hexdigest()


def tile_angles(tile_row: int, tile_column: int, pixels_per_degree: float) -> tuple[FloatArray, FloatArray]:
    """Latitudes and longitudes (515,) in radians of a tile's pixel centres, some of the neighbours' included."""
    index = np.arange(-APRON, TILE_PIXELS + 2)
    latitude = np.radians(90.0 - (tile_row * TILE_PIXELS + index + 0.5) / pixels_per_degree)
    longitude = np.radians((tile_column * TILE_PIXELS + index + 0.5) / pixels_per_degree)
    return latitude, longitude


def coarse_nodes(
    latitude: FloatArray, longitude: FloatArray, stride: int, spare: int
) -> tuple[FloatArray, FloatArray, float, float]:
    """Every ``stride``-th place of the global grid about a part of it, and where the part begins among them.

    All tiles pick the same nodes, so what is interpolated between them agrees at tile edges.  ``spare`` nodes are
    added on all sides; the returned starts are in nodes.
    """
    step = float(latitude[0] - latitude[1])
    starts, nodes = [], []
    for first, count in (
        (round((0.5 * math.pi - float(latitude[0])) / step - 0.5), latitude.size),
        (round(float(longitude[0]) / step - 0.5), longitude.size),
    ):
        low = first // stride - spare
        high = (first + count - 1) // stride + 2 + spare
        starts.append(first / stride - low)
        nodes.append(np.asarray((np.arange(low, high) * stride + 0.5) * step, dtype=np.float64))
    return np.asarray(0.5 * math.pi - nodes[0]), np.asarray(nodes[1]), starts[0], starts[1]


def _azimuths(count: int) -> FloatArray:
    """Azimuths (count,) from north, clockwise, evenly spread."""
    return np.asarray((np.arange(count) + 0.5) * (2.0 * math.pi / count))


def _circle(
    latitude: FloatArray, longitude: FloatArray, radius: FloatArray, azimuths: int
) -> tuple[FloatArray, FloatArray]:
    """Places (n, azimuths) on small circles of angular ``radius`` about centres (n, 1)."""
    azimuth = _azimuths(azimuths)
    sine = np.sin(latitude) * np.cos(radius) + np.cos(latitude) * np.sin(radius) * np.cos(azimuth)
    east = np.sin(azimuth) * np.sin(radius) * np.cos(latitude)
    return np.arcsin(sine), longitude + np.arctan2(east, np.cos(radius) - np.sin(latitude) * sine)
