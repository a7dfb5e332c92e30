"""Odometry inside the filter: craters that no catalogue names, seen in two frames in a row, tie the two positions.

The position of the frame before is kept among the states (a stochastic clone). A detection of that frame, put on a
sphere at the height of the ground about, predicts where it should be found now; what is found instead says how far the
spacecraft has moved. How high the ground is there is not known, and the noise says so.

References
----------
Roumeliotis and Burdick (2002), Stochastic cloning: a generalized framework for processing relative state measurements.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lunar.arrays import FloatArray, IntArray
from lunar.camera import PinholeCamera
from lunar.constants import MOON_RADIUS_M
from payload_emulator.flight.navigation.filter import (
    ATTITUDE,
    PIXEL,
    POSITION,
    FilterState,
    corrected_covariance,
)
from payload_emulator.flight.navigation.sighting import turned_by
from payload_emulator.flight.vision.detections import Detections

CLONE = -1
"""Stands among the craters of a filter state for the position of the frame before."""

_CLONES = np.array([CLONE], dtype=np.int64)


@dataclass(frozen=True, slots=True)
class RelativeParameters:
    """Rules of the relative measurement.

    Attributes
    ----------
    enabled
        Off as shipped: dynamics know the motion between two frames to centimetres, pixels to some hundred metres.
    height_sigma_m
        Of the ground at a place about which nothing is known.
    log_diameter_gate, gate
        Largest difference of logarithms of diameters; chi-square of 2 degrees at 0.999.
    """

    enabled: bool = False
    height_sigma_m: float = 700.0
    log_diameter_gate: float = 0.3
    gate: float = 13.8


@dataclass(frozen=True, slots=True, eq=False)
class Remembered:
    """Detections of the frame before with the attitude and the Moon's orientation of then."""

    found: Detections
    variance_px2: FloatArray
    camera_from_icrf: FloatArray
    mcmf_from_icrf: FloatArray


def with_clone(state: FilterState) -> FilterState:
    """Return the state with its position kept as of now."""
    state = without_clone(state)
    size = state.mean.size
    covariance = np.empty((size + 3, size + 3))
    covariance[:size, :size] = state.covariance
    covariance[size:, :size] = state.covariance[POSITION]
    covariance[:size, size:] = state.covariance[:, POSITION]
    covariance[size:, size:] = state.covariance[POSITION, POSITION]
    mean = np.concatenate([state.mean, state.mean[POSITION]])
    return FilterState(state.ticks, mean, covariance, np.concatenate([state.craters, _CLONES]))


def without_clone(state: FilterState) -> FilterState:
    """Return the state without a position of the past."""
    return state.only_craters(state.craters[state.craters != CLONE])


def tie(
    state: FilterState,
    before: Remembered,
    now: Remembered,
    camera: PinholeCamera,
    surface_m: float,
    attitude_noise_rad: float,
    parameters: RelativeParameters,
) -> tuple[FilterState, int]:
    """Return the state after the move between two frames was measured, without the clone, and the number of ties.

    Parameters
    ----------
    state
        Predicted, with the clone.
    surface_m
        Height of the ground about, above the sphere of the maps.
    """
    slot = int(state.slots(_CLONES)[0])
    if slot < 0 or not len(before.found) or not len(now.found):
        return without_clone(state), 0
    predicted, by_now, by_before, noise, tilt = _predicted(
        state, slot, before, now, camera, MOON_RADIUS_M + surface_m, parameters.height_sigma_m
    )
    count, size = len(predicted), state.mean.size
    design = np.zeros((count, 2, size))
    design[:, :, POSITION], design[:, :, slot : slot + 3] = by_now, by_before
    one, other = _pairs(state, design, predicted, noise, before, now, parameters)
    if not one.size:
        return without_clone(state), 0
    uv = np.stack([now.found.u_px, now.found.v_px], axis=1)[other]
    rows = 2 * one.size
    used = design[one].reshape(rows, size)
    shared = tilt[one].reshape(rows, 3) * np.sqrt(2.0) * attitude_noise_rad
    measured = shared @ shared.T
    for k in range(one.size):
        block = slice(2 * k, 2 * k + 2)
        measured[block, block] += noise[one[k]] + now.variance_px2[other[k]] * np.eye(2)
    crossed = used @ state.covariance
    spread = crossed @ used.T + measured
    innovation = (uv - predicted[one]).reshape(rows)
    if float(innovation @ np.linalg.solve(spread, innovation)) > parameters.gate * one.size:
        return without_clone(state), 0
    gain = np.linalg.solve(spread, crossed).T
    covariance = corrected_covariance(state.covariance, used, gain, measured)
    tied = FilterState(state.ticks, state.mean + gain @ innovation, covariance, state.craters)
    return without_clone(tied), int(one.size)


def _predicted(
    state: FilterState,
    slot: int,
    before: Remembered,
    now: Remembered,
    camera: PinholeCamera,
    radius_m: float,
    height_sigma_m: float,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return pixels (n, 2), derivatives by both positions (n, 2, 3), noise (n, 2, 2), derivatives by attitude."""
    turn = turned_by(-state.mean[ATTITUDE])
    bias = state.mean[PIXEL]
    uv = np.stack([before.found.u_px, before.found.v_px], axis=1) - bias
    mcmf_from_camera = before.mcmf_from_icrf @ (turn @ before.camera_from_icrf).T
    ray = camera.rays(uv)
    slopes = np.stack([camera.rays(uv + step) - camera.rays(uv - step) for step in 0.5 * np.eye(2)], axis=2)
    ray, slopes = ray @ mcmf_from_camera.T, mcmf_from_camera @ slopes
    centre = before.mcmf_from_icrf @ state.mean[slot : slot + 3]
    along = ray @ centre
    with np.errstate(invalid="ignore"):
        distance = -along - np.sqrt(along**2 - (centre @ centre - radius_m**2))
    point = centre + distance[:, None] * ray
    up = point / radius_m
    steep = np.einsum("ni,ni->n", ray, up)
    by_centre = np.eye(3) - ray[:, :, None] * up[:, None, :] / steep[:, None, None]
    camera_from_mcmf = turn @ now.camera_from_icrf @ now.mcmf_from_icrf.T
    seen = (point - now.mcmf_from_icrf @ state.mean[POSITION]) @ camera_from_mcmf.T
    depth = np.where(seen[:, 2] > 0.0, seen[:, 2], np.nan)
    x, y, f = seen[:, 0] / depth, seen[:, 1] / depth, camera.focal_px
    predicted = f * np.stack([x, y], axis=1) + np.array(camera.centre_px) + bias
    by_point = np.zeros((len(uv), 2, 3))
    by_point[:, 0, 0] = by_point[:, 1, 1] = f / depth
    by_point[:, 0, 2], by_point[:, 1, 2] = -f * x / depth, -f * y / depth
    by_attitude = np.stack(
        [
            np.stack([f * x * y, -f * (1.0 + x * x), f * y], axis=1),
            np.stack([f * (1.0 + y * y), -f * x * y, -f * x], axis=1),
        ],
        axis=1,
    )
    by_ground = by_point @ camera_from_mcmf
    by_pixel = by_ground @ (distance[:, None, None] * (by_centre @ slopes))
    by_height = (by_ground @ (ray / steep[:, None])[:, :, None])[:, :, 0]
    noise = by_pixel @ np.swapaxes(by_pixel, 1, 2) * before.variance_px2[:, None, None]
    noise += height_sigma_m**2 * by_height[:, :, None] * by_height[:, None, :]
    by_now = -(by_point @ turn @ now.camera_from_icrf)
    return predicted, by_now, by_ground @ by_centre @ before.mcmf_from_icrf, noise, by_attitude


def _pairs(
    state: FilterState,
    design: FloatArray,
    predicted: FloatArray,
    noise: FloatArray,
    before: Remembered,
    now: Remembered,
    parameters: RelativeParameters,
) -> tuple[IntArray, IntArray]:
    """Return detections of the frame before and of now that are each other's nearest and inside their gates."""
    uv = np.stack([now.found.u_px, now.found.v_px], axis=1)
    own = np.einsum("nai,ij,nbj->nab", design, state.covariance, design) + noise
    spread = own[:, None] + now.variance_px2[None, :, None, None] * np.eye(2)
    offset = uv[None] - predicted[:, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        good = np.all(np.isfinite(spread), axis=(2, 3)) & np.all(np.isfinite(offset), axis=2)
        alike = np.abs(np.log(before.found.diameter_px[:, None] / now.found.diameter_px[None]))
        good &= alike < parameters.log_diameter_gate
    spread[~good], offset[~good] = np.eye(2), np.inf
    distance = np.full(good.shape, np.inf)
    solved = np.linalg.solve(spread[good], offset[good][..., None])[..., 0]
    distance[good] = np.einsum("ki,ki->k", offset[good], solved)
    nearest, back = np.argmin(distance, axis=1), np.argmin(distance, axis=0)
    one = np.arange(len(distance))
    kept = (back[nearest] == one) & (distance[one, nearest] < parameters.gate)
    return one[kept].astype(np.int64), nearest[kept].astype(np.int64)
