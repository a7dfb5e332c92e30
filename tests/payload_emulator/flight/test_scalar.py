"""Scalar updates of the orbit filter against closed forms, simulated correlated errors, and hand-made gates."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from payload_emulator.flight.navigation import anchored
from payload_emulator.flight.navigation.anchored import Observation
from payload_emulator.flight.navigation.filter import SIZE, FilterState
from payload_emulator.flight.navigation.scalar import (
    Innovation,
    ScalarMeasurement,
    ScalarPrediction,
    scalar_update,
)
from tests.payload_emulator.flight.test_anchored_navigator import SECOND, Orbit

FIRST = np.eye(SIZE)[0]


def state(sigma: float = 3.0) -> FilterState:
    covariance = np.eye(SIZE) * sigma**2
    covariance[0, 1] = covariance[1, 0] = 0.5 * sigma**2
    return FilterState(5, np.zeros(SIZE), covariance, np.empty(0, dtype=np.int64))


def measured(value: float, gate: float = 5.0) -> ScalarMeasurement:
    return ScalarMeasurement(5, value, lambda *_: None, gate)


def test_an_update_is_the_weighted_mean_of_prediction_and_measurement() -> None:
    result = scalar_update(state(3.0), measured(10.0), ScalarPrediction(2.0, FIRST, 4.0))
    assert result is not None
    after, innovation = result
    # variances 9 and 16: weight 9 / 25 of the residual of 8; the neighbour follows with its correlation of a half
    assert after.mean[0] == pytest.approx(8.0 * 9.0 / 25.0)
    assert after.mean[1] == pytest.approx(8.0 * 4.5 / 25.0)
    assert after.covariance[0, 0] == pytest.approx(1.0 / (1.0 / 9.0 + 1.0 / 16.0))
    assert innovation == Innovation(8.0, 5.0, used=True)


def test_the_gate_refuses_beyond_its_limit_and_leaves_the_state() -> None:
    prediction = ScalarPrediction(0.0, FIRST, 4.0)
    inside = scalar_update(state(3.0), measured(14.9, gate=3.0), prediction)
    outside = scalar_update(state(3.0), measured(-15.1, gate=3.0), prediction)
    assert inside is not None and inside[1].used
    assert outside is not None and not outside[1].used
    np.testing.assert_array_equal(outside[0].mean, np.zeros(SIZE))
    assert outside[1] == Innovation(-15.1, 5.0, used=False)


def test_the_gate_uses_one_measurement_and_the_weight_the_correlation() -> None:
    share = 0.8
    result = scalar_update(state(3.0), measured(8.0), ScalarPrediction(0.0, FIRST, 4.0, share))
    assert result is not None
    assert result[1].sigma == 5.0
    assert result[0].mean[0] == pytest.approx(8.0 * 9.0 / (9.0 + 16.0 * 1.8 / 0.2))


def test_the_variance_claimed_after_many_correlated_measurements_is_that_of_their_mean() -> None:
    rng, share, sigma, count, runs = np.random.default_rng(3), 0.7, 10.0, 200, 300
    error = np.empty((runs, count))
    error[:, 0] = sigma * rng.standard_normal(runs)
    for k in range(1, count):
        error[:, k] = share * error[:, k - 1] + sigma * np.sqrt(1.0 - share**2) * rng.standard_normal(runs)
    ends, claimed = [], 0.0
    for row in error:
        one = state(1e4)
        for value in row:
            result = scalar_update(
                one, measured(float(value)), ScalarPrediction(float(one.mean[0]), FIRST, sigma, share)
            )
            assert result is not None
            one = result[0]
        ends.append(one.mean[0])
        claimed = float(np.sqrt(one.covariance[0, 0]))
    # 300 runs know the scatter to 4 %
    assert claimed == pytest.approx(np.std(ends), rel=0.12)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_numbers_without_meaning_are_not_used(value: float) -> None:
    assert scalar_update(state(), measured(value), ScalarPrediction(0.0, FIRST, 1.0)) is None
    assert scalar_update(state(), measured(0.0), ScalarPrediction(value, FIRST, 1.0)) is None
    assert scalar_update(state(), measured(0.0), ScalarPrediction(0.0, FIRST, value)) is None


@pytest.fixture(scope="module")
def orbit(navigation_case: Any) -> Orbit:
    return Orbit(navigation_case(8))


def radius_model(sigma_m: float) -> Any:
    def model(prior: FilterState, mcmf_from_icrf: Any, landmarks: Any) -> ScalarPrediction:
        assert mcmf_from_icrf.shape == (3, 3) and len(landmarks.ids)
        radius = float(np.linalg.norm(prior.mean[:3]))
        design = np.zeros(prior.mean.size)
        design[:3] = prior.mean[:3] / radius
        return ScalarPrediction(radius, design, sigma_m)

    return model


def test_the_navigator_uses_a_measurement_at_its_own_time(orbit: Orbit) -> None:
    navigator = orbit.navigator(start_position_m=1_000.0)
    true_radius = float(np.linalg.norm(orbit.states[2, :3]))
    measurement = ScalarMeasurement(int(orbit.ticks[2]), true_radius, radius_model(1.0), 5.0)
    state, innovation = anchored.measured(navigator.state, measurement, navigator.setup)
    assert innovation is not None and innovation.used
    assert state.estimate.ticks == orbit.ticks[2]
    assert float(np.linalg.norm(state.estimate.mean[:3])) == pytest.approx(true_radius, abs=3.0)


def test_the_navigator_does_not_move_for_what_it_cannot_use(orbit: Orbit) -> None:
    navigator = orbit.navigator()
    ticks, radius = int(orbit.ticks[0]), float(np.linalg.norm(orbit.states[0, :3]))

    def measure(ticks: int, value: float, model: Any) -> Innovation | None:
        measurement = ScalarMeasurement(ticks, value, model, 5.0)
        state, innovation = anchored.measured(navigator.state, measurement, navigator.setup)
        assert state is navigator.state
        return innovation

    assert measure(ticks - 1, radius, radius_model(1.0)) is None
    assert measure(ticks + SECOND, radius, lambda *_: None) is None
    assert measure(1 << 47, radius, radius_model(1.0)) is None
    refused = measure(ticks + SECOND, radius + 1e6, radius_model(1.0))
    assert refused is not None and not refused.used


def test_an_attitude_with_its_own_sigma_weighs_the_frame(orbit: Orbit) -> None:
    after = {}
    for sigma in (None, 1e-5, 1e-2):
        navigator = orbit.navigator()
        observation = Observation(int(orbit.ticks[0]), orbit.detections(0), orbit.attitude(0), sigma)
        state, _ = anchored.step(navigator.state, observation, navigator.setup)
        after[sigma] = state.estimate.position_sigma_m
    assert after[1e-5] < after[None] < after[1e-2]
