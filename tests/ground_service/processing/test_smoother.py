"""The smoother against a batch solution of the same measurements, and on what it was not told of."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ground_service.processing.smoother import CommandedBurn, FilterStates, SmootherModel, smooth
from lunar.elements import Elements, icrf_state_from_elements
from lunar.frames import IauOrientation
from lunar.gravity import builtin_gravity
from lunar.propagation import ForceModel, propagate_with_stm
from lunar.timescales import parse_utc, tdb_s_from_utc_ns

EPOCH = parse_utc("2029-08-07T00:00:00Z")
STEP_S, STATES = 60.0, 30
SIGMA_M = 100.0
FORCES = ForceModel(builtin_gravity(), IauOrientation(), 8)
# Nothing but the forces moves the spacecraft: then the smoother has a batch solution to agree with.
QUIET = SmootherModel(FORCES, (1e-18, 1e-18, 1e-18), (1e-15, 1e-15, 1e-15), 900.0)
TIMES = EPOCH + np.arange(STATES) * round(STEP_S) * 10**9


def start_state() -> np.ndarray:
    position, velocity = icrf_state_from_elements(
        Elements(1_768_180.0, 0.006908, *np.radians([89.076, 3.164, 333.604, 8.882])),
        float(tdb_s_from_utc_ns(EPOCH)),
        builtin_gravity().gm_m3_s2,
    )
    return np.concatenate([position, velocity])


def carried(state: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Return state (6,) and transition (6, 6) from sample k to the next."""
    position, velocity, transition = propagate_with_stm(
        float(tdb_s_from_utc_ns(int(TIMES[k]))), state[:3], state[3:], STEP_S, FORCES
    )
    return np.concatenate([position, velocity]), transition


class Session:
    """A true orbit, positions measured along it, and a plain Kalman filter of them, written out here."""

    def __init__(self, seed: int, kick: np.ndarray | None = None, kick_at: int = -1) -> None:
        rng = np.random.default_rng(seed)
        truth = [start_state()]
        for k in range(STATES - 1):
            if k == kick_at and kick is not None:
                truth[-1] = truth[-1] + np.concatenate([np.zeros(3), kick])
            truth.append(carried(truth[-1], k)[0])
        self.truth = np.array(truth)
        prior = np.diag([1e3**2] * 3 + [1.0**2] * 3)
        mean = self.truth[0] + np.sqrt(np.diag(prior)) * rng.standard_normal(6)
        self.prior_mean, self.prior = mean.copy(), prior.copy()
        self.measured = self.truth[:, :3] + SIGMA_M * rng.standard_normal((STATES, 3))
        states, covariances = [], []
        for k in range(STATES):
            if k:
                if k - 1 == kick_at and kick is not None:
                    mean = mean + np.concatenate([np.zeros(3), kick])
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
        self.filtered = FilterStates(TIMES, np.array(states), np.array(covariances))


def batch(session: Session) -> tuple[np.ndarray, np.ndarray]:
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


def test_without_process_noise_the_first_smoothed_state_is_that_of_one_least_squares_over_everything() -> (
    None
):
    session = Session(1)
    smoothed = smooth(session.filtered, QUIET)
    expected, covariance = batch(session)
    sigma = np.sqrt(np.diag(covariance))
    # The filter linearised about its own states, the batch about the solution: a hundredth of a sigma apart.
    np.testing.assert_array_less(np.abs(smoothed.state[0, :6] - expected) / sigma, 0.05)
    np.testing.assert_allclose(np.sqrt(np.diag(smoothed.covariance[0])[:6]), sigma, rtol=0.02)


def test_smoothing_gains_by_half_and_keeps_its_own_account() -> None:
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


def test_the_last_state_is_the_filters_and_uncertainty_never_grows() -> None:
    session = Session(3)
    smoothed = smooth(session.filtered, QUIET)
    np.testing.assert_array_equal(smoothed.state[-1], session.filtered.state[-1])
    assert np.all(smoothed.sigma_rtn_m <= session.filtered.sigma_rtn_m * (1.0 + 1e-9))


def test_a_commanded_burn_is_flown_over() -> None:
    kick = np.array([0.0, 0.0, 3.0])
    session = Session(4, kick, kick_at=14)
    # The burn falls between the samples 14 and 15, a moment after the former.
    burn = CommandedBurn(int(TIMES[14]) + 1, kick, 1e-6)
    error = smooth(session.filtered, replace(QUIET, burns=(burn,))).state[:, :3] - session.truth[:, :3]
    # Sigma of the smoothed position is below 40 m here.
    assert np.linalg.norm(error, axis=1).max() < 160.0


def test_a_burn_that_nobody_commanded_parts_the_orbit_in_two() -> None:
    kick = np.array([0.0, 0.0, 3.0])
    session = Session(5, kick, kick_at=14)
    known = smooth(session.filtered, QUIET)
    alone = smooth(session.filtered.select(np.arange(STATES) < 15), QUIET)
    np.testing.assert_allclose(known.state[:15], alone.state, rtol=1e-12)


def test_a_clock_that_went_backwards_parts_the_orbit_in_two() -> None:
    session = Session(6)
    times = TIMES.copy()
    times[20:] -= 3_600 * 10**9
    torn = smooth(FilterStates(times, session.filtered.state, session.filtered.covariance), QUIET)
    np.testing.assert_array_equal(torn.state[19], session.filtered.state[19])


@pytest.mark.parametrize("count", [0, 1])
def test_few_states_come_back_as_they_are(count: int) -> None:
    few = Session(7).filtered.select(np.arange(STATES) < count)
    np.testing.assert_array_equal(smooth(few, QUIET).state, few.state)
