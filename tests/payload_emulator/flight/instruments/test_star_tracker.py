"""The attitude filter against closed forms and simulated hardware: consistency, outages, gaps, gates, restarts."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from lunar.frames import (
    matrix_from_quaternion,
    matrix_from_rotation_vector,
    quaternion_from_matrix,
    rotation_vector_from_matrix,
)
from payload_emulator.flight.instruments import AttitudeEstimate, Knowledge, flight_instruments
from payload_emulator.flight.instruments.star_tracker import (
    INSTRUMENT,
    StarTrackerParameters,
    attitude_of,
    corrected,
    propagated,
    start,
    step,
)
from tmtc.instruments import ATTITUDE

SECOND = 65_536
ARCSEC = math.radians(1.0 / 3600.0)
PARAMETERS = StarTrackerParameters()
NO_TURN = np.zeros(3)


def tracker_axes() -> Any:
    """Boresight at 40 degrees from the zenith towards image right: written out, not by the code under test."""
    axis = np.array([math.sin(math.radians(40.0)), 0.0, -math.cos(math.radians(40.0))])
    first = np.array([0.0, 1.0, 0.0])
    return np.stack([first, np.cross(axis, first), axis])


def quaternion(rotation: Any) -> Any:
    return quaternion_from_matrix(rotation)


def tracked(rotation: Any = None, ticks: int = 0) -> Any:
    """Return the state after a first solution; None: without rotation."""
    rotation = np.eye(3) if rotation is None else rotation
    state = propagated(PARAMETERS, start(PARAMETERS), ticks, np.full(3, np.nan))
    return corrected(PARAMETERS, state, 1.0, quaternion(rotation))[0]


def angle_sigma(state: Any) -> Any:
    return np.sqrt(np.diag(state.covariance)[:3])


def test_the_first_solution_is_the_attitude_with_the_noise_of_the_star_tracker() -> None:
    rotation = matrix_from_rotation_vector(np.array([0.5, 1.0, -0.3]))
    state = tracked(rotation, 7 * SECOND)
    np.testing.assert_allclose(state.camera_from_icrf, rotation, atol=1e-12)
    axes = tracker_axes()
    spread = np.sqrt(np.diag(axes @ state.covariance[:3, :3] @ axes.T))
    np.testing.assert_allclose(spread, np.array([10.0, 10.0, 70.0]) * ARCSEC, rtol=1e-9)
    found = attitude_of(PARAMETERS, state, 7 * SECOND)
    assert found.sigma_rad == pytest.approx(70.0 * ARCSEC)
    assert state.tracked_ticks == 7 * SECOND


def test_gyroscopes_carry_the_attitude_and_its_uncertainty_grows_as_their_errors_do() -> None:
    state = replace(
        tracked(), covariance=tracked().covariance * np.outer(*(np.r_[[0.0] * 3, [1.0] * 3],) * 2)
    )
    turn, steps = np.array([0.0, 0.004, 0.0]), 24
    for k in range(1, steps + 1):
        state = propagated(PARAMETERS, state, 5 * k * SECOND, turn)
        state, row = corrected(PARAMETERS, state, 0.0, np.full(4, np.nan))
        assert row["sample_status"] == "no_data"
    np.testing.assert_allclose(state.camera_from_icrf, matrix_from_rotation_vector(steps * turn), atol=1e-12)
    # two minutes about a fixed axis: bias times time and the random walk
    bias, walk = PARAMETERS.gyro_bias_sigma_rad_s * 120.0, PARAMETERS.gyro_noise_rad_sqrt_s * math.sqrt(120.0)
    assert angle_sigma(state)[1] == pytest.approx(math.hypot(bias, walk), rel=0.01)
    assert state.tracked_ticks == 0


def simulate(seed: int, seconds: int = 600, outage: tuple[int, int] = (0, 0)) -> tuple[Any, Any, Any]:
    """Fly 5 s samples of a camera that turns with the orbit; return state, true attitude, true bias."""
    rng, dt = np.random.default_rng(seed), 5.0
    axes = tracker_axes()
    truth = matrix_from_rotation_vector(rng.standard_normal(3))
    bias = PARAMETERS.gyro_bias_sigma_rad_s * rng.standard_normal(3)
    state = start(PARAMETERS)
    for k in range(int(seconds / dt)):
        turn = np.full(3, np.nan)
        if k:
            rate = matrix_from_rotation_vector(np.array([0.0, 9e-4 * dt, 0.0]))
            truth = rate @ truth
            noise = PARAMETERS.gyro_noise_rad_sqrt_s * math.sqrt(dt) * rng.standard_normal(3)
            turn = np.array([0.0, 9e-4 * dt, 0.0]) + bias * dt + noise
            bias = bias + PARAMETERS.gyro_walk_rad_s_sqrt_s * math.sqrt(dt) * rng.standard_normal(3)
        error = axes.T @ (np.array([10.0, 10.0, 70.0]) * ARCSEC * rng.standard_normal(3))
        state = propagated(PARAMETERS, state, round(5 * k * SECOND), turn)
        if not outage[0] <= 5 * k < outage[1]:
            seen = matrix_from_rotation_vector(error) @ truth
            state, _ = corrected(PARAMETERS, state, 1.0, quaternion(seen))
    return state, truth, bias


@pytest.mark.parametrize("outage", [(0, 0), (420, 601)])
def test_errors_are_as_large_as_the_filter_says(outage: tuple[int, int]) -> None:
    squares = []
    for seed in range(60):
        state, truth, bias = simulate(seed, outage=outage)
        error = np.concatenate(
            [rotation_vector_from_matrix(truth @ state.camera_from_icrf.T), bias - state.bias_rad_s]
        )
        squares.append(error @ np.linalg.solve(state.covariance, error))
    # chi-square of 360 degrees over 60: 99.9 % between 4.6 and 7.6
    assert 4.6 < float(np.mean(squares)) < 7.6


def test_tracking_estimates_the_bias_of_the_gyroscopes() -> None:
    state, _, bias = simulate(1, seconds=1_800)
    assert float(np.abs(bias - state.bias_rad_s).max()) < 0.2 * PARAMETERS.gyro_bias_sigma_rad_s
    assert float(np.max(np.sqrt(np.diag(state.covariance)[3:]))) < 0.2 * PARAMETERS.gyro_bias_sigma_rad_s


def test_a_wrong_solution_is_refused_and_several_start_again() -> None:
    state = tracked()
    wrong = matrix_from_rotation_vector(np.array([0.01, 0.0, 0.0]))
    for k in range(1, PARAMETERS.refused_samples + 1):
        state = propagated(PARAMETERS, state, 5 * k * SECOND, NO_TURN)
        state, row = corrected(PARAMETERS, state, 1.0, quaternion(wrong))
        assert row["sample_status"] == "gated" and state.refused == k
        assert float(np.abs(rotation_vector_from_matrix(state.camera_from_icrf)).max()) < 1e-9
        residual = tracker_axes() @ np.array([0.01, 0.0, 0.0]) / ARCSEC
        assert row["roll_arcsec"] == pytest.approx(residual[2])
        assert row["cross_y_arcsec"] == pytest.approx(residual[1])
    state = propagated(PARAMETERS, state, 40 * SECOND, NO_TURN)
    state, row = corrected(PARAMETERS, state, 1.0, quaternion(wrong))
    assert row["sample_status"] == "used" and state.refused == 0 and np.isnan(row["roll_arcsec"])
    np.testing.assert_allclose(state.camera_from_icrf, wrong, atol=1e-12)


def test_the_gate_lies_at_its_number_of_sigmas() -> None:
    state = propagated(PARAMETERS, tracked(), SECOND, NO_TURN)
    axes = tracker_axes()
    noise = (axes.T * (np.array([10.0, 10.0, 70.0]) * ARCSEC) ** 2) @ axes
    sigma = math.sqrt((axes @ (state.covariance[:3, :3] + noise) @ axes.T)[2, 2])
    for share, status in ((0.99, "used"), (1.01, "gated")):
        turn = axes[2] * share * PARAMETERS.gate_sigmas * sigma
        _, row = corrected(PARAMETERS, state, 1.0, quaternion(matrix_from_rotation_vector(turn)))
        assert row["sample_status"] == status
        assert row["roll_sigma_arcsec"] == pytest.approx(sigma / ARCSEC)


@pytest.mark.parametrize(("quality", "q"), [(0.0, (1, 0, 0, 0)), (1.0, (0.9, 0, 0, 0)), (1.0, (np.nan,) * 4)])
def test_what_is_no_solution_changes_nothing(quality: float, q: Any) -> None:
    state = tracked()
    after, row = corrected(PARAMETERS, state, quality, np.array(q, dtype=float))
    assert after is state and row["sample_status"] == "no_data"


def test_a_gap_of_the_gyroscopes_ends_the_attitude_but_keeps_the_bias() -> None:
    state, _, _ = simulate(2, seconds=900)
    for ticks, turn in ((state.ticks + SECOND, np.full(3, np.nan)), (state.ticks - SECOND, NO_TURN)):
        after = propagated(PARAMETERS, state, ticks, turn)
        assert after.camera_from_icrf is None
        np.testing.assert_array_equal(after.bias_rad_s, state.bias_rad_s)
        assert attitude_of(PARAMETERS, after, ticks).camera_from_icrf is None
        np.testing.assert_array_equal(after.covariance[:3], 0.0)
        again, _ = corrected(PARAMETERS, after, 1.0, quaternion(np.eye(3)))
        assert again.camera_from_icrf is not None
        np.testing.assert_array_equal(again.covariance[:3, 3:], 0.0)


def test_there_is_no_attitude_from_an_old_sample_or_with_a_large_uncertainty() -> None:
    state = tracked(ticks=10 * SECOND)
    assert attitude_of(PARAMETERS, state, 10 * SECOND + SECOND // 4).camera_from_icrf is not None
    assert attitude_of(PARAMETERS, state, 11 * SECOND).camera_from_icrf is None
    assert attitude_of(PARAMETERS, state, 9 * SECOND).camera_from_icrf is None
    covariance = state.covariance.copy()
    covariance[1, 1] = 0.021**2
    uncertain = attitude_of(PARAMETERS, replace(state, covariance=covariance), 10 * SECOND)
    assert uncertain.camera_from_icrf is None and uncertain.sigma_rad is None


def test_a_frame_has_the_attitude_of_its_samples_and_reports_it() -> None:
    rotation = matrix_from_rotation_vector(np.array([0.2, 0.0, 0.1]))
    q = quaternion(rotation)
    samples = np.array(
        [
            [5.0 * SECOND, 1.0, *q, *(np.nan,) * 3],
            [10.0 * SECOND, 0.0, *(np.nan,) * 4, 0.0, 0.0, 0.0],
        ]
    )
    reading = step(PARAMETERS, start(PARAMETERS), samples, Knowledge(10 * SECOND, AttitudeEstimate(None)))
    assert [row["sample_status"] for row in reading.rows] == ["used", "no_data"]
    assert reading.attitude is not None and reading.attitude.camera_from_icrf is not None
    np.testing.assert_allclose(matrix_from_quaternion(reading.frame[ATTITUDE]), rotation, atol=1e-12)
    assert reading.frame["tracking_age_s"] == 5.0
    assert reading.frame["attitude_sigma_deg"] == pytest.approx(
        math.degrees(reading.attitude.sigma_rad or 0.0)
    )
    blind = step(
        PARAMETERS, start(PARAMETERS), samples[1:], Knowledge(10 * SECOND, AttitudeEstimate(np.eye(3)))
    )
    assert blind.attitude is not None and blind.attitude.camera_from_icrf is None
    assert np.isnan(blind.frame[ATTITUDE]).all() and math.isnan(blind.frame["tracking_age_s"])


def test_attitude_comes_before_its_users() -> None:
    assert flight_instruments()["star_tracker"] is INSTRUMENT
    assert next(iter(flight_instruments())) == "star_tracker"


def spread_of(state: Any) -> Any:
    return state.covariance[:3, :3]


def test_the_error_of_an_outage_lasts_from_frame_to_frame() -> None:
    quiet = replace(PARAMETERS, gyro_bias_sigma_rad_s=0.0, gyro_walk_rad_s_sqrt_s=0.0)
    state = propagated(quiet, start(quiet), 0, np.full(3, np.nan))
    state = corrected(quiet, state, 1.0, quaternion(np.eye(3)))[0]
    turn = np.array([0.01, -0.02, 0.005])
    samples = np.array([[5.0 * k * SECOND, 0.0, *(np.nan,) * 4, *turn] for k in (1, 2, 3)])
    reading = step(quiet, state, samples, Knowledge(15 * SECOND, AttitudeEstimate(None)))
    assert reading.attitude is not None
    error = reading.attitude.error
    assert error is not None
    # The error turns with the camera; new is the angular random walk of 15 s.
    np.testing.assert_allclose(error.memory, matrix_from_rotation_vector(3.0 * turn), atol=1e-9)
    np.testing.assert_allclose(error.added, quiet.gyro_noise_rad_sqrt_s**2 * 15.0 * np.eye(3), atol=1e-20)
    np.testing.assert_allclose(error.covariance, spread_of(reading.state))
    np.testing.assert_allclose(
        error.memory @ spread_of(state) @ error.memory.T + error.added, error.covariance, rtol=1e-9
    )


def test_a_solution_of_the_star_tracker_leaves_the_share_that_it_does_not_correct() -> None:
    quiet = replace(
        PARAMETERS, gyro_bias_sigma_rad_s=0.0, gyro_walk_rad_s_sqrt_s=0.0, gyro_noise_rad_sqrt_s=0.0
    )
    state = propagated(quiet, start(quiet), 0, np.full(3, np.nan))
    state = corrected(quiet, state, 1.0, quaternion(np.eye(3)))[0]
    sample = np.array([[5.0 * SECOND, 1.0, *quaternion(np.eye(3)), *NO_TURN]])
    reading = step(quiet, state, sample, Knowledge(5 * SECOND, AttitudeEstimate(None)))
    assert reading.attitude is not None and reading.attitude.error is not None
    error = reading.attitude.error
    # Two solutions of equal noise: the mean of both has half the variance, and half the error of the first remains.
    np.testing.assert_allclose(error.memory, 0.5 * np.eye(3), atol=1e-9)
    np.testing.assert_allclose(error.covariance, 0.5 * spread_of(state), rtol=1e-9)
    np.testing.assert_allclose(error.added, 0.25 * spread_of(state), rtol=1e-6)


def test_the_first_attitude_and_one_after_a_new_start_have_no_memory() -> None:
    first = np.array([[0.0, 1.0, *quaternion(np.eye(3)), *(np.nan,) * 3]])
    reading = step(PARAMETERS, start(PARAMETERS), first, Knowledge(0, AttitudeEstimate(None)))
    assert reading.attitude is not None and reading.attitude.error is not None
    assert not reading.attitude.error.memory.any()
    np.testing.assert_allclose(reading.attitude.error.added, spread_of(reading.state))
    refusing = replace(reading.state, refused=PARAMETERS.refused_samples)
    far = matrix_from_rotation_vector(np.array([0.1, 0.0, 0.0]))
    again = step(
        PARAMETERS,
        refusing,
        np.array([[5.0 * SECOND, 1.0, *quaternion(far), *NO_TURN]]),
        Knowledge(5 * SECOND, AttitudeEstimate(None)),
    )
    assert again.attitude is not None and again.attitude.error is not None
    np.testing.assert_allclose(again.attitude.error.memory, 0.0, atol=1e-12)
    np.testing.assert_allclose(again.attitude.error.added, spread_of(again.state), rtol=1e-9)


def test_the_stated_memory_is_that_of_simulated_errors() -> None:
    """600 runs: three tracked frames, then three without a solution; errors now and then, and their joint spread."""
    rng = np.random.default_rng(11)
    sigma = np.array([PARAMETERS.cross_sigma_rad, PARAMETERS.cross_sigma_rad, PARAMETERS.roll_sigma_rad])
    axes = tracker_axes()
    errors = np.empty((600, 6, 3))
    for run in range(len(errors)):
        bias = PARAMETERS.gyro_bias_sigma_rad_s * rng.standard_normal(3)
        state, stated = start(PARAMETERS), []
        for frame in range(6):
            rows = []
            for k in (1, 2, 3):
                seen = matrix_from_rotation_vector(axes.T @ (sigma * rng.standard_normal(3)))
                walk = PARAMETERS.gyro_noise_rad_sqrt_s * math.sqrt(5.0) * rng.standard_normal(3)
                solution = quaternion(seen) if frame < 3 else np.full(4, np.nan)
                rows.append(
                    [(15 * frame + 5 * k) * SECOND, float(frame < 3), *solution, *(5.0 * bias + walk)]
                )
            now = Knowledge(15 * (frame + 1) * SECOND, AttitudeEstimate(None))
            reading = step(PARAMETERS, state, np.array(rows), now)
            state = reading.state
            assert reading.attitude is not None and reading.attitude.camera_from_icrf is not None
            stated.append(reading.attitude.error)
            errors[run, frame] = rotation_vector_from_matrix(reading.attitude.camera_from_icrf.T)
    for frame in range(1, 6):
        one = stated[frame]
        assert one is not None
        scale = np.sqrt(np.diag(one.covariance))
        joint = errors[:, frame].T @ errors[:, frame - 1] / len(errors)
        before = errors[:, frame - 1].T @ errors[:, frame - 1] / len(errors)
        spread = np.sqrt(np.diag(before))
        # Correlations of 600 runs are known to 0.04, three sigma.
        np.testing.assert_allclose(
            joint / np.outer(scale, spread), one.memory @ before / np.outer(scale, spread), atol=0.12
        )
