"""A seeded Moon that needs no data: fractal relief with plains, and craters of a synthetic catalogue."""

import itertools
import math

import numpy as np
import numpy.typing as npt

from lunar.arrays import BoolArray, FloatArray
from lunar.catalogue import CLASS_LIMITS_M, PAPER_CLASS_COUNTS, CraterCatalogue, make_catalogue
from lunar.constants import MOON_RADIUS_M
from payload_emulator.sim.terrain import craters, kernels
from payload_emulator.sim.terrain.tiles import MEAN_ALBEDO, Heights, Terrain, coarse_nodes

COARSE_STEP = 8
"""Long waves are computed at every eighth pixel and resampled."""

WAVES_KM = (
    (1600.0, 900.0),
    (800.0, 600.0),
    (400.0, 420.0),
    (200.0, 260.0),
    (100.0, 170.0),
    (50.0, 105.0),
    (25.0, 66.0),
    (12.0, 42.0),
    (6.5, 27.0),
    (3.1, 17.0),
    (1.5, 10.0),
    (0.7, 5.4),
    (0.33, 2.6),
)
"""Wavelength in km and rms in m of every octave of the uplands."""

COARSE_WAVE_PIXELS = 48.0
SHORTEST_WAVE_PIXELS = 3.0
SMALLEST_CRATER_PIXELS = 3.2
"""Longer waves are computed on every eighth pixel; shorter waves and smaller craters than these are left out."""

PLAIN_SHARE = 0.22
PLAIN_DROP_M = 1500.0
PLAIN_ROUGHNESS = 0.3
PLAIN_CRATERS = 0.3
"""A fifth of the surface is plains: lower, smoother, with fewer craters (maria cover 16 % of the Moon)."""

LARGE_CRATERS = 3_674
"""Craters above 30 km (the paper, section V-B.2)."""

CATALOGUE_LOW_M = 2_000.0
SMALL_LOW_M = 400.0
BELOW_CLASSES_EXPONENT = 1.8
"""Cumulative slope from 5 to 2 km; the catalogue LU1319381 falls as D^-1.79 there."""

SMALL_EXPONENT = 2.2
"""Below 2 km: meets the equilibrium density of Trask (1966), 0.079 per km2 above 1 km, near 0.7 km."""


class ProceduralTerrain(Terrain):
    """The whole Moon from a seed, on 256 pixels per degree (118 m)."""

    def __init__(
        self, seed: int, pixels_per_degree: int = 256, cache_tiles: int = 192, catalogue: CraterCatalogue | None = None
    ) -> None:
        """``catalogue`` takes the place of the synthetic one: its craters are stamped where and as large as it says.

        Depths it does not tell are drawn.
        """
        self.seed = seed
        self._profiles = craters.crater_profiles()
        rng = np.random.Generator(np.random.PCG64([seed, 0x4D4F4F4E]))
        salts = rng.integers(1, 2**31 - 1, 64)
        self._salts = [int(salt) for salt in salts]
        self._plains = _plains_map(self._salts[60:])
        if catalogue is None:
            name = f"procedural Moon, seed {seed}"
            catalogue, self._shapes = _draw_catalogue(rng, self._plains, seed)
        else:
            name = f"craters of {catalogue.source} on a procedural base, seed {seed}"
            self._shapes = _shape_catalogue(catalogue, rng)
        count_2km = np.count_nonzero(catalogue.diameter_m >= CATALOGUE_LOW_M)
        sphere_km2 = 4.0 * math.pi * (MOON_RADIUS_M / 1000.0) ** 2
        density = 1.0 - (1.0 - PLAIN_CRATERS) * self._plains[::2, ::2][:180, :360]
        weight = np.cos(np.radians(89.5 - np.arange(180)))[:, None]
        density = density / np.average(density, weights=np.broadcast_to(weight, density.shape))
        self._small = craters.SmallCraters(
            seed,
            SMALL_LOW_M,
            CATALOGUE_LOW_M,
            count_2km / sphere_km2 * (CATALOGUE_LOW_M / SMALL_LOW_M) ** SMALL_EXPONENT,
            SMALL_EXPONENT,
            density,
        )
        super().__init__(name, (name,), catalogue, pixels_per_degree, cache_tiles)
        # Widest first: a tile asks for the craters of each size band within that band's reach.
        reach = kernels.PROFILE_REACH * 1.05 * self._shapes.radius_rad * MOON_RADIUS_M
        edges = (0.0, 8.0e3, 25.0e3, 80.0e3, np.inf)
        self._bands = []
        for low, high in itertools.pairwise(edges):
            chosen = np.flatnonzero((reach >= low) & (reach < high))
            if chosen.size:
                self._bands.append((float(reach[chosen].max()), chosen, catalogue.select(chosen)))

    def covers(self, latitude_rad: npt.ArrayLike, longitude_rad: npt.ArrayLike) -> BoolArray:
        """Return whether the source itself holds each place: everywhere but within six degrees of the poles."""
        latitude, _ = np.broadcast_arrays(np.asarray(latitude_rad, dtype=np.float64), np.asarray(longitude_rad))
        return np.asarray(np.abs(latitude) < math.radians(83.0))

    def make_heights(self, latitude_rad: FloatArray, longitude_rad: FloatArray) -> Heights:
        """Heights on an even grid of places (rows, columns) in metres."""
        step = float(latitude_rad[0] - latitude_rad[1])
        pixel_km = step * MOON_RADIUS_M / 1000.0
        node_latitude, node_longitude, top, left = coarse_nodes(latitude_rad, longitude_rad, COARSE_STEP, 1)
        plain = self._plain(node_latitude, node_longitude)
        roughness = (1.0 - (1.0 - PLAIN_ROUGHNESS) * plain).astype(np.float32)
        coarse = (-PLAIN_DROP_M * plain).astype(np.float32)
        even = np.ones_like(coarse)
        waves = [(km, rms, salt) for (km, rms), salt in zip(WAVES_KM, self._salts, strict=False)]
        long = [wave for wave in waves if wave[0] > COARSE_WAVE_PIXELS * pixel_km]
        short = [wave for wave in waves[len(long) :] if wave[0] > SHORTEST_WAVE_PIXELS * pixel_km]
        angles = (np.cos(node_latitude), np.sin(node_latitude), np.cos(node_longitude), np.sin(node_longitude))
        for wavelength, rms, salt in long:
            gain = even if wavelength > 300.0 else roughness
            kernels.add_noise(coarse, *angles, MOON_RADIUS_M / 1000.0 / wavelength, rms, salt, gain)
        out = np.empty((latitude_rad.size, longitude_rad.size), np.float32)
        gain = np.empty_like(out)
        for source, target in ((coarse, out), (roughness, gain)):
            kernels.resample_cubic(source, top, 1.0 / COARSE_STEP, left, 1.0 / COARSE_STEP, target)
        angles = (np.cos(latitude_rad), np.sin(latitude_rad), np.cos(longitude_rad), np.sin(longitude_rad))
        for wavelength, rms, salt in short:
            kernels.add_noise(out, *angles, MOON_RADIUS_M / 1000.0 / wavelength, rms, salt, gain)
        stamp(out, latitude_rad, longitude_rad, self._craters_about(latitude_rad, longitude_rad), self._profiles)
        small = self.small_craters(latitude_rad, longitude_rad)
        stamp(out, latitude_rad, longitude_rad, small.above(SMALLEST_CRATER_PIXELS * 0.5 * step), self._profiles)
        return out

    def make_albedo(self, latitude_rad: FloatArray, longitude_rad: FloatArray) -> Heights:
        """Normal albedo on a grid of places: dark plains, bright uplands, mottled."""
        plain = self._plain(latitude_rad, longitude_rad)
        return mottled_albedo(1.12 - 0.5 * plain, latitude_rad, longitude_rad, self._salts[40:46])

    def _plain(self, latitude: FloatArray, longitude: FloatArray) -> FloatArray:
        """Return the plain fraction (0..1) of a grid of places, (rows, columns), cubic in a half-degree map."""
        rows = (90.0 - np.degrees(latitude)) * 2.0
        columns = np.degrees(longitude) * 2.0
        left = math.floor(columns[0]) - 2
        width = math.ceil(columns[-1]) + 4 - left
        # Rows beyond a pole are not used (see POLE_LIMIT_RAD); the clip only keeps the index in the map.
        top = math.floor(rows[0]) - 2
        height = math.ceil(rows[-1]) + 4 - top
        source = self._plains[np.clip(np.arange(top, top + height), 0, 360)][:, np.arange(left, left + width) % 720]
        out = np.empty((rows.size, columns.size), np.float32)
        kernels.resample_cubic(
            np.ascontiguousarray(source, dtype=np.float32),
            float(rows[0] - top),
            float(rows[1] - rows[0]),
            float(columns[0] - left),
            float(columns[1] - columns[0]),
            out,
        )
        return out.astype(np.float64)

    def _craters_about(self, latitude: FloatArray, longitude: FloatArray) -> craters.CraterShapes:
        middle_latitude = 0.5 * float(latitude[0] + latitude[-1])
        middle_longitude = 0.5 * float(longitude[0] + longitude[-1])
        half = float(latitude[0] - latitude[-1]) * 0.75 * MOON_RADIUS_M
        found = [
            chosen[np.asarray(part.near(middle_latitude, middle_longitude, half + reach), dtype=np.int64)]
            for reach, chosen, part in self._bands
        ]
        return self._shapes.select(np.sort(np.concatenate([np.empty(0, np.int64), *found])))


def stamp(
    out: Heights,
    latitude: FloatArray,
    longitude: FloatArray,
    shapes: craters.CraterShapes,
    profiles: npt.NDArray[np.float32],
) -> None:
    """Add craters to a tile of heights in place."""
    kernels.stamp_craters(
        out,
        latitude,
        longitude,
        shapes.latitude_rad,
        shapes.longitude_rad,
        shapes.radius_rad,
        shapes.depth_m,
        shapes.profile_row,
        shapes.wobble,
        profiles,
    )


def mottled_albedo(base: FloatArray, latitude: FloatArray, longitude: FloatArray, salts: list[int]) -> Heights:
    """Normal albedo: a smooth map relative to the mean, with seeded mottling of 3 to 60 km."""
    angles = (np.cos(latitude), np.sin(latitude), np.cos(longitude), np.sin(longitude))
    mottle = np.zeros(base.shape, np.float32)
    even = np.ones_like(mottle)
    for wavelength, rms, salt in zip(
        (60.0, 25.0, 11.0, 5.0, 3.0), (0.05, 0.045, 0.04, 0.03, 0.02), salts, strict=False
    ):
        kernels.add_noise(mottle, *angles, MOON_RADIUS_M / 1000.0 / wavelength, rms, salt, even)
    return np.asarray(np.clip(MEAN_ALBEDO * base * (1.0 + mottle), 0.04, 0.3), dtype=np.float32)


def _plains_map(salts: list[int]) -> npt.NDArray[np.float32]:
    """Return the plain fraction of each half-degree node, 0..1, (361, 720); node rows start at the north pole."""
    latitude = np.radians(90.0 - np.arange(361) * 0.5)
    longitude = np.radians(np.arange(720) * 0.5)
    field = np.zeros((361, 720), np.float32)
    even = np.ones_like(field)
    angles = (np.cos(latitude), np.sin(latitude), np.cos(longitude), np.sin(longitude))
    for wavelength, rms, salt in zip((2600.0, 1200.0, 500.0, 200.0), (1.0, 0.7, 0.35, 0.15), salts, strict=False):
        kernels.add_noise(field, *angles, MOON_RADIUS_M / 1000.0 / wavelength, rms, salt, even)
    weights = np.repeat(np.cos(latitude)[:, None], 720, axis=1).ravel()
    order = np.argsort(field, axis=None)
    share = np.cumsum(weights[order]) / weights.sum()
    limit = float(field.ravel()[order[np.searchsorted(share, 1.0 - PLAIN_SHARE)]])
    edge = np.clip((field - limit) / 0.35 + 0.5, 0.0, 1.0)
    return np.asarray(edge * edge * (3.0 - 2.0 * edge), dtype=np.float32)


def _shape_catalogue(catalogue: CraterCatalogue, rng: np.random.Generator) -> craters.CraterShapes:
    """Shapes of a given catalogue's craters, as deep as it says or else as drawn."""
    drawn = craters.draw_depth_ratio(rng, len(catalogue), craters.DEPTH_QUANTILES)
    known = catalogue.depth_m / catalogue.diameter_m
    # Drawn ratios are of simple craters and shrink with the fresh depth of large ones; what a catalogue says does not.
    shrink = np.minimum(1.0, craters.fresh_depth_ratio(catalogue.diameter_m) / 0.2)
    ratio = np.where(np.isfinite(known), np.maximum(known, 0.005) / shrink, drawn)
    return craters.shape_craters(catalogue.latitude_rad, catalogue.longitude_rad, catalogue.diameter_m, ratio, rng)


def _draw_catalogue(
    rng: np.random.Generator, plains: npt.NDArray[np.float32], seed: int
) -> tuple[CraterCatalogue, craters.CraterShapes]:
    """The synthetic catalogue from 2 km up, largest first, and the shapes that are stamped for it."""
    above = sum(PAPER_CLASS_COUNTS) + LARGE_CRATERS
    below = round(above * ((CLASS_LIMITS_M[0] / CATALOGUE_LOW_M) ** BELOW_CLASSES_EXPONENT - 1.0))
    spans = (
        (LARGE_CRATERS, CLASS_LIMITS_M[3] * 1.0001, 300.0e3, 1.9),
        (PAPER_CLASS_COUNTS[2], CLASS_LIMITS_M[2], CLASS_LIMITS_M[3], 1.66),
        (PAPER_CLASS_COUNTS[1], CLASS_LIMITS_M[1], CLASS_LIMITS_M[2], 1.84),
        (PAPER_CLASS_COUNTS[0], CLASS_LIMITS_M[0], CLASS_LIMITS_M[1], 1.77),
        (below, CATALOGUE_LOW_M, CLASS_LIMITS_M[0] * 0.9999, BELOW_CLASSES_EXPONENT),
    )
    diameter = np.concatenate([craters.draw_power_law(rng, *span) for span in spans])
    diameter = diameter[np.argsort(-diameter, kind="stable")]
    count = diameter.size
    latitude, longitude = np.empty(count), np.empty(count)
    todo = np.arange(count)
    while todo.size:
        latitude[todo] = np.arcsin(rng.uniform(-1.0, 1.0, todo.size))
        longitude[todo] = rng.uniform(0.0, 2.0 * math.pi, todo.size)
        row = np.rint((90.0 - np.degrees(latitude[todo])) * 2.0).astype(np.int64)
        column = np.rint(np.degrees(longitude[todo]) * 2.0).astype(np.int64) % 720
        keep = 1.0 - (1.0 - PLAIN_CRATERS) * plains[row, column]
        todo = todo[rng.random(todo.size) > keep]
    ratio = craters.draw_depth_ratio(rng, count, craters.DEPTH_QUANTILES)
    catalogue = make_catalogue(latitude, longitude, diameter, source=f"synthetic, seed {seed}")
    return catalogue, craters.shape_craters(latitude, longitude, diameter, ratio, rng)
