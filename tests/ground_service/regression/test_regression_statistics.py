"""Paired statistics over units and Holm's procedure: against printed examples and simulation."""

import numpy as np
import pytest

from ground_service.regression.gates.statistics import (
    UnitSums,
    aligned,
    frames_needed,
    holm_levels,
    joined_sums,
    mean_change,
    ratio_change,
    ratio_error,
    student_upper_tail,
    unit_sums,
)
from tests.lazy import Lazy

stats = Lazy("scipy.stats")


def test_holm_steps_down_as_in_the_textbook_example() -> None:
    """Four p-values at 0.05: 0.005 and 0.01 are refused (0.0125, 0.0167), 0.03 is kept at 0.025, all after it too."""
    p_values = [0.01, 0.04, 0.03, 0.005]
    levels = holm_levels(p_values, 0.05)
    assert [p <= level for p, level in zip(p_values, levels, strict=True)] == [True, False, False, True]
    assert levels == pytest.approx([0.05 / 3, 0.025, 0.025, 0.0125])
    assert holm_levels([], 0.05) == []


def sums(unit: list[int], numerator: list[float], denominator: list[float], stratum: int = 0) -> UnitSums:
    return unit_sums(
        np.array(unit), np.full(len(unit), stratum), np.array(numerator, float), np.array(denominator, float)
    )


def test_rows_are_summed_by_unit_and_units_of_either_build_are_aligned() -> None:
    before, after = sums([7, 3, 7], [1, 1, 0], [1, 1, 1]), sums([3, 9], [1, 0], [1, 1])
    assert (before.unit.tolist(), before.numerator.tolist(), before.denominator.tolist()) == (
        [3, 7],
        [1, 1],
        [1, 2],
    )
    first, second = aligned(before, after)
    assert first.unit.tolist() == second.unit.tolist() == [3, 7, 9]
    assert (first.denominator.tolist(), second.denominator.tolist()) == ([1, 2, 0], [1, 0, 1])
    assert joined_sums([first, second]).value == pytest.approx(3 / 5)
    assert np.isnan(sums([], [], []).value)


def test_the_error_of_a_ratio_of_equal_units_is_that_of_a_mean() -> None:
    values = np.random.default_rng(1).standard_normal(400)
    one = UnitSums(np.arange(400), np.zeros(400, np.int64), values, np.ones(400))
    assert ratio_error(one) == pytest.approx(np.std(values, ddof=1) / 20.0)
    assert np.isnan(ratio_error(sums([1], [1], [1])))


def test_a_difference_between_kinds_of_terrain_is_no_chance() -> None:
    """All units of one kind change by 1, all of the other by 0: within each kind nothing varies."""
    kind = np.repeat([0, 1], 50)
    before = UnitSums(np.arange(100), kind, np.zeros(100), np.ones(100))
    after = UnitSums(np.arange(100), kind, kind.astype(float), np.ones(100))
    change = ratio_change(before, after)
    assert (change.estimate, change.error, change.units) == (0.5, pytest.approx(1.8 / 100), 100)


@pytest.mark.parametrize("correlated", [False, True])
def test_a_one_sided_test_is_wrong_as_often_as_it_says(correlated: bool) -> None:
    """400 pairs of equal builds, rows of a track alike or independent, at 5 %."""
    rng, wrong = np.random.default_rng(3), 0
    size = rng.integers(1, 8, 120)
    track = np.repeat(np.arange(120), size)
    for _ in range(400):
        draws = rng.random((2, 120))[:, track] if correlated else rng.random((2, len(track)))
        before, after = (
            unit_sums(track, np.zeros_like(track), (row < 0.7).astype(float), np.ones(len(track)))
            for row in draws
        )
        change = ratio_change(before, after)
        wrong += student_upper_tail(-change.estimate / change.error, change.units - 1) < 0.05
    assert 0 < wrong <= stats.binom.isf(1e-4, 400, 0.05)


def test_the_mean_change_of_passes_is_a_ratio_for_lengths_and_a_difference_for_shares() -> None:
    before, after = np.array([1.0, 2.0, 4.0, np.nan]), np.array([2.0, 4.0, 8.0, 1.0])
    assert mean_change(before, after, relative=True).estimate == pytest.approx(np.log(2.0))
    change = mean_change(before, after, relative=False)
    assert (change.estimate, change.units) == (pytest.approx(7.0 / 3.0), 3)
    assert change.error == pytest.approx(np.std([1.0, 2.0, 4.0], ddof=1) / np.sqrt(3.0))
    assert (change.baseline, change.candidate) == (2.0, 3.0)
    assert mean_change(before[3:], after[3:], relative=True).units == 0


def test_the_frames_needed_follow_the_square_of_error_over_distance() -> None:
    assert frames_needed(100, 0.05, 0.01, 1.0) == 2500
    assert frames_needed(100, 0.05, 0.0, 1.0) is None
    assert frames_needed(10, 1.0, 1e-6, 1.0) is None
    assert frames_needed(0, 0.05, 0.01, 1.0) is None
