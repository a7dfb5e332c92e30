"""Distance of labels from the rims that rays find: it shows whether labels are at the craters."""

import math

import numpy as np
from numpy import cos, sin

from lunar.camera import project_mcmf
from lunar.constants import MOON_RADIUS_M
from lunar.frames import mcmf_from_spherical, spherical_from_mcmf
from payload_emulator.sim.render.labels import label_frame
from payload_emulator.sim.render.raymarch import cast

AZIMUTH = np.arange(48) * (math.pi / 24.0)
ROUNDS = 8
FOUND_M = 10.0
"""A ray has found a rim point when it meets the ground this close to it: a tenth of a pixel at the least altitude."""

LEAST_FOUND = 0.9
"""Share of a rim that must be in sight: the mean over a part of it would say little of the centre."""


def rim_errors(terrain, camera, position_mcmf_m, camera_from_mcmf):
    """Labels of a picture against rims found by casting rays onto the terrain.

    Of the craters that are whole in the picture with their rims in sight: the rows (n,) in the terrain's catalogue, and
    the middle (n, 2) of the rim that rays find less the label's place, pixels.

    The rim at an azimuth is the ground that lies a radius from the centre there, whatever its height.  A ray is turned
    until it meets just that ground; where nearer ground is in the way it never does.
    """
    position = np.asarray(position_mcmf_m, float)
    rotation = np.asarray(camera_from_mcmf, float)
    labels = label_frame(terrain, camera, position, rotation, 5_000.0)
    craters = terrain.measured(labels.index)
    chosen = np.flatnonzero(labels.inside & (labels.visible_fraction == 1.0) & np.isfinite(craters.rim_height_m))
    index, craters = labels.index[chosen], craters.select(chosen)
    if not index.size:
        return index, np.empty((0, 2))
    latitude, longitude = _circle(craters.latitude_rad, craters.longitude_rad, craters.diameter_m)
    level = np.broadcast_to(craters.rim_height_m[:, None], latitude.shape)
    tilted = level + terrain.rim_tilts_m(index) @ np.stack([cos(AZIMUTH), sin(AZIMUTH)])
    centre = project_mcmf(camera, rotation, position, craters.position_mcmf_m)
    expected = project_mcmf(camera, rotation, position, mcmf_from_spherical(latitude, longitude, tilted))
    circle = project_mcmf(camera, rotation, position, mcmf_from_spherical(latitude, longitude, level))
    # What a rim of one height would show as its middle is the projected centre: perspective moves both alike.
    middle = centre + (expected - circle).mean(axis=1)
    place = np.stack([labels.u_px[chosen], labels.v_px[chosen]], axis=-1)
    uv = expected
    for _ in range(ROUNDS):
        hit = cast(terrain, camera, position, rotation, uv.reshape(-1, 2)).reshape(*latitude.shape, 3)
        rim = mcmf_from_spherical(latitude, longitude, spherical_from_mcmf(hit)[2])
        miss = np.linalg.norm(hit - rim, axis=-1)
        uv = np.where((miss > FOUND_M)[..., None], project_mcmf(camera, rotation, position, rim), uv)
    found = miss <= FOUND_M
    difference = np.where(found[..., None], uv - expected, 0.0)
    count = found.sum(axis=1)
    good = count >= LEAST_FOUND * len(AZIMUTH)
    mean = difference[good].sum(axis=1) / count[good][:, None]
    return index[good], middle[good] + mean - place[good]


def _circle(latitude, longitude, diameter_m):
    """Places (n, 48) on the rims."""
    radius = (0.5 * diameter_m / MOON_RADIUS_M)[:, None]
    sine0, cosine0 = sin(latitude)[:, None], cos(latitude)[:, None]
    sine = sine0 * cos(radius) + cosine0 * sin(radius) * cos(AZIMUTH)
    east = sin(AZIMUTH) * sin(radius) * cosine0
    return np.arcsin(sine), longitude[:, None] + np.arctan2(east, cos(radius) - sine0 * sine)
