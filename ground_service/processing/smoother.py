"""Smoothing of the on-board filter after the fact: each state corrected by everything that was seen later.

The downlinked states and covariances of the filter are run through backwards with the recursion of Rauch, Tung and
Striebel. Dynamics are the ground's own: a gravity field with Earth and Sun, an empirical acceleration that decays (the
last three numbers of a state), white acceleration for what the field leaves out, and burns as commanded. Errors that a
whole session shares (a catalogue displaced, a camera tilted) are in the filter's covariance and stay in the smoothed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lunar.constants import NANOSECONDS_PER_SECOND
from lunar.frames import rtn_from_inertial
from lunar.propagation import ForceModel, propagate_with_stm
from lunar.timescales import tdb_s_from_utc_ns

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

SIZE = 9
_POSITION, _VELOCITY, _ACCELERATION = slice(0, 3), slice(3, 6), slice(6, 9)
# A filtered state this far from what the one before it leads to (chi-square, 9 degrees of freedom: 1e-17 by chance)
# follows on something that the ground was not told of: the orbit is smoothed on either side of it.
_BROKEN = 100.0
# Over a minute the axes of the orbit turn by 3 degrees: the empirical acceleration, 1e-6 m/s^2, is held in them.
_LONGEST_STEP_S = 60.0


@dataclass(frozen=True, slots=True, eq=False)
class FilterStates:
    """States of a filter in time order, one per frame.

    Attributes
    ----------
    utc_ns
        Shape (n,).
    state
        Position (m) and velocity (m/s), Moon-centred ICRF, empirical acceleration (m/s^2; R, T, N), shape (n, 9).
    covariance
        Shape (n, 9, 9).
    """

    utc_ns: IntArray
    state: FloatArray
    covariance: FloatArray

    def __len__(self) -> int:
        return len(self.utc_ns)

    def select(self, which: NDArray[np.bool_]) -> FilterStates:
        """The states of a mask."""
        return FilterStates(self.utc_ns[which], self.state[which], self.covariance[which])

    @property
    def sigma_rtn_m(self) -> FloatArray:
        """Standard deviations of the position (n, 3): radial, transverse, normal."""
        rtn = rtn_from_inertial(self.state[:, _POSITION], self.state[:, _VELOCITY])
        block = rtn @ self.covariance[:, :3, :3] @ np.swapaxes(rtn, 1, 2)
        return np.asarray(np.sqrt(np.maximum(np.einsum("nii->ni", block), 0.0)), dtype=np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class CommandedBurn:
    """An impulsive burn as commanded: ICRF, with one sigma per axis of its execution."""

    utc_ns: int
    delta_v_m_s: FloatArray
    sigma_m_s: float


@dataclass(frozen=True, slots=True, eq=False)
class SmootherModel:
    """What the ground knows of the motion.

    Attributes
    ----------
    forces
        Gravity field with Earth and Sun.
    white_psd_m2_s3
        Spectral density of white acceleration, R, T, N: gravity beyond the degree of the field.
    markov_sigma_m_s2, correlation_s
        Standard deviation and memory of the empirical acceleration.
    burns
        In time order.
    """

    forces: ForceModel
    white_psd_m2_s3: tuple[float, float, float] = (6e-8, 3.5e-8, 3.5e-8)
    markov_sigma_m_s2: tuple[float, float, float] = (2e-6, 2e-6, 2e-6)
    correlation_s: float = 900.0
    burns: tuple[CommandedBurn, ...] = ()


def smooth(filtered: FilterStates, model: SmootherModel) -> FilterStates:
    """The states given everything that was seen, before and after.

    Where a state does not follow on the one before it (a jump of the clock, a restart, a burn nobody commanded), the
    stretches on either side are smoothed alone.

    References
    ----------
    Rauch, Tung, Striebel (1965), Maximum likelihood estimates of linear dynamic systems, AIAA Journal 3, equations
    3.28 to 3.30.
    """
    state, covariance = filtered.state.copy(), filtered.covariance.copy()
    for k in range(len(filtered) - 2, -1, -1):
        if filtered.utc_ns[k + 1] <= filtered.utc_ns[k]:
            continue
        predicted, transition, noise = _carried(
            filtered.state[k], int(filtered.utc_ns[k]), int(filtered.utc_ns[k + 1]), model
        )
        prior = transition @ filtered.covariance[k] @ transition.T + noise
        jump = filtered.state[k + 1] - predicted
        if not float(_divided(jump[None, :], prior)[0] @ jump) < _BROKEN:
            continue
        gain = _divided(filtered.covariance[k] @ transition.T, prior)
        state[k] = filtered.state[k] + gain @ (state[k + 1] - predicted)
        smoothed = filtered.covariance[k] + gain @ (covariance[k + 1] - prior) @ gain.T
        covariance[k] = 0.5 * (smoothed + smoothed.T)
    return FilterStates(filtered.utc_ns, state, covariance)


def _carried(
    state: FloatArray, from_utc_ns: int, to_utc_ns: int, model: SmootherModel
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """State (9,), transition (9, 9) and process noise (9, 9) from one instant to a later one."""
    total, noise = np.eye(SIZE), np.zeros((SIZE, SIZE))
    burns = [burn for burn in model.burns if from_utc_ns < burn.utc_ns <= to_utc_ns]
    at = from_utc_ns
    for stop, burn in [*((burn.utc_ns, burn) for burn in burns), (to_utc_ns, None)]:
        steps = max(1, int(np.ceil((stop - at) / (_LONGEST_STEP_S * NANOSECONDS_PER_SECOND))))
        step_s = (stop - at) / NANOSECONDS_PER_SECOND / steps
        start_s = float(tdb_s_from_utc_ns(at))
        for number in range(steps if step_s > 0.0 else 0):
            state, transition, added = _step(state, start_s + number * step_s, step_s, model)
            total = transition @ total
            noise = transition @ noise @ transition.T + added
        if burn is not None:
            state = state.copy()
            state[_VELOCITY] += burn.delta_v_m_s
            noise[_VELOCITY, _VELOCITY] += np.eye(3) * burn.sigma_m_s**2
        at = stop
    return state, total, noise


def _step(
    state: FloatArray, tdb_s: float, step_s: float, model: SmootherModel
) -> tuple[FloatArray, FloatArray, FloatArray]:
    position, velocity, moved = propagate_with_stm(
        tdb_s, state[_POSITION], state[_VELOCITY], step_s, model.forces, step_s=_LONGEST_STEP_S / 2.0
    )
    axes = rtn_from_inertial(position, velocity).T
    decay = float(np.exp(-step_s / model.correlation_s))
    push = np.concatenate([0.5 * step_s**2 * axes, step_s * axes])
    transition = np.zeros((SIZE, SIZE))
    transition[:6, :6], transition[:6, _ACCELERATION] = moved, push
    transition[_ACCELERATION, _ACCELERATION] = decay * np.eye(3)
    carried = np.concatenate([position, velocity, decay * state[_ACCELERATION]])
    carried[:6] += push @ state[_ACCELERATION]
    density = axes @ np.diag(model.white_psd_m2_s3) @ axes.T
    noise = np.zeros((SIZE, SIZE))
    noise[_POSITION, _POSITION] = density * step_s**3 / 3.0
    noise[_POSITION, _VELOCITY] = noise[_VELOCITY, _POSITION] = density * step_s**2 / 2.0
    noise[_VELOCITY, _VELOCITY] = density * step_s
    noise[_ACCELERATION, _ACCELERATION] = np.diag(model.markov_sigma_m_s2) ** 2 * (1.0 - decay**2)
    return carried, transition, noise


def _divided(left: FloatArray, covariance: FloatArray) -> FloatArray:
    """left covariance^-1, scaled so that metres and micrometres per second squared are of one size."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 1e-30))
    correlation = covariance / np.outer(scale, scale)
    return np.asarray(np.linalg.solve(correlation, (left / scale).T).T / scale, dtype=np.float64)
