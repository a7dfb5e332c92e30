"""Extended Kalman filter of orbit, common errors and the craters in view, iterated, covariance in Joseph form.

The first 18 states are position and velocity (ICRF), empirical acceleration (radial, transverse, normal), attitude
bias (camera axes), pixel bias, catalogue offset (east, north, up) and image scale. They are followed by three states
for each crater that was used and is still in view: its offset from its catalogued position, east, north, up. A crater
is observed several times on a pass with the same error, so its error is a state and not independent noise. It begins
with the catalogue offset of that time, which changes along the track for craters that come into view later, and ends
when the crater leaves the view. The attitude error of a frame, one rotation for all its detections, is a state
during an update: it is observable in a wide field of view, and the projection is too nonlinear over a degree to treat
it as noise about the measured attitude.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from lunar.arrays import FloatArray, IntArray
from lunar.camera import PinholeCamera
from payload_emulator.flight.navigation.filter.attitude_monitor import RotationEvidence
from payload_emulator.flight.navigation.filter.dynamics import OrbitModel
from payload_emulator.flight.navigation.sighting import LandmarkMap, Pose, Sighting, look
from tmtc.packets.pus import TICKS_PER_SECOND

SIZE = 18
POSITION, VELOCITY, ACCELERATION = slice(0, 3), slice(3, 6), slice(6, 9)
ATTITUDE, PIXEL, OFFSET, SCALE = slice(9, 12), slice(12, 14), slice(14, 17), 17
ORBIT = slice(0, 9)
LEARNED = slice(14, 16)
"""The offset of the catalogue east and north, whose size is learned in flight."""
TURN: IntArray = np.array([-2], dtype=np.int64)
"""Stands among the craters of a state for the rotation that the attitude of the frame is off by."""

# Projection bends by the square of a move over the altitude: after one this small another iteration gains millimetres.
_LINEAR_M = 10.0
# The same for a turn: at the corner of the image 1e-3 rad bend by a twentieth of a pixel.
_LINEAR_RAD = 1e-3


@dataclass(frozen=True, slots=True)
class CommonErrors:
    """Errors shared by the sightings of a frame and of its neighbours, one sigma, with their memory.

    Attributes
    ----------
    attitude_noise_rad
        Star tracker noise of one frame, per axis.
    attitude_bias_rad, attitude_correlation_s
        Slow part: alignment, thermal bending.
    pixel_bias_px, pixel_correlation_s
        Shift of all detections of a frame, as an uneven response to slanting light causes, for as long as the light
        stays: 0.09 px at most in the mean over five windows of the tuning terrain (docs/results/navigation.md), which
        0.05 px exceed in one of ten draws. Innovations cannot show it and it is nearly the same as a shift of the
        position: a larger value lets position and bias wander together.
    catalogue_offset_m, catalogue_correlation_rad
        What registration and raster leave, east, north, up: a Gauss-Markov process over the ground, and the angle at
        the Moon's centre over which it is similar (1/e). Chosen on tuning ground, with a distorted map and without.
    noise_factor
        Factor on the standard deviation of the part of a detection's error that is new in every frame, as learned.
    scale, scale_sigma
        Stretch of all detections about the image centre as calibrated, and how well it is known; it does not change.
        A single pass cannot tell it from an error of altitude: the periods of several orbits can.
    """

    attitude_noise_rad: float = float(np.radians(0.01))
    attitude_bias_rad: float = float(np.radians(0.01))
    attitude_correlation_s: float = 14_400.0
    pixel_bias_px: float = 0.05
    pixel_correlation_s: float = 14_400.0
    catalogue_offset_m: tuple[float, float, float] = (40.0, 40.0, 10.0)
    catalogue_correlation_rad: float = float(np.radians(30.0))
    scale: float = 0.0
    scale_sigma: float = 5e-4
    noise_factor: float = field(default=1.0, repr=False)


@dataclass(frozen=True, slots=True, eq=False)
class Slope:
    """Derivatives of mean (n,) and covariance (n, n) by the logarithm of the variance of the catalogue offset."""

    mean: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class FilterState:
    """Estimate (18 + 3 m,) and covariance at an on-board time, with the m craters among the states.

    Attributes
    ----------
    craters
        Indices into the map, shape (m,).
    slope
        Derivatives by the size of the catalogue offset; None where that is not learned.
    """

    ticks: int
    mean: FloatArray
    covariance: FloatArray
    craters: IntArray
    slope: Slope | None = None

    @property
    def position_sigma_m(self) -> float:
        """Standard deviation of the position in its worst direction."""
        return float(np.sqrt(np.max(np.linalg.eigvalsh(self.covariance[POSITION, POSITION]))))

    @property
    def finite(self) -> bool:
        return bool(np.all(np.isfinite(self.mean)) and np.all(np.isfinite(self.covariance)))

    def slots(self, index: IntArray) -> IntArray:
        """Return the place of the first of the three states of each given crater, -1 where it has none."""
        if not self.craters.size:
            return np.full(index.size, -1, dtype=np.int64)
        order = np.argsort(self.craters)
        at = np.minimum(np.searchsorted(self.craters[order], index), order.size - 1)
        found = self.craters[order[at]] == index
        return np.where(found, SIZE + 3 * order[at], -1)

    def shifts(self, index: IntArray) -> FloatArray:
        """Return how far each given crater, shape (n, 3), lies from its catalogued place beyond the common offset.

        Zero where it is not estimated.
        """
        slots = self.slots(index)
        values = self.mean[np.maximum(slots, 0)[:, None] + np.arange(3)] - self.mean[OFFSET]
        return np.where(slots[:, None] >= 0, values, 0.0)

    def with_craters(self, index: IntArray, sigma_m: FloatArray) -> FilterState:
        """Return the state with the given craters among its states; new ones where the common offset has them.

        `sigma_m`, shape (n, 3), is what a crater may be off by beyond that offset.
        """
        new = self.slots(index) < 0
        count, size = int(np.count_nonzero(new)), self.mean.size
        if not count:
            return self
        # A copy of the offset for each crater, which it keeps while the offset changes along the track.
        places = np.concatenate([np.arange(size), np.tile(np.arange(OFFSET.start, OFFSET.stop), count)])
        part = np.concatenate([np.ones(size), np.repeat(index[new] != TURN[0], 3)])
        both, shared = np.ix_(places, places), part[:, None] * part
        covariance, rest = self.covariance[both] * shared, np.arange(size, size + 3 * count)
        covariance[rest, rest] += sigma_m[new].reshape(-1) ** 2
        mean, slope = self.mean[places] * part, self.slope
        if slope is not None:
            slope = Slope(slope.mean[places] * part, slope.covariance[both] * shared)
        return FilterState(self.ticks, mean, covariance, np.concatenate([self.craters, index[new]]), slope)

    def only_craters(self, keep: IntArray) -> FilterState:
        """Return the state without the craters that are not among the given ones."""
        kept = np.isin(self.craters, keep)
        if kept.all():
            return self
        slots = SIZE + 3 * np.flatnonzero(kept)
        places = np.concatenate([np.arange(SIZE), (slots[:, None] + np.arange(3)).reshape(-1)])
        both, slope = np.ix_(places, places), self.slope
        if slope is not None:
            slope = Slope(slope.mean[places], slope.covariance[both])
        return FilterState(self.ticks, self.mean[places], self.covariance[both], self.craters[kept], slope)

    def with_offset(self, old_m: float, new_m: float) -> FilterState:
        """Return the state with the offset of the catalogue, east and north, scaled from one size to another."""
        if old_m == new_m:
            return self
        scale = np.ones(self.mean.size)
        scale[LEARNED] = new_m / old_m
        both = scale[:, None] * scale
        slope = None if self.slope is None else Slope(self.slope.mean * scale, self.slope.covariance * both)
        return replace(self, mean=self.mean * scale, covariance=self.covariance * both, slope=slope)


@dataclass(frozen=True, slots=True, eq=False)
class Update:
    """Estimate after a frame, with the innovations that led to it.

    Attributes
    ----------
    nis
        Normalised innovation squared over all used sightings.
    mean_innovation
        Mean of detection minus prediction, right and down, over its standard deviation, shape (2,).
    residual_px
        Detection minus prediction after the update, shape (n, 2).
    attitude_rad, attitude_sigma_rad
        Rotation that the attitude of the frame is off by beyond what lasts, shape (3,), and what is left uncertain of
        it and of what lasts about the worst axis.
    rotation
        What the innovations say about a rotation of the camera.
    contradiction
        Squared normalised innovation of each sighting after the update with all the others, shape (n,): chi-square of
        two degrees of freedom.
    score
        Derivative of the log-likelihood of the innovations by the logarithm of the variance of the catalogue offset,
        and its expected square; 0, 0 where that is not learned.
    noise_score
        The same for the logarithm of the factor on the variances of all detections.
    """

    state: FilterState
    nis: float
    mean_innovation: FloatArray
    residual_px: FloatArray
    attitude_rad: FloatArray
    attitude_sigma_rad: float
    rotation: RotationEvidence
    contradiction: FloatArray
    score: tuple[float, float] = (0.0, 0.0)
    noise_score: tuple[float, float] = (0.0, 0.0)


class KalmanFilter(Protocol):
    """Prediction and correction of a filter state, as in this module; a replacement is a module with the same two."""

    def predict(
        self, state: FilterState, ticks: int, model: OrbitModel, errors: CommonErrors
    ) -> FilterState | None: ...

    def update(
        self,
        prior: FilterState,
        camera_from_icrf: FloatArray,
        mcmf_from_icrf: FloatArray,
        landmarks: LandmarkMap,
        index: IntArray,
        uv_px: FloatArray,
        variance_px2: FloatArray,
        camera: PinholeCamera,
        errors: CommonErrors,
    ) -> Update | None: ...


def initial_filter_state(
    ticks: int,
    position_icrf_m: FloatArray,
    velocity_icrf_m_s: FloatArray,
    sigma_position_m: float,
    sigma_velocity_m_s: float,
    markov_sigma_m_s2: tuple[float, float, float],
    errors: CommonErrors,
    learns_offset: bool = False,
) -> FilterState:
    """Return the state that starts the filter: common errors as calibrated, with their full uncertainty."""
    mean = np.zeros(SIZE)
    mean[POSITION], mean[VELOCITY], mean[SCALE] = position_icrf_m, velocity_icrf_m_s, errors.scale
    sigma = np.concatenate(
        [
            np.full(3, sigma_position_m),
            np.full(3, sigma_velocity_m_s),
            np.array(markov_sigma_m_s2),
            np.full(3, errors.attitude_bias_rad),
            np.full(2, errors.pixel_bias_px),
            np.array(errors.catalogue_offset_m),
            np.array([errors.scale_sigma]),
        ]
    )
    state = FilterState(ticks, mean, np.diag(sigma**2), np.empty(0, dtype=np.int64))
    if not learns_offset:
        return state
    by_size = np.zeros((SIZE, SIZE))
    by_size[LEARNED, LEARNED] = state.covariance[LEARNED, LEARNED]
    return replace(state, slope=Slope(np.zeros(SIZE), by_size))


def predict(state: FilterState, ticks: int, model: OrbitModel, errors: CommonErrors) -> FilterState | None:
    """Return the state carried to another time, None where the orbit model has no orientation of the Moon."""
    transition, mean, noise = transition_to(state, ticks, model, errors)
    if transition is None:
        return None
    slope = state.slope
    if slope is not None:
        renewed = np.zeros_like(noise)
        renewed[LEARNED, LEARNED] = noise[LEARNED, LEARNED]
        moved = slope.mean.copy()
        moved[:SIZE] = transition @ moved[:SIZE]
        slope = Slope(moved, _carried(slope.covariance, transition, renewed))
    return FilterState(ticks, mean, _carried(state.covariance, transition, noise), state.craters, slope)


def _carried(covariance: FloatArray, transition: FloatArray, noise: FloatArray) -> FloatArray:
    """Return a covariance (n, n) after the transition (18, 18) of its first states with their noise, symmetric."""
    covariance = covariance.copy()
    covariance[:SIZE] = transition @ covariance[:SIZE]
    covariance[:, :SIZE] = covariance[:, :SIZE] @ transition.T
    covariance[:SIZE, :SIZE] += noise
    return np.asarray(0.5 * (covariance + covariance.T), dtype=np.float64)


def burn(state: FilterState, delta_v_icrf_m_s: FloatArray, sigma_m_s: float) -> FilterState:
    """Return the state after an impulsive burn (3,) that was carried out to a standard deviation per axis."""
    mean, covariance = state.mean.copy(), state.covariance.copy()
    mean[VELOCITY] += delta_v_icrf_m_s
    covariance[VELOCITY, VELOCITY] += np.eye(3) * sigma_m_s**2
    return replace(state, mean=mean, covariance=covariance)


def widened(state: FilterState, sigma_position_m: float, sigma_velocity_m_s: float) -> FilterState:
    """Return the state with more uncertainty per axis: after a restart, an old state, a burn of unknown size."""
    covariance = state.covariance.copy()
    covariance[POSITION, POSITION] += np.eye(3) * sigma_position_m**2
    covariance[VELOCITY, VELOCITY] += np.eye(3) * sigma_velocity_m_s**2
    return replace(state, covariance=covariance)


def transition_to(
    state: FilterState, ticks: int, model: OrbitModel, errors: CommonErrors
) -> tuple[FloatArray | None, FloatArray, FloatArray]:
    """Return transition (18, 18; None outside the orientation table), propagated mean and process noise (18, 18)."""
    orbit = model.propagate(state.mean[ORBIT], state.ticks, ticks)
    transition, noise, mean = np.eye(SIZE), np.zeros((SIZE, SIZE)), state.mean.copy()
    if orbit is None:
        return None, mean, noise
    transition[ORBIT, ORBIT], noise[ORBIT, ORBIT], mean[ORBIT] = orbit.transition, orbit.noise, orbit.state
    elapsed_s = abs(ticks - state.ticks) / TICKS_PER_SECOND
    lengths = np.linalg.norm(state.mean[POSITION]) * np.linalg.norm(mean[POSITION])
    turned_rad = float(np.arccos(np.clip(state.mean[POSITION] @ mean[POSITION] / lengths, -1.0, 1.0)))
    for part, sigma, memories in (
        (ATTITUDE, errors.attitude_bias_rad, elapsed_s / errors.attitude_correlation_s),
        (PIXEL, errors.pixel_bias_px, elapsed_s / errors.pixel_correlation_s),
        (OFFSET, np.array(errors.catalogue_offset_m), turned_rad / errors.catalogue_correlation_rad),
    ):
        decay = float(np.exp(-memories))
        diagonal = np.arange(part.start, part.stop)
        transition[diagonal, diagonal] = decay
        noise[diagonal, diagonal] = np.square(sigma) * (1.0 - decay**2)
        mean[part] *= decay
    return transition, mean, noise


def pose_of(state: FilterState, camera_from_icrf: FloatArray, mcmf_from_icrf: FloatArray) -> Pose:
    """Return the camera pose that a filter state stands for."""
    mean, turn = state.mean, int(state.slots(TURN)[0])
    return Pose(
        mean[POSITION],
        camera_from_icrf,
        mcmf_from_icrf,
        mean[ATTITUDE] if turn < 0 else mean[ATTITUDE] + mean[turn : turn + 3],
        mean[PIXEL],
        mean[OFFSET],
        float(mean[SCALE]),
    )


def design_matrix(sighting: Sighting, state: FilterState) -> FloatArray:
    """Return the derivatives of all predicted pixels by all states, shape (n, 2, 18 + 3 m)."""
    matrix = np.zeros((len(sighting), 2, state.mean.size))
    matrix[:, :, POSITION] = sighting.by_position
    matrix[:, :, ATTITUDE] = sighting.by_attitude
    matrix[:, 0, PIXEL.start] = matrix[:, 1, PIXEL.start + 1] = 1.0
    matrix[:, :, SCALE] = sighting.by_scale
    slots = state.slots(sighting.index)
    known = np.flatnonzero(slots >= 0)
    matrix[slots < 0, :, OFFSET] = sighting.by_offset[slots < 0]
    for axis in range(3):
        matrix[known, :, slots[known] + axis] = sighting.by_offset[known, :, axis]
    turn = int(state.slots(TURN)[0])
    if turn >= 0:
        matrix[:, :, turn : turn + 3] = sighting.by_attitude
    return matrix


def update(
    prior: FilterState,
    camera_from_icrf: FloatArray,
    mcmf_from_icrf: FloatArray,
    landmarks: LandmarkMap,
    index: IntArray,
    uv_px: FloatArray,
    variance_px2: FloatArray,
    camera: PinholeCamera,
    errors: CommonErrors,
    iterations: int = 3,
) -> Update | None:
    """Return the state after sightings of known craters; None where the numbers allow none.

    Parameters
    ----------
    prior
        Must hold the craters among its states.
    index, uv_px
        Craters (into the map) and where they were detected, shapes (n,) and (n, 2).
    variance_px2
        Variance of each detection, per axis, shape (n,). The attitude noise, common to the frame, comes from `errors`.
    """
    count = 2 * index.size
    prior = prior.with_craters(TURN, np.full((1, 3), errors.attitude_noise_rad))
    turn = int(prior.slots(TURN)[0])
    noise: FloatArray = np.diag(np.repeat(variance_px2, 2))
    mean = prior.mean
    for step in range(iterations):
        current = replace(prior, mean=mean)
        sighting = look(
            landmarks, index, pose_of(current, camera_from_icrf, mcmf_from_icrf), camera, current.shifts(index)
        )
        design = design_matrix(sighting, current).reshape(count, mean.size)
        crossed = design @ prior.covariance
        spread = crossed @ design.T + noise
        innovation = (uv_px - sighting.uv_px).reshape(count) - design @ (prior.mean - mean)
        if not (np.all(np.isfinite(innovation)) and np.all(np.isfinite(spread))):
            return None
        if step == 0:
            turning = design[:, turn : turn + 3]
            solved = np.linalg.solve(spread, np.column_stack([innovation, turning]))
            nis = float(innovation @ solved[:, 0])
            rotation = RotationEvidence(turning.T @ solved[:, 0], turning.T @ solved[:, 1:], errors.attitude_noise_rad)
            spread_of_sum = spread.reshape(index.size, 2, index.size, 2).sum(axis=(0, 2))
            mean_innovation = innovation.reshape(-1, 2).sum(axis=0) / np.sqrt(np.diag(spread_of_sum))
        gain: FloatArray = np.asarray(np.linalg.solve(spread, crossed).T, dtype=np.float64)
        previous, mean = mean, prior.mean + gain @ innovation
        turned = float(np.linalg.norm(mean[turn : turn + 3] - previous[turn : turn + 3]))
        moved = float(np.linalg.norm(mean[POSITION] - previous[POSITION]))
        if moved < _LINEAR_M and turned < _LINEAR_RAD:
            break
    contradiction, noise_score = _judged(spread, innovation, np.repeat(variance_px2, 2))
    slope, score = _sloped(prior.slope, design, gain, spread, innovation)
    covariance = corrected_covariance(prior.covariance, design, gain, noise)
    state = FilterState(prior.ticks, mean, covariance, prior.craters, slope)
    pose = pose_of(state, camera_from_icrf, mcmf_from_icrf)
    after = look(landmarks, index, pose, camera, state.shifts(index))
    attitude = np.r_[ATTITUDE, turn : turn + 3]
    both = np.tile(np.eye(3), 2)
    left = both @ state.covariance[np.ix_(attitude, attitude)] @ both.T
    if not state.finite:
        return None
    return Update(
        state.only_craters(state.craters[state.craters != TURN[0]]),
        nis,
        mean_innovation,
        uv_px - after.uv_px,
        mean[turn : turn + 3],
        float(np.sqrt(np.max(np.linalg.eigvalsh(left)))),
        rotation,
        contradiction,
        score,
        noise_score,
    )


def _sloped(
    slope: Slope | None, design: FloatArray, gain: FloatArray, spread: FloatArray, innovation: FloatArray
) -> tuple[Slope | None, tuple[float, float]]:
    """Return the derivatives after a measurement, and those of its log-likelihood: score and expected information.

    References
    ----------
    Gupta, Mehra (1974), Computational aspects of maximum likelihood estimation, IEEE Trans. Automatic Control 19.
    """
    if slope is None:
        return None, (0.0, 0.0)
    crossed = slope.covariance @ design.T
    both = np.column_stack([design @ crossed, -design @ slope.mean, innovation])
    solved = np.linalg.solve(spread, both)
    relative, moved, pull = solved[:, :-2], solved[:, -2], solved[:, -1]
    changed = both[:, :-2]
    score = 0.5 * float(pull @ changed @ pull - np.trace(relative)) - float(both[:, -2] @ pull)
    information = 0.5 * float(np.sum(relative * relative.T)) + float(both[:, -2] @ moved)
    mean = slope.mean + gain @ both[:, -2] + (crossed - gain @ changed) @ pull
    across = gain @ crossed.T
    covariance = slope.covariance - across - across.T + gain @ changed @ gain.T
    return Slope(mean, 0.5 * (covariance + covariance.T)), (score, information)


def _judged(spread: FloatArray, innovation: FloatArray, noise: FloatArray) -> tuple[FloatArray, tuple[float, float]]:
    """Return how far each pair of innovations (2 n,) contradicts all others, (n,), and the score of their noise (2 n,).

    The score is d log L / d log f at f = 1 where all noise is multiplied by f, with its expected square.
    """
    count = innovation.size // 2
    inverse = np.linalg.inv(spread)
    pull = (inverse @ innovation).reshape(count, 2)
    each = np.arange(count)
    blocks = inverse.reshape(count, 2, count, 2)[each, :, each]
    contradiction = np.asarray(np.einsum("ka,kab,kb->k", pull, np.linalg.inv(blocks), pull), dtype=np.float64)
    score = 0.5 * float(noise @ (pull.reshape(-1) ** 2 - np.diag(inverse)))
    return contradiction, (score, 0.5 * float(noise @ inverse**2 @ noise))


def corrected_covariance(covariance: FloatArray, design: FloatArray, gain: FloatArray, noise: FloatArray) -> FloatArray:
    """Return the covariance after a measurement in Joseph form, (1 - K H) P (1 - K H)' + K R K', symmetric.

    The form is valid for any gain, not only the optimal one, so rounding of the gain does not invalidate it.

    Parameters
    ----------
    covariance, design, gain, noise
        P (n, n), H (m, n), K (n, m) and R (m, m).

    References
    ----------
    Bucy, Joseph (1968), Filtering for Stochastic Processes with Applications to Guidance, chapter 16.
    """
    reduced = -gain @ design
    reduced[np.diag_indices_from(reduced)] += 1.0
    joined = reduced @ covariance @ reduced.T + gain @ noise @ gain.T
    return np.asarray(0.5 * (joined + joined.T), dtype=np.float64)
