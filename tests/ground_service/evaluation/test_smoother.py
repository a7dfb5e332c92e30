"""The smoother against a batch solution of the same measurements, and with unannounced changes."""

from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal, assert_array_less
from pytest import approx, mark, raises

from ground_service.errors import EvaluationError
from ground_service.evaluation.smoother import (
    ONBOARD,
    CommandedBurn,
    FilterStates,
    MapOffset,
    SmootherModel,
    _carried,
    _legs,
    _step,
    smooth,
    smoother_model,
)
from lunar.frames import ICRF, IauOrientation, rtn_from_inertial
from lunar.gravity import GravityField, builtin_gravity
from lunar.gravity_omission import field_noise
from lunar.propagation import ForceModel, propagate_with_stm
from lunar.timescales import parse_utc, tdb_s_from_utc_ns
from payload_emulator.flight.navigation.filter.filter import CommonErrors
from tests.payload_emulator.flight.test_dynamics import start_state

EPOCH = parse_utc("2029-08-07T00:00:00Z")
START_S = float(tdb_s_from_utc_ns(EPOCH))
STEP_S, STATES = 60.0, 30
SIGMA_M = 100.0
FORCES = ForceModel(builtin_gravity(), IauOrientation(), 8)
# Nothing but the forces moves the spacecraft: then the smoother has a batch solution to agree with.
QUIET = SmootherModel(FORCES, (1e-18, 1e-18, 1e-18), (1e-15, 1e-15, 1e-15), 900.0)
TIMES = EPOCH + np.arange(STATES) * round(STEP_S) * 10**9


def carried(state, k):
    """Return state (6,) and transition (6, 6) from sample k to the next."""
    position, velocity, transition = propagate_with_stm(
        float(tdb_s_from_utc_ns(int(TIMES[k]))), state[:3], state[3:], STEP_S, FORCES
    )
    return np.concatenate([position, velocity]), transition


class Session:
    """A true orbit, positions measured along it, and a plain Kalman filter of them, written out here."""

    def __init__(self, seed, kick=0.0, kick_at=-1):
        push = np.concatenate([np.zeros(3), np.broadcast_to(kick, 3)])
        rng = np.random.default_rng(seed)
        truth = [start_state()[:6]]
        for k in range(STATES - 1):
            if k == kick_at:
                truth[-1] = truth[-1] + push
            truth.append(carried(truth[-1], k)[0])
        self.truth = np.array(truth)
        prior = np.diag([1e3**2] * 3 + [1.0**2] * 3)
        mean = self.truth[0] + np.sqrt(np.diag(prior)) * rng.standard_normal(6)
        self.prior_mean, self.prior = mean.copy(), prior.copy()
        self.measured = self.truth[:, :3] + SIGMA_M * rng.standard_normal((STATES, 3))
        states, covariances = [], []
        for k in range(STATES):
            if k:
                if k - 1 == kick_at:
                    mean = mean + push
                mean, transition = carried(mean, k - 1)
                prior = transition @ prior @ transition.T
            spread = prior[:3, :3] + SIGMA_M**2 * np.eye(3)
            gain = prior[:, :3] @ np.linalg.inv(spread)
            mean = mean + gain @ (self.measured[k] - mean[:3])
            left = np.eye(6) - gain @ np.eye(3, 6)
            prior = left @ prior @ left.T + SIGMA_M**2 * gain @ gain.T
            states.append(np.concatenate([mean, np.zeros(3)]))
            full = np.eye(9) * 1e-24
            full[:6, :6] = prior
            covariances.append(full)
        self.filtered = FilterStates(TIMES, np.array(states), np.array(covariances), ICRF)


def batch(session):
    """Return the first state and its covariance by one least squares over all measurements and the prior."""
    state = session.prior_mean.copy()
    for _ in range(4):
        normal = np.linalg.inv(session.prior)
        right = normal @ (session.prior_mean - state)
        moved, transition = state, np.eye(6)
        for k in range(STATES):
            if k:
                moved, step = carried(moved, k - 1)
                transition = step @ transition
            design = transition[:3] / SIGMA_M
            normal = normal + design.T @ design
            right = right + design.T @ ((session.measured[k] - moved[:3]) / SIGMA_M)
        state = state + np.linalg.solve(normal, right)
    return state, np.linalg.inv(normal)


def test_without_process_noise_the_first_smoothed_state_is_that_of_one_least_squares_over_everything():
    """The last state is the filter's, and the uncertainty never grows."""
    session = Session(1)
    smoothed = smooth(session.filtered, QUIET)
    assert_array_equal(smoothed.state[-1], session.filtered.state[-1])
    assert np.all(smoothed.sigma_rtn_m <= session.filtered.sigma_rtn_m * (1.0 + 1e-9))
    expected, covariance = batch(session)
    sigma = np.sqrt(np.diag(covariance))
    # The filter linearised about its own states, the batch about the solution: a hundredth of a sigma apart.
    assert_array_less(np.abs(smoothed.state[0, :6] - expected) / sigma, 0.05)
    assert_allclose(np.sqrt(np.diag(smoothed.covariance[0])[:6]), sigma, rtol=0.02)


def test_smoothing_gains_by_half_and_keeps_its_own_account():
    filtered, smoothed, nees = [], [], []
    for seed in range(8):
        session = Session(seed)
        result = smooth(session.filtered, QUIET)
        error = result.state[:, :6] - session.truth
        smoothed.append(np.linalg.norm(error[:, :3], axis=1))
        filtered.append(np.linalg.norm(session.filtered.state[:, :3] - session.truth[:, :3], axis=1))
        nees.append(error[0] @ np.linalg.solve(result.covariance[0, :6, :6], error[0]))
    assert np.median(filtered) >= 1.5 * np.median(smoothed)
    # Chi-square of 48 degrees over 8 runs: 99.9 % lie within 3.2 and 10.
    assert 3.2 <= np.mean(nees) <= 10.0


KICK = np.array([0.0, 0.0, 3.0])


def test_a_commanded_burn_is_flown_over():
    session = Session(4, KICK, kick_at=14)
    # The burn falls between the samples 14 and 15, a moment after the former.
    burn = CommandedBurn(int(TIMES[14]) + 1, KICK, 1e-6)
    error = smooth(session.filtered, replace(QUIET, burns=(burn,))).state[:, :3] - session.truth[:, :3]
    # Sigma of the smoothed position is below 40 m here.
    assert np.linalg.norm(error, axis=1).max() < 160.0


def test_a_burn_that_nobody_commanded_and_a_clock_that_went_backwards_part_the_orbit_in_two():
    session = Session(5, KICK, kick_at=14)
    known = smooth(session.filtered, QUIET)
    alone = smooth(session.filtered.select(np.arange(STATES) < 15), QUIET)
    assert_allclose(known.state[:15], alone.state, rtol=1e-12)
    session = Session(6)
    times = TIMES.copy()
    times[20:] -= 3_600 * 10**9
    torn = smooth(replace(session.filtered, utc_ns=times), QUIET)
    assert_array_equal(torn.state[19], session.filtered.state[19])


@mark.parametrize("count", [0, 1])
def test_few_states_come_back_as_they_are(count):
    few = Session(7).filtered.select(np.arange(STATES) < count)
    assert_array_equal(smooth(few, QUIET).state, few.state)


# Nearly nothing pulls, 1e-12 m/s^2, and 1e9 m out at 1 m/s the axes of the orbit stay those of ICRF to 1e-7: the
# motion is a straight line, and all matrices of the textbook can be written down.
NOTHING = ForceModel(
    GravityField("nothing", 1.0, 1e6, np.ones((1, 1)), np.zeros((1, 1))), IauOrientation(), 0, False, False
)
WHITE, MARKOV, MEMORY_S = (6e-4, 3e-4, 2e-4), (2e-3, 3e-3, 4e-3), 80.0
PUSHED = SmootherModel(NOTHING, WHITE, MARKOV, MEMORY_S)


def step_matrices(seconds):
    """Transition and noise of constant velocity under white acceleration and under one that decays."""
    one, q, decay = np.eye(3), np.diag(WHITE), np.exp(-seconds / MEMORY_S)
    nothing = np.zeros((3, 3))
    transition = np.block(
        [[one, seconds * one, 0.5 * seconds**2 * one], [nothing, one, seconds * one], [nothing, nothing, decay * one]]
    )  # fmt: skip
    noise = np.block(
        [
            [q * seconds**3 / 3.0, q * seconds**2 / 2.0, nothing],
            [q * seconds**2 / 2.0, q * seconds, nothing],
            [nothing, nothing, np.diag(np.square(MARKOV)) * (1.0 - decay**2)],
        ]
    )
    return transition, noise


def straight(seconds, seed=9):
    """States near a straight line with covariances that correlate everything."""
    rng = np.random.default_rng(seed)
    states, covariances = [], []
    for t in seconds:
        line = np.array([1e9, t, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0])
        # No velocity and no push along z: the plane of the orbit stays.
        scatter = np.array([3.0, 3.0, 3.0, 0.02, 0.02, 0.0, 1e-3, 1e-3, 0.0])
        states.append(line + scatter * rng.standard_normal(9))
        root = np.repeat([5.0, 0.1, 2e-3], 3)[:, None] * rng.standard_normal((9, 9))
        covariances.append(root @ root.T)
    times = EPOCH + (np.array(seconds) * 1e9).astype(np.int64)
    return FilterStates(times, np.array(states), np.array(covariances), ICRF, np.arange(len(seconds)))


def rauch_tung_striebel(filtered, legs, kicks, sigma_m_s=0.0):
    """Return smoothed states and covariances by equations 3.28 to 3.30, with plain inverses.

    `kicks` are the changes of the y velocity at the end of each leg.
    """
    state, covariance = filtered.state.copy(), filtered.covariance.copy()
    for k in range(len(legs))[::-1]:
        moved, total, noise = filtered.state[k].copy(), np.eye(9), np.zeros((9, 9))
        for seconds, kick in zip(legs[k], kicks[k], strict=True):
            transition, added = step_matrices(seconds)
            moved, total = transition @ moved, transition @ total
            noise = transition @ noise @ transition.T + added
            if kick:
                moved[4] += kick
                noise[3:6, 3:6] += np.eye(3) * sigma_m_s**2
        prior = total @ filtered.covariance[k] @ total.T + noise
        gain = filtered.covariance[k] @ total.T @ np.linalg.inv(prior)
        state[k] = filtered.state[k] + gain @ (state[k + 1] - moved)
        covariance[k] = filtered.covariance[k] + gain @ (covariance[k + 1] - prior) @ gain.T
    return state, covariance


def assert_same(found, expected, start):
    state, covariance = expected
    scale = np.sqrt(np.einsum("nii->ni", start.covariance))
    # Positions of 1e9 m have seven digits behind the point; the axes are turned by 1e-7.
    assert_allclose((found.state - state) / scale, 0.0, atol=1e-5)
    assert_allclose((found.covariance - covariance) / (scale[:, :, None] * scale[:, None, :]), 0.0, atol=1e-5)
    assert np.abs(state - start.state).max() > 0.1  # and there was something to smooth


def test_pushed_motion_is_smoothed_as_the_textbook_does_it():
    """Half a second, a step of 50 s, and 100 s in two steps of 50 s."""
    filtered = straight([0.0, 0.5, 50.5, 150.5])
    found = smooth(filtered, PUSHED)
    legs = [[0.5], [50.0], [50.0, 50.0]]
    assert_same(found, rauch_tung_striebel(filtered, legs, [[0.0] * len(one) for one in legs]), filtered)
    assert_array_equal(found.utc_ns, filtered.utc_ns)


@mark.parametrize(
    "seconds, pushes, legs, kicks",
    [
        # At the instant of the second state and 20 s after it; two at one instant.
        ([0, 50, 130], [(50, 0.05), (70, 0.05)], [[50.0], [20.0, 60.0]], [[0.05], [0.05, 0.0]]),
        ([0, 50], [(20, 0.05), (20, 0.03)], [[20.0, 0.0, 30.0]], [[0.05, 0.03, 0.0]]),
    ],
)
def test_burns_part_the_steps_and_count_once(seconds, pushes, legs, kicks):
    """Burns of some cm/s, with a sigma of 0.3 m/s each."""
    filtered = straight(seconds)
    burns = tuple(CommandedBurn(EPOCH + at * 10**9, np.array([0.0, push, 0.0]), 0.3) for at, push in pushes)
    found = smooth(filtered, replace(PUSHED, burns=burns))
    assert_same(found, rauch_tung_striebel(filtered, legs, kicks, 0.3), filtered)


def test_each_state_is_carried_as_if_it_were_alone():
    model = replace(QUIET, map_sigma_rtn_m=(60.0, 50.0, 40.0), map_correlation_rad=0.1)
    states = Session(1).filtered.state[:2]
    times, steps = np.asarray(tdb_s_from_utc_ns(TIMES[:2]), float), np.array([60.0, 120.0])
    both = _step(states, times, steps, model)
    for k in range(2):
        for one, alone in zip(both, _step(states[k : k + 1], times[k : k + 1], steps[k : k + 1], model), strict=True):
            assert_allclose(one[k], alone[0], rtol=1e-12)


def test_a_jump_of_a_hundred_in_chi_square_parts_the_orbit():
    filtered = straight([0.0, 30.0])
    transition, noise = step_matrices(30.0)
    prior = transition @ filtered.covariance[0] @ transition.T + noise
    for surprise, smoothed in (99.0, True), (101.0, False):
        jump = np.zeros(9)
        jump[4] = np.sqrt(surprise / np.linalg.inv(prior)[4, 4])
        after = np.array([filtered.state[0], transition @ filtered.state[0] + jump])
        found = smooth(replace(filtered, state=after), PUSHED)
        assert bool(np.any(found.state[0] != filtered.state[0])) is smoothed


def test_a_selection_keeps_its_degrees_and_sigmas_lie_along_the_axes_of_the_orbit():
    some = straight([0.0, 1.0, 2.0]).select(np.array([True, False, True]))
    assert some.innovation_degrees.tolist() == [0, 2]
    # Position along y and velocity along -x: radial is y, transverse -x, normal z.
    covariance = np.zeros((1, 9, 9))
    covariance[0, :3, :3] = np.diag([4.0, 9.0, 16.0])
    state = np.array([[0.0, 2e6, 0.0, -1.6e3, 0.0, 0.0, 0.0, 0.0, 0.0]])
    one = FilterStates(TIMES[:1], state, covariance, ICRF)
    assert_allclose(one.sigma_rtn_m, [[3.0, 2.0, 4.0]])
    assert_allclose(one.position_covariance_rtn_m2[0], np.diag([9.0, 4.0, 16.0]), atol=1e-12)


def test_long_steps_are_cut_into_equal_ones_of_a_minute_at_most():
    """TDB runs with UTC but for a second or two at the epoch; a burn ends a step."""
    second = 10**9
    assert _legs(EPOCH, EPOCH + 150 * second, START_S, ()) == [
        (START_S, 50.0, None), (START_S + 50.0, 50.0, None), (START_S + 100.0, 50.0, None),
    ]  # fmt: skip
    assert _legs(EPOCH, EPOCH + 60 * second, START_S, ()) == [(START_S, 60.0, None)]
    assert _legs(EPOCH, EPOCH, START_S, ()) == []
    burn = CommandedBurn(EPOCH + 90 * second, np.zeros(3), 0.1)
    first, last, after = _legs(EPOCH, EPOCH + 100 * second, START_S, (burn,))
    assert (first, last[1:]) == ((START_S, 45.0, None), (45.0, burn)) and after[1:] == (10.0, None)
    # Microseconds are what a float64 of seconds past J2000 tells.
    assert (last[0] - START_S, after[0] - START_S) == approx((45.0, 90.0), abs=1e-5)


def test_the_smoother_has_the_noise_of_the_field_on_each_side_of_the_moon():
    field = replace(builtin_gravity(), name="LP165P")
    model = smoother_model(field, IauOrientation(), ())
    assert model.field_noise == field_noise("LP165P", min(100, field.degree))
    axes = IauOrientation().mcmf_from_icrf(START_S)
    # Over 0 and 180 degrees of longitude, going north.
    states = [np.r_[side * 1_767.4e3 * axes[0], 1_650.0 * axes[2], np.zeros(3)] for side in (1.0, -1.0)]
    near, far = model.densities(np.full(2, START_S), np.array(states))
    assert_allclose(near, model.field_noise.near_psd_m2_s3, rtol=1e-6)
    assert_allclose(far, model.field_noise.far_psd_m2_s3, rtol=1e-3)
    # The noise of a step is that of the place at its beginning.
    carried = [
        _carried(state[None], np.array([EPOCH]), np.array([EPOCH + 60 * 10**9]), model)[2][0] for state in states
    ]
    ratio = np.trace(carried[1][3:6, 3:6]) / np.trace(carried[0][3:6, 3:6])
    assert ratio == approx(far.sum() / near.sum(), rel=0.02)


def test_the_shift_of_the_map_is_renewed_over_the_ground():
    """A share 1 - exp(-2 angle / 30 degrees) of its variance is new after a step; 10, 40 and 40 m."""
    model = smoother_model(builtin_gravity(), IauOrientation(), ())
    without = replace(model, map_sigma_rtn_m=(0.0, 0.0, 0.0))
    state, at, after = start_state()[:6], np.array([EPOCH]), np.array([EPOCH + 60 * 10**9])
    nine = np.concatenate([state, np.zeros(3)])[None]
    (carried, _, noise), (_, _, plain) = _carried(nine, at, after, model), _carried(nine, at, after, without)
    before, behind = state[:3], carried[0, :3]
    angle = np.arccos(before @ behind / np.linalg.norm(before) / np.linalg.norm(behind))
    added = noise[0] - plain[0]
    axes = rtn_from_inertial(behind, carried[0, 3:6])
    share = 1.0 - np.exp(-2.0 * angle / np.radians(30.0))
    assert_allclose(axes @ added[:3, :3] @ axes.T, share * np.diag([100.0, 1600.0, 1600.0]), atol=1e-6)
    assert_allclose(added[3:], 0.0, atol=1e-12)
    errors = CommonErrors()
    east_m, north_m, up_m = errors.catalogue_offset_m
    stated = smoother_model(builtin_gravity(), IauOrientation(), (), MapOffset((20.0, 25.0, 5.0), 80.0))
    assert stated.map_sigma_rtn_m == (5.0, 25.0, 20.0)
    assert stated.map_correlation_rad == approx(np.radians(80.0))
    assert model.map_sigma_rtn_m == (up_m, north_m, east_m)
    assert model.map_correlation_rad == errors.catalogue_correlation_rad


def test_states_in_the_axes_of_the_payload_are_not_smoothed():
    with raises(EvaluationError, match="expected states in ICRF, found inertial axes of the payload"):
        smooth(replace(straight([0.0, 60.0]), frame=ONBOARD), QUIET)
