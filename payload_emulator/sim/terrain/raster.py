"""Real terrain from georeferenced rasters, sharpened below their resolution by seeded craters and roughness.

Heights are metres above the map sphere (kilometres where the raster's unit says so).  Pixels are areas.  Rasters of one
resolution form a layer; the finest layer that holds a place gives its height, and layers join over a feathered edge.
"""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from lunar.arrays import BoolArray, FloatArray
from lunar.catalogue import CraterCatalogue
from lunar.constants import MOON_RADIUS_M
from payload_emulator.errors import TerrainError
from payload_emulator.sim.terrain import kernels
from payload_emulator.sim.terrain.albedo import open_albedo
from payload_emulator.sim.terrain.craters import SmallCraters, crater_profiles
from payload_emulator.sim.terrain.procedural import SHORTEST_WAVE_PIXELS, SMALLEST_CRATER_PIXELS, mottled_albedo, stamp
from payload_emulator.sim.terrain.rasters import ChunkCache, RasterLayer, open_layers
from payload_emulator.sim.terrain.tiles import Heights, Terrain, coarse_nodes

SMOOTHING_PIXELS = 1.0
"""GLD100 is quantised to 1 m, which shows as a weave under a low Sun; one pixel of smoothing removes it."""

FEATHER_DEG = 0.12
ROUGHNESS_WAVES_KM = ((1.7, 3.6), (0.85, 2.3), (0.42, 1.4), (0.26, 0.8))
"""Wavelength in km and rms in m added below the raster's effective resolution, on ground of average slope."""

REFERENCE_SLOPE = 0.10
"""Rms slope of the smoothed raster over 1 km on which the roughness above is added as it stands."""

SLOPE_SPACING_M = 950.0
SMALL_LOW_M = 350.0
EFFECTIVE_RESOLUTION_M = 1_800.0
"""GLD100 shows craters from about this size on, at 128 or 256 pixels per degree alike."""

SMALL_EXPONENT = 2.2
CATALOGUE_DENSITY_2KM = 0.0080
"""Craters above 2 km per km2 in LU1319381 (222,451 over 53 of 72 tiles); scales the smaller ones by place."""

_LONGEST_MOVE = 2.5
"""Above the distance from a hole to the nearest pixel with a height: 2.2, the longest move of OpenCV's transform."""

_Pixels = tuple[Heights, BoolArray, Heights]
"""Heights of a window with holes filled, the holes, and the weight that rises from 0 at their edges (if any)."""

_Windows = dict[RasterLayer, tuple[int, int, _Pixels]]
"""Newest window of each layer: first row, first column and pixels."""


class RasterTerrain(Terrain):
    """Terrain of georeferenced height rasters on a grid of 256 pixels per degree."""

    is_real = True

    def __init__(
        self,
        paths: Sequence[Path | str],
        catalogue: CraterCatalogue,
        *,
        coarse_paths: Sequence[Path | str] = (),
        albedo_paths: Sequence[Path | str] = (),
        name: str = "rasters",
        data_names: tuple[str, ...] = (),
        seed: int = 0,
        sharpen: bool = True,
        registration_north_m: float = 0.0,
        registration_east_m: float = 0.0,
        smoothing_pixels: float = SMOOTHING_PIXELS,
        effective_resolution_m: float = EFFECTIVE_RESOLUTION_M,
        pixels_per_degree: int = 256,
        cache_tiles: int = 192,
    ) -> None:
        """``coarse_paths`` fill in around ``paths`` (under shadows and at edges) and do not count as covered.

        ``sharpen`` adds seeded craters and roughness below ``effective_resolution_m``, the size of what the rasters
        still show, whatever their pixels; ``registration_*`` shift the rasters on the ground, for
        studies of a wrong map. Rasters of 128 and 256 px/deg agree to 2 m as georeferenced; it is the catalogue that is
        registered to them (`registration`).
        """
        if not paths:
            raise TerrainError("terrain rasters: expected at least one height raster, found none")
        self._chunks = ChunkCache()
        coarse = open_layers(coarse_paths, chunks=self._chunks)
        self._fine = open_layers(paths, chunks=self._chunks, relief=coarse[0] if coarse else None)
        self._layers = [*coarse, *self._fine]
        self._layers.sort(key=lambda layer: layer.pixels_per_degree)
        self.registration_north_m = registration_north_m
        self.registration_east_m = registration_east_m
        self.height_files = tuple(Path(path) for path in paths)
        self._shift_north_deg = math.degrees(registration_north_m / MOON_RADIUS_M)
        self._shift_east_m = registration_east_m
        self._smoothing = smoothing_pixels
        self._sharpen = sharpen
        self._profiles = crater_profiles()
        rng = np.random.Generator(np.random.PCG64([seed, 0x52415354]))
        self._salts = [int(salt) for salt in rng.integers(1, 2**31 - 1, 32)]
        if sharpen and effective_resolution_m > SMALL_LOW_M:
            per_km2 = CATALOGUE_DENSITY_2KM * (2_000.0 / SMALL_LOW_M) ** SMALL_EXPONENT
            per_km2 *= _share_below(effective_resolution_m) / _share_below(EFFECTIVE_RESOLUTION_M)
            self._small = SmallCraters(
                seed, SMALL_LOW_M, effective_resolution_m, per_km2, SMALL_EXPONENT, _density_map(catalogue)
            )
        self._waves = [wave for wave in ROUGHNESS_WAVES_KM if wave[0] * 1e3 <= effective_resolution_m]
        self._reflectance = open_albedo(albedo_paths) if albedo_paths else None
        super().__init__(name, data_names or (name,), catalogue, pixels_per_degree, cache_tiles)

    def covers(self, latitude_rad: npt.ArrayLike, longitude_rad: npt.ArrayLike) -> BoolArray:
        """Return whether a height raster (not a coarse one) spans each place."""
        latitude, longitude = np.broadcast_arrays(
            np.asarray(latitude_rad, dtype=np.float64), np.asarray(longitude_rad, dtype=np.float64)
        )
        held = np.zeros(latitude.shape, dtype=bool)
        for layer in self._fine:
            held |= layer.holds(latitude, longitude)
        return held

    def release_ground(self) -> None:
        """Drop the tiles and the decoded pixels of the files; both are made again when they are needed."""
        super().release_ground()
        self._chunks.clear()

    def make_heights(self, latitude_rad: FloatArray, longitude_rad: FloatArray) -> Heights:
        """Heights on an even grid of places (rows, columns) in metres."""
        windows: _Windows = {}
        if not self._sharpen:
            return self._resampled(latitude_rad, longitude_rad, windows)
        step = float(latitude_rad[0] - latitude_rad[1])
        shortest = SHORTEST_WAVE_PIXELS * step * MOON_RADIUS_M / 1000.0
        gain = self._slope_gain(latitude_rad, longitude_rad, windows)  # first: its windows hold those of the heights
        out = self._resampled(latitude_rad, longitude_rad, windows)
        angles = (np.cos(latitude_rad), np.sin(latitude_rad), np.cos(longitude_rad), np.sin(longitude_rad))
        for (wavelength, rms), salt in zip(self._waves, self._salts, strict=False):
            if wavelength > shortest:
                kernels.add_noise(out, *angles, MOON_RADIUS_M / 1000.0 / wavelength, rms, salt, gain)
        small = self.small_craters(latitude_rad, longitude_rad)
        stamp(out, latitude_rad, longitude_rad, small.above(SMALLEST_CRATER_PIXELS * 0.5 * step), self._profiles)
        return out

    def make_albedo(self, latitude_rad: FloatArray, longitude_rad: FloatArray) -> Heights:
        """Normal albedo on a grid of places: the map where there is one, mottled."""
        if self._reflectance is None:
            base = np.ones((latitude_rad.size, longitude_rad.size))
        else:
            base = self._reflectance.relative(latitude_rad, longitude_rad)
        return mottled_albedo(base, latitude_rad, longitude_rad, self._salts[10:15])

    def _resampled(self, latitude: FloatArray, longitude: FloatArray, windows: _Windows) -> Heights:
        """Heights on a grid of places from the finest layers, cubic."""
        shape = (latitude.size, longitude.size)
        result: Heights | None = None
        for layer in reversed(self._layers):
            values, weight = self._from_layer(layer, latitude, longitude, windows)
            if result is None:
                result, share = values, weight
            else:
                result = np.asarray(share * result + (1.0 - share) * values, dtype=np.float32)
                share = np.maximum(share, weight)
            if share.min() >= 1.0:
                return result
        assert result is not None
        if share.min() <= 0.0:
            row, column = np.unravel_index(int(share.argmin()), shape)
            raise TerrainError(
                f"terrain {self.name}: expected heights at latitude {math.degrees(latitude[row]):.3f} deg, "
                f"longitude {math.degrees(longitude[column]) % 360.0:.3f} deg E, found none"
            )
        return result

    def _from_layer(
        self, layer: RasterLayer, latitude: FloatArray, longitude: FloatArray, windows: _Windows
    ) -> tuple[Heights, Heights]:
        """Smoothed heights of one layer and how much they count: 1 inside, falling to 0 at the edge of its data."""
        ppd = layer.pixels_per_degree
        middle = 0.5 * float(latitude[0] + latitude[-1])
        east_deg = math.degrees(self._shift_east_m / MOON_RADIUS_M / math.cos(middle))
        rows = (90.0 - (np.degrees(latitude) - self._shift_north_deg)) * ppd - 0.5 - layer.north_offset
        columns = (np.degrees(longitude) - east_deg) * ppd - 0.5 - layer.west_offset
        feather = math.ceil(FEATHER_DEG * ppd)
        # Steps wider than the source's pixels need a wider mean.
        sigma = max(self._smoothing, 0.45 * float(rows[1] - rows[0]))
        reach = math.ceil(3.5 * sigma)
        margin = max(reach, feather) + 3
        top, left = math.floor(rows[0]) - margin, math.floor(columns[0]) - margin
        height, width = math.ceil(rows[-1]) + margin + 1 - top, math.ceil(columns[-1]) + margin + 1 - left
        source, hole, smooth = _window(layer, top, left, height, width, feather, windows)
        out = np.zeros((latitude.size, longitude.size), np.float32)
        if hole.all():
            return out, np.zeros_like(out)
        weight = np.ones_like(out)
        if hole.any():
            kernels.resample_cubic(smooth, *_span(rows, top), *_span(columns, left), weight)
            weight = np.clip(weight, 0.0, 1.0)
        if sigma > 0.0:
            source = _smoothed(source, sigma, reach)
        kernels.resample_cubic(source, *_span(rows, top), *_span(columns, left), out)
        return out, weight

    def _slope_gain(self, latitude: FloatArray, longitude: FloatArray, windows: _Windows) -> Heights:
        """Return the roughness of the ground about each pixel, relative to average ground, (rows, columns)."""
        step = float(latitude[0] - latitude[1])
        # About 1 km between nodes whatever the level, on pixels all tiles share.
        stride = max(1, round(SLOPE_SPACING_M / (step * MOON_RADIUS_M)))
        nodes_latitude, nodes_longitude, top, left = coarse_nodes(latitude, longitude, stride, 3)
        heights = self._resampled(nodes_latitude, nodes_longitude, windows)
        spacing = stride * step * MOON_RADIUS_M
        north = np.diff(heights, axis=0)[:, :-1] / spacing
        east = np.diff(heights, axis=1)[:-1] / (spacing * np.cos(nodes_latitude[:-1])[:, None])
        square = north * north + east * east
        height, width = square.shape[0] - 2, square.shape[1] - 2
        blurred = sum(square[i : i + height, j : j + width] for i in range(3) for j in range(3)) / 9.0
        gain = np.clip(np.sqrt(blurred) / REFERENCE_SLOPE, 0.25, 1.6)
        # Cell (k, l) of the blur is centred half a step after node k + 1.
        out = np.empty((latitude.size, longitude.size), np.float32)
        kernels.resample_cubic(
            np.ascontiguousarray(gain, dtype=np.float32), top - 1.5, 1.0 / stride, left - 1.5, 1.0 / stride, out
        )
        return out


def _window(
    layer: RasterLayer, top: int, left: int, height: int, width: int, feather: int, windows: _Windows
) -> _Pixels:
    """Return what `_Pixels` says of a window, cut from the one in ``windows`` if that holds it, else put there."""
    if layer in windows:
        first_row, first_column, pixels = windows[layer]
        y, x = top - first_row, left - first_column
        part = np.s_[max(y, 0) : y + height, max(x, 0) : x + width]
        if pixels[0][part].shape == (height, width):
            source, hole, smooth = pixels
            return np.ascontiguousarray(source[part]), hole[part], np.ascontiguousarray(smooth[part])
    source = smooth = layer.read(top, left, height, width)
    hole = np.isnan(source)
    if hole.any() and not hole.all():
        import cv2

        # No hole takes a height from beyond this box, and no weight outside it is below 1.
        found = (np.flatnonzero(hole.any(axis)) for axis in (1, 0))
        box = tuple(slice(max(at[0] - feather - 3, 0), at[-1] + feather + 4) for at in found)
        empty, values = hole[box], source[box]
        inside = cv2.distanceTransform((~empty).astype(np.uint8), cv2.DIST_L2, 5)
        _, labels = cv2.distanceTransformWithLabels(
            empty.astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
        )
        # Holes take the nearest height, so that the smoothing has something to work on at edges.
        edge = (inside > 0.0) & (inside < _LONGEST_MOVE)
        of_label = np.zeros(int(labels.max()) + 1, np.float32)
        of_label[labels[edge]] = values[edge]
        values[empty] = of_label[labels[empty]]
        share = np.clip((inside - 1.0) / feather, 0.0, 1.0)
        smooth = np.ones_like(source)
        smooth[box] = share * share * (3.0 - 2.0 * share)
    windows[layer] = top, left, (source, hole, smooth)
    return source, hole, smooth


def _share_below(diameter_m: float) -> float:
    """Share of all craters above the low limit that are smaller than this."""
    return 1.0 - float((SMALL_LOW_M / diameter_m) ** SMALL_EXPONENT)


def _span(places: FloatArray, origin: int) -> tuple[float, float]:
    return float(places[0] - origin), float(places[1] - places[0])


def _smoothed(values: Heights, sigma: float, reach: int) -> Heights:
    """Gaussian of ``values``, separable; the outer ``reach`` pixels are left as they are."""
    offsets = np.arange(-reach, reach + 1)
    weights = np.exp(-0.5 * (offsets / sigma) ** 2)
    weights = np.asarray(weights / weights.sum(), dtype=np.float32)
    smoothed: Heights = kernels.smooth(values, weights)
    return smoothed


def _density_map(catalogue: CraterCatalogue) -> FloatArray:
    """Craters of 2 to 5 km about each cell of one degree relative to the mean, (180, 360), over 7 x 7 cells."""
    density = np.ones((180, 360))
    chosen = (catalogue.diameter_m >= 2_000.0) & (catalogue.diameter_m < 5_000.0)
    if np.count_nonzero(chosen) < 1_000:
        return density
    row = np.clip(np.floor(90.0 - np.degrees(catalogue.latitude_rad[chosen])), 0, 179).astype(np.int64)
    column = np.floor(np.degrees(catalogue.longitude_rad[chosen]) % 360.0).astype(np.int64) % 360
    count = np.zeros((180, 360))
    np.add.at(count, (row, column), 1.0)
    area = np.repeat(np.cos(np.radians(89.5 - np.arange(180)))[:, None], 360, axis=1)
    counted = _box(count)
    expected = CATALOGUE_DENSITY_2KM * (1.0 - 0.4**1.8) * 919.4 * _box(area)
    return np.clip(np.where(counted > 0.0, counted / expected, 1.0), 0.25, 2.0)


def _box(values: FloatArray) -> FloatArray:
    """Mean over 7 x 7 cells, around the meridian."""
    padded = np.pad(np.pad(values, ((3, 3), (0, 0)), mode="edge"), ((0, 0), (3, 3)), mode="wrap")
    return np.asarray(sum(padded[i : i + 180, j : j + 360] for i in range(7) for j in range(7)) / 49.0)
