"""Rauch-Tung-Striebel smoother of the states of the on-board filter, and the baselines without images.

The recursion runs backwards over the downlinked states and covariances of the filter. The ground uses its own dynamics:
a gravity field with Earth and Sun, an empirical acceleration that decays exponentially (the last three elements of a
state), white acceleration for the gravity that the field omits, and commanded burns. Errors common to a whole session
(a catalogue offset, a camera misalignment) are part of the filter's covariance and remain in the smoothed covariance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ground_service.errors import EvaluationError
from ground_service.evaluation import alignment
from lunar.arrays import FloatArray, IntArray
from lunar.constants import NS
from lunar.frames import ICRF, Orientation, icrf_from_onboard, rtn_from_inertial
from lunar.gravity import GravityField
from lunar.gravity_omission import FieldNoise, densities_at, field_noise
from lunar.propagation import ForceModel, propagate, propagate_with_stm
from lunar.timescales import tdb_s_from_utc_ns
from reports.values import NavigationSeries

SIZE = 9
ONBOARD = "inertial axes of the payload"
_POSITION, _VELOCITY, _ACCELERATION = slice(0, 3), slice(3, 6), slice(6, 9)
# Limit of the squared Mahalanobis distance between a filtered state and its prediction from the preceding state (9
# degrees of freedom: exceeded by chance with a probability of 1e-17). A larger distance indicates an event unknown to
# the ground, so the segments before and after it are smoothed separately.
_BROKEN = 100.0
# The R/T/N axes rotate by 3 degrees per minute: within a step, the empirical acceleration (1e-6 m/s^2) is constant.
_LONGEST_STEP_S = 60.0


@dataclass(frozen=True, slots=True, eq=False)
class FilterStates:
    """States of a filter in time order, one per frame.

    Attributes
    ----------
    utc_ns
        Time tags, shape (n,).
    state
        Position (m) and velocity (m/s), Moon-centred in the axes `frame`, empirical acceleration (m/s^2; R, T, N),
        shape (n, 9).
    covariance
        Shape (n, 9, 9).
    frame
        `ICRF`, or `ONBOARD`: the inertial axes that follow from the lunar orientation of the payload.
    innovation_degrees
        Degrees of freedom of the normalised innovation squared of each frame, 0 without a fix, -1 if unknown, shape
        (n,); None for states that do not belong to frames.
    """

    utc_ns: IntArray
    state: FloatArray
    covariance: FloatArray
    frame: str
    innovation_degrees: IntArray | None = None

    def __len__(self) -> int:
        return len(self.utc_ns)

    def select(self, which: NDArray[np.bool_]) -> FilterStates:
        """Return the states that a mask selects."""
        degrees = None if self.innovation_degrees is None else self.innovation_degrees[which]
        return FilterStates(self.utc_ns[which], self.state[which], self.covariance[which], self.frame, degrees)

    def in_icrf(self, orientation: Orientation, onboard: Orientation) -> FilterStates:
        """Return states of the payload, whose lunar orientation is `onboard`, turned into ICRF by that of the pass."""
        assert self.frame == ONBOARD
        tdb_s = np.asarray(tdb_s_from_utc_ns(self.utc_ns), dtype=np.float64)
        turn = icrf_from_onboard(orientation.mcmf_from_icrf(tdb_s), onboard.mcmf_from_icrf(tdb_s))
        state, jacobian = self.state.copy(), np.tile(np.eye(SIZE), (len(self), 1, 1))
        for part in (_POSITION, _VELOCITY):
            state[:, part] = np.einsum("nij,nj->ni", turn, state[:, part])
            jacobian[:, part, part] = turn
        covariance = jacobian @ self.covariance @ np.swapaxes(jacobian, 1, 2)
        return FilterStates(self.utc_ns, state, covariance, ICRF, self.innovation_degrees)

    @property
    def position_covariance_rtn_m2(self) -> FloatArray:
        """Return the position covariance (n, 3, 3) in radial, transverse and normal axes of each state."""
        rtn = rtn_from_inertial(self.state[:, _POSITION], self.state[:, _VELOCITY])
        block = rtn @ self.covariance[:, _POSITION, _POSITION] @ np.swapaxes(rtn, 1, 2)
        return np.asarray(block, dtype=np.float64)

    @property
    def sigma_rtn_m(self) -> FloatArray:
        """Return the standard deviations of the position (n, 3): radial, transverse, normal."""
        variance = np.einsum("nii->ni", self.position_covariance_rtn_m2)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)), dtype=np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class CommandedBurn:
    """Commanded impulsive burn: delta-v in ICRF and execution error per axis (1 sigma)."""

    utc_ns: int
    delta_v_m_s: FloatArray
    sigma_m_s: float


@dataclass(frozen=True, slots=True)
class MapOffset:
    """Offset that all craters of the list have in common, 1 sigma east, north, up, and the arc of its memory (1/e)."""

    sigma_enu_m: tuple[float, float, float]
    correlation_deg: float


@dataclass(frozen=True, slots=True, eq=False)
class SmootherModel:
    """Force model and process noise of the smoother.

    Attributes
    ----------
    forces
        Gravity field with Earth and Sun.
    white_psd_m2_s3
        Power spectral density of the white acceleration (R, T, N), if there is no `field_noise`.
    field_noise
        Error of the gravity field by side of the Moon, inclination and altitude, as white acceleration. It must be that
        of the filter: with less noise over a coast than the filter had, the states before the coast count too much.
    markov_sigma_m_s2, correlation_s
        Standard deviation (R, T, N) and correlation time of the empirical acceleration.
    burns
        Commanded burns in time order.
    map_sigma_rtn_m, map_correlation_rad
        Shift of the map that the positions of the filter contain, and the angle at the Moon's centre over which it is
        similar (1/e): positions over other ground have another shift, which looks like noise of the motion.
    """

    forces: ForceModel
    white_psd_m2_s3: tuple[float, float, float] = (6e-8, 3.5e-8, 3.5e-8)
    markov_sigma_m_s2: tuple[float, float, float] = (2e-6, 2e-6, 2e-6)
    correlation_s: float = 900.0
    burns: tuple[CommandedBurn, ...] = ()
    field_noise: FieldNoise | None = None
    map_sigma_rtn_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    map_correlation_rad: float = 1.0

    def densities(self, tdb_s: FloatArray, state: FloatArray) -> FloatArray:
        """Return the spectral densities (n, 3; R, T, N) at times (n,) in states (n, 9)."""
        if self.field_noise is None:
            return np.tile(self.white_psd_m2_s3, (len(state), 1))
        rotation = self.forces.orientation.mcmf_from_icrf(tdb_s)
        position = np.einsum("nij,nj->ni", rotation, state[:, _POSITION])
        return densities_at(self.field_noise, position, np.einsum("nij,nj->ni", rotation, state[:, _VELOCITY]))


def smooth(filtered: FilterStates, model: SmootherModel) -> FilterStates:
    """Return the states estimated from all measurements, earlier and later.

    Where a state does not follow from the preceding one (clock jump, restart, uncommanded burn), the segments before
    and after it are smoothed separately.

    Raises
    ------
    EvaluationError
        The states are not in ICRF, the axes of the force model.

    References
    ----------
    Rauch, Tung, Striebel (1965), Maximum likelihood estimates of linear dynamic systems, AIAA Journal 3, equations
    3.28 to 3.30.
    """
    if filtered.frame != ICRF:
        raise EvaluationError(f"smoother: expected states in {ICRF}, found {filtered.frame}")
    state, covariance = filtered.state.copy(), filtered.covariance.copy()
    before = np.flatnonzero(np.diff(filtered.utc_ns) > 0)
    known, known_covariance = filtered.state[before], filtered.covariance[before]
    predicted, transition, noise = _carried(known, filtered.utc_ns[before], filtered.utc_ns[before + 1], model)
    moved = transition @ known_covariance
    prior = moved @ _turned(transition) + noise
    jump = (filtered.state[before + 1] - predicted)[:, None, :]
    surprise = (_divided(jump, prior) @ _turned(jump))[:, 0, 0]
    gain = _divided(_turned(moved), prior)
    for row in np.flatnonzero(surprise < _BROKEN)[::-1]:
        k = before[row]
        state[k] = filtered.state[k] + gain[row] @ (state[k + 1] - predicted[row])
        smoothed = filtered.covariance[k] + gain[row] @ (covariance[k + 1] - prior[row]) @ gain[row].T
        covariance[k] = 0.5 * (smoothed + smoothed.T)
    return FilterStates(filtered.utc_ns, state, covariance, filtered.frame)


def _turned(matrices: FloatArray) -> FloatArray:
    return np.swapaxes(matrices, -1, -2)


def _carried(
    state: FloatArray, from_utc_ns: IntArray, to_utc_ns: IntArray, model: SmootherModel
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return states (n, 9), transition matrices and process noise (n, 9, 9 each), propagated over n intervals."""
    state = state.copy()
    total = np.tile(np.eye(SIZE), (len(state), 1, 1))
    noise = np.zeros((len(state), SIZE, SIZE))
    starts_s = np.asarray(tdb_s_from_utc_ns(from_utc_ns), dtype=np.float64)
    legs = [
        _legs(start, stop, start_s, model.burns)
        for start, stop, start_s in zip(from_utc_ns.tolist(), to_utc_ns.tolist(), starts_s.tolist(), strict=True)
    ]
    lengths = np.array([len(one) for one in legs], dtype=np.int64)
    for number in range(int(lengths.max(initial=0))):
        rows = np.flatnonzero(lengths > number)
        starts, steps, burns = zip(*(legs[row][number] for row in rows), strict=True)
        state[rows], transition, added = _step(state[rows], np.array(starts), np.array(steps), model)
        total[rows] = transition @ total[rows]
        noise[rows] = transition @ noise[rows] @ _turned(transition) + added
        for row, burn in zip(rows, burns, strict=True):
            if burn is not None:
                state[row, _VELOCITY] += burn.delta_v_m_s
                noise[row, _VELOCITY, _VELOCITY] += np.eye(3) * burn.sigma_m_s**2
    return state, total, noise


def _legs(
    from_utc_ns: int, to_utc_ns: int, start_s: float, burns: tuple[CommandedBurn, ...]
) -> list[tuple[float, float, CommandedBurn | None]]:
    """Return start (TDB seconds), length (s) and final burn, if any, of every integration step of an interval.

    ``start_s`` is the start of the interval in TDB seconds.
    """
    legs: list[tuple[float, float, CommandedBurn | None]] = []
    at = from_utc_ns
    between = [burn for burn in burns if from_utc_ns < burn.utc_ns <= to_utc_ns]
    for stop, burn in [*((burn.utc_ns, burn) for burn in between), (to_utc_ns, None)]:
        count = max(1, int(np.ceil((stop - at) / (_LONGEST_STEP_S * NS))))
        step_s = (stop - at) / NS / count
        if step_s > 0.0 or burn is not None:
            if at != from_utc_ns:
                start_s = float(tdb_s_from_utc_ns(at))
            legs += [(start_s + i * step_s, step_s, burn if i == count - 1 else None) for i in range(count)]
        at = stop
    return legs


def _step(
    state: FloatArray, tdb_s: FloatArray, step_s: FloatArray, model: SmootherModel
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return states (n, 9) after one step each (n,), with transition matrices and process noise (n, 9, 9 each)."""
    position, velocity = np.empty((len(state), 3)), np.empty((len(state), 3))
    transition = np.zeros((len(state), SIZE, SIZE))
    for row, (one, start, length) in enumerate(zip(state, tdb_s.tolist(), step_s.tolist(), strict=True)):
        position[row], velocity[row], transition[row, :6, :6] = propagate_with_stm(
            start, one[_POSITION], one[_VELOCITY], length, model.forces, step_s=_LONGEST_STEP_S / 2.0
        )
    axes = _turned(rtn_from_inertial(position, velocity))
    decay = np.exp(-step_s / model.correlation_s)
    length = step_s[:, None, None]
    push = np.concatenate([0.5 * length**2 * axes, length * axes], axis=1)
    transition[:, :6, _ACCELERATION] = push
    transition[:, _ACCELERATION, _ACCELERATION] = decay[:, None, None] * np.eye(3)
    carried = np.concatenate([position, velocity, decay[:, None] * state[:, _ACCELERATION]], axis=1)
    carried[:, :6] += (push @ state[:, _ACCELERATION, None])[..., 0]
    density = (axes * model.densities(tdb_s, state)[:, None, :]) @ _turned(axes)
    noise = np.zeros((len(state), SIZE, SIZE))
    noise[:, _POSITION, _POSITION] = density * length**3 / 3.0
    noise[:, _POSITION, _VELOCITY] = noise[:, _VELOCITY, _POSITION] = density * length**2 / 2.0
    noise[:, _VELOCITY, _VELOCITY] = density * length
    cosine = np.einsum("ni,ni->n", position, state[:, _POSITION])
    cosine /= np.linalg.norm(position, axis=1) * np.linalg.norm(state[:, _POSITION], axis=1)
    turned_rad = np.arccos(np.clip(cosine, -1.0, 1.0))
    renewed = (1.0 - np.exp(-2.0 * turned_rad / model.map_correlation_rad))[:, None]
    shift = renewed * np.square(model.map_sigma_rtn_m)
    noise[:, _POSITION, _POSITION] += (axes * shift[:, None, :]) @ _turned(axes)
    noise[:, _ACCELERATION, _ACCELERATION] = np.diag(model.markov_sigma_m_s2) ** 2 * (1.0 - decay[:, None, None] ** 2)
    return carried, transition, noise


def _divided(left: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return left @ covariance^-1 of stacked matrices, scaled for elements that differ by orders of magnitude."""
    scale = np.sqrt(np.maximum(np.einsum("nii->ni", covariance), 1e-30))
    correlation = covariance / (scale[:, :, None] * scale[:, None, :])
    solved = np.linalg.solve(correlation, _turned(left / scale[:, None, :]))
    return np.asarray(_turned(solved) / scale[:, None, :], dtype=np.float64)


BASELINE_DEGREE = 50
"""Degree of the propagate-only baseline: what a flight computer can afford."""


@dataclass(frozen=True, slots=True, eq=False)
class StartState:
    """The state that the estimators were started from, Moon-centred ICRF."""

    utc_ns: int
    position_icrf_m: FloatArray
    velocity_icrf_m_s: FloatArray


def propagated_positions(
    start: StartState,
    utc_ns: IntArray,
    gravity: GravityField,
    degree: int,
    orientation: Orientation,
    *,
    third_bodies: bool = True,
) -> FloatArray:
    """Return the ICRF positions (n, 3) of the start state flown on to `utc_ns` (n,), ascending; NaN before the start.

    Degree 0 without third bodies is the two-body (Kepler) orbit.

    Raises
    ------
    ImpactError
        If the orbit meets the ground.
    """
    positions = np.full((len(utc_ns), 3), np.nan)
    after = np.asarray(utc_ns) >= start.utc_ns
    if not after.any():
        return positions
    epoch = float(tdb_s_from_utc_ns(start.utc_ns))
    tdb_s = np.asarray(tdb_s_from_utc_ns(np.asarray(utc_ns)[after]), dtype=np.float64)
    duration_s = float(tdb_s[-1] - epoch)
    if duration_s <= 0.0:
        positions[after] = start.position_icrf_m
        return positions
    model = ForceModel(
        gravity=gravity,
        degree=min(degree, gravity.degree),
        orientation=orientation,
        earth=third_bodies,
        sun=third_bodies,
    )
    trajectory = propagate(epoch, start.position_icrf_m, start.velocity_icrf_m_s, duration_s, model)
    positions[after] = trajectory.state(np.minimum(tdb_s, trajectory.stop_tdb_s))[:, :3]
    return positions


SMOOTHED = "smoothed"
SMOOTHER_DEGREE = 100
UNSTATED_OFFSET = MapOffset((40.0, 40.0, 10.0), 30.0)
"""Offset of the payloads that were flown before the mission description stated one."""


def smoother_model(
    gravity: GravityField, orientation: Orientation, burns: tuple[CommandedBurn, ...], offset: MapOffset | None = None
) -> SmootherModel:
    """Return the smoother's model of the motion, with gravity to `SMOOTHER_DEGREE` or the degree of the field.

    The process noise is that of the filter: of the field, by its name, and of the map; None: `UNSTATED_OFFSET`.
    """
    offset = UNSTATED_OFFSET if offset is None else offset
    east_m, north_m, up_m = offset.sigma_enu_m
    degree = min(SMOOTHER_DEGREE, gravity.degree)
    return SmootherModel(
        ForceModel(gravity, orientation, degree),
        burns=burns,
        field_noise=field_noise(gravity.name, degree),
        map_sigma_rtn_m=(up_m, north_m, east_m),
        map_correlation_rad=math.radians(offset.correlation_deg),
    )


def smoothed_series(
    filtered: FilterStates,
    track: alignment.ReferenceStates,
    path_m: FloatArray,
    model: SmootherModel,
    reference_covariance_m2: FloatArray,
) -> NavigationSeries | None:
    """Return the errors of the smoothed orbit relative to the reference; None with fewer than two states.

    Parameters
    ----------
    filtered
        States in ICRF.
    track
        Reference at the times of `filtered`.
    path_m
        Length of the ground path up to each time (n,).
    reference_covariance_m2
        Covariance of the reference (3, 3), R/T/N, which the NEES adds to that of the estimate.
    """
    if len(filtered) < 2:
        return None
    smoothed = smooth(filtered, model)
    position = smoothed.state[:, :3]
    latitude, longitude, altitude = alignment.places_of_positions(track, position)
    error = alignment.error_of_positions_rtn_m(track, position)
    never = np.zeros(len(filtered), dtype=np.bool_)
    return NavigationSeries(
        name=SMOOTHED,
        kind=SMOOTHED,
        utc_ns=filtered.utc_ns,
        latitude_deg=latitude,
        longitude_deg=longitude,
        altitude_m=altitude,
        error_rtn_m=error,
        sigma_rtn_m=smoothed.sigma_rtn_m,
        statistics=alignment.navigation_statistics(error, path_m, never),
        description=(
            f"the filter smoothed on the ground with {model.forces.gravity.name} to degree "
            f"{model.forces.degree}, Earth and Sun"
        ),
        nees=alignment.nees(error, smoothed.position_covariance_rtn_m2 + reference_covariance_m2),
        drift_by_length=alignment.drift_by_length(error, path_m, never),
    )
