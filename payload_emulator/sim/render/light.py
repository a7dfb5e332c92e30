"""Direction of the Sun: drawn per frame as in the paper, or from the ephemeris."""

import math

import numpy as np

from lunar.arrays import FloatArray
from lunar.frames import enu_from_mcmf

SUN_ANGULAR_RADIUS_RAD = math.radians(0.2666)
"""Half the Sun's apparent diameter at 1 au (nominal solar radius 695 700 km over 149 597 871 km)."""


def sun_direction_mcmf(
    elevation_rad: float, azimuth_rad: float, latitude_rad: float, longitude_rad: float
) -> FloatArray:
    """Unit vector (3,) to a Sun of this elevation and azimuth (from north, clockwise) at a place."""
    horizontal = math.cos(elevation_rad)
    enu = np.array([horizontal * math.sin(azimuth_rad), horizontal * math.cos(azimuth_rad), math.sin(elevation_rad)])
    return np.asarray(enu_from_mcmf(latitude_rad, longitude_rad).T @ enu)


def sun_angles(sun_mcmf: FloatArray, latitude_rad: float, longitude_rad: float) -> tuple[float, float]:
    """Elevation and azimuth (from north, clockwise, -pi..pi) of a unit vector to the Sun at a place."""
    east, north, up = enu_from_mcmf(latitude_rad, longitude_rad) @ sun_mcmf
    return math.asin(min(1.0, max(-1.0, up))), math.atan2(east, north)
