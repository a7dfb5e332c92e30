"""Recovery of a lost estimate: counting of disagreeing frames, widened search, search without a prior."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from lunar.arrays import FloatArray
from lunar.camera import PinholeCamera
from payload_emulator.flight.navigation import filter as kalman
from payload_emulator.flight.navigation.acquisition import acquire
from payload_emulator.flight.navigation.anchored_parameters import AnchoredParameters
from payload_emulator.flight.navigation.association import altitude_above_sphere_m, detection_variance_px2
from payload_emulator.flight.navigation.correction import Fix, correct
from payload_emulator.flight.navigation.filter import FilterState
from payload_emulator.flight.navigation.identification import Identification
from payload_emulator.flight.navigation.lost_in_space import LostParameters, PlaceIndex, find_place
from payload_emulator.flight.navigation.sighting import LandmarkMap, Pose, look
from payload_emulator.flight.vision.detections import Detections

_NO_CRATERS = np.empty(0, dtype=np.int64)
# Angular rate of a low orbit (2 pi in 111 minutes): an along-track position error implies a velocity error of this rate
# times the position error.
_ORBITAL_RATE_RAD_S = 1e-3
# Highest altitude of a search without a prior over the predicted one.
_HIGHEST_SHARE = 1.2


def disagreements(
    count: int, fix: Fix | None, expected: int, detections: int, parameters: AnchoredParameters
) -> int:
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
) -> Fix | None:
    """Return a fix from a search by votes within a radius of the prediction; None where none is safe."""
    prior = prior.only_craters(_NO_CRATERS)
    pairs = acquire(
        found,
        landmarks,
        pose,
        camera,
        radius_m,
        np.sqrt(detection_variance_px2(found, parameters)),
        parameters.errors.attitude_noise_rad + parameters.errors.attitude_bias_rad,
        parameters.acquisition,
    )
    if pairs is None:
        return None
    sighting = look(landmarks, pairs.index, pairs.pose, camera)
    everything = np.arange(pairs.index.size)
    identification = Identification(pairs.detection, everything, pairs.candidates, pairs.needed)
    altitude_m = altitude_above_sphere_m(prior)
    return correct(
        prior, pose, found, identification, sighting, landmarks, camera, parameters, altitude_m, reacquired=True
    )  # fmt: skip


def search_widely(
    prior: FilterState,
    pose: Pose,
    found: Detections,
    landmarks: LandmarkMap,
    camera: PinholeCamera,
    parameters: AnchoredParameters,
) -> Fix | None:
    """Return a fix from a search far beyond the claimed uncertainty of the estimate; None where none is safe."""
    wide = prior.covariance.copy()
    extra = parameters.search_radius_m / parameters.limits.search_radius_sigmas
    wide[kalman.POSITION, kalman.POSITION] += np.eye(3) * extra**2
    wide[kalman.VELOCITY, kalman.VELOCITY] += np.eye(3) * (_ORBITAL_RATE_RAD_S * extra) ** 2
    widened = replace(prior, covariance=wide)
    return search_by_votes(widened, pose, found, landmarks, camera, parameters, extra)


def search_everywhere(
    prior: FilterState,
    pose: Pose,
    found: Detections,
    landmarks: LandmarkMap,
    camera: PinholeCamera,
    parameters: AnchoredParameters,
    markov_sigma_m_s2: tuple[float, float, float],
    places: PlaceIndex,
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
        _ORBITAL_RATE_RAD_S * float(np.linalg.norm(new - old)) + limits.found_velocity_m_s,
        markov_sigma_m_s2,
        parameters.errors,
    )
    there = replace(pose, position_icrf_m=new)
    sighting = look(landmarks, place.index, there, camera)
    everything = np.arange(place.index.size)
    identification = Identification(place.detection, everything, len(found), len(place))
    altitude_m = altitude_above_sphere_m(prior)
    return correct(
        fresh, there, found, identification, sighting, landmarks, camera, parameters, altitude_m, reacquired=True
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
