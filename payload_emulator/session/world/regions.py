"""Ground that is observed: where the crater catalogue and the height rasters describe it, and the craters around it."""

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import groupby

import numpy as np

from lunar.arrays import BoolArray, FloatArray
from lunar.boxes import Box, inside_box
from lunar.catalogue import CraterCatalogue
from lunar.constants import MOON_RADIUS_M
from lunar.frames import mcmf_from_spherical
from payload_emulator.session.world.rims import Watched, rims_of
from payload_emulator.session.world.world import World
from payload_emulator.sim.terrain.tiles import Terrain
from tmtc.dictionary.tables import CatalogueTable

CELL_DEG = 15
"""Cells of the choice: the size of the tiles of the height rasters, half that of the tiles of the crater catalogue."""

LATITUDE_LIMIT_DEG = 60
CRATER_DIAMETER_M = 5e3
"""Smallest craters that are scored; a cell of the catalogue without any is not catalogued."""

SAMPLES = 4

CATALOGUE_MARGIN_DEG = 5.0
"""Half the field of view of the camera at 60 km altitude, beyond the latitudes of the windows."""

WINDOW_LATITUDE_DEG = 20.0
"""Half the band of latitudes that a pass crosses in 12 minutes."""


def observed_boxes(terrain: Terrain, latitude_limit_deg: float) -> list[Box]:
    """Return the boxes of the windows, each twice `latitude_limit_deg` high.

    A terrain without data is the same everywhere: its windows are at the equator. On real terrain, each 15 deg of
    longitude have one box where fine height rasters and the crater catalogue cover all of it, the nearest to the
    equator; longitudes without such a place have none. Coarse rasters show few of the craters, so where no fine ones
    cover any box, the catalogue decides alone.
    """
    if not terrain.is_real:
        return [Box(-180.0, 180.0, -latitude_limit_deg, latitude_limit_deg)]
    rows = max(math.ceil(2.0 * latitude_limit_deg / CELL_DEG), 1)
    catalogued = _catalogued(terrain)
    columns = _bands(catalogued & _covered(terrain), rows, latitude_limit_deg)
    if not any(columns):
        columns = _bands(catalogued, rows, latitude_limit_deg)
    boxes = []
    for band, group in groupby(enumerate(columns), key=lambda one: one[1]):
        numbers = [number for number, _ in group]
        if band is not None:
            boxes.append(Box(float(CELL_DEG * numbers[0]), float(CELL_DEG * (numbers[-1] + 1)), *band))
    if len(boxes) > 1 and boxes[0].west_deg == 0.0 and boxes[-1].east_deg == 360.0:
        first, last = boxes[0], boxes[-1]
        if (first.south_deg, first.north_deg) == (last.south_deg, last.north_deg):
            boxes = [replace(first, west_deg=last.west_deg - 360.0), *boxes[1:-1]]
    return boxes


def _bands(described: BoolArray, rows: int, limit_deg: float) -> list[tuple[float, float] | None]:
    """Return south and north of the best box of each column of cells; None without a described one."""

    def centres(column: BoolArray) -> Iterator[float]:
        for first in range(len(column) - rows + 1):
            if column[first : first + rows].all():
                yield -LATITUDE_LIMIT_DEG + CELL_DEG * (first + rows / 2.0)

    best = (min(centres(column), key=lambda one: (abs(one), one), default=None) for column in described.T)
    return [None if one is None else (one - limit_deg, one + limit_deg) for one in best]


def _cells() -> tuple[int, int]:
    return 2 * LATITUDE_LIMIT_DEG // CELL_DEG, 360 // CELL_DEG


def _catalogued(terrain: Terrain) -> BoolArray:
    """Return whether the catalogue is complete in each cell (rows from the south, columns from 0 E)."""
    listed = terrain.catalogue
    scored = listed.diameter_m >= CRATER_DIAMETER_M
    counts = []
    for chosen in (scored & listed.complete, scored & ~listed.complete):
        number, _, _ = np.histogram2d(
            np.degrees(listed.latitude_rad[chosen]),
            np.degrees(listed.longitude_rad[chosen]) % 360.0,
            bins=_cells(),
            range=((-LATITUDE_LIMIT_DEG, LATITUDE_LIMIT_DEG), (0.0, 360.0)),
        )
        counts.append(number)
    return np.asarray((counts[0] > 0) & (counts[1] == 0))


def _covered(terrain: Terrain) -> BoolArray:
    """Return whether height rasters cover each cell (rows from the south, columns from 0 E)."""
    rows, columns = _cells()
    steps = (np.arange(SAMPLES) + 0.5) * CELL_DEG / SAMPLES
    latitude = np.radians(-LATITUDE_LIMIT_DEG + CELL_DEG * np.arange(rows)[:, None] + steps).reshape(-1)
    longitude = np.radians(CELL_DEG * np.arange(columns)[:, None] + steps).reshape(-1)
    held = terrain.covers(latitude[:, None], longitude[None, :])
    return np.asarray(held.reshape(rows, SAMPLES, columns, SAMPLES).all(axis=(1, 3)))


def observed_craters(
    world: World, latitude_limit_deg: float = WINDOW_LATITUDE_DEG, watched: Watched = iter
) -> CraterCatalogue:
    """Return the craters around the observed boxes, with the heights of their rims."""
    listed = world.terrain.catalogue
    near = [one.widened(CATALOGUE_MARGIN_DEG) for one in observed_boxes(world.terrain, latitude_limit_deg)]
    places = np.degrees(listed.latitude_rad), np.degrees(listed.longitude_rad)
    inside = np.any([inside_box(one, *places) for one in near], axis=0)
    catalogue = rims_of(world.scenario, world.terrain, np.flatnonzero(inside), watched)
    world.terrain.release_ground()
    world.terrain.release_thread()
    return catalogue


_WAVES = 100


def displaced(table: CatalogueTable, sigma_m: float, correlation_deg: float, seed: int) -> CatalogueTable:
    """Return a table whose craters are displaced by smooth random fields.

    `sigma_m` is the standard deviation east and north each, `correlation_deg` the arc over which the correlation falls
    to 1/e. The table does not state these errors.
    """
    rng = np.random.default_rng((seed, 2**36))
    fields = regional_field(table.latitude_rad, table.longitude_rad, math.radians(correlation_deg), rng)
    east, north = sigma_m / MOON_RADIUS_M * fields[:, 0], sigma_m / MOON_RADIUS_M * fields[:, 1]
    longitude = table.longitude_rad + east / np.cos(table.latitude_rad)
    return replace(table, latitude_rad=table.latitude_rad + north, longitude_rad=longitude)


def regional_field(
    latitude_rad: FloatArray, longitude_rad: FloatArray, correlation_rad: float, rng: np.random.Generator
) -> FloatArray:
    """Return three random fields (n, 3) of variance 1 and covariance exp(-d / correlation) over the chord d.

    Sums of waves, with wave vectors from the spectral density of the covariance in three dimensions.

    References
    ----------
    Rahimi, Recht (2007), Random features for large-scale kernel machines.
    """
    places = mcmf_from_spherical(latitude_rad, longitude_rad, 0.0) / MOON_RADIUS_M
    fields = []
    for _ in range(3):
        vectors = rng.standard_normal((_WAVES, 3))
        vectors /= correlation_rad * np.abs(rng.standard_normal((_WAVES, 1)))
        phases = rng.uniform(0.0, 2.0 * np.pi, _WAVES)
        waves = (np.cos(places @ vector + phase) for vector, phase in zip(vectors, phases, strict=True))
        fields.append(math.sqrt(2.0 / _WAVES) * sum(waves))
    return np.stack(fields, axis=1)
