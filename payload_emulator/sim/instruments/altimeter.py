"""Laser altimeter along the boresight of the camera: footprint of the beam on the terrain, noise and drop-outs.

The range is the centroid of the echo: the mean over rays that cover the footprint, weighted by the Gaussian profile of
the beam. Where the ground inside the footprint is sloped or rough the echo is longer, and its centroid less certain
(Gardner 1992, Ranging performance of satellite laser altimeters, IEEE Trans. Geoscience and Remote Sensing 30).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lunar.arrays import FloatArray
from lunar.constants import MOON_RADIUS_M
from lunar.frames import spherical_from_mcmf
from payload_emulator.sim.instruments import Limit, SimulatedInstrument, Situation, Surroundings
from payload_emulator.sim.terrain.tiles import Terrain

_NAN = float("nan")
# A ray reaches the ground to a centimetre in two iterations over plains and in six on slopes of 30 degrees.
_ITERATIONS = 12
_CONVERGED_M = 0.01
# Rings of rays at these shares of the radius of the beam (1/e^2 of the intensity), with this many rays each.
_RINGS = ((0.0, 1), (0.4, 6), (0.8, 12))


@dataclass(frozen=True, slots=True)
class AltimeterSection:
    """Settings of the altimeter.

    Attributes
    ----------
    range_noise_m
        Standard deviation of a range to flat ground.
    divergence_mrad
        Full angle of the beam, to 1/e^2 of the intensity: 1 mrad is a footprint of 30 m from 30 km.
    echo_noise_share
        Noise of the centroid as a share of the standard deviation of the ground's range inside the footprint.
    maximum_range_km
        No echo from beyond.
    dropout_share
        Share of samples without an echo for other reasons.
    cadence_s
        Time between samples.
    rim_height_share
        Height of crater rims above the ground between craters as a share of the diameter, which the ground measures on
        its terrain and uploads: 0.03 on the real Moon, 0 on the procedural one.
    """

    range_noise_m: float = 1.0
    divergence_mrad: float = 1.0
    echo_noise_share: float = 0.3
    maximum_range_km: float = 100.0
    dropout_share: float = 0.02
    cadence_s: float = 5.0
    rim_height_share: float = 0.03


def _limits(settings: AltimeterSection) -> tuple[Limit, ...]:
    return (
        Limit(settings.range_noise_m > 0.0, "range_noise_m", "positive", settings.range_noise_m),
        Limit(
            0.0 <= settings.divergence_mrad <= 50.0,
            "divergence_mrad",
            "from 0 to 50",
            settings.divergence_mrad,
        ),
        Limit(
            settings.echo_noise_share >= 0.0, "echo_noise_share", "zero or more", settings.echo_noise_share
        ),
        Limit(settings.maximum_range_km > 0.0, "maximum_range_km", "positive", settings.maximum_range_km),
        Limit(0.0 <= settings.dropout_share <= 1.0, "dropout_share", "from 0 to 1", settings.dropout_share),
        Limit(settings.cadence_s >= 0.1, "cadence_s", "at least 0.1", settings.cadence_s),
        Limit(
            0.0 <= settings.rim_height_share <= 0.2,
            "rim_height_share",
            "from 0 to 0.2",
            settings.rim_height_share,
        ),
    )


def measure(
    settings: AltimeterSection, state: None, surroundings: Surroundings, situation: Situation
) -> tuple[None, tuple[float, ...]]:
    """Return the range, m, NaN without an echo."""
    rng = surroundings.rng("altimeter", situation.utc_ns)
    noise, dropped = rng.standard_normal(), rng.random() < settings.dropout_share
    boresight = (situation.camera_from_icrf @ situation.mcmf_from_icrf.T)[2]
    offsets, weights = beam(0.5e-3 * settings.divergence_mrad)
    directions = _around(boresight, offsets)
    ranges = ground_ranges_m(surroundings.terrain, situation.position_mcmf_m, directions)
    centre = float(weights @ ranges)
    if dropped or not np.isfinite(centre) or centre > 1e3 * settings.maximum_range_km:
        return None, (_NAN,)
    spread = float(np.sqrt(weights @ (ranges - centre) ** 2))
    sigma = float(np.hypot(settings.range_noise_m, settings.echo_noise_share * spread))
    return None, (centre + sigma * noise,)


def beam(radius_rad: float) -> tuple[FloatArray, FloatArray]:
    """Return the rays of a beam: offsets from its axis (n, 2), rad, and their weights (n,), whose sum is 1.

    Parameters
    ----------
    radius_rad
        Half angle at which the intensity is 1/e^2 of that on the axis.
    """
    offsets, weights = list[FloatArray](), list[FloatArray]()
    for k, (share, count) in enumerate(_RINGS):
        inner = 0.0 if k == 0 else 0.5 * (_RINGS[k - 1][0] + share)
        outer = 1.0 if k == len(_RINGS) - 1 else 0.5 * (share + _RINGS[k + 1][0])
        angles = 2.0 * np.pi * (np.arange(count) + 0.5 * (k % 2)) / count
        offsets.append(share * radius_rad * np.stack([np.cos(angles), np.sin(angles)], axis=1))
        # The part of the Gaussian profile in the ring that the rays stand for.
        energy = np.exp(-2.0 * inner**2) - np.exp(-2.0 * outer**2)
        weights.append(np.full(count, energy / count))
    weight = np.concatenate(weights)
    return np.concatenate(offsets), weight / weight.sum()


def ground_ranges_m(terrain: Terrain, position_mcmf_m: FloatArray, directions: FloatArray) -> FloatArray:
    """Return the distance (n,) from a place to the terrain along unit directions (n, 3) in MCMF; NaN on a miss.

    Each iteration intersects the rays with the sphere through the ground below the points reached before.
    """
    along = directions @ position_mcmf_m
    square = float(position_mcmf_m @ position_mcmf_m)
    radius = np.full(along.shape, MOON_RADIUS_M)
    ranges = np.zeros(along.shape)
    for _ in range(_ITERATIONS):
        with np.errstate(invalid="ignore"):
            reached = -along - np.sqrt(along**2 - square + radius**2)
        if not np.isfinite(reached).all():
            return np.full(along.shape, _NAN)
        moved = float(np.max(np.abs(reached - ranges)))
        ranges = reached
        if moved < _CONVERGED_M:
            break
        latitude, longitude, _ = spherical_from_mcmf(position_mcmf_m + ranges[:, None] * directions)
        radius = MOON_RADIUS_M + terrain.height_m(latitude, longitude)
    return np.where(ranges > 0.0, ranges, _NAN)


def _around(axis: FloatArray, offsets_rad: FloatArray) -> FloatArray:
    """Return unit vectors (n, 3) at small angles (n, 2) from a unit axis."""
    aside = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    aside /= np.linalg.norm(aside)
    rays = axis + offsets_rad[:, :1] * aside + offsets_rad[:, 1:] * np.cross(axis, aside)
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


INSTRUMENT = SimulatedInstrument(
    name="altimeter",
    settings=AltimeterSection,
    limits=_limits,
    cadence_s=lambda settings: float(settings.cadence_s),
    # Ranges lie between frames, so that each is used at its own time and none at that of an image.
    delay_s=lambda settings: 0.5 * float(settings.cadence_s),
    data_sheet=lambda settings: {
        "range_sigma_m": settings.range_noise_m,
        "rim_height_share": settings.rim_height_share,
    },
    start=lambda settings, surroundings: None,
    measure=measure,
)
