"""Extended Kalman filter of orbit and common errors, iterated, in Joseph form.

State of 17: position and velocity (ICRF), empirical acceleration (radial, transverse, normal), attitude bias
(camera axes), pixel bias, catalogue offset (east, north, up). The last three groups are errors that many
sightings share; they are estimated with their own memory instead of being taken for fresh noise each time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lunar.camera import PinholeCamera
from payload_emulator.flight.dynamics import OrbitModel
from payload_emulator.flight.sighting import LandmarkMap, Pose, Sighting, look
from payload_emulator.flight.tables import TICKS_PER_SECOND

Float = NDArray[np.float64]
Index = NDArray[np.int64]

SIZE = 17
POSITION, VELOCITY, ACCELERATION = slice(0, 3), slice(3, 6), slice(6, 9)
ATTITUDE, PIXEL, OFFSET = slice(9, 12), slice(12, 14), slice(14, 17)
ORBIT = slice(0, 9)


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
        Shift of all detections of a frame, as an uneven response to slanting light causes.
    catalogue_offset_m
        Shift of the whole catalogue, east, north, up; it does not change.
    """

    attitude_noise_rad: float = float(np.radians(0.01))
    attitude_bias_rad: float = float(np.radians(0.01))
    attitude_correlation_s: float = 3_600.0
    pixel_bias_px: float = 0.1
    pixel_correlation_s: float = 600.0
    catalogue_offset_m: tuple[float, float, float] = (15.0, 15.0, 10.0)


@dataclass(frozen=True, slots=True, eq=False)
class FilterState:
    """Estimate (17,) and covariance (17, 17) at an on-board time."""

    ticks: int
    mean: Float
    covariance: Float

    @property
    def position_sigma_m(self) -> float:
        """Standard deviation of the position in its worst direction."""
        return float(np.sqrt(np.max(np.linalg.eigvalsh(self.covariance[POSITION, POSITION]))))

    @property
    def finite(self) -> bool:
        return bool(np.all(np.isfinite(self.mean)) and np.all(np.isfinite(self.covariance)))


@dataclass(frozen=True, slots=True, eq=False)
class Update:
    """Estimate after a frame, with the innovations that led to it.

    Attributes
    ----------
    nis
        Normalised innovation squared over all used sightings.
    residual_px
        Detection minus prediction after the update, shape (n, 2).
    """

    state: FilterState
    nis: float
    residual_px: Float


def initial_filter_state(
    ticks: int,
    position_icrf_m: Float,
    velocity_icrf_m_s: Float,
    sigma_position_m: float,
    sigma_velocity_m_s: float,
    markov_sigma_m_s2: tuple[float, float, float],
    errors: CommonErrors,
) -> FilterState:
    """Return the state that starts the filter: common errors zero, with their full uncertainty."""
    mean = np.zeros(SIZE)
    mean[POSITION], mean[VELOCITY] = position_icrf_m, velocity_icrf_m_s
    sigma = np.concatenate(
        [
            np.full(3, sigma_position_m),
            np.full(3, sigma_velocity_m_s),
            np.array(markov_sigma_m_s2),
            np.full(3, errors.attitude_bias_rad),
            np.full(2, errors.pixel_bias_px),
            np.array(errors.catalogue_offset_m),
        ]
    )
    return FilterState(ticks, mean, np.diag(sigma**2))


def predict(state: FilterState, ticks: int, model: OrbitModel, errors: CommonErrors) -> FilterState | None:
    """Return the state carried to another time, None where the orbit model has no orientation of the Moon."""
    transition, mean, noise = transition_to(state, ticks, model, errors)
    if transition is None:
        return None
    covariance = transition @ state.covariance @ transition.T + noise
    return FilterState(ticks, mean, 0.5 * (covariance + covariance.T))


def transition_to(
    state: FilterState, ticks: int, model: OrbitModel, errors: CommonErrors
) -> tuple[Float | None, Float, Float]:
    """Return transition matrix (None outside the orientation table), propagated mean and process noise."""
    orbit = model.propagate(state.mean[ORBIT], state.ticks, ticks)
    transition, noise, mean = np.eye(SIZE), np.zeros((SIZE, SIZE)), state.mean.copy()
    if orbit is None:
        return None, mean, noise
    transition[ORBIT, ORBIT], noise[ORBIT, ORBIT], mean[ORBIT] = orbit.transition, orbit.noise, orbit.state
    elapsed_s = abs(ticks - state.ticks) / TICKS_PER_SECOND
    for part, sigma, correlation_s in (
        (ATTITUDE, errors.attitude_bias_rad, errors.attitude_correlation_s),
        (PIXEL, errors.pixel_bias_px, errors.pixel_correlation_s),
    ):
        decay = float(np.exp(-elapsed_s / correlation_s))
        for k in range(part.start, part.stop):
            transition[k, k] = decay
            noise[k, k] = sigma**2 * (1.0 - decay**2)
        mean[part] *= decay
    return transition, mean, noise


def pose_of(mean: Float, camera_from_icrf: Float, mcmf_from_icrf: Float) -> Pose:
    """Return the camera pose that a filter state stands for."""
    return Pose(mean[POSITION], camera_from_icrf, mcmf_from_icrf, mean[ATTITUDE], mean[PIXEL], mean[OFFSET])


def design_matrix(sighting: Sighting) -> Float:
    """Return the derivatives of all predicted pixels by the state, shape (n, 2, 17)."""
    matrix = np.zeros((len(sighting), 2, SIZE))
    matrix[:, :, POSITION] = sighting.by_position
    matrix[:, :, ATTITUDE] = sighting.by_attitude
    matrix[:, 0, PIXEL.start] = matrix[:, 1, PIXEL.start + 1] = 1.0
    matrix[:, :, OFFSET] = sighting.by_offset
    return matrix


def update(
    prior: FilterState,
    camera_from_icrf: Float,
    mcmf_from_icrf: Float,
    landmarks: LandmarkMap,
    index: Index,
    uv_px: Float,
    noise_px2: Float,
    test_noise_px2: Float,
    camera: PinholeCamera,
    errors: CommonErrors,
    iterations: int = 3,
) -> Update | None:
    """Return the state after sightings of known craters; None where the numbers allow none.

    Parameters
    ----------
    index, uv_px
        Craters (into the map) and where they were detected, shapes (n,) and (n, 2).
    noise_px2
        Covariance of each detection against its catalogued place, shape (n, 2, 2), raised for errors that will
        be met again with the same crater: what the estimate is weighed with. Independent between craters; the
        attitude noise, common to the frame, is added here.
    test_noise_px2
        The same for one frame alone: what the innovations are tested with.
    """
    count = 2 * index.size
    mean = prior.mean
    for step in range(iterations):
        sighting = look(landmarks, index, pose_of(mean, camera_from_icrf, mcmf_from_icrf), camera)
        design = design_matrix(sighting).reshape(count, SIZE)
        tilt = sighting.by_attitude.reshape(count, 3) * errors.attitude_noise_rad
        noise = _block_diagonal(noise_px2) + tilt @ tilt.T
        spread = design @ prior.covariance @ design.T + noise
        innovation = (uv_px - sighting.uv_px).reshape(count) - design @ (prior.mean - mean)
        if not (np.all(np.isfinite(innovation)) and np.all(np.isfinite(spread))):
            return None
        if step == 0:
            once = spread + _block_diagonal(test_noise_px2 - noise_px2)
            nis = float(innovation @ np.linalg.solve(once, innovation))
        gain = np.linalg.solve(spread, design @ prior.covariance).T
        previous, mean = mean, prior.mean + gain @ innovation
        if np.linalg.norm(mean[POSITION] - previous[POSITION]) < 0.01:
            break
    left = np.eye(SIZE) - gain @ design
    covariance = left @ prior.covariance @ left.T + gain @ noise @ gain.T
    state = FilterState(prior.ticks, mean, 0.5 * (covariance + covariance.T))
    after = look(landmarks, index, pose_of(mean, camera_from_icrf, mcmf_from_icrf), camera)
    return Update(state, nis, uv_px - after.uv_px) if state.finite else None


def _block_diagonal(blocks: Float) -> Float:
    """Return blocks (n, 2, 2) on the diagonal of a matrix (2n, 2n)."""
    n = blocks.shape[0]
    matrix = np.zeros((n, 2, n, 2))
    rows = np.arange(n)
    matrix[rows, :, rows, :] = blocks
    return matrix.reshape(2 * n, 2 * n)
