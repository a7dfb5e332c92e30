"""Star tracker and gyroscopes: noise across and about the boresight, outages, drift of the gyroscopes.

The star tracker has no solution while the Sun, the Moon or the Earth is too close to its boresight, and at random
times. The gyroscopes measure the rotation from one sample to the next at all times. Positions of Sun and Earth are
those of the ephemeris, also where the light of the scenario is drawn at random.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from lunar.arrays import FloatArray
from lunar.constants import MOON_RADIUS_M
from lunar.frames import matrix_from_rotation_vector, quaternion_from_matrix, rotation_vector_from_matrix
from lunar.third_bodies import earth_position_icrf_m, sun_position_icrf_m
from lunar.timescales import tdb_s_from_utc_ns
from payload_emulator.sim.instruments import Limit, SimulatedInstrument, Situation, Surroundings

_NAN = float("nan")
_NS = 1_000_000_000
_ARCSEC = math.radians(1.0 / 3600.0)
_DEG_H = math.radians(1.0) / 3600.0
"""Degree per hour in rad/s; with the square root of an hour, 60 s^(1/2), the unit of random walks."""
_SQRT_HOUR = 60.0
_TRACKING, _OUTAGE = 1.0, 0.0


@dataclass(frozen=True, slots=True)
class StarTrackerSection:
    """Settings of star tracker and gyroscopes.

    Attributes
    ----------
    cross_arcsec, roll_arcsec
        Noise of a sample across and about the boresight, 1 sigma.
    alignment_deg
        Constant rotation of the star tracker against the camera that the ground does not know, 1 sigma per axis.
    off_zenith_deg, azimuth_deg
        Boresight: its angle from the direction opposite to that of the camera, towards an azimuth that counts clockwise
        from image up.
    sun_exclusion_deg, earth_exclusion_deg, moon_exclusion_deg
        No solution with the centre of the Sun or the Earth, or the limb of the Moon, closer to the boresight.
    outages_per_hour, outage_s
        Mean number of further outages per hour, and their mean duration.
    gyro_bias_deg_h, gyro_walk_deg_h_sqrt_h, gyro_noise_deg_sqrt_h
        Bias of the gyroscopes when switched on, its random walk, and the angular random walk, 1 sigma per axis.
    cadence_s
        Time between samples.
    """

    cross_arcsec: float = 10.0
    roll_arcsec: float = 70.0
    alignment_deg: float = 0.005
    off_zenith_deg: float = 40.0
    azimuth_deg: float = 90.0
    sun_exclusion_deg: float = 35.0
    earth_exclusion_deg: float = 15.0
    moon_exclusion_deg: float = 15.0
    outages_per_hour: float = 2.0
    outage_s: float = 90.0
    gyro_bias_deg_h: float = 5.0
    gyro_walk_deg_h_sqrt_h: float = 0.3
    gyro_noise_deg_sqrt_h: float = 0.15
    cadence_s: float = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class StarTrackerState:
    """State of the hardware: misalignment and gyroscope bias in camera axes, last attitude, end of an outage."""

    misalignment_rad: FloatArray
    gyro_bias_rad_s: FloatArray
    camera_from_icrf: FloatArray | None = None
    outage_until_ns: int = -1


def _limits(settings: StarTrackerSection) -> tuple[Limit, ...]:
    positive = ("cross_arcsec", "roll_arcsec", "gyro_noise_deg_sqrt_h")
    zero_or_more = ("outages_per_hour", "outage_s", "gyro_bias_deg_h", "gyro_walk_deg_h_sqrt_h")
    angles = ("sun_exclusion_deg", "earth_exclusion_deg", "moon_exclusion_deg", "off_zenith_deg")
    # The navigation filter allows for this alignment error, 1 sigma.
    aligned = 0.0 <= settings.alignment_deg <= 0.01
    return (
        *(_limit(settings, key, 0.0, math.inf, "positive", above=True) for key in positive),
        *(_limit(settings, key, 0.0, math.inf, "zero or more") for key in zero_or_more),
        *(_limit(settings, key, 0.0, 180.0, "from 0 to 180") for key in angles),
        _limit(settings, "azimuth_deg", 0.0, 360.0, "from 0 to 360"),
        Limit(aligned, "alignment_deg", "from 0 to 0.01", settings.alignment_deg),
        _limit(settings, "cadence_s", 0.1, math.inf, "at least 0.1"),
    )


def _limit(
    settings: StarTrackerSection, key: str, low: float, high: float, expected: str, *, above: bool = False
) -> Limit:
    value = getattr(settings, key)
    return Limit(low <= value <= high and not (above and value == low), key, expected, value)


def _data_sheet(settings: StarTrackerSection) -> Mapping[str, object]:
    return {
        "cross_sigma_rad": settings.cross_arcsec * _ARCSEC,
        "roll_sigma_rad": settings.roll_arcsec * _ARCSEC,
        "off_zenith_rad": math.radians(settings.off_zenith_deg),
        "azimuth_rad": math.radians(settings.azimuth_deg),
        "gyro_bias_sigma_rad_s": settings.gyro_bias_deg_h * _DEG_H,
        "gyro_walk_rad_s_sqrt_s": settings.gyro_walk_deg_h_sqrt_h * _DEG_H / _SQRT_HOUR,
        "gyro_noise_rad_sqrt_s": math.radians(settings.gyro_noise_deg_sqrt_h) / _SQRT_HOUR,
    }


def start(settings: StarTrackerSection, surroundings: Surroundings) -> StarTrackerState:
    """Return the state of the hardware when it is switched on for the first time."""
    draws = surroundings.rng("star_tracker").standard_normal((2, 3))
    return StarTrackerState(
        math.radians(settings.alignment_deg) * draws[0], settings.gyro_bias_deg_h * _DEG_H * draws[1]
    )


def measure(
    settings: StarTrackerSection, state: StarTrackerState, surroundings: Surroundings, situation: Situation
) -> tuple[StarTrackerState, tuple[float, ...]]:
    """Return the state after a sample, and quality, quaternion (NaN in an outage) and turn since the sample before."""
    rng = surroundings.rng("star_tracker", situation.utc_ns)
    noise, gyro_noise, walk_noise = rng.standard_normal((3, 3))
    chance, length = rng.random(), rng.exponential()
    attitude, elapsed_s = situation.camera_from_icrf, situation.elapsed_s
    turn = np.full(3, _NAN)
    if state.camera_from_icrf is not None and elapsed_s is not None:
        turn = rotation_vector_from_matrix(attitude @ state.camera_from_icrf.T)
        turn = turn + state.gyro_bias_rad_s * elapsed_s
        turn += math.radians(settings.gyro_noise_deg_sqrt_h) / _SQRT_HOUR * math.sqrt(elapsed_s) * gyro_noise
        walk = settings.gyro_walk_deg_h_sqrt_h * _DEG_H / _SQRT_HOUR * math.sqrt(elapsed_s)
        state = replace(state, gyro_bias_rad_s=state.gyro_bias_rad_s + walk * walk_noise)
    if chance < settings.outages_per_hour * settings.cadence_s / 3600.0:
        state = replace(state, outage_until_ns=situation.utc_ns + round(length * settings.outage_s * _NS))
    state = replace(state, camera_from_icrf=attitude)
    if situation.utc_ns < state.outage_until_ns or is_blinded(settings, situation):
        return state, (_OUTAGE, *(_NAN,) * 4, *turn.tolist())
    tracker = tracker_from_camera(math.radians(settings.off_zenith_deg), math.radians(settings.azimuth_deg))
    sigma = _ARCSEC * np.array([settings.cross_arcsec, settings.cross_arcsec, settings.roll_arcsec])
    error = matrix_from_rotation_vector(tracker.T @ (sigma * noise))
    seen = error @ matrix_from_rotation_vector(state.misalignment_rad) @ attitude
    return state, (_TRACKING, *quaternion_from_matrix(seen).tolist(), *turn.tolist())


def is_blinded(settings: StarTrackerSection, situation: Situation) -> bool:
    """Return whether Sun, Earth or Moon is too close to the boresight; the Moon may hide the other two."""
    boresight = boresight_in_camera(math.radians(settings.off_zenith_deg), math.radians(settings.azimuth_deg))
    axis = situation.camera_from_icrf.T @ boresight
    place = situation.position_icrf_m
    distance = float(np.linalg.norm(place))
    down, moon_rad = -place / distance, math.asin(min(MOON_RADIUS_M / distance, 1.0))
    if _angle(axis, down) - moon_rad < math.radians(settings.moon_exclusion_deg):
        return True
    tdb_s = float(tdb_s_from_utc_ns(situation.utc_ns))
    for body, exclusion_deg in (
        (sun_position_icrf_m(tdb_s), settings.sun_exclusion_deg),
        (earth_position_icrf_m(tdb_s), settings.earth_exclusion_deg),
    ):
        direction = np.asarray(body) - place
        direction = direction / np.linalg.norm(direction)
        hidden = _angle(direction, down) < moon_rad
        if not hidden and _angle(axis, direction) < math.radians(exclusion_deg):
            return True
    return False


def boresight_in_camera(off_zenith_rad: float, azimuth_rad: float) -> FloatArray:
    """Return the boresight in camera axes (right, down, forward), unit (3,)."""
    sine = math.sin(off_zenith_rad)
    return np.array([sine * math.sin(azimuth_rad), -sine * math.cos(azimuth_rad), -math.cos(off_zenith_rad)])


def tracker_from_camera(off_zenith_rad: float, azimuth_rad: float) -> FloatArray:
    """Return the rotation (3, 3) to two cross-boresight axes and the boresight."""
    axis = boresight_in_camera(off_zenith_rad, azimuth_rad)
    first = np.array([math.cos(azimuth_rad), math.sin(azimuth_rad), 0.0])
    return np.stack([first, np.cross(axis, first), axis])


def _angle(one: FloatArray, other: FloatArray) -> float:
    return math.atan2(float(np.linalg.norm(np.cross(one, other))), float(one @ other))


INSTRUMENT = SimulatedInstrument(
    name="star_tracker",
    settings=StarTrackerSection,
    limits=_limits,
    cadence_s=lambda settings: float(settings.cadence_s),
    # The newest sample is taken with the image, so that its attitude needs no extrapolation.
    delay_s=lambda settings: 0.0,
    data_sheet=_data_sheet,
    start=start,
    measure=measure,
    replaces=("attitude.knowledge_noise_deg", "attitude.knowledge_bias_deg", "attitude.declared_noise_deg"),
    gives_attitude=True,
)
