"""Regions of the Moon as boxes of latitude and longitude, and the frames whose ground lies outside of regions."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from lunar.arrays import BoolArray, FloatArray
from lunar.camera import PinholeCamera
from lunar.constants import MOON_RADIUS_M


@dataclass(frozen=True, slots=True)
class Box:
    """West, east, south, north in degrees; east may exceed 360."""

    west_deg: float
    east_deg: float
    south_deg: float
    north_deg: float

    def widened(self, margin_deg: float) -> Box:
        """Return the box with a margin on all sides."""
        width = min(self.east_deg - self.west_deg + 2.0 * margin_deg, 360.0)
        west_deg = self.west_deg - margin_deg
        return Box(
            west_deg, west_deg + width, max(self.south_deg - margin_deg, -90.0), min(self.north_deg + margin_deg, 90.0)
        )


def inside_box(box: Box, latitude_deg: FloatArray, longitude_deg: FloatArray, buffer_km: float = 0.0) -> BoolArray:
    """Return which places lie in a box or within `buffer_km` of it."""
    margin = math.degrees(buffer_km * 1000.0 / MOON_RADIUS_M)
    widen = margin / np.cos(np.radians(np.minimum(np.abs(latitude_deg) + margin, 85.0)))
    middle = 0.5 * (box.west_deg + box.east_deg)
    offset = np.mod(longitude_deg - middle + 180.0, 360.0) - 180.0
    across = np.abs(offset) <= 0.5 * (box.east_deg - box.west_deg) + widen
    inside: BoolArray = across & (latitude_deg >= box.south_deg - margin) & (latitude_deg <= box.north_deg + margin)
    return inside


@dataclass(frozen=True, slots=True)
class Region:
    """Ground in one of `boxes` that is further than `buffer_km` from every box of `avoid`."""

    boxes: tuple[Box, ...]
    avoid: tuple[Box, ...] = ()
    buffer_km: float = 0.0

    def contains(self, latitude_deg: FloatArray, longitude_deg: FloatArray) -> BoolArray:
        """Return whether places (n,) lie in the region."""
        inside = np.zeros(np.shape(latitude_deg), dtype=np.bool_)
        for box in self.boxes:
            inside |= inside_box(box, latitude_deg, longitude_deg)
        for box in self.avoid:
            inside &= ~inside_box(box, latitude_deg, longitude_deg, self.buffer_km)
        return inside


def share_outside(
    regions: Iterable[Region],
    camera: PinholeCamera,
    latitude_rad: FloatArray,
    longitude_rad: FloatArray,
    altitude_m: FloatArray,
) -> float | None:
    """Return the share of nadir frames none of whose ground lies in a region; None without frames.

    The ground of a frame is sampled at the centre, edges and corners of its footprint. Frames at places (n,) that are
    NaN do not count.
    """
    known = np.isfinite(altitude_m)
    latitude, longitude, altitude = latitude_rad[known], longitude_rad[known], altitude_m[known]
    half_u = np.tan(camera.fov_rad / 2.0) * altitude / MOON_RADIUS_M
    half_v = half_u * camera.height_px / camera.width_px
    seen = np.zeros(latitude.size, dtype=np.bool_)
    for right in (-1.0, 0.0, 1.0):
        for up in (-1.0, 0.0, 1.0):
            there = np.clip(latitude + up * half_v, -np.pi / 2.0, np.pi / 2.0)
            east = longitude + right * half_u / np.maximum(np.cos(there), 1e-3)
            for region in regions:
                seen |= region.contains(np.degrees(there), np.degrees(east))
    return float(np.count_nonzero(~seen) / seen.size) if seen.size else None
