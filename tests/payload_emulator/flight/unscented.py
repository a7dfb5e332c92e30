"""Sigma-point twin of the filter: the same states and noise, without derivatives of the projection or the orbit.

Divided differences of second order about the mean, whose covariances stay positive.

References
----------
Nørgaard, Poulsen, Ravn (2000), New developments in state estimation for nonlinear systems, Automatica 36.
"""

from dataclasses import replace

import numpy as np
from numpy import diag, sqrt

from payload_emulator.flight.navigation.filter import filter as kalman
from payload_emulator.flight.navigation.filter.attitude_monitor import RotationEvidence
from payload_emulator.flight.navigation.filter.filter import FilterState, Update
from payload_emulator.flight.navigation.sighting import look

# The best distance of the points for a Gaussian, in standard deviations.
_H = sqrt(3.0)


def _differences(centre, plus, minus):
    """Return mean (m,) of a function, and its first and second differences (m, n), from its values at the points."""
    mean = (_H**2 - plus.shape[0]) / _H**2 * centre + (plus + minus).sum(axis=0) / (2.0 * _H**2)
    second = sqrt(_H**2 - 1.0) / (2.0 * _H**2) * (plus + minus - 2.0 * centre)
    return mean, (plus - minus).T / (2.0 * _H), second.T


def predict(state, ticks, model, errors):
    """Return the state carried to another time; None where the orbit model has no orientation of the Moon."""
    transition, mean, noise = kalman.transition_to(state, ticks, model, errors)
    if transition is None:
        return None
    root, orbit = np.linalg.cholesky(state.covariance), kalman.ORBIT
    values = []
    for move in np.concatenate([np.zeros((1, 9)), _H * root[orbit, orbit].T, -_H * root[orbit, orbit].T]):
        flown = model.propagate(state.mean[orbit] + move, state.ticks, ticks)
        if flown is None:
            return None
        values.append(flown.state)
    mean[orbit], first, second = _differences(values[0], np.array(values[1:10]), np.array(values[10:]))
    spread = root.copy()
    common = slice(orbit.stop, kalman.SIZE)
    spread[common] = transition[common, common] @ root[common]
    spread[orbit, orbit] = first
    covariance = spread @ spread.T
    covariance[orbit, orbit] += second @ second.T
    covariance[: kalman.SIZE, : kalman.SIZE] += noise
    return FilterState(ticks, mean, 0.5 * (covariance + covariance.T), state.craters)


def update(prior, camera_from_icrf, mcmf_from_icrf, landmarks, index, uv_px, variance_px2, camera, errors):
    """Return the state after sightings of known craters; None where the numbers allow none."""
    prior = prior.with_craters(kalman.TURN, np.full((1, 3), errors.attitude_noise_rad))
    turn = int(prior.slots(kalman.TURN)[0])
    turns = slice(turn, turn + 3)

    def seen(mean):
        moved = replace(prior, mean=mean)
        pose = kalman.pose_of(moved, camera_from_icrf, mcmf_from_icrf)
        return look(landmarks, index, pose, camera, moved.shifts(index)).uv_px.reshape(-1)

    root = np.linalg.cholesky(prior.covariance)
    points = [np.array([seen(prior.mean + sign * _H * move) for move in root.T]) for sign in (1.0, -1.0)]
    expected, first, second = _differences(seen(prior.mean), *points)
    noise = diag(np.repeat(variance_px2, 2)) + second @ second.T
    spread = first @ first.T + noise
    innovation = uv_px.reshape(-1) - expected
    if not (np.all(np.isfinite(innovation)) and np.all(np.isfinite(spread))):
        return None
    gain = np.linalg.solve(spread, first @ root.T).T
    mean = prior.mean + gain @ innovation
    reduced = root - gain @ first
    covariance = reduced @ reduced.T + gain @ noise @ gain.T
    state = FilterState(prior.ticks, mean, 0.5 * (covariance + covariance.T), prior.craters)
    turning = first @ root[turns].T / errors.attitude_noise_rad**2
    solved = np.linalg.solve(spread, np.column_stack([innovation, turning]))
    summed = spread.reshape(index.size, 2, index.size, 2).sum(axis=(0, 2))
    attitude, both = np.r_[kalman.ATTITUDE, turns], np.tile(np.eye(3), 2)
    left = both @ covariance[np.ix_(attitude, attitude)] @ both.T
    judged, noise_score = kalman._judged(spread, innovation, np.repeat(variance_px2, 2))
    return Update(
        state.only_craters(state.craters[state.craters != kalman.TURN[0]]), float(innovation @ solved[:, 0]),
        innovation.reshape(-1, 2).sum(axis=0) / sqrt(diag(summed)), uv_px - seen(mean).reshape(-1, 2),
        mean[turns], float(sqrt(np.max(np.linalg.eigvalsh(left)))),
        RotationEvidence(turning.T @ solved[:, 0], turning.T @ solved[:, 1:], errors.attitude_noise_rad),
        judged, noise_score=noise_score
    )  # fmt: skip
