"""Correction of a predicted estimate with identified craters, and the tests that a correction must pass."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lunar.arrays import FloatArray, IntArray
from lunar.camera import PinholeCamera
from payload_emulator.flight.navigation import filter as kalman
from payload_emulator.flight.navigation.anchored_parameters import AnchoredLimits, AnchoredParameters
from payload_emulator.flight.navigation.association import detection_variance_px2
from payload_emulator.flight.navigation.filter import FilterState, Update
from payload_emulator.flight.navigation.identification import Identification
from payload_emulator.flight.navigation.prediction import is_usable
from payload_emulator.flight.navigation.sighting import LandmarkMap, Pose, Sighting
from payload_emulator.flight.vision.detections import Detections


@dataclass(frozen=True, slots=True, eq=False)
class Fix:
    """Identified craters of a frame with the update they gave.

    Attributes
    ----------
    index
        Craters, into the map, shape (n,).
    reacquired
        The fix came from a widened search.
    """

    identification: Identification
    index: IntArray
    update: Update
    reacquired: bool


def correct(
    prior: FilterState,
    pose: Pose,
    found: Detections,
    identification: Identification,
    sighting: Sighting,
    landmarks: LandmarkMap,
    camera: PinholeCamera,
    parameters: AnchoredParameters,
    altitude_m: float,
    *,
    reacquired: bool,
) -> Fix | None:
    """Return the fix of identified craters; None where it contradicts the prediction as a whole.

    Parameters
    ----------
    altitude_m
        Predicted altitude, which scales the lasting part of the detector's error to the ground.
    """
    variance = detection_variance_px2(found, parameters)
    if len(identification) > parameters.crater_limit:
        surest = np.argsort(variance[identification.detection], kind="stable")
        identification = identification.select(np.sort(surest[: parameters.crater_limit]))
    index = sighting.index[identification.sighted]
    uv = np.stack([found.u_px, found.v_px], axis=1)[identification.detection]
    variance = variance[identification.detection]
    persistence = detection_persistence(found, parameters)[identification.detection]
    sigma_m = crater_sigma_m(landmarks.sigma_m[index], variance * persistence, altitude_m, camera, parameters)
    update = kalman.update(
        prior.with_craters(index, sigma_m),
        pose.camera_from_icrf,
        pose.mcmf_from_icrf,
        landmarks,
        index,
        uv,
        fresh_variance_px2(variance * (1.0 - persistence), parameters),
        camera,
        parameters.errors,
    )
    limits = parameters.limits
    if update is None or update.nis > frame_limit(2 * len(identification), limits.frame_gate_sigmas):
        return None
    if not is_plausible(prior, update.state, limits):
        return None
    return Fix(identification, index, update, reacquired)


def crater_sigma_m(
    catalogue_sigma_m: FloatArray,
    lasting_variance_px2: FloatArray,
    altitude_m: float,
    camera: PinholeCamera,
    parameters: AnchoredParameters,
) -> FloatArray:
    """Return the uncertainty of the place at which each crater is detected, east, north, up, shape (n, 3).

    It is that of the catalogue (n, 3) and the part of the detector's error that is the same in every frame.
    """
    altitude_m = max(altitude_m, parameters.limits.lowest_altitude_m)
    lasting_px = np.sqrt(lasting_variance_px2)
    sigma_m = catalogue_sigma_m.copy()
    sigma_m[:, :2] = np.hypot(sigma_m[:, :2], (lasting_px * altitude_m / camera.focal_px)[:, None])
    return sigma_m


def detection_persistence(found: Detections, parameters: AnchoredParameters) -> FloatArray:
    """Return the share of each detection's variance that is the same in every frame of its crater, shape (n,)."""
    if found.persistence is None:
        return np.full(len(found), parameters.detection_persistence)
    return found.persistence


def fresh_variance_px2(variance_px2: FloatArray, parameters: AnchoredParameters) -> FloatArray:
    """Return variances (n,) that are new in every frame, not below the repeatability of any detector."""
    return np.maximum(variance_px2, parameters.limits.smallest_variance_px2)


def is_plausible(prior: FilterState, posterior: FilterState, limits: AnchoredLimits) -> bool:
    """Return whether the prediction's uncertainty allows a correction, and whether it leads to a usable estimate."""
    change = float(np.linalg.norm(posterior.mean[kalman.POSITION] - prior.mean[kalman.POSITION]))
    positive = bool(np.all(np.diag(posterior.covariance) >= 0.0))
    return (
        is_usable(posterior, limits)
        and positive
        and change < limits.correction_sigmas * prior.position_sigma_m
    )


def frame_limit(degrees: int, sigmas: float) -> float:
    """Return the chi-square quantile at the probability of a normal quantile.

    Cube-root approximation: too large by 7 % at two degrees of freedom and by 2 % at ten.

    References
    ----------
    Wilson, Hilferty (1931), The distribution of chi-square, PNAS 17.
    """
    share = 2.0 / (9.0 * degrees)
    return float(degrees * (1.0 - share + sigmas * np.sqrt(share)) ** 3)
