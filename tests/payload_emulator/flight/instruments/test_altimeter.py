"""The altimeter on board: surface of three craters by hand, derivatives by differences, use of samples, accuracy."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from lunar.constants import MOON_RADIUS_M
from lunar.frames import matrix_from_rotation_vector, mcmf_from_spherical
from payload_emulator.flight.instruments import AttitudeEstimate, Knowledge
from payload_emulator.flight.instruments.altimeter import (
    AltimeterParameters,
    attitude_at,
    range_model,
    step,
    surface,
)
from payload_emulator.flight.navigation import anchored
from payload_emulator.flight.navigation.filter import OFFSET, POSITION, SIZE, VELOCITY, FilterState
from payload_emulator.flight.navigation.scalar import ScalarMeasurement
from payload_emulator.flight.navigation.sighting import LandmarkMap, landmark_map
from tests.payload_emulator.flight.test_anchored_navigator import Orbit
from tmtc.tables import CatalogueTable

SECOND = 65_536
PARAMETERS = AltimeterParameters()
NO_ROTATION = np.eye(3)


def craters(*rows: tuple[float, float, float]) -> LandmarkMap:
    """Craters on the equator: distance along it in metres from longitude 0, rim height, diameter."""
    along, height, diameter = np.array(rows).T
    return landmark_map(
        CatalogueTable(
            np.arange(len(rows)),
            np.zeros(len(rows)),
            along / MOON_RADIUS_M,
            diameter,
            height,
            np.full((len(rows), 3), 10.0),
        )
    )


PLAIN = craters((5e3, 1_000.0, 4e3), (-5e3, 1_000.0, 4e3), (8e3, 1_000.0, 4e3))


def orbit_state(position: Any) -> FilterState:
    mean = np.zeros(SIZE)
    mean[POSITION], mean[VELOCITY] = position, (0.0, 1_600.0, 0.0)
    return FilterState(0, mean, np.eye(SIZE), np.empty(0, dtype=np.int64))


def test_the_surface_is_the_weighted_mean_of_rims_lowered_by_their_height() -> None:
    ground = mcmf_from_spherical(0.0, 0.0, 0.0)
    parameters = AltimeterParameters(rim_height_share=0.05, surface_sigma_floor_m=30.0)
    found = surface(parameters, craters((0.0, 700.0, 4e3), (5e3, 900.0, 4e3), (-10e3, 100.0, 6e3)), ground)
    assert found is not None
    # weights 1 / (d^2 + 5^2): 1/25, 1/50, 1/125 in the ratio 10 : 5 : 2
    weights, heights = np.array([10.0, 5.0, 2.0]) / 17.0, np.array([500.0, 700.0, -200.0])
    mean = weights @ heights
    scatter = weights @ (heights - mean) ** 2 * (1.0 + weights @ weights)
    assert found[0] - MOON_RADIUS_M == pytest.approx(mean, abs=0.01)
    assert found[1] == pytest.approx(math.sqrt(scatter + 30.0**2), rel=1e-4)


def test_too_few_craters_within_reach_make_no_surface() -> None:
    ground = mcmf_from_spherical(0.0, 0.0, 0.0)
    assert surface(PARAMETERS, craters((0.0, 1.0, 4e3), (49e3, 1.0, 4e3), (51e3, 1.0, 4e3)), ground) is None
    assert surface(PARAMETERS, craters((0.0, 1.0, 4e3), (49e3, 1.0, 4e3), (-49e3, 1.0, 4e3)), ground)


@pytest.mark.parametrize("tilt_deg", [0.0, 15.0])
def test_the_derivatives_are_those_of_the_predicted_range(tilt_deg: float) -> None:
    position = mcmf_from_spherical(0.0, 0.001, 30e3)
    mcmf_from_icrf = matrix_from_rotation_vector(np.array([0.3, -0.2, 0.9]))
    down = -position / np.linalg.norm(position)
    boresight = matrix_from_rotation_vector(np.radians(tilt_deg) * np.array([0.0, 0.0, 1.0])) @ down
    model = range_model(PARAMETERS, mcmf_from_icrf.T @ boresight, 0.0, math.inf)

    def predicted(mean: Any) -> Any:
        state = FilterState(0, mean, np.eye(SIZE), np.empty(0, dtype=np.int64))
        found = model(state, mcmf_from_icrf, PLAIN)
        assert found is not None
        return found

    mean = orbit_state(mcmf_from_icrf.T @ position).mean
    base = predicted(mean)
    slopes = [
        (predicted(mean + 5.0 * axis).value - predicted(mean - 5.0 * axis).value) / 10.0
        for axis in np.eye(SIZE)
    ]
    # three equal heights: the surface below stays the same as the ground point moves
    np.testing.assert_allclose(base.design[POSITION], slopes[POSITION], atol=1e-5)
    np.testing.assert_allclose(base.design[OFFSET], slopes[OFFSET], atol=1e-5)
    others = np.r_[3 : OFFSET.start, OFFSET.stop : SIZE]
    np.testing.assert_array_equal(base.design[others], 0.0)
    if not tilt_deg:
        assert base.value == pytest.approx(30e3 - 1_000.0 + 0.03 * 4e3, abs=0.01)
        assert base.design[OFFSET.start + 2] == pytest.approx(-1.0)


def test_the_uncertainty_of_the_attitude_counts_where_the_beam_leans() -> None:
    position = mcmf_from_spherical(0.0, 0.0, 30e3)
    down = -position / np.linalg.norm(position)
    leaning = matrix_from_rotation_vector(np.array([0.0, 0.0, np.radians(30.0)])) @ down

    def sigma(boresight: Any, attitude_sigma_rad: float) -> float:
        found = range_model(PARAMETERS, boresight, attitude_sigma_rad, 1.0)(
            orbit_state(position), NO_ROTATION, PLAIN
        )
        assert found is not None
        return found.sigma

    assert sigma(down, 0.02) == pytest.approx(sigma(down, 0.0), rel=1e-6)
    added = math.sqrt(sigma(leaning, 0.02) ** 2 - sigma(leaning, 0.0) ** 2)
    # 34 km of range, tangent of an incidence of 30.6 degrees
    assert added == pytest.approx(0.02 * 33.9e3 * math.tan(math.radians(30.5)), rel=0.03)


def test_successive_ranges_share_the_error_of_the_ground_between_them() -> None:
    position = mcmf_from_spherical(0.0, 0.0, 30e3)
    down = -position / np.linalg.norm(position)

    def share(since_s: float) -> float:
        found = range_model(PARAMETERS, down, 0.0, since_s)(orbit_state(position), NO_ROTATION, PLAIN)
        assert found is not None
        return found.lasting_share

    assert share(9.375) == pytest.approx(math.exp(-1.0))  # 1,600 m/s for 15 km
    assert share(math.inf) == 0.0


def test_there_is_no_prediction_beside_the_moon_or_away_from_it() -> None:
    position = mcmf_from_spherical(0.0, 0.0, 30e3)
    up = position / np.linalg.norm(position)
    half_way = math.pi * MOON_RADIUS_M
    # the line through a boresight that leads away meets the Moon behind the spacecraft, on the other side
    behind = craters((half_way, 0.0, 4e3), (half_way - 5e3, 0.0, 4e3), (half_way + 5e3, 0.0, 4e3))
    for boresight in (up, np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])):
        for known in (PLAIN, behind):
            model = range_model(PARAMETERS, boresight, 0.0, 1.0)
            assert model(orbit_state(position), NO_ROTATION, known) is None


def test_the_attitude_between_two_frames_turns_at_a_constant_rate() -> None:
    before = matrix_from_rotation_vector(np.array([0.1, 0.2, 0.3]))
    turn = np.array([0.0, 0.02, 0.0])
    now = matrix_from_rotation_vector(turn) @ before
    knowledge = Knowledge(15 * SECOND, AttitudeEstimate(now), (0, before))
    found = attitude_at(5 * SECOND, knowledge, 60.0)
    np.testing.assert_allclose(found, matrix_from_rotation_vector(turn / 3.0) @ before, atol=1e-12)
    np.testing.assert_array_equal(attitude_at(15 * SECOND, knowledge, 60.0), now)
    assert attitude_at(-1, knowledge, 60.0) is None
    assert attitude_at(5 * SECOND, knowledge, 14.0) is None
    assert attitude_at(5 * SECOND, Knowledge(15 * SECOND, AttitudeEstimate(now)), 60.0) is None
    assert attitude_at(5 * SECOND, Knowledge(15 * SECOND, AttitudeEstimate(None), (0, before)), 60.0) is None


def test_samples_become_measurements_or_say_why_not() -> None:
    known = Knowledge(15 * SECOND, AttitudeEstimate(np.eye(3)), (0, np.eye(3)))
    samples = np.array([[2.0 * SECOND, 29e3], [7.0 * SECOND, math.nan], [12.0 * SECOND, 30e3]])
    reading = step(PARAMETERS, None, samples, known)
    assert [row.get("sample_status") for row in reading.rows] == [None, "no_data", None]
    assert [(one.row, one.measurement.ticks, one.measurement.value) for one in reading.measurements] == [
        (0, 2 * SECOND, 29e3),
        (2, 12 * SECOND, 30e3),
    ]
    assert {one.measurement.gate_sigmas for one in reading.measurements} == {PARAMETERS.gate_sigmas}
    assert reading.state == 12 * SECOND
    blind = step(PARAMETERS, 1, samples, Knowledge(15 * SECOND, AttitudeEstimate(None), (0, np.eye(3))))
    assert [row["sample_status"] for row in blind.rows] == ["no_model", "no_data", "no_model"]
    assert blind.measurements == () and blind.state == 1
    assert step(PARAMETERS, 1, np.zeros((0, 2)), known).rows == ()


@pytest.fixture(scope="module")
def orbit(navigation_case: Any) -> Orbit:
    return Orbit(navigation_case(12))


def test_ranges_correct_the_height_of_an_orbit_as_far_as_the_surface_is_known(orbit: Orbit) -> None:
    """The ground lies where the rims of the case put it, so that only the error that is claimed for it is left."""
    navigator = orbit.navigator(start_position_m=2_000.0)
    state, radial = navigator.state, orbit.states[11, :3] / np.linalg.norm(orbit.states[11, :3])
    for k in range(1, 12):
        place = orbit.rotations[k] @ orbit.states[k, :3]
        known = surface(PARAMETERS, orbit.map, place)
        assert known is not None
        range_m = float(np.linalg.norm(place)) - known[0]
        model = range_model(PARAMETERS, orbit.attitude(k)[2], 0.0, 15.0)
        measurement = ScalarMeasurement(int(orbit.ticks[k]), range_m, model, 4.0)
        state, innovation = anchored.measured(state, measurement, navigator.setup)
        assert innovation is not None and innovation.used
    error = abs(float((state.estimate.mean[:3] - orbit.states[11, :3]) @ radial))
    coasted, _ = anchored.step(
        navigator.state, anchored.Observation(int(orbit.ticks[11]), None, None), navigator.setup
    )

    def claimed(one: anchored.AnchoredState) -> float:
        return math.sqrt(float(radial @ one.estimate.covariance[:3, :3] @ radial))

    assert claimed(state) < 0.3 * claimed(coasted)
    assert error < claimed(state)
