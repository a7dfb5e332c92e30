"""Odometry inside the filter: the derivatives, what it adds where nothing else is known, and that it is safe."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from payload_emulator.flight.navigation.anchored_parameters import AnchoredParameters
from payload_emulator.flight.navigation.dynamics import ProcessNoise
from payload_emulator.flight.navigation.filter import CommonErrors
from payload_emulator.flight.navigation.relative import CLONE, RelativeParameters, with_clone, without_clone
from studies.montecarlo import CatalogueErrors, SimulatedDetector, fly

NOISE = ProcessNoise((1.2e-7, 6e-8, 6e-8), (1e-7, 1e-7, 1e-7), 900.0)
OFF = AnchoredParameters(
    noise=NOISE,
    errors=CommonErrors(pixel_bias_px=1e-3, catalogue_offset_m=(0.1, 0.1, 0.1), scale_sigma=1e-6),
    detection_persistence=0.0,
)
ON = replace(OFF, relative=RelativeParameters(enabled=True))


def blind(navigation_case: Any, velocity_m_s: float, parameters: AnchoredParameters) -> Any:
    """Return a case whose catalogue names nothing that is there: only the move between frames can be seen."""
    return navigation_case(
        16,
        start_position_m=200.0,
        start_velocity_m_s=velocity_m_s,
        catalogue_errors=CatalogueErrors(wrong_share=1.0),
        detector=SimulatedDetector(recall=(0.9, 0.9, 0.9, 0.9), precision=0.95),
        # No wide searches: nothing of this catalogue can be found, however long one looks.
        parameters=replace(parameters, tracking_limit_m=50_000.0, suspicion_frames=1_000),
    )


def test_a_clone_is_the_position_itself_until_the_orbit_moves_on(navigation_case: Any) -> None:
    from payload_emulator.flight.navigation.filter import initial_filter_state

    state = initial_filter_state(0, np.ones(3), np.ones(3), 100.0, 0.1, (1e-7,) * 3, CommonErrors())
    kept = with_clone(state)
    assert kept.craters.tolist() == [CLONE]
    difference = np.zeros((3, kept.mean.size))
    difference[:, :3], difference[:, -3:] = np.eye(3), -np.eye(3)
    np.testing.assert_allclose(difference @ kept.covariance @ difference.T, 0.0, atol=1e-9)
    np.testing.assert_array_equal(without_clone(kept).covariance, state.covariance)


def test_odometry_finds_a_velocity_that_nothing_else_tells(navigation_case: Any) -> None:
    # Ground whose height is known to 700 m puts a tie 50 m/s off; ten of them in each of 15 frames leave a few m/s.
    on, off = (
        fly(blind(navigation_case, 60.0, parameters), 1).velocity_error_m_s[-1] for parameters in (ON, OFF)
    )
    assert on < 0.7 * off


@pytest.mark.parametrize("seed", [4])
def test_beside_a_catalogue_and_good_dynamics_odometry_adds_next_to_nothing(
    navigation_case: Any, seed: int
) -> None:
    sparse = navigation_case(50, catalogue_errors=CatalogueErrors(wrong_share=0.5), parameters=OFF)
    without = fly(sparse, seed)
    with_odometry = fly(replace(sparse, parameters=ON), seed)
    ratio = np.median(with_odometry.error_m[20:]) / np.median(without.error_m[20:])
    assert 0.75 < ratio < 1.25
    assert np.mean(with_odometry.nees[20:]) < 15.0
