"""Resampling in blocks, Student's t, Holm's procedure: against SciPy, printed examples and what they must keep."""

import numpy as np
import pytest
from scipy import stats

from ground_service.processing.regression_statistics import (
    block_of_frame,
    block_weights,
    degrees_of_freedom,
    holm_levels,
    interval,
    standard_error,
    student_quantile,
    student_upper_tail,
    weighted_quantile,
    weighted_ratio,
)


@pytest.mark.parametrize("freedom", [1, 2, 3, 7, 29, 200])
@pytest.mark.parametrize("t", [-2.5, 0.0, 0.3, 1.0, 2.33, 5.0, 12.0])
def test_the_tail_of_students_t_is_that_of_scipy(t: float, freedom: int) -> None:
    assert student_upper_tail(t, freedom) == pytest.approx(stats.t.sf(t, freedom), rel=1e-6, abs=1e-15)


@pytest.mark.parametrize(("upper_tail", "freedom"), [(0.05, 5), (0.01, 29), (0.0004, 14), (1e-5, 60)])
def test_the_quantile_of_students_t_is_that_of_scipy(upper_tail: float, freedom: int) -> None:
    assert student_quantile(upper_tail, freedom) == pytest.approx(stats.t.isf(upper_tail, freedom), rel=1e-6)


def test_holm_steps_down_as_in_the_textbook_example() -> None:
    """Four p-values at 0.05: 0.005 and 0.01 are refused (0.0125, 0.0167), 0.03 is kept at 0.025, all after it too."""
    p_values = [0.01, 0.04, 0.03, 0.005]
    levels = holm_levels(p_values, 0.05)
    assert [p <= level for p, level in zip(p_values, levels, strict=True)] == [True, False, False, True]
    assert levels == pytest.approx([0.05 / 3, 0.025, 0.025, 0.0125])


def test_holm_without_tests_has_no_levels() -> None:
    assert holm_levels([], 0.05) == []


def test_blocks_are_of_nearly_equal_length_and_at_least_two() -> None:
    assert np.bincount(block_of_frame(150, 5)).tolist() == [5] * 30
    assert np.bincount(block_of_frame(7, 5)).tolist() == [4, 3]
    assert block_of_frame(1, 5).tolist() == [0]
    assert block_of_frame(0, 5).tolist() == []


def test_every_pass_keeps_its_number_of_frames_nearly_and_its_blocks_whole() -> None:
    weights = block_weights((20, 10), 5, 50)
    assert weights.shape == (50, 30)
    assert (weights[:, :20].sum(axis=1) == 20).all()
    assert (weights[:, 20:].sum(axis=1) == 10).all()
    assert (weights[:, :5] == weights[:, :1]).all()
    assert degrees_of_freedom([20, 10], 5) == 4


def test_the_same_samples_give_the_same_weights() -> None:
    assert (block_weights((40,), 5, 20) == block_weights((40,), 5, 20)).all()


def test_the_standard_error_of_a_mean_of_independent_frames_is_sigma_over_root_n() -> None:
    rng = np.random.default_rng(1)
    values = rng.standard_normal(1000)
    weights = block_weights((1000,), 5, 2000)
    resampled = weighted_ratio(values, np.ones(1000), weights)
    # 2000 resamples and 200 blocks know a standard deviation to 5 % or so.
    assert standard_error(resampled, [1000], 5) == pytest.approx(1.0 / np.sqrt(1000.0), rel=0.15)


def test_blocks_see_that_neighbouring_frames_say_the_same() -> None:
    """Values constant over five frames carry a fifth of the information: the error is larger by root five."""
    rng = np.random.default_rng(2)
    values = np.repeat(rng.standard_normal(200), 5)
    resampled = weighted_ratio(values, np.ones(1000), block_weights((1000,), 5, 2000))
    assert standard_error(resampled, [1000], 5) == pytest.approx(1.0 / np.sqrt(200.0), rel=0.15)


def test_a_single_block_has_no_standard_error() -> None:
    weights = block_weights((1,), 5, 50)
    assert np.isnan(standard_error(weighted_ratio(np.ones(1), np.ones(1), weights), [1], 5))


def test_weighted_figures_of_equal_weights_are_the_plain_ones() -> None:
    values = np.array([5.0, 1.0, 3.0, np.nan, 2.0])
    whole = np.ones((1, 5))
    assert weighted_ratio(values, np.ones(5), whole)[0] == pytest.approx(np.nanmean(values))
    assert weighted_quantile(values, 0.5, whole)[0] == np.nanquantile(values, 0.5, method="inverted_cdf")


def test_a_quantile_follows_its_weights_and_has_none_without_them() -> None:
    values = np.array([1.0, 2.0, 3.0])
    weights = np.array([[0.0, 0.0, 4.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    found = weighted_quantile(values, 0.5, weights)
    assert found[:2].tolist() == [3.0, 1.0]
    assert np.isnan(found[2])


def test_an_interval_of_nothing_is_no_interval() -> None:
    assert np.isnan(interval(np.full(10, np.nan))).all()
