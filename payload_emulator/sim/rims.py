"""How far labels lie from the rims that rays find: the measure of whether labels sit where craters are."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lunar.camera import PinholeCamera, project_mcmf
from lunar.constants import MOON_RADIUS_M
from lunar.frames import mcmf_from_spherical, spherical_from_mcmf
from payload_emulator.sim.labels import label_frame
from payload_emulator.sim.raymarch import cast
from payload_emulator.sim.terrain.tiles import Terrain

Floats = npt.NDArray[np.float64]

AZIMUTHS = 48
ROUNDS = 8
FOUND_M = 10.0
"""A ray has found a rim point when it meets the ground this close to it: a tenth of a pixel at the least altitude."""

LEAST_FOUND = 0.9
"""Share of a rim that must be in sight: the mean over a part of it would say little of the centre."""


@dataclass(frozen=True, eq=False, slots=True)
class RimErrors:
    """Of the craters of one picture, arrays (n): those whole in the picture with their rims in sight.

    Attributes
    ----------
    index
        Row in the terrain's catalogue.
    offset_u_px, offset_v_px
        Mean over azimuths of where rays find the rim, less where the label's circle has it.
    scatter_px
        Rms of the single points about that mean: rims are no circles of one height.
    """

    index: npt.NDArray[np.int64]
    offset_u_px: Floats
    offset_v_px: Floats
    scatter_px: Floats


def rim_errors(
    terrain: Terrain,
    camera: PinholeCamera,
    position_mcmf_m: npt.ArrayLike,
    camera_from_mcmf: npt.ArrayLike,
    minimum_diameter_m: float = 5_000.0,
) -> RimErrors:
    """Labels of a picture against rims found by casting rays onto the terrain.

    The rim at an azimuth is the ground that lies a radius from the centre there, whatever its height.  A ray is turned
    until it meets just that ground; where nearer ground is in the way it never does.
    """
    position = np.asarray(position_mcmf_m, dtype=np.float64)
    rotation = np.asarray(camera_from_mcmf, dtype=np.float64)
    labels = label_frame(terrain, camera, position, rotation, minimum_diameter_m)
    chosen = labels.index[labels.inside & (labels.visible_fraction == 1.0)]
    craters = terrain.measured(chosen)
    known = np.isfinite(craters.rim_height_m)
    craters, chosen = craters.select(np.flatnonzero(known)), chosen[known]
    if not chosen.size:
        empty = np.empty(0)
        return RimErrors(chosen, empty, empty, empty)
    latitude, longitude = _circle(craters.latitude_rad, craters.longitude_rad, craters.diameter_m)
    expected = _project(
        camera,
        position,
        rotation,
        latitude,
        longitude,
        np.broadcast_to(craters.rim_height_m[:, None], latitude.shape),
    )
    uv = expected
    for _ in range(ROUNDS):
        hit = cast(terrain, camera, position, rotation, uv.reshape(-1, 2)).reshape(*latitude.shape, 3)
        height = spherical_from_mcmf(hit)[2]
        rim = mcmf_from_spherical(latitude, longitude, height)
        miss = np.linalg.norm(hit - rim, axis=-1)
        uv = np.where((miss > FOUND_M)[..., None], project_mcmf(camera, rotation, position, rim), uv)
    found = miss <= FOUND_M
    difference = np.where(found[..., None], uv - expected, 0.0)
    count = found.sum(axis=1)
    good = count >= LEAST_FOUND * AZIMUTHS
    mean = difference[good].sum(axis=1) / count[good][:, None]
    about = np.where(found[good][..., None], difference[good] - mean[:, None], 0.0)
    scatter = np.sqrt((about**2).sum(axis=(1, 2)) / count[good])
    return RimErrors(chosen[good], mean[:, 0], mean[:, 1], scatter)


def _circle(latitude: Floats, longitude: Floats, diameter_m: Floats) -> tuple[Floats, Floats]:
    """Places (n, 48) on the rims."""
    radius = (0.5 * diameter_m / MOON_RADIUS_M)[:, None]
    azimuth = np.arange(AZIMUTHS) * (2.0 * math.pi / AZIMUTHS)
    sine0, cosine0 = np.sin(latitude)[:, None], np.cos(latitude)[:, None]
    sine = sine0 * np.cos(radius) + cosine0 * np.sin(radius) * np.cos(azimuth)
    east = np.sin(azimuth) * np.sin(radius) * cosine0
    return np.arcsin(sine), longitude[:, None] + np.arctan2(east, np.cos(radius) - sine0 * sine)


def _project(
    camera: PinholeCamera,
    position: Floats,
    rotation: Floats,
    latitude: Floats,
    longitude: Floats,
    height_m: Floats,
) -> Floats:
    return project_mcmf(camera, rotation, position, mcmf_from_spherical(latitude, longitude, height_m))
