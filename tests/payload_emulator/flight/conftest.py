"""A smooth spherical Moon with point craters and a Kepler orbit, made without the code under test."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from payload_emulator.flight.detections import Detections

Float = NDArray[np.float64]
RADIUS_M = 1_737_400.0
GM_M3_S2 = 4.902800066e12
MOON_RATE_RAD_S = 2.661699e-6
EPOCH_TICKS = 61_000_000_000_000
TICKS_PER_SECOND = 65_536
# 120 degrees over 512 pixels, written out here on purpose.
FOCAL_PX = 256.0 / np.tan(np.radians(60.0))
CENTRE_PX = 255.5
# Craters of 5 to 30 km per square metre, and the shares of the three classes (paper, section V-B).
DENSITY_M2 = 2.09e-9
CLASS_SHARES = (58_649 / 79_387, 12_830 / 79_387, 7_908 / 79_387)
CLASS_DIAMETERS_M = (7_000.0, 12_000.0, 20_000.0)


def paper_orbit_mcmf_m(seconds: Iterable[float] | Float) -> Float:
    """Return positions (n, 3) on the Kepler orbit of the paper's Table I over a uniformly turning Moon."""
    time = np.asarray(list(seconds) if not isinstance(seconds, np.ndarray) else seconds, dtype=np.float64)
    a, e = 1_768_180.0, 0.006908
    i, node, perilune, start = np.radians([89.076, 3.164, 333.604, 8.882])
    anomaly = 2.0 * np.arctan(np.sqrt((1.0 - e) / (1.0 + e)) * np.tan(start / 2.0))
    mean = anomaly - e * np.sin(anomaly) + np.sqrt(GM_M3_S2 / a**3) * time
    eccentric = mean.copy()
    for _ in range(12):
        eccentric = mean + e * np.sin(eccentric)
    true = 2.0 * np.arctan2(
        np.sqrt(1.0 + e) * np.sin(eccentric / 2.0), np.sqrt(1.0 - e) * np.cos(eccentric / 2.0)
    )
    radius, u, turned = a * (1.0 - e * np.cos(eccentric)), perilune + true, node - MOON_RATE_RAD_S * time
    return radius[:, None] * np.stack(
        [
            np.cos(turned) * np.cos(u) - np.sin(turned) * np.sin(u) * np.cos(i),
            np.sin(turned) * np.cos(u) + np.cos(turned) * np.sin(u) * np.cos(i),
            np.sin(u) * np.sin(i),
        ],
        axis=1,
    )


def place(position_m: Float) -> tuple[float, float, float]:
    """Return latitude, longitude, altitude."""
    radius = float(np.linalg.norm(position_m))
    latitude = float(np.arcsin(position_m[2] / radius))
    return latitude, float(np.arctan2(position_m[1], position_m[0])), radius - RADIUS_M


def ticks_at(second: float) -> int:
    return EPOCH_TICKS + round(second * TICKS_PER_SECOND)


@dataclass(frozen=True)
class CraterField:
    """Point craters on the smooth sphere, ordered by z."""

    position_m: Float
    diameter_m: Float

    def perfect_detections(self, position_m: Float) -> Detections:
        """Return every crater in view of a nadir camera, image up to the north, by true perspective."""
        latitude, longitude, altitude = place(position_m)
        reach = RADIUS_M * np.sin(np.arccos(RADIUS_M / (RADIUS_M + altitude)))
        low, high = np.searchsorted(self.position_m[:, 2], [position_m[2] - reach, position_m[2] + reach])
        points, diameter = self.position_m[low:high], self.diameter_m[low:high]
        up = np.array(
            [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)]
        )
        east = np.array([-np.sin(longitude), np.cos(longitude), 0.0])
        away = points - position_m
        depth = -away @ up
        depth[depth <= 0.0] = np.nan
        u = CENTRE_PX + FOCAL_PX * (away @ east) / depth
        v = CENTRE_PX - FOCAL_PX * (away @ np.cross(up, east)) / depth
        seen = (np.abs(u - 255.5) < 256.0) & (np.abs(v - 255.5) < 256.0)
        seen &= points @ up > RADIUS_M**2 / (RADIUS_M + altitude)
        return detections(u[seen], v[seen], (FOCAL_PX * diameter / depth)[seen])


def make_crater_field(seed: int) -> CraterField:
    rng = np.random.default_rng(seed)
    count = int(4.0 * np.pi * RADIUS_M**2 * DENSITY_M2)
    z = np.sort(rng.uniform(-1.0, 1.0, count))
    longitude = rng.uniform(-np.pi, np.pi, count)
    ring = np.sqrt(1.0 - z * z)
    position = RADIUS_M * np.stack([ring * np.cos(longitude), ring * np.sin(longitude), z], axis=1)
    return CraterField(position, rng.choice(CLASS_DIAMETERS_M, size=count, p=CLASS_SHARES))


def detections(u_px: Float, v_px: Float, diameter_px: Float) -> Detections:
    u = np.atleast_1d(np.asarray(u_px, dtype=np.float64))
    return Detections(
        u,
        np.atleast_1d(np.asarray(v_px, dtype=np.float64)),
        np.atleast_1d(np.asarray(diameter_px, dtype=np.float64)),
        np.ones_like(u),
        np.full_like(u, np.nan),
    )


@dataclass(frozen=True)
class Toolbox:
    """What tests of flight share, since test files cannot import each other."""

    orbit: Callable[..., Float] = paper_orbit_mcmf_m
    place: Callable[[Float], tuple[float, float, float]] = place
    ticks_at: Callable[[float], int] = ticks_at
    crater_field: Callable[[int], CraterField] = make_crater_field
    detections: Callable[..., Detections] = detections
    radius_m: float = RADIUS_M
    focal_px: float = float(FOCAL_PX)
    centre_px: float = CENTRE_PX


@pytest.fixture(scope="session")
def moon() -> Toolbox:
    return Toolbox()
