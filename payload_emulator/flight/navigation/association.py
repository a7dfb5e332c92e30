"""Association of detections with the craters that a predicted pose puts into the image."""

from __future__ import annotations

import numpy as np

from lunar.arrays import FloatArray
from lunar.camera import PinholeCamera
from lunar.constants import MOON_RADIUS_M
from payload_emulator.flight.navigation.anchored_parameters import AnchoredLimits, AnchoredParameters
from payload_emulator.flight.navigation.filter import filter as kalman
from payload_emulator.flight.navigation.filter.filter import FilterState
from payload_emulator.flight.navigation.search.identification import Identification, identify
from payload_emulator.flight.navigation.sighting import LandmarkMap, Sighting, ground_scale
from payload_emulator.flight.vision.detections import Detections


def detection_variance_px2(found: Detections, parameters: AnchoredParameters) -> FloatArray:
    """Return the variance of each detection per axis, shape (n,)."""
    sigma = np.where(np.isfinite(found.sigma_px), found.sigma_px, parameters.detection_sigma_px)
    sigma = np.maximum(sigma * parameters.detection_sigma_scale, parameters.detection_sigma_floor_px)
    return np.asarray(sigma**2, dtype=np.float64)


def altitude_above_sphere_m(estimate: FilterState) -> float:
    """Return the altitude of an estimate above the sphere of the maps."""
    return float(np.linalg.norm(estimate.mean[kalman.POSITION])) - MOON_RADIUS_M


def search_margin_px(prior: FilterState, camera: PinholeCamera, limits: AnchoredLimits) -> float:
    """Return how far outside the predicted image craters are searched: the position sigma seen from the altitude."""
    altitude_m = max(altitude_above_sphere_m(prior), limits.lowest_altitude_m)
    wanted = limits.search_sigmas * prior.position_sigma_m / altitude_m * camera.focal_px
    return min(wanted, limits.search_margin_px)


def tracking_limit_m(prior: FilterState, parameters: AnchoredParameters) -> float:
    """Return the largest position sigma with which the search uses a linear prediction."""
    return parameters.tracking_limit_m * ground_scale(altitude_above_sphere_m(prior))


def associate(
    prior: FilterState,
    sighting: Sighting,
    found: Detections,
    landmarks: LandmarkMap,
    camera: PinholeCamera,
    parameters: AnchoredParameters,
) -> Identification:
    """Return the craters of a sighting that detections belong to.

    A crater among the states brings its own uncertainty; the others have that of the catalogue. The detector's error
    counts in full for both, because the crater of a detection is not known yet.
    """
    count = len(sighting)
    design = kalman.design_matrix(sighting, prior).reshape(2 * count, prior.mean.size)
    tilt = sighting.by_attitude.reshape(2 * count, 3) * parameters.errors.attitude_noise_rad
    spread = (design @ prior.covariance @ design.T + tilt @ tilt.T).reshape(count, 2, count, 2)
    place = (
        sighting.by_position
        @ prior.covariance[kalman.POSITION, kalman.POSITION]
        @ np.swapaxes(sighting.by_position, 1, 2)
    )
    scaled = sighting.by_offset * landmarks.sigma_m[sighting.index][:, None, :]
    own = scaled @ np.swapaxes(scaled, 1, 2)
    own[prior.slots(sighting.index) >= 0] = 0.0
    return identify(
        found,
        sighting,
        spread,
        own,
        detection_variance_px2(found, parameters),
        float(camera.width_px * camera.height_px),
        parameters.identification,
        place,
    )
