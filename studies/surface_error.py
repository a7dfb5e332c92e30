"""Error of the surface that ranges of the laser altimeter are compared with: crater rims against the real ground.

On board the ground below the beam is interpolated from the rims of catalogued craters
(`payload_emulator.flight.instruments.altimeter.surface`). Here this surface is compared with the terrain along
meridians: error = interpolated radius minus radius of the terrain. Positive means that the interpolated ground is high.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from lunar.arrays import FloatArray
from lunar.catalogue import CraterCatalogue
from lunar.constants import MOON_RADIUS_M
from lunar.frames import mcmf_from_spherical
from payload_emulator.flight.instruments.altimeter import AltimeterParameters, surface
from payload_emulator.flight.navigation.sighting import LandmarkMap, landmark_map
from payload_emulator.session.loading import onboard_catalogue
from payload_emulator.session.scenario import Scenario

TRACKS_DEG = (272.0, 276.0, 280.0, 304.0, 308.0, 312.0, 316.0, 320.0, 326.0)
"""Meridians of the default study: ground of the training set, west and east of the strip never used in training."""

_CALM_SHARE = 0.25


class Ground(Protocol):
    """What the study needs of a terrain."""

    catalogue: CraterCatalogue

    def height_m(self, latitude_rad: ArrayLike, longitude_rad: ArrayLike, level: int = 0) -> FloatArray:
        """Return heights above the map sphere."""
        ...

    def measured(self, indices: np.ndarray) -> CraterCatalogue:
        """Return craters with rim heights and depths as this terrain shows them."""
        ...


@dataclass(frozen=True, slots=True)
class SurfaceTrack:
    """Error along one meridian; ``known_share`` of the places have enough craters around them."""

    longitude_deg: float
    places: int
    known_share: float
    mean_m: float
    sigma_m: float


@dataclass(frozen=True, slots=True)
class SurfaceErrors:
    """Error over all tracks.

    Attributes
    ----------
    bias_m, sigma_m
        Mean, and root mean square about zero.
    calm_sigma_m
        The latter over the quarter of the places where the rims scatter least.
    scaled_rms
        Root mean square of error over claimed standard deviation; 1 for a claim that fits.
    correlation
        Correlation of errors (about zero) by distance on the ground in metres, between neighbouring places and farther.
    """

    tracks: tuple[SurfaceTrack, ...]
    bias_m: float
    sigma_m: float
    calm_sigma_m: float
    scaled_rms: float
    correlation: dict[float, float]


def study_surface(
    ground: Ground,
    scenario: Scenario,
    parameters: AltimeterParameters,
    longitudes_deg: Sequence[float] = TRACKS_DEG,
    latitude_limit_deg: float = 60.0,
    spacing_m: float = 2_000.0,
    lags: Sequence[int] = (1, 2, 4, 8, 16),
) -> SurfaceErrors:
    """Compare the interpolated surface with the ground every ``spacing_m`` along meridians.

    ``lags`` are the distances of the correlation, in places.
    """
    limit = math.radians(latitude_limit_deg)
    latitude = np.arange(-limit, limit, spacing_m / MOON_RADIUS_M)
    errors = np.full((len(longitudes_deg), latitude.size), np.nan)
    claims = np.full_like(errors, np.nan)
    for track, degrees in enumerate(longitudes_deg):
        longitude = np.full_like(latitude, math.radians(degrees))
        craters = craters_along(ground, scenario, latitude, math.radians(degrees), parameters.surface_reach_m)
        heights = ground.height_m(latitude, longitude)
        for k, place in enumerate(mcmf_from_spherical(latitude, longitude, heights)):
            known = surface(parameters, craters, place)
            if known is not None:
                errors[track, k] = known[0] - (MOON_RADIUS_M + heights[k])
                claims[track, k] = known[1]
    tracks = tuple(
        SurfaceTrack(degrees, row.size, float(np.isfinite(row).mean()), _mean(row), _rms(row))
        for degrees, row in zip(longitudes_deg, errors, strict=True)
    )
    calm = claims <= np.nanquantile(claims, _CALM_SHARE) if np.isfinite(claims).any() else claims > 0.0
    correlation = {spacing_m * lag: _correlation(errors, lag) for lag in lags if lag < latitude.size}
    return SurfaceErrors(
        tracks, _mean(errors), _rms(errors), _rms(errors[calm]), _rms(errors / claims), correlation
    )


def craters_along(
    ground: Ground, scenario: Scenario, latitude_rad: FloatArray, longitude_rad: float, reach_m: float
) -> LandmarkMap:
    """Return the on-board map of the craters around a meridian: those of the scenario, with its catalogue errors."""
    catalogue, navigation = ground.catalogue, scenario.navigation
    near = np.zeros(len(catalogue), dtype=bool)
    # Circles of twice the reach at every reach cover the whole band of one reach.
    stops = np.arange(latitude_rad[0], latitude_rad[-1] + reach_m / MOON_RADIUS_M, reach_m / MOON_RADIUS_M)
    for latitude in stops:
        near[catalogue.near(float(latitude), longitude_rad, 2.0 * reach_m)] = True
    near &= catalogue.diameter_m >= 1e3 * navigation.catalogue_min_diameter_km
    near &= catalogue.diameter_m <= 1e3 * navigation.catalogue_max_diameter_km
    return landmark_map(onboard_catalogue(scenario, ground.measured(np.flatnonzero(near))))


def _mean(values: FloatArray) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else math.nan


def _rms(values: FloatArray) -> float:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if known.size else math.nan


def _correlation(errors: FloatArray, lag: int) -> float:
    """Return the correlation about zero of errors ``lag`` places apart on a track; NaN without any."""
    first, second = errors[:, :-lag], errors[:, lag:]
    both = np.isfinite(first) & np.isfinite(second)
    if not both.any():
        return math.nan
    a, b = first[both], second[both]
    return float(np.mean(a * b) / np.sqrt(np.mean(a**2) * np.mean(b**2)))
