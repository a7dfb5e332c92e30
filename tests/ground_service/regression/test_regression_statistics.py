"""Resampling in blocks, Student's t, Holm's procedure: against SciPy, printed examples and what they must keep."""

import numpy as np
import pytest
from scipy import stats

from ground_service.regression.gates.statistics import (
    Spread,
    autocorrelation_time,
    block_length,
    block_of_frame,
    block_weights,
    frames_needed,
    holm_levels,
    interval,
    ratio_influence,
    resampled_spread,
    resolution,
    series_spread,
    student_quantile,
    student_upper_tail,
    unseen_changes,
    weighted_quantile,
    weighted_ratio,
)


@pytest.mark.parametrize("freedom", [1, 2, 3, 7, 29, 200])
@pytest.mark.parametrize("t", [-2.5, 0.0, 0.3, 1.0, 2.33, 5.0, 12.0])
def test_the_tail_of_students_t_is_that_of_scipy(t: float, freedom: int) -> None:
    assert student_upper_tail(t, freedom) == pytest.approx(stats.t.sf(t, freedom), rel=1e-6, abs=1e-15)


@pytest.mark.parametrize("freedom", [1.0, 2.5, 14.0, 60.0, np.inf])
@pytest.mark.parametrize("probability", [0.8, 0.95, 0.99, 0.9996])
def test_the_quantile_of_students_t_is_that_of_scipy(probability: float, freedom: float) -> None:
    assert student_quantile(probability, freedom) == pytest.approx(
        stats.t.ppf(probability, freedom), rel=1e-6
    )


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


def test_the_same_samples_give_the_same_weights() -> None:
    assert (block_weights((40,), 5, 20) == block_weights((40,), 5, 20)).all()


def ar1(rng: np.random.Generator, frames: int, memory: float) -> np.ndarray:
    """A stationary series of unit variance with this correlation from frame to frame."""
    series = rng.standard_normal(frames)
    for i in range(1, frames):
        series[i] = memory * series[i - 1] + np.sqrt(1.0 - memory**2) * series[i]
    return series


@pytest.mark.parametrize(("memory", "time"), [(0.0, 1.0), (0.5, 3.0), (0.8, 9.0)])
def test_the_autocorrelation_time_of_a_first_order_series_is_known(memory: float, time: float) -> None:
    """(1 + a) / (1 - a), over 20,000 frames in ten passes; the estimate scatters by a twentieth or so."""
    series = np.concatenate([ar1(np.random.default_rng(k), 2000, memory) for k in range(10)])
    assert autocorrelation_time(series, [2000] * 10) == pytest.approx(time, rel=0.15)


def test_short_passes_do_not_hide_the_autocorrelation() -> None:
    """Forty frames with an autocorrelation time of 9: without the correction for the mean it would come out near 6."""
    found = [
        autocorrelation_time(
            np.concatenate([ar1(np.random.default_rng((k, j)), 40, 0.8) for j in range(5)]), [40] * 5
        )
        for k in range(60)
    ]
    assert np.median(found) == pytest.approx(9.0, rel=0.2)


def test_a_pass_of_n_frames_shows_no_longer_time_than_a_third_of_n() -> None:
    assert autocorrelation_time(np.arange(30.0), [30]) == 10.0
    assert autocorrelation_time(np.zeros(30), [30]) == 1.0
    assert autocorrelation_time(np.zeros(0), []) == 1.0


def test_four_frames_are_the_fewest_that_show_a_correlation() -> None:
    """1, 1, -1, -1 has r1 = 1/3; less a third of the pass at most: 4/3 of a frame."""
    assert autocorrelation_time(np.array([1.0, 1.0, -1.0, -1.0]), [4]) == pytest.approx(4.0 / 3.0)
    assert autocorrelation_time(np.array([1.0, 0.0, -1.0]), [3]) == 1.0


def test_the_standard_error_of_a_mean_of_independent_frames_is_sigma_over_root_n() -> None:
    values = np.random.default_rng(1).standard_normal(4000)
    spread = series_spread(values / 4000, [2000, 2000])
    assert spread.error == pytest.approx(1.0 / np.sqrt(4000.0), rel=0.1)
    assert spread.freedom == pytest.approx(3998.0, rel=0.1)


def test_frames_that_say_the_same_carry_less_information() -> None:
    """Values constant over five frames: a fifth of the independent values, an error larger by root five."""
    values = np.repeat(np.random.default_rng(2).standard_normal(800), 5)
    spread = series_spread(values / 4000, [4000])
    assert spread.correlation_frames == pytest.approx(5.0, rel=0.2)
    assert spread.error == pytest.approx(1.0 / np.sqrt(800.0), rel=0.15)


def test_a_difference_between_passes_is_no_chance() -> None:
    """Passes are strata: a series that is constant within each pass has no spread."""
    spread = series_spread(np.repeat([1.0, 5.0], 50), [50, 50])
    assert spread.error == 0.0


@pytest.mark.parametrize(
    ("memory", "passes", "frames"), [(0.0, 2, 12), (0.3, 2, 12), (0.8, 5, 40), (0.0, 5, 40)]
)
def test_a_one_sided_test_is_wrong_as_often_as_it_says(memory: float, passes: int, frames: int) -> None:
    """400 series of mean 0 tested at 5 %: at most as many rejections as one test in ten thousand would give."""
    rng = np.random.default_rng(int(100 * memory) + frames)
    wrong = 0
    for _ in range(400):
        series = np.concatenate([ar1(rng, frames, memory) for _ in range(passes)])
        spread = series_spread(series / len(series), [frames] * passes)
        wrong += student_upper_tail(series.mean() / spread.error, spread.freedom) < 0.05
    assert wrong <= stats.binom.isf(1e-4, 400, 0.05)
    assert wrong > 0


def test_too_few_frames_have_no_spread_and_resolve_nothing() -> None:
    spread = series_spread(np.array([1.0]), [1])
    assert np.isnan(spread.error)
    assert resolution(spread, 0.99, 0.8) == np.inf
    assert frames_needed(1, 1, spread, 0.1, 0.99, 0.8) is None


def test_the_bootstrap_error_of_a_mean_is_that_of_the_series() -> None:
    values = np.random.default_rng(3).standard_normal(1000)
    resampled = weighted_ratio(values, np.ones(1000), block_weights((1000,), 1, 2000))
    assert resampled_spread(resampled, [1000], 1, 1.0).error == pytest.approx(1.0 / np.sqrt(1000.0), rel=0.1)


def test_a_block_lasts_two_autocorrelation_times() -> None:
    assert [block_length(time) for time in (1.0, 1.1, 4.0, 9.5)] == [1, 3, 8, 19]


def test_the_influence_of_a_frame_is_the_change_of_the_ratio_without_it() -> None:
    """To first order: the ratio without frame i is less by its influence, over 1 - its share of the denominator."""
    rng = np.random.default_rng(4)
    below = rng.integers(10, 30, 50).astype(np.float64)
    above = rng.binomial(below.astype(int), 0.7).astype(np.float64)
    influence = ratio_influence(above, below)
    assert influence.sum() == pytest.approx(0.0, abs=1e-12)
    without = (above.sum() - above[7]) / (below.sum() - below[7])
    exact = above.sum() / below.sum() - without
    assert influence[7] / (1.0 - below[7] / below.sum()) == pytest.approx(exact)
    assert np.isnan(ratio_influence(above, np.zeros(50))).all()


def test_the_rule_of_three() -> None:
    assert unseen_changes(0.95) == pytest.approx(3.0, abs=0.005)


def test_the_resolution_is_detected_with_the_power_stated() -> None:
    """Normal case: a change of the resolution exceeds the critical value with the probability that is the power."""
    spread = Spread(0.01, 1e9, 1.0)
    detectable = resolution(spread, 0.99, 0.8)
    assert stats.norm.sf((stats.norm.ppf(0.99) * 0.01 - detectable) / 0.01) == pytest.approx(0.8, abs=1e-6)


def test_the_frames_needed_follow_the_square_of_the_resolution() -> None:
    spread = Spread(0.05, 1e4, 1.0)
    detectable = resolution(spread, 0.99, 0.8)
    needed = frames_needed(1000, 1, spread, detectable / 3.0, 0.99, 0.8)
    assert needed == pytest.approx(9000, rel=0.01)
    assert frames_needed(1000, 1, spread, detectable * 1.01, 0.99, 0.8) == 1000


def test_a_floor_falls_with_the_number_of_frames_itself() -> None:
    spread = Spread(0.0, 1e4, 1.0, floor=0.05)
    detectable = resolution(spread, 0.99, 0.8)
    assert frames_needed(1000, 1, spread, detectable / 3.0, 0.99, 0.8) == pytest.approx(3000, rel=0.01)
    open_tail = Spread(0.001, 1e4, 1.0, floor=np.inf, fewest_frames=92.1)
    assert resolution(open_tail, 0.99, 0.8) == np.inf
    assert frames_needed(24, 1, open_tail, 0.1, 0.99, 0.8) == 93


def test_a_number_of_frames_beyond_all_archives_is_unknown() -> None:
    assert frames_needed(10, 1, Spread(1.0, 8.0, 1.0), 1e-6, 0.99, 0.8) is None
    assert frames_needed(10, 1, Spread(1.0, 8.0, 1.0), 0.0, 0.99, 0.8) is None


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
