"""Attitude on board from star tracker and gyroscopes: a multiplicative Kalman filter of attitude and gyroscope bias.

The gyroscopes carry the attitude from sample to sample, the star tracker corrects it. In an outage the attitude goes on
with the gyroscopes alone and its uncertainty grows. Without a sample before, or after a gap in the samples, there is no
attitude until the star tracker has a solution.

The error is a small rotation delta in camera axes, true = exp([delta x]) estimate. It lasts from frame to frame: in an
outage all of it, otherwise the part that the star tracker does not correct. Each attitude therefore states its
correlation with that of the frame before.

References
----------
Lefferts, Markley, Shuster (1982), Kalman filtering for spacecraft attitude estimation, J. Guidance 5.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from lunar.arrays import FloatArray
from lunar.frames import (
    matrix_from_quaternion,
    matrix_from_rotation_vector,
    quaternion_from_matrix,
    rotation_vector_from_matrix,
)
from payload_emulator.flight.instruments import AttitudeEstimate, FlightInstrument, Knowledge, Reading
from payload_emulator.flight.navigation.filter import AttitudeError, corrected_covariance
from tmtc.cuc import TICKS_PER_SECOND
from tmtc.instruments import ATTITUDE

_NAN = float("nan")
_ARCSEC = math.radians(1.0 / 3600.0)
_UNIT_TOLERANCE = 1e-3
_ANGLE, _BIAS = slice(0, 3), slice(3, 6)


@dataclass(frozen=True, slots=True)
class StarTrackerParameters:
    """Data sheet and use of star tracker and gyroscopes.

    Attributes
    ----------
    cross_sigma_rad, roll_sigma_rad
        Noise across and about the boresight.
    off_zenith_rad, azimuth_rad
        Boresight: angle from the direction opposite to that of the camera, towards an azimuth clockwise from image up.
    gyro_bias_sigma_rad_s, gyro_walk_rad_s_sqrt_s, gyro_noise_rad_sqrt_s
        Bias when switched on, its random walk, and the angular random walk.
    gate_sigmas
        A solution is refused where its normalised distance from the prediction is larger: 4.5 refuses 1 of 10,000
        correct ones (chi-square of 3 degrees).
    refused_samples
        After this number of refused solutions in a row the filter starts again from the star tracker.
    attitude_age_s
        A frame has an attitude only if the newest sample is not older.
    largest_sigma_rad
        With a larger uncertainty there is no attitude: matching craters fails beyond about a degree.
    """

    cross_sigma_rad: float = 10.0 * _ARCSEC
    roll_sigma_rad: float = 70.0 * _ARCSEC
    off_zenith_rad: float = math.radians(40.0)
    azimuth_rad: float = math.radians(90.0)
    gyro_bias_sigma_rad_s: float = 2.4e-5
    gyro_walk_rad_s_sqrt_s: float = 2.4e-8
    gyro_noise_rad_sqrt_s: float = 4.4e-5
    gate_sigmas: float = 4.5
    refused_samples: int = 6
    attitude_age_s: float = 0.5
    largest_sigma_rad: float = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeState:
    """Estimate of attitude and gyroscope bias.

    Attributes
    ----------
    ticks
        On-board time of the newest sample; -1 before the first.
    camera_from_icrf
        Shape (3, 3); None without attitude.
    bias_rad_s
        Shape (3,), camera axes.
    covariance
        Of attitude error and bias, shape (6, 6).
    tracked_ticks
        On-board time of the last solution used; -1 before the first.
    refused
        Solutions refused since then.
    memory
        Derivatives of the errors by those at the frame before, shape (6, 6).
    """

    ticks: int
    camera_from_icrf: FloatArray | None
    bias_rad_s: FloatArray
    covariance: FloatArray
    tracked_ticks: int = -1
    refused: int = 0
    memory: FloatArray = field(default_factory=lambda: np.eye(6))


def start(parameters: StarTrackerParameters) -> AttitudeState:
    """Return the state after a boot: no attitude, bias as on the data sheet."""
    covariance = np.zeros((6, 6))
    covariance[_BIAS, _BIAS] = np.eye(3) * parameters.gyro_bias_sigma_rad_s**2
    return AttitudeState(-1, None, np.zeros(3), covariance)


def step(
    parameters: StarTrackerParameters, state: AttitudeState, samples: FloatArray, knowledge: Knowledge
) -> Reading:
    """Return the attitude at the frame."""
    rows, before = [], state.covariance
    state = replace(state, memory=np.eye(6))
    for sample in samples:
        state = propagated(parameters, state, int(sample[0]), sample[6:9])
        state, row = corrected(parameters, state, sample[1], sample[2:6])
        rows.append({"sample_ticks": int(sample[0]), **row})
    attitude = attitude_of(parameters, state, knowledge.ticks)
    known = attitude.camera_from_icrf
    if known is not None:
        attitude = replace(attitude, error=attitude_error(state, before))
    frame: dict[str, object] = {
        ATTITUDE: (_NAN,) * 4 if known is None else quaternion_from_matrix(known),
        "attitude_sigma_deg": _NAN if attitude.sigma_rad is None else math.degrees(attitude.sigma_rad),
        "gyro_bias_deg_h": np.degrees(state.bias_rad_s) * 3600.0,
        "tracking_age_s": _NAN
        if state.tracked_ticks < 0
        else (knowledge.ticks - state.tracked_ticks) / TICKS_PER_SECOND,
    }
    return Reading(state, tuple(rows), frame, attitude=attitude)


def propagated(
    parameters: StarTrackerParameters, state: AttitudeState, ticks: int, turn_rad: FloatArray
) -> AttitudeState:
    """Return the state at a sample; without attitude where the gyroscopes do not reach back to the sample before.

    With the measured turn m = turn + bias dt + noise the attitude becomes exp([m - b dt] x) times itself, the error
    delta becomes exp([m - b dt] x) delta - (error of b) dt - noise.
    """
    elapsed_s = (ticks - state.ticks) / TICKS_PER_SECOND if state.ticks >= 0 else 0.0
    covariance = state.covariance.copy()
    covariance[_BIAS, _BIAS] += np.eye(3) * parameters.gyro_walk_rad_s_sqrt_s**2 * max(elapsed_s, 0.0)
    if state.camera_from_icrf is None or elapsed_s <= 0.0 or not np.isfinite(turn_rad).all():
        covariance[_ANGLE, :] = covariance[:, _ANGLE] = 0.0
        memory = _without_angle(state.memory)
        return replace(state, ticks=ticks, camera_from_icrf=None, covariance=covariance, memory=memory)
    rotation = matrix_from_rotation_vector(turn_rad - state.bias_rad_s * elapsed_s)
    transition = np.eye(6)
    transition[_ANGLE, _ANGLE] = rotation
    transition[_ANGLE, _BIAS] = -np.eye(3) * elapsed_s
    covariance = transition @ covariance @ transition.T
    covariance[_ANGLE, _ANGLE] += np.eye(3) * parameters.gyro_noise_rad_sqrt_s**2 * elapsed_s
    return replace(
        state,
        ticks=ticks,
        camera_from_icrf=rotation @ state.camera_from_icrf,
        covariance=covariance,
        memory=transition @ state.memory,
    )


def corrected(
    parameters: StarTrackerParameters, state: AttitudeState, quality: float, q_wxyz: FloatArray
) -> tuple[AttitudeState, dict[str, object]]:
    """Return the state after a solution of the star tracker, and the fields of its telemetry."""
    length = float(np.linalg.norm(q_wxyz))
    if quality < 1.0 or not abs(length - 1.0) <= _UNIT_TOLERANCE:
        return state, _row("no_data")
    seen = matrix_from_quaternion(q_wxyz)
    tracker = _tracker_from_camera(parameters.off_zenith_rad, parameters.azimuth_rad)
    sigma = np.array([parameters.cross_sigma_rad, parameters.cross_sigma_rad, parameters.roll_sigma_rad])
    noise = (tracker.T * sigma**2) @ tracker
    if state.camera_from_icrf is None or state.refused >= parameters.refused_samples:
        covariance = state.covariance.copy()
        covariance[_ANGLE, :] = covariance[:, _ANGLE] = 0.0
        covariance[_ANGLE, _ANGLE] = noise
        # The first solution is the estimate: it has no prediction to differ from.
        started = replace(
            state,
            camera_from_icrf=seen,
            covariance=covariance,
            tracked_ticks=state.ticks,
            refused=0,
            memory=_without_angle(state.memory),
        )
        return started, _row("used")
    design = np.eye(3, 6)
    residual = rotation_vector_from_matrix(seen @ state.camera_from_icrf.T)
    spread = state.covariance[_ANGLE, _ANGLE] + noise
    row = _row("used", tracker @ residual, np.sqrt(np.diag(tracker @ spread @ tracker.T)))
    if float(residual @ np.linalg.solve(spread, residual)) > parameters.gate_sigmas**2:
        return replace(state, refused=state.refused + 1), row | {"sample_status": "gated"}
    gain = np.linalg.solve(spread, design @ state.covariance).T
    change = gain @ residual
    return (
        replace(
            state,
            camera_from_icrf=matrix_from_rotation_vector(change[_ANGLE]) @ state.camera_from_icrf,
            bias_rad_s=state.bias_rad_s + change[_BIAS],
            covariance=corrected_covariance(state.covariance, design, gain, noise),
            tracked_ticks=state.ticks,
            refused=0,
            memory=state.memory - gain @ (design @ state.memory),
        ),
        row,
    )


def attitude_of(parameters: StarTrackerParameters, state: AttitudeState, ticks: int) -> AttitudeEstimate:
    """Return the attitude at a frame; unknown without a sample at that time or with too large an uncertainty."""
    old = ticks - state.ticks > parameters.attitude_age_s * TICKS_PER_SECOND
    if state.camera_from_icrf is None or state.ticks > ticks or old:
        return AttitudeEstimate(None)
    sigma_rad = math.sqrt(float(np.max(np.linalg.eigvalsh(state.covariance[_ANGLE, _ANGLE]))))
    if not sigma_rad <= parameters.largest_sigma_rad:
        return AttitudeEstimate(None)
    return AttitudeEstimate(state.camera_from_icrf, sigma_rad)


def attitude_error(state: AttitudeState, before: FloatArray) -> AttitudeError:
    """Return how the attitude error depends on that of the frame before, whose covariance (6, 6) is given.

    With the joint covariance C = cov(error now, error then) = memory P(then), the best linear prediction of the error
    now from the attitude error then is C_aa P_aa(then)^-1, and the rest is independent of it.
    """
    now, then = state.covariance[_ANGLE, _ANGLE], before[_ANGLE, _ANGLE]
    if not then.any():
        return AttitudeError(now, np.zeros((3, 3)), now)
    joint = (state.memory @ before)[_ANGLE, _ANGLE]
    memory = np.asarray(np.linalg.solve(then, joint.T).T, dtype=np.float64)
    added = now - memory @ joint.T
    return AttitudeError(now, memory, 0.5 * (added + added.T))


def _without_angle(memory: FloatArray) -> FloatArray:
    """Return the derivatives (6, 6) with an attitude error that is independent of former errors."""
    memory = memory.copy()
    memory[_ANGLE, :] = 0.0
    return memory


def _row(
    status: str, residual_rad: FloatArray | None = None, sigma_rad: FloatArray | None = None
) -> dict[str, object]:
    names = ("cross_x", "cross_y", "roll")
    values = (_NAN,) * 3 if residual_rad is None else (residual_rad / _ARCSEC).tolist()
    sigmas = (_NAN,) * 3 if sigma_rad is None else (sigma_rad / _ARCSEC).tolist()
    return {
        "sample_status": status,
        **{f"{name}_arcsec": value for name, value in zip(names, values, strict=True)},
        **{f"{name}_sigma_arcsec": value for name, value in zip(names, sigmas, strict=True)},
    }


def _tracker_from_camera(off_zenith_rad: float, azimuth_rad: float) -> FloatArray:
    """Return the rotation (3, 3) from camera axes (right, down, forward) to cross-boresight axes and boresight."""
    sine = math.sin(off_zenith_rad)
    axis = np.array([sine * math.sin(azimuth_rad), -sine * math.cos(azimuth_rad), -math.cos(off_zenith_rad)])
    first = np.array([math.cos(azimuth_rad), math.sin(azimuth_rad), 0.0])
    return np.stack([first, np.cross(axis, first), axis])


INSTRUMENT = FlightInstrument(
    name="star_tracker",
    columns=("ticks", "quality", "q_w", "q_x", "q_y", "q_z", "turn_x_rad", "turn_y_rad", "turn_z_rad"),
    parameters=StarTrackerParameters,
    start=start,
    step=step,
    gives_attitude=True,
)
