"""The navigation filter against a dense reference written here. Burns that the payload knows of: the table, and
the filter's flight over them.

The reference holds all states in one vector, differentiates its own measurement model numerically, iterates by
Gauss-Newton on the least-squares problem and inverts the normal matrix: none of it shares code or form with the filter.
"""

import math
from dataclasses import replace

import numpy as np
from numpy import diag, exp, eye, nan, sqrt
from numpy.linalg import eigvalsh, norm
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx, fixture, mark, raises
from scipy.spatial.transform import Rotation

from lunar.camera import PinholeCamera
from lunar.frames import IauOrientation
from lunar.gravity import builtin_gravity
from lunar.timescales import parse_utc, tdb_s_from_utc_ns, ticks_from_utc_ns
from payload_emulator.flight.navigation.filter import filter as kalman
from payload_emulator.flight.navigation.filter.dynamics import OrbitModel, Prediction, ProcessNoise, flown
from payload_emulator.flight.navigation.filter.filter import CommonErrors, FilterState
from payload_emulator.flight.navigation.filter.map_offset import OffsetRule, first_size, learned
from payload_emulator.flight.navigation.sighting import landmark_map, look
from tests.payload_emulator.flight.test_dynamics import start_state
from tmtc.dictionary.tables import (
    BurnTable,
    CatalogueTable,
    GravityTable,
    no_burns,
    pack_burn_table,
    pack_orientation_table,
    unpack_burn_table,
    unpack_orientation_table,
)
from tmtc.errors import TableError

CAMERA = PinholeCamera()
RADIUS_M = 1_737_400.0
SECOND = 65_536
# Camera over the equator at longitude 0, looking down: x east, y south, z down; Moon-fixed axes turned against ICRF.
CAMERA_FROM_MCMF = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
MCMF_FROM_ICRF = Rotation.from_rotvec([0.3, -0.2, 1.1]).as_matrix()
CAMERA_FROM_ICRF = CAMERA_FROM_MCMF @ MCMF_FROM_ICRF
POSITION_ICRF = MCMF_FROM_ICRF.T @ np.array([RADIUS_M + 30e3, 2_000.0, -1_500.0])
ERRORS = CommonErrors(
    attitude_noise_rad=4e-4, attitude_bias_rad=2e-4, attitude_correlation_s=1_000.0, pixel_bias_px=0.25,
    pixel_correlation_s=500.0, catalogue_offset_m=(15.0, 12.0, 10.0), scale=2e-4, scale_sigma=5e-4
)  # fmt: skip


def craters(count=7, seed=2):
    rng = default_rng(seed)
    place = rng.uniform(-0.015, 0.015, (2, count))
    heights = rng.uniform(-1e3, 1e3, count)
    return landmark_map(
        CatalogueTable(np.arange(count), place[0], place[1], np.full(count, 6e3), heights, np.full((count, 3), 60.0))
    )


def projected(state, landmarks, index, turn):
    """Pixels (n, 2) of craters whose shifts, with the common offset, are the last states, by rotations of SciPy."""
    shifts = state[18:].reshape(-1, 3)
    seen = np.empty((index.size, 2))
    camera_from_icrf = Rotation.from_rotvec(-(state[9:12] + turn)).as_matrix() @ CAMERA_FROM_ICRF
    for k, crater in enumerate(index):
        east, north, up = landmarks.enu_from_mcmf[crater]
        point = landmarks.position_mcmf_m[crater] + shifts[k] @ [east, north, up]
        x, y, z = camera_from_icrf @ (MCMF_FROM_ICRF.T @ point - state[:3])
        focal = CAMERA.focal_px * (1.0 + state[17])
        seen[k] = [focal * x / z + 255.5 + state[12], focal * y / z + 255.5 + state[13]]
    return seen


def prior_state(index):
    """A correlated prior over the common states and the given craters."""
    rng = default_rng(5)
    sizes = [60.0, 0.08, 2e-6, 2e-4, 0.25, 15.0, 12.0, 10.0, 5e-4, 60.0]
    sigma = np.repeat(sizes, [3, 3, 3, 3, 2, 1, 1, 1, 1, 3 * index.size])
    root = eye(sigma.size) + 0.15 * rng.standard_normal((sigma.size, sigma.size))
    covariance = (root @ root.T) * sigma[:, None] * sigma[None]
    mean = np.zeros(sigma.size)
    mean[:3], mean[3:6], mean[17] = POSITION_ICRF, [10.0, 1_600.0, -50.0], 2e-4
    mean[9:17] = 0.3 * sigma[9:17] * rng.standard_normal(8)
    mean[18:] = 20.0 * rng.standard_normal(3 * index.size)
    return FilterState(1_000 * SECOND, mean, covariance, index.astype(int))


def differences(size):
    """Steps of the states and of the turn of the frame for numeric derivatives."""
    return np.repeat([1.0, 1e-6, 1e-3, 0.1, 1e-7, 0.1, 1e-6], [9, 3, 2, 3, 1, size - 18, 3])


def first_state(sigma_m=1.0, sigma_m_s=1.0, errors=ERRORS, **options):
    """The filter over the common place at the start of time."""
    return kalman.initial_filter_state(
        0, POSITION_ICRF, np.zeros(3), sigma_m, sigma_m_s, (1e-6,) * 3, errors, **options
    )


def updated(prior, landmarks, index, uv, variance, errors=ERRORS, *iterations):
    return kalman.update(
        prior, CAMERA_FROM_ICRF, MCMF_FROM_ICRF, landmarks, index, uv, variance, CAMERA, errors, *iterations
    )


def dense_update(prior, landmarks, index, uv, variance):
    """Mean, covariance, NIS and mean innovation of the least-squares problem; the turn of the frame stands last."""
    size = prior.mean.size
    mean0 = np.concatenate([prior.mean, np.zeros(3)])
    covariance0 = np.zeros((size + 3, size + 3))
    covariance0[:size, :size] = prior.covariance
    covariance0[size:, size:] = eye(3) * ERRORS.attitude_noise_rad**2
    information, weight = np.linalg.inv(covariance0), np.repeat(1.0 / variance, 2)
    steps = differences(size)

    def measure(x):
        return projected(x[:size], landmarks, index, x[size:]).reshape(-1)

    def jacobian(x):
        columns = []
        for k, step in enumerate(steps):
            change = np.zeros(size + 3)
            change[k] = step
            columns.append((measure(x + change) - measure(x - change)) / (2.0 * step))
        return np.stack(columns, axis=1)

    x, first = mean0, jacobian(mean0)
    for _ in range(6):
        h = jacobian(x)
        normal = information + h.T @ (weight[:, None] * h)
        right = h.T @ (weight * (uv.reshape(-1) - measure(x))) - information @ (x - mean0)
        x = x + np.linalg.solve(normal, right)
    covariance = np.linalg.inv(normal)
    spread = first @ covariance0 @ first.T + diag(1.0 / weight)
    innovation = uv.reshape(-1) - measure(mean0)
    nis = float(innovation @ np.linalg.inv(spread) @ innovation)
    summed = innovation.reshape(-1, 2).sum(axis=0)
    rows = np.arange(innovation.size).reshape(-1, 2)
    scatter = np.array([spread[np.ix_(rows[:, a], rows[:, a])].sum() for a in (0, 1)])
    return x, covariance, nis, summed / sqrt(scatter)


def test_an_update_is_the_least_squares_solution_with_its_covariance():
    landmarks, index = craters(), np.array([5, 0, 3, 2, 6])
    prior = prior_state(index)
    rng = default_rng(8)
    truth = prior.mean.copy()
    truth[:3] += [30.0, -20.0, 25.0]
    variance = np.array([0.6, 1.1, 0.3, 2.0, 0.8])
    turn = np.array([3e-4, -2e-4, 4e-4])
    uv = projected(truth, landmarks, index, turn) + sqrt(variance)[:, None] * rng.standard_normal((5, 2))
    found = updated(prior, landmarks, index, uv, variance, ERRORS, 6)
    mean, covariance, nis, mean_innovation = dense_update(prior, landmarks, index, uv, variance)
    size = prior.mean.size
    sigma = sqrt(diag(covariance))
    # Iteration ends within centimetres; covariances are taken at the last point of linearisation.
    assert np.max(np.abs(found.state.mean - mean[:size]) / sigma[:size]) < 2e-3
    assert_allclose(found.attitude_rad, mean[size:], atol=2e-3 * sigma[-1])
    relative = (found.state.covariance - covariance[:size, :size]) / (sigma[:size, None] * sigma[None, :size])
    assert np.max(np.abs(relative)) < 2e-3
    assert found.nis == approx(nis, rel=1e-6)
    assert_allclose(found.mean_innovation, mean_innovation, rtol=1e-6)
    residual = uv - projected(mean[:size], landmarks, index, mean[size:])
    assert_allclose(found.residual_px, residual, atol=2e-3)
    total = covariance[9:12, 9:12] + covariance[size:, size:]
    total = total + covariance[9:12, size:] + covariance[size:, 9:12]
    assert found.attitude_sigma_rad == approx(sqrt(eigvalsh(total)[-1]), rel=1e-3)
    assert found.state.craters.tolist() == index.tolist()
    assert found.state.ticks == prior.ticks
    # Each sighting against the update with the others alone: its own variance is as good as infinite there.
    for k in range(index.size):
        x, p, _, _ = dense_update(prior, landmarks, index, uv, np.where(np.arange(index.size) == k, 1e12, variance))
        design = np.empty((2, x.size))
        for column in range(x.size):
            width = sqrt(p[column, column]) * 0.1
            change = eye(x.size)[column] * width
            ends = [projected(y[:size], landmarks, index, y[size:])[k] for y in (x + change, x - change)]
            design[:, column] = (ends[0] - ends[1]) / (2.0 * width)
        off = uv[k] - projected(x[:size], landmarks, index, x[size:])[k]
        expected = off @ np.linalg.solve(design @ p @ design.T + variance[k] * eye(2), off)
        assert found.contradiction[k] == approx(expected, rel=0.02)
    # A rotation of the camera: gradient and information of the innovations.
    errors = replace(ERRORS, attitude_noise_rad=1e-3 * ERRORS.attitude_noise_rad)
    free = updated(prior, landmarks, index, uv, variance, errors)
    assert free.rotation.sigma_rad == errors.attitude_noise_rad
    # With a small attitude noise the estimated rotation is the gradient times its variance.
    assert_allclose(free.attitude_rad, errors.attitude_noise_rad**2 * free.rotation.gradient, rtol=0.05, atol=1e-12)
    assert np.all(eigvalsh(free.rotation.information) > 0.0)


def test_what_all_craters_share_is_distinguished_from_the_position_by_its_prior_alone():
    """A shift of the catalogue to the east looks like one of the camera: they divide it by their variances."""
    landmarks, index = craters(40, seed=1), np.arange(40)
    errors = replace(ERRORS, attitude_noise_rad=1e-9, catalogue_offset_m=(30.0, 1e-3, 1e-3))
    start = first_state(40.0, errors=replace(errors, attitude_bias_rad=1e-9))
    covariance = start.covariance.copy()
    covariance[12:14, 12:14], covariance[17, 17] = eye(2) * 1e-12, 1e-16
    prior = replace(start, covariance=covariance).with_craters(index, np.full((40, 3), 1e-3))
    shifted = replace(prior, mean=prior.mean.copy())
    shifted.mean[14] = 100.0
    shifted.mean[18::3] = 100.0
    uv = projected(shifted.mean, landmarks, index, np.zeros(3))
    found = updated(prior, landmarks, index, uv, np.full(40, 1e-2), errors)
    # East offset o and camera shift -p with o + p = 100: o : p = 30^2 : 40^2. Detections know their sum to 3 m and,
    # by the curvature of the ground, their difference to 250 m.
    assert found.state.mean[14] == approx(36.0, abs=1.0)
    east = MCMF_FROM_ICRF @ (found.state.mean[:3] - POSITION_ICRF)
    assert east[1] == approx(-64.0, abs=1.0)
    # What stays unknown is their common part: 1 / (1/30^2 + 1/40^2).
    assert sqrt(found.state.covariance[14, 14]) == approx(24.0, abs=0.5)
    moved = MCMF_FROM_ICRF @ found.state.covariance[:3, 14]
    assert moved[1] / found.state.covariance[14, 14] == approx(1.0, abs=0.02)


def test_craters_seen_where_they_are_predicted_move_nothing_and_tell_much():
    landmarks, index = craters(), np.arange(7)
    prior = prior_state(index)
    found = updated(prior, landmarks, index, projected(prior.mean, landmarks, index, np.zeros(3)), np.full(7, 0.5))
    assert_allclose(found.state.mean, prior.mean, atol=1e-5)
    assert found.nis == approx(0.0, abs=1e-9)
    assert np.all(diag(found.state.covariance) <= diag(prior.covariance) * (1.0 + 1e-9))


def test_numbers_that_allow_no_update_give_none():
    landmarks, index = craters(), np.arange(2)
    prior = prior_state(index)
    behind = replace(prior, mean=prior.mean.copy())
    behind.mean[:3] *= 0.9
    uv, variance = np.full((2, 2), 250.0), np.ones(2)
    assert updated(behind, landmarks, index, uv, variance) is None
    assert updated(prior, landmarks, index, nan * uv, variance) is None


def test_derivatives_stand_in_the_columns_of_their_states():
    landmarks, index = craters(), np.array([4, 1])
    state = prior_state(index).with_craters(np.array([-2]), np.full((1, 3), 1e-4))
    state.mean[-3:] = 0.0
    pose = kalman.pose_of(state, CAMERA_FROM_ICRF, MCMF_FROM_ICRF)
    # Asked for in another order than the states hold them, with a crater that is none.
    asked = np.array([1, 4, 6])
    sighting = look(landmarks, asked, pose, CAMERA, state.shifts(asked))
    design = kalman.design_matrix(sighting, state)
    size = state.mean.size
    assert design.shape == (3, 2, size)

    def measured(x):
        return projected(np.concatenate([x[:18], x[21:24], x[18:21], x[14:17]]), landmarks, asked, x[24:])

    steps = differences(24)
    for k in range(size):
        change = np.zeros(size)
        change[k] = steps[k]
        numeric = (measured(state.mean + change) - measured(state.mean - change)) / (2.0 * steps[k])
        scale = max(np.abs(numeric).max(), 1e-9)
        # The derivative by the attitude is taken at small angles: 2e-4 rad of it.
        assert_allclose(design[:, :, k], numeric, atol=1e-3 * scale, err_msg=str(k))


class Drift:
    """Dynamics that a reader can follow: a constant transition with noise, known before a time."""

    def __init__(self):
        rng = default_rng(0)
        self.transition = eye(9) + 0.1 * rng.standard_normal((9, 9))
        root = rng.standard_normal((9, 9))
        self.noise = 1e-3 * root @ root.T

    def propagate(self, state, from_ticks, to_ticks):
        if to_ticks > 5_000 * SECOND:
            return None
        return Prediction(self.transition @ state, self.transition, self.noise)


def test_a_prediction_carries_each_part_by_its_own_law():
    prior, model = prior_state(np.array([2, 0])), Drift()
    found = kalman.predict(prior, 1_300 * SECOND, model, ERRORS)
    # 300 s at memories of 1000 s and 500 s.
    tilt, shift = exp(-0.3), exp(-0.6)
    transition = eye(24)
    transition[:9, :9] = model.transition
    transition[9:12, 9:12] = tilt * eye(3)
    transition[12:14, 12:14] = shift * eye(2)
    # What the registration leaves is lost with the angle flown, at a memory of 30 degrees.
    there = model.propagate(prior.mean[:9], prior.ticks, 1_300 * SECOND).state[:3]
    here = prior.mean[:3]
    place = exp(-np.arccos(here @ there / norm(here) / norm(there)) / np.radians(30.0))
    assert 0.1 < place < 0.95
    transition[14:17, 14:17] = place * eye(3)
    noise = np.zeros((24, 24))
    noise[:9, :9] = model.noise
    noise[9:12, 9:12] = eye(3) * 2e-4**2 * (1.0 - tilt**2)
    noise[12:14, 12:14] = eye(2) * 0.25**2 * (1.0 - shift**2)
    noise[14:17, 14:17] = diag([15.0, 12.0, 10.0]) ** 2 * (1.0 - place**2)
    assert_allclose(found.mean, transition @ prior.mean, rtol=1e-12)
    expected = transition @ prior.covariance @ transition.T + noise
    scale = sqrt(diag(expected))
    assert_allclose(found.covariance / scale / scale[:, None], expected / scale / scale[:, None], atol=1e-12)
    assert_array_equal(found.covariance, found.covariance.T)
    assert found.ticks == 1_300 * SECOND and found.craters.tolist() == [2, 0]
    assert kalman.predict(prior, 6_000 * SECOND, model, ERRORS) is None


def test_slow_errors_come_to_rest_at_the_size_they_are_said_to_have():
    state = first_state()

    class Still(Drift):
        def propagate(self, state, from_ticks, to_ticks):
            return Prediction(state, eye(9), np.zeros((9, 9)))

    for k in range(1, 400):
        following = kalman.predict(state, 100 * k * SECOND, Still(), ERRORS)
        assert following is not None
        state = following
    sigma = sqrt(diag(state.covariance))
    assert_allclose(sigma[9:12], 2e-4, rtol=1e-9)
    assert_allclose(sigma[12:14], 0.25, rtol=1e-9)
    assert_allclose(sigma[14:18], [15.0, 12.0, 10.0, 5e-4], rtol=1e-9)


def test_the_first_state_holds_what_it_is_given():
    state = kalman.initial_filter_state(
        77, POSITION_ICRF, np.array([1.0, 2.0, 3.0]), 500.0, 0.5, (1e-6, 2e-6, 3e-6), ERRORS
    )
    expected = [500.0] * 3 + [0.5] * 3 + [1e-6, 2e-6, 3e-6] + [2e-4] * 3 + [0.25] * 2 + [15.0, 12.0, 10.0, 5e-4]
    assert_allclose(state.covariance, diag(np.square(expected)), rtol=1e-12)
    assert_array_equal(state.mean[:6], [*POSITION_ICRF, 1.0, 2.0, 3.0])
    assert state.mean[17] == 2e-4 and not state.mean[6:17].any()
    assert state.ticks == 77 and not state.craters.size
    assert state.position_sigma_m == approx(500.0)
    # The worst direction counts.
    axes = Rotation.from_rotvec([0.4, 0.5, -0.2]).as_matrix()
    state.covariance[:3, :3] = axes @ diag([4.0, 100.0, 9.0]) @ axes.T
    assert state.position_sigma_m == approx(10.0)


def test_burns_and_restarts_add_what_they_leave_unknown():
    prior = prior_state(np.array([1]))
    burnt = kalman.burn(prior, np.array([1.0, -2.0, 0.5]), 0.03)
    assert_allclose(burnt.mean[3:6], prior.mean[3:6] + np.array([1.0, -2.0, 0.5]))
    assert_allclose(np.delete(burnt.mean, [3, 4, 5]), np.delete(prior.mean, [3, 4, 5]))
    added = np.zeros_like(prior.covariance)
    added[3:6, 3:6] = eye(3) * 9e-4
    assert_allclose(burnt.covariance, prior.covariance + added, rtol=1e-12)
    wide = kalman.widened(prior, 40.0, 0.2)
    added[:3, :3], added[3:6, 3:6] = eye(3) * 1_600.0, eye(3) * 0.04
    assert_allclose(wide.covariance, prior.covariance + added, rtol=1e-12)
    assert_array_equal(wide.mean, prior.mean)


def test_craters_come_and_go_with_their_correlations():
    prior = prior_state(np.array([4, 1, 6]))
    assert prior.slots(np.array([6, 2, 4, 1])).tolist() == [24, -1, 18, 21]
    assert_array_equal(prior.shifts(np.array([1, 5])), [prior.mean[21:24] - prior.mean[14:17], np.zeros(3)])
    kept = prior.only_craters(np.array([6, 4, 9]))
    places = [*range(18), 18, 19, 20, 24, 25, 26]
    assert kept.craters.tolist() == [4, 6]
    assert_array_equal(kept.mean, prior.mean[places])
    assert_array_equal(kept.covariance, prior.covariance[np.ix_(places, places)])
    sigma = np.array([[1.0, 2.0, 3.0], [50.0, 60.0, 70.0], [7.0, 8.0, 9.0]])
    grown = prior.with_craters(np.array([2, 4, 0]), sigma)
    assert grown.craters.tolist() == [4, 1, 6, 2, 0]
    assert_array_equal(grown.covariance[:27, :27], prior.covariance)
    # A new crater stands where the common offset has it now, and is off by its own error beyond that.
    offset, own = prior.covariance[14:17, 14:17], diag([1.0, 4.0, 9.0, 49.0, 64.0, 81.0])
    assert_allclose(grown.covariance[27:, 27:], np.tile(offset, (2, 2)) + own)
    assert_array_equal(grown.covariance[27:, :27], np.tile(prior.covariance[14:17], (2, 1)))
    assert_array_equal(grown.mean[27:], np.tile(prior.mean[14:17], 2))
    turned = prior.with_craters(kalman.TURN, np.ones((1, 3)))
    assert not turned.covariance[27:, :27].any() and not turned.mean[27:].any()
    assert prior.with_craters(np.array([4]), np.ones((1, 3))) is prior
    assert first_state().slots(np.array([3])).tolist() == [-1]


def test_joseph_form_holds_for_a_gain_that_is_not_optimal():
    rng = default_rng(6)
    root, design = rng.standard_normal((5, 5)), rng.standard_normal((2, 5))
    covariance, noise = root @ root.T, diag([0.3, 0.7])
    gain = rng.standard_normal((5, 2))
    # The error after x' = x + K (z - H x) by drawing: (1 - K H) e - K v.
    errors = rng.multivariate_normal(np.zeros(5), covariance, 400_000)
    noises = rng.multivariate_normal(np.zeros(2), noise, 400_000)
    after = errors @ (eye(5) - gain @ design).T - noises @ gain.T
    found = kalman.corrected_covariance(covariance, design, gain, noise)
    scale = sqrt(diag(found))
    # 400,000 draws know a covariance to 0.2 %; four of that.
    assert_allclose(np.cov(after.T) / scale / scale[:, None], found / scale / scale[:, None], atol=0.01)


def test_a_hundred_thousand_updates_leave_the_covariance_symmetric_and_positive():
    """A prior of 10 km against measurements of a millimetre: 1e14 in variance."""
    rng = default_rng(7)
    size, count = 4, 2
    covariance, noise = eye(size) * 1e8, eye(count) * 1e-6
    designs = rng.standard_normal((50, count, size))
    least, lopsided = np.inf, 0.0
    for k in range(100_000):
        design = designs[k % 50]
        crossed = design @ covariance
        gain = np.linalg.solve(crossed @ design.T + noise, crossed).T
        covariance = kalman.corrected_covariance(covariance, design, gain, noise)
        if k % 1_000 == 0 or k < 100:
            scale = sqrt(diag(covariance))
            least = min(least, float(eigvalsh(covariance / scale / scale[:, None])[0]))
            lopsided = max(lopsided, float(np.abs(covariance - covariance.T).max()))
        # A coast: everything is forgotten again.
        if k % 10 == 9:
            covariance = covariance + eye(size) * 1e8
    assert np.all(np.isfinite(covariance)) and least > 0.0
    assert lopsided == 0.0


EPOCH = parse_utc("2029-08-07T00:00:00Z")
START = int(ticks_from_utc_ns(EPOCH))
KICK = np.array([1.0, -2.0, 3.0])
TABLE = BurnTable(np.array([START + 600 * SECOND]), KICK[None], np.array([0.05]))


@fixture(scope="module")
def model():
    hours = EPOCH + np.arange(-8, 9) * 3_600 * 10**9
    moon, field = IauOrientation(), builtin_gravity()
    tdb_s = np.asarray(tdb_s_from_utc_ns(hours), float)
    rotations = moon.mcmf_from_icrf(tdb_s)
    table = unpack_orientation_table(
        pack_orientation_table(
            np.asarray(ticks_from_utc_ns(hours)), rotations, moon.pa_from_icrf(tdb_s[0]) @ rotations[0].T
        )
    )
    gravity = GravityTable(field.name, field.gm_m3_s2, field.radius_m, field.c_bar, field.s_bar)
    return OrbitModel(gravity, table, 8, ProcessNoise((1e-12,) * 3, (1e-12,) * 3, 900.0))


def test_a_table_of_burns_comes_back_in_order_of_time():
    two = BurnTable(np.array([START + 9, START]), np.stack([KICK, -KICK]), np.array([0.1, 0.2]))
    found = unpack_burn_table(pack_burn_table(two))
    assert_array_equal(found.ticks, [START, START + 9])
    assert_array_equal(found.delta_v_icrf_m_s, [-KICK, KICK])
    assert_array_equal(found.sigma_m_s, [0.2, 0.1])
    assert len(unpack_burn_table(pack_burn_table(no_burns()))) == 0


@mark.parametrize("count, kick, sigma", [(2, KICK, 0.1), (1, KICK, -0.1), (1, nan * KICK, 0.1)])
def test_burns_at_one_time_negative_sigmas_and_nan_are_refused(count, kick, sigma):
    table = BurnTable(np.full(count, START), np.tile(kick, (count, 1)), np.full(count, sigma))
    with raises(TableError, match="burn table"):
        unpack_burn_table(pack_burn_table(table))


def test_a_burn_is_flown_at_its_time_and_not_before(model):
    state, stop = start_state(), START + 900 * SECOND
    kicked = model.propagate(state, START, START + 600 * SECOND).state.copy()
    kicked[3:6] += KICK
    rest = model.propagate(kicked, START + 600 * SECOND, stop)
    assert_array_equal(flown(model, state, START, stop, TABLE), rest.state)
    before, coasted = (flown(model, state, START, START + 599 * SECOND, table) for table in (TABLE, no_burns()))
    assert_array_equal(before, coasted)


class Turning(Drift):
    """Dynamics that turn position and velocity by 0.23 degrees a call, so that the offset is renewed a little."""

    def propagate(self, state, from_ticks, to_ticks):
        transition = eye(9)
        if to_ticks > from_ticks:
            transition[:3, :3] = transition[3:6, 3:6] = Rotation.from_rotvec([0.0, 0.0, 4e-3]).as_matrix()
        return Prediction(transition @ state, transition, np.zeros((9, 9)))


def log_likelihood(prior, landmarks, index, nis):
    """Logarithm of the density of innovations of variance 0.7 px^2 and a NIS, without its constant."""
    state = prior.with_craters(kalman.TURN, np.full((1, 3), ERRORS.attitude_noise_rad))
    pose = kalman.pose_of(state, CAMERA_FROM_ICRF, MCMF_FROM_ICRF)
    design = kalman.design_matrix(look(landmarks, index, pose, CAMERA, state.shifts(index)), state)
    design = design.reshape(-1, state.mean.size)
    spread = design @ state.covariance @ design.T + 0.7 * eye(len(design))
    return -0.5 * (nis + float(np.linalg.slogdet(spread)[1]))


def test_the_slope_is_the_derivative_of_state_and_likelihood_by_the_size_of_the_offset():
    """Four sightings of the same craters from a moving camera: differences over 2 % of the variance."""
    landmarks, index = craters(), np.array([5, 0, 3, 2, 6])
    model, variance = Turning(), np.full(5, 0.7)
    turn = model.propagate(np.zeros(9), 0, 1).transition[:3, :3]

    def flown(size_m):
        errors = replace(ERRORS, catalogue_offset_m=(size_m, size_m, 10.0))
        state = first_state(40.0, 1e-3, errors, learns_offset=True)
        logarithm = score = information = 0.0
        rng, place = default_rng(3), POSITION_ICRF
        for k in range(4):
            moved = kalman.predict(state, 5 * k * SECOND, model, errors)
            place = turn @ place if k else place
            prior = moved.with_craters(index, np.full((5, 3), 50.0)).only_craters(index)
            true = np.concatenate([place, np.zeros(15), np.tile([30.0, -20.0, 0.0], 5)])
            uv = projected(true, landmarks, index, np.zeros(3)) + 0.8 * rng.standard_normal((5, 2))
            found = updated(prior, landmarks, index, uv, variance, errors, 1)
            logarithm += log_likelihood(prior, landmarks, index, found.nis)
            state, score = found.state, score + found.score[0]
            information += found.score[1]
        return state, logarithm, score, information

    (low, below, *_), (middle, _, score, information), (high, above, *_) = (
        flown(30.0 * exp(0.5 * x)) for x in (-0.01, 0.0, 0.01)
    )
    sigma = sqrt(diag(middle.covariance))
    assert_allclose(middle.slope.mean / sigma, (high.mean - low.mean) / 0.02 / sigma, atol=1e-3)
    both = sigma[:, None] * sigma
    changed = (high.covariance - low.covariance) / 0.02 / both
    assert_allclose(middle.slope.covariance / both, changed, atol=1e-3)
    assert np.abs(changed).max() > 0.1
    assert score == approx((above - below) / 0.02, rel=0.02) and abs(score) > 0.05
    assert 0.0 < information < 0.05


def test_the_slope_after_a_measurement_and_its_score_are_derivatives_of_a_linear_update():
    rng = default_rng(6)
    design, root, change = rng.standard_normal((4, 3)), rng.standard_normal((3, 3)), rng.standard_normal((3, 3))
    innovation, moving = 2.0 * rng.standard_normal(4), rng.standard_normal(3)

    def measured(x):
        """Mean, covariance and log-likelihood of the prior root root' + x change change' whose mean moves with x."""
        prior, left = root @ root.T + x * change @ change.T, innovation - design @ (x * moving)
        spread = design @ prior @ design.T + eye(4)
        gain = np.linalg.solve(spread, design @ prior).T
        logarithm = -0.5 * (left @ np.linalg.solve(spread, left) + np.linalg.slogdet(spread)[1])
        return x * moving + gain @ left, prior - gain @ design @ prior, logarithm, spread, gain

    low, (_, _, _, spread, gain), high = measured(-1e-4), measured(0.0), measured(1e-4)
    slope = kalman.Slope(moving, change @ change.T)
    after, (score, information) = kalman._sloped(slope, design, gain, spread, innovation)
    assert_allclose(after.mean, (high[0] - low[0]) / 2e-4, rtol=1e-5)
    assert_allclose(after.covariance, (high[1] - low[1]) / 2e-4, rtol=1e-5)
    assert score == approx((high[2] - low[2]) / 2e-4, rel=1e-5)
    relative = np.linalg.solve(spread, design @ change @ change.T @ design.T)
    moved = design @ moving
    assert information == approx(0.5 * np.trace(relative @ relative) + moved @ np.linalg.solve(spread, moved))
    assert kalman._sloped(None, design, gain, spread, innovation) == (None, (0.0, 0.0))


def test_an_offset_of_another_size_scales_its_part_of_state_and_slope():
    start = first_state(40.0, learns_offset=True)
    covariance = start.covariance.copy()
    covariance[0, 14] = covariance[14, 0] = 100.0
    mean = start.mean.copy()
    mean[14:17] = [4.0, 6.0, 8.0]
    slope = replace(start.slope, mean=mean)
    grown = replace(start, mean=mean, covariance=covariance, slope=slope).with_offset(20.0, 30.0)
    assert grown.mean[14:17].tolist() == grown.slope.mean[14:17].tolist() == approx([6.0, 9.0, 8.0])
    assert grown.covariance[14, 14] == approx(2.25 * covariance[14, 14])
    assert grown.covariance[16, 16] == covariance[16, 16] and grown.covariance[0, 0] == covariance[0, 0]
    assert grown.covariance[0, 14] == grown.covariance[14, 0] == approx(150.0)
    assert grown.slope.covariance[15, 15] == approx(2.25 * start.slope.covariance[15, 15])


def test_the_size_of_the_offset_is_learned_in_bounded_steps_and_not_from_a_few_fixes():
    rule = OffsetRule(fixes=3, prior_information=2.0)
    size = first_size(rule)
    assert (size.sigma_m, size.fixes) == (60.0, 0)
    for score in ((-0.2, 0.1), (math.nan, 0.1), (-0.2, 0.1)):
        size = learned(size, score, (0.0, 0.0), rule)
    # A score that is no number is no evidence: two fixes are too few.
    assert (size.sigma_m, size.pending, size.fixes) == (60.0, 2, 0)
    size = learned(size, (-0.1, 0.115), (0.0, 0.0), rule)
    # x moves by the scores over the information 0.97 * 2 + 0.315 = 2.255: exp(-0.5 / 4.51) of the size.
    assert size.information == approx(2.255)
    assert (size.sigma_m, size.pending, size.fixes) == (approx(60.0 * math.exp(-0.5 / 4.51)), 0, 3)
    assert (size.score, size.gained) == (0.0, 0.0)

    def after(score, steps):
        size = first_size(rule)
        for _ in range(3 * steps):
            size = learned(size, (score, 0.1), (0.0, 0.0), rule)
        return size.sigma_m

    assert after(-9.0, 1) == approx(30.0) and after(-9.0, 9) == 15.0
    assert after(9.0, 1) == 100.0
    rule = replace(rule, largest_m=1e3)
    assert after(9.0, 1) == approx(120.0)


def test_the_noise_of_detections_is_learned_in_shorter_steps_within_its_limits():
    rule = OffsetRule(fixes=3, noise_fixes=2)
    size = learned(first_size(rule), (0.0, 0.1), (-8.0, 2.0), rule)
    assert (size.noise_factor, size.noise_information) == (1.0, 20.0)
    assert learned(size, (0.0, 0.1), (math.inf, 2.0), rule) == size
    size = learned(size, (0.0, 0.1), (-4.0, 3.0), rule)
    # 0.97 * 20 + 5 = 24.4; the variance moves by -12 over it, while the size waits for its third fix.
    assert (size.noise_information, size.noise_factor) == (approx(24.4), approx(math.exp(-6.0 / 24.4)))
    assert (size.sigma_m, size.pending, size.noise_score, size.noise_gained) == (60.0, 2, 0.0, 0.0)
    for score, limit in ((-99.0, 0.5), (99.0, 2.0)):
        size = first_size(rule)
        for _ in range(12):
            size = learned(size, (0.0, 0.1), (score, 0.1), rule)
        assert (size.noise_factor, size.fixes) == (limit, 12)


def test_the_score_of_the_noise_is_the_derivative_of_the_likelihood_with_its_expected_square():
    rng, noise = default_rng(5), np.array([0.5, 0.5, 2.0, 2.0])
    root, innovation = rng.standard_normal((4, 3)), 2.0 * rng.standard_normal(4)

    def spread(x):
        return root @ root.T + exp(x) * diag(noise)

    def logarithm(x):
        return -0.5 * (innovation @ np.linalg.solve(spread(x), innovation) + np.linalg.slogdet(spread(x))[1])

    contradiction, (score, information) = kalman._judged(spread(0.0), innovation, noise)
    assert score == approx((logarithm(1e-4) - logarithm(-1e-4)) / 2e-4, rel=1e-6) and abs(score) > 0.1
    relative = np.linalg.solve(spread(0.0), diag(noise))
    assert information == approx(0.5 * np.trace(relative @ relative)) and contradiction.shape == (2,)
