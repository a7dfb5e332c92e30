"""Recovery of a lost estimate: counting of disagreeing frames, widened search, search without a prior."""

import math
from dataclasses import replace

import numpy as np

from lunar.arrays import FloatArray
from lunar.camera import PinholeCamera
from payload_emulator.flight.navigation.anchored.correction import (
    Fix,
    altitude_above_sphere_m,
    correct,
    detection_variance_px2,
)
from payload_emulator.flight.navigation.anchored.parameters import AnchoredParameters
from payload_emulator.flight.navigation.filter import filter as kalman
from payload_emulator.flight.navigation.filter.filter import FilterState, KalmanFilter
from payload_emulator.flight.navigation.search.acquisition import acquire
from payload_emulator.flight.navigation.search.identification import Identification
from payload_emulator.flight.navigation.search.lost_in_space import LostParameters, PlaceIndex, find_place
from payload_emulator.flight.navigation.sighting import LandmarkMap, Pose, look
from payload_emulator.flight.vision.detections import Detections

_NO_CRATERS = np.empty(0, dtype=np.int64)
# Highest altitude of a search without a prior over the predicted one.
_HIGHEST_SHARE = 1.2

ORBITAL_RATE_RAD_S = 1e-3
"""Angular rate of a low orbit (2 pi in 111 minutes): an along-track position error implies a velocity error of this
rate times the position error."""


def disagreements(count: int, fix: Fix | None, expected: int, detections: int, parameters: AnchoredParameters) -> int:
    """Return the number of consecutive frames in which map and image disagree, after one more frame.

    Parameters
    ----------
    count
        The number before the frame.
    expected, detections
        Craters of the map in the predicted image, and detections in the frame.
    """
    usable, limits = min(expected, detections), parameters.limits
    # A fix uses at most `crater_limit` craters, also where hundreds are in view.
    explained = min(limits.agreement_share * usable, parameters.crater_limit)
    if fix is not None and len(fix.index) >= max(1, explained):
        return 0
    return count + 1 if usable >= limits.judged_craters else count


def is_widened_search_due(count: int, parameters: AnchoredParameters) -> bool:
    """Return whether the number of disagreements requires a widened search."""
    return count >= parameters.suspicion_frames


def is_lost_search_due(count: int, parameters: AnchoredParameters) -> bool:
    """Return whether the number of disagreements requires a search without a prior."""
    beyond = count - parameters.lost_frames
    return beyond >= 0 and beyond % parameters.limits.lost_search_every == 0


def search_by_votes(
    prior: FilterState,
    pose: Pose,
    found: Detections,
    landmarks: LandmarkMap,
    camera: PinholeCamera,
    parameters: AnchoredParameters,
    radius_m: float,
    unseen_s: float | None = None,
    method: KalmanFilter = kalman,
) -> Fix | None:
    """Return a fix from a search by votes around the prediction; None where none is safe.

    Parameters
    ----------
    radius_m
        Standard deviation of the position that the search covers, per axis.
    unseen_s
        Time since the last fix, inf without one, if the search goes beyond what the prediction claims; None if it does
        not.
    """
    prior = prior.only_craters(_NO_CRATERS)
    pairs = acquire(
        found,
        landmarks,
        pose,
        camera,
        min(radius_m, parameters.limits.search_largest_m),
        np.sqrt(detection_variance_px2(found, parameters)),
        parameters.errors.attitude_noise_rad + parameters.errors.attitude_bias_rad,
        parameters.acquisition,
    )
    if pairs is None:
        return None
    if unseen_s is not None:
        moved_m = float(np.linalg.norm(pairs.pose.position_icrf_m - pose.position_icrf_m))
        prior = kalman.widened(prior, moved_m, _velocity_error_m_s(moved_m, unseen_s, radius_m))
    sighting = look(landmarks, pairs.index, pairs.pose, camera)
    everything = np.arange(pairs.index.size)
    identification = Identification(pairs.detection, everything, pairs.candidates, pairs.needed)
    altitude_m = altitude_above_sphere_m(prior)
    return correct(
        prior, pose, found, identification, sighting, landmarks, camera, parameters, altitude_m, reacquired=True,
        method=method,
    )  # fmt: skip


def search_widely(
    prior: FilterState,
    pose: Pose,
    found: Detections,
    landmarks: LandmarkMap,
    camera: PinholeCamera,
    parameters: AnchoredParameters,
    unseen_s: float = math.inf,
    method: KalmanFilter = kalman,
) -> Fix | None:
    """Return a fix from a search far beyond the claimed uncertainty of the estimate; None where none is safe.

    The uncertainty of the prediction grows by the distance at which the place was found, not by the radius of the
    search: a short pass would otherwise determine the velocity from the errors of a few craters.

    Parameters
    ----------
    unseen_s
        Time since the last fix; inf without one.
    """
    radius_m = parameters.search_radius_m / parameters.limits.search_radius_sigmas
    return search_by_votes(prior, pose, found, landmarks, camera, parameters, radius_m, unseen_s, method)


def _velocity_error_m_s(moved_m: float, unseen_s: float, radius_m: float) -> float:
    """Return the error of velocity that belongs to a position error of some size.

    It is that of another place on the orbit, or of a motion that began after the last fix, such as a burn that is not
    planned; the latter is limited to what the radius of the search stands for.
    """
    recent_m_s = moved_m / unseen_s if unseen_s > 0.0 else math.inf
    return max(ORBITAL_RATE_RAD_S * moved_m, min(recent_m_s, ORBITAL_RATE_RAD_S * radius_m))


def search_everywhere(
    prior: FilterState,
    pose: Pose,
    found: Detections,
    landmarks: LandmarkMap,
    camera: PinholeCamera,
    parameters: AnchoredParameters,
    markov_sigma_m_s2: tuple[float, float, float],
    places: PlaceIndex,
    method: KalmanFilter = kalman,
) -> Fix | None:
    """Return a fix from a search over the whole map, for a nadir camera; None where no place is safe.

    The velocity is turned with the position, and the filter starts afresh at the new place.

    Parameters
    ----------
    markov_sigma_m_s2
        Standard deviation of the empirical acceleration, with which the filter starts.
    places
        Search index of the map.
    """
    sigma_px = np.sqrt(detection_variance_px2(found, parameters))
    place = find_place(found, sigma_px, places, camera, _lost_parameters(prior, parameters))
    if place is None:
        return None
    old, new = prior.mean[kalman.POSITION], pose.mcmf_from_icrf.T @ place.position_mcmf_m
    limits = parameters.limits
    fresh = kalman.initial_filter_state(
        prior.ticks,
        new,
        _turned_velocity(prior.mean[kalman.VELOCITY], old, new),
        limits.found_sigmas * float(place.sigma_m.max()) + limits.found_position_m,
        ORBITAL_RATE_RAD_S * float(np.linalg.norm(new - old)) + limits.found_velocity_m_s,
        markov_sigma_m_s2,
        parameters.errors,
        prior.slope is not None,
    )
    there = replace(pose, position_icrf_m=new)
    sighting = look(landmarks, place.index, there, camera)
    everything = np.arange(place.index.size)
    identification = Identification(place.detection, everything, len(found), len(place))
    altitude_m = altitude_above_sphere_m(prior)
    return correct(
        fresh, there, found, identification, sighting, landmarks, camera, parameters, altitude_m, reacquired=True,
        method=method,
    )  # fmt: skip


def _lost_parameters(prior: FilterState, parameters: AnchoredParameters) -> LostParameters:
    """Return the parameters of the search with altitudes up to 1.2 times the predicted one.

    A lost estimate errs in its place rather than in its altitude, which follows from the period of the orbit. Below 46
    km the altitudes of the parameters apply.
    """
    highest_m = _HIGHEST_SHARE * altitude_above_sphere_m(prior)
    if highest_m <= parameters.lost.maximum_altitude_m:
        return parameters.lost
    return replace(parameters.lost, maximum_altitude_m=highest_m)


def _turned_velocity(velocity: FloatArray, old: FloatArray, new: FloatArray) -> FloatArray:
    """Return a velocity (3,) turned by the shortest rotation from one place (3,) to another, by Rodrigues' formula.

    The rotation of the orbital plane that this leaves out is within the velocity sigma of the new start.
    """
    axis = np.cross(old, new) / (np.linalg.norm(old) * np.linalg.norm(new))
    cosine = math.sqrt(max(1.0 - float(axis @ axis), 0.0))
    turned = velocity + np.cross(axis, velocity) + np.cross(axis, np.cross(axis, velocity)) / (1.0 + cosine)
    return np.asarray(turned, dtype=np.float64)
