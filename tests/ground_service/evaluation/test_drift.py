"""Drift and statistics, on errors whose figures can be said beforehand."""

import numpy as np
import pytest

from ground_service.evaluation.navigation.drift import (
    drift_by_length,
    drift_percent,
    error_before_reset_m,
    navigation_statistics,
)

STEP_M = 24_500.0


def drifting(frames: int, per_step: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    steps = np.arange(frames)[:, None]
    return steps * np.array(per_step), np.arange(frames) * STEP_M


def test_a_steady_drift_is_its_share_of_the_path() -> None:
    error, path = drifting(100, (0.0, 245.0, 0.0))
    assert drift_percent(error, path, np.zeros(100, dtype=bool)) == pytest.approx(1.0, rel=1e-12)


def test_height_errors_are_no_horizontal_drift() -> None:
    error, path = drifting(100, (500.0, 0.0, 0.0))
    assert drift_percent(error, path, np.zeros(100, dtype=bool)) == 0.0


def test_a_reset_hides_no_drift() -> None:
    """Sawtooth: 2 % between resets, although the error at the end of the pass is nearly nothing."""
    phase = np.arange(100) % 20
    error = np.column_stack([np.zeros(100), phase * 0.02 * STEP_M, np.zeros(100)])
    resets = phase == 0
    assert drift_percent(error, np.arange(100) * STEP_M, resets) == pytest.approx(2.0, rel=1e-12)


def test_the_error_before_a_reset_is_that_of_the_sample_before() -> None:
    error, _ = drifting(6, (0.0, 3.0, 4.0))
    before = error_before_reset_m(error, np.array([True, False, False, True, False, False]))
    assert before[3] == pytest.approx(10.0)
    assert np.isnan(before[[0, 1, 2, 4, 5]]).all()


def test_drift_by_length_crosses_no_reset() -> None:
    error, path = drifting(100, (0.0, 245.0, 0.0))
    resets = np.zeros(100, dtype=bool)
    resets[50] = True
    error[50:] = 0.0
    samples = drift_by_length(error, path, resets)
    assert [sample.path_length_m for sample in samples] == [100e3, 200e3, 500e3, 1000e3]
    # 100 km are nearest to 4 steps of 24.5 km: 46 sub-tracks in each half of 50 samples, drifting and standing still.
    assert samples[0].samples == 92
    assert samples[0].p95_percent == pytest.approx(1.0)


def test_statistics_leave_out_samples_without_reference() -> None:
    error = np.array([[3.0, 4.0, 0.0], [np.nan] * 3, [0.0, 0.0, 10.0]])
    statistics = navigation_statistics(error, np.array([0.0, np.nan, 1000.0]), np.zeros(3, dtype=bool))
    assert statistics.median_3d_m == pytest.approx(7.5)
    assert statistics.max_3d_m == pytest.approx(10.0)
    assert statistics.end_of_pass_m == pytest.approx(10.0)
    assert statistics.path_length_m == pytest.approx(1000.0)


@pytest.mark.parametrize("count", [0, 1])
def test_none_or_one_sample_gives_no_drift(count: int) -> None:
    statistics = navigation_statistics(np.zeros((count, 3)), np.zeros(count), np.zeros(count, dtype=bool))
    assert np.isnan(statistics.drift_percent)
