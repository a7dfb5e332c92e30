"""Distortion of a map: smooth displacements of the craters that the payload carries against the terrain that is drawn.

A list that was measured on the raster that is drawn shares its errors; a displaced one does not.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from lunar.arrays import FloatArray
from lunar.constants import MOON_RADIUS_M
from lunar.frames import mcmf_from_spherical
from tmtc.dictionary.tables import CatalogueTable

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
