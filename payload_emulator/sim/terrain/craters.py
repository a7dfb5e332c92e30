"""Shapes and populations of synthetic craters.

Sizes and depths follow published scaling: rim height a fifth of the depth and depth 0.196 D^1.01 for simple craters,
1.044 D^0.301 km for complex ones (Pike 1977, Impact and Explosion Cratering, pp. 489-509, in km).  Age is a diffused
profile of less depth, from fresh (0) to ghost (1).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

from lunar.arrays import FloatArray, IntArray
from lunar.constants import MOON_RADIUS_M
from payload_emulator.sim.terrain.kernels import PROFILE_REACH

KEPT_CELLS = 1024
"""Cells of small craters that are kept, 20 KB each: the widest tile needs 169."""

AGE_STEPS = 10
SHAPES = 4
"""Bowl, flat floor, terraced flat floor, floor with a central peak."""

SHAPE_LIMITS_M = (12_000.0, 20_000.0, 35_000.0)
PROFILE_SAMPLES = 256

DEPTH_QUANTILES = (
    (0.0, 0.010),
    (0.10, 0.022),
    (0.20, 0.034),
    (0.35, 0.05),
    (0.50, 0.07),
    (0.70, 0.105),
    (0.85, 0.145),
    (0.94, 0.185),
    (1.0, 0.21),
)
"""Distribution of depth over diameter of craters above 2 km: a third shallower than 0.05, one in ten nearly fresh.

Real catalogues hold more ghosts (a quarter below 0.03 on GLD100); a synthetic Moon of those would teach nothing.
"""

SMALL_DEPTH_QUANTILES = ((0.0, 0.02), (0.3, 0.05), (0.6, 0.08), (0.85, 0.12), (0.97, 0.17), (1.0, 0.2))
"""The same for craters below 2 km, which are in equilibrium: most of them worn."""


@dataclass(frozen=True, eq=False, slots=True)
class CraterShapes:
    """Craters ready to stamp, arrays of one length; angles in radians."""

    latitude_rad: FloatArray
    longitude_rad: FloatArray
    radius_rad: FloatArray
    depth_m: FloatArray
    profile_row: IntArray
    wobble: FloatArray

    def __len__(self) -> int:
        return self.latitude_rad.size

    def select(self, indices: IntArray) -> CraterShapes:
        """The craters of these indices, in that order."""
        return CraterShapes(*(getattr(self, one.name)[indices] for one in fields(self)))

    def above(self, radius_rad: float) -> CraterShapes:
        """The craters larger than this."""
        large = self.radius_rad > radius_rad
        return self if large.all() else self.select(np.flatnonzero(large))


def no_craters() -> CraterShapes:
    """Shapes of no crater at all."""
    none = np.zeros(0)
    return CraterShapes(none, none, none, none, np.zeros(0, np.int64), np.zeros((0, 4)))


def crater_profiles() -> npt.NDArray[np.float32]:
    """Radial profiles of unit depth (rim to mean inner floor), (40, 258), sampled from the centre to 2.6 radii."""
    s = np.asarray(np.arange(PROFILE_SAMPLES + 2) * (PROFILE_REACH / PROFILE_SAMPLES), dtype=np.float64)
    rows = []
    for shape in range(SHAPES):
        fresh = _fresh_profile(s, shape)
        for step in range(AGE_STEPS):
            rows.append(_aged_profile(s, fresh, step / (AGE_STEPS - 1)))
    return np.asarray(rows, dtype=np.float32)


def fresh_depth_ratio(diameter_m: FloatArray) -> FloatArray:
    """Depth over diameter of fresh craters: 0.2 up to about 15 km, then falling as complex craters do."""
    kilometres = np.maximum(diameter_m / 1000.0, 1.0e-3)
    return np.minimum(0.2, 1.044 * kilometres ** (0.301 - 1.0))


def shape_craters(
    latitude_rad: FloatArray,
    longitude_rad: FloatArray,
    diameter_m: FloatArray,
    depth_ratio: FloatArray,
    rng: np.random.Generator,
) -> CraterShapes:
    """Craters of given sizes and depth ratios with seeded irregular rims."""
    count = latitude_rad.size
    fresh = fresh_depth_ratio(diameter_m)
    ratio = np.minimum(depth_ratio * np.minimum(1.0, fresh / 0.2), fresh)
    age = np.clip(1.0 - ratio / fresh, 0.0, 1.0)
    shape = np.searchsorted(np.array(SHAPE_LIMITS_M), diameter_m)
    row = shape * AGE_STEPS + np.rint(age * (AGE_STEPS - 1)).astype(np.int64)
    wobble = rng.normal(0.0, 1.0, (count, 4)) * np.array([0.035, 0.035, 0.02, 0.02])
    return CraterShapes(
        latitude_rad,
        longitude_rad,
        0.5 * diameter_m / MOON_RADIUS_M,
        ratio * diameter_m,
        row,
        np.clip(wobble, -0.08, 0.08),
    )


def draw_power_law(rng: np.random.Generator, count: int, low_m: float, high_m: float, exponent: float) -> FloatArray:
    """Diameters (count,) between two limits with cumulative numbers falling as ``D ** -exponent``."""
    share = rng.random(count)
    low, high = low_m**-exponent, high_m**-exponent
    return np.asarray((low + share * (high - low)) ** (-1.0 / exponent))


def draw_depth_ratio(rng: np.random.Generator, count: int, quantiles: tuple[tuple[float, float], ...]) -> FloatArray:
    """Depth over diameter (count,) by a table of (share, value)."""
    table = np.array(quantiles)
    return np.asarray(np.interp(rng.random(count), table[:, 0], table[:, 1]))


class SmallCraters:
    """Craters below the catalogue's limit, drawn cell by cell of one degree from the seed alone."""

    def __init__(
        self, seed: int, low_m: float, high_m: float, per_km2: float, exponent: float, density: FloatArray | None = None
    ) -> None:
        """``per_km2`` counts craters above ``low_m``; ``density`` (180, 360) scales it per cell, north first."""
        self.seed = seed
        self.low_m = low_m
        self.high_m = high_m
        self.exponent = exponent
        top = np.radians(90.0 - np.arange(181))
        area = MOON_RADIUS_M**2 * math.radians(1.0) * (np.sin(top[:-1]) - np.sin(top[1:])) / 1.0e6
        self._mean = per_km2 * np.repeat(area[:, None], 360, axis=1)
        if density is not None:
            self._mean = self._mean * density
        self._cells: dict[tuple[int, int], CraterShapes] = {}

    def around(self, latitude_rad: FloatArray, longitude_rad: FloatArray) -> CraterShapes:
        """The craters of every cell that can touch a tile of these latitudes and longitudes, in a fixed order."""
        margin = PROFILE_REACH * 1.05 * 0.5 * self.high_m / MOON_RADIUS_M
        north = math.degrees(latitude_rad.max() + margin)
        south = math.degrees(latitude_rad.min() - margin)
        wide = margin / max(math.cos(math.radians(max(abs(north), abs(south)))), 0.05)
        west = math.floor(math.degrees(longitude_rad.min() - wide))
        east = math.floor(math.degrees(longitude_rad.max() + wide))
        rows = range(max(0, math.floor(90.0 - north)), min(179, math.floor(90.0 - south)) + 1)
        # The order of stamping must not depend on the tile: sums of floats do not commute in the last bit.
        cells = sorted({(row, column % 360) for row in rows for column in range(west, east + 1)})
        parts = [self._cell(*cell) for cell in cells]
        names = (one.name for one in fields(CraterShapes))
        return CraterShapes(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))

    def _cell(self, row: int, column: int) -> CraterShapes:
        found = self._cells.get((row, column))
        if found is not None:
            return found
        rng = np.random.Generator(np.random.Philox(key=[self.seed & 0xFFFF_FFFF_FFFF_FFFF, row * 360 + column]))
        count = int(rng.poisson(self._mean[row, column]))
        top, bottom = math.radians(90.0 - row), math.radians(89.0 - row)
        latitude = np.arcsin(rng.uniform(math.sin(bottom), math.sin(top), count))
        longitude = np.radians(column + rng.random(count))
        diameter = draw_power_law(rng, count, self.low_m, self.high_m, self.exponent)
        ratio = draw_depth_ratio(rng, count, SMALL_DEPTH_QUANTILES)
        made = shape_craters(latitude, longitude, diameter, ratio, rng)
        self._cells[row, column] = made
        if len(self._cells) > KEPT_CELLS:
            del self._cells[next(iter(self._cells))]
        return made


def _fresh_profile(s: FloatArray, shape: int) -> FloatArray:
    rim = 0.2
    outside = np.where(s > 1.0, np.maximum(s, 1.0) ** -3.2, 1.0)
    end = PROFILE_REACH**-3.2
    outside = rim * (outside - end) / (1.0 - end)
    if shape == 0:
        inside = rim - 1.07 * (1.0 - s**2.1)
    else:
        floor_radius = (0.35, 0.55, 0.62)[shape - 1]
        wall = np.clip((s - floor_radius) / (1.0 - floor_radius), 0.0, 1.0)
        rise = wall**1.35
        if shape >= 2:
            rise = rise + 0.035 * np.sin(wall * 3.0 * 2.0 * math.pi) * np.sin(wall * math.pi)
        inside = rim - 1.0 + rise
        if shape == 3:
            inside = inside + 0.3 * np.exp(-((s / 0.13) ** 2))
    return np.where(s < 1.0, inside, np.maximum(outside, 0.0))


def _aged_profile(s: FloatArray, fresh: FloatArray, age: float) -> FloatArray:
    """The profile after diffusion: rounded over a length that grows with age, scaled back to unit depth."""
    width = 0.025 + 0.30 * age
    step = s[1] - s[0]
    half = math.ceil(3.5 * width / step)
    offsets = np.arange(-half, half + 1) * step
    weights = np.exp(-0.5 * (offsets / width) ** 2)
    weights /= weights.sum()
    padded = np.concatenate([fresh[half:0:-1], fresh, np.zeros(half)])
    smooth = np.convolve(padded, weights, mode="valid")
    taper = np.clip((PROFILE_REACH - s) / 0.5, 0.0, 1.0)
    smooth = smooth * taper * taper * (3.0 - 2.0 * taper)
    inner = s <= 0.4
    depth = np.interp(1.0, s, smooth) - np.average(smooth[inner], weights=s[inner] + 1.0e-9)
    result = smooth / depth
    result[-2:] = 0.0
    return result
