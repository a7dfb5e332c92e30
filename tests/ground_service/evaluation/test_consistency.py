"""Consistency against values from outside: printed tables of the chi-square distribution, hand-computed quadratics."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ground_service.evaluation.navigation.consistency import (
    average_bounds,
    bounds,
    independent_samples,
    nees,
    nis,
    share_inside,
    squared_normalised_errors,
    summary,
)


def test_a_correlated_error_is_weighted_with_the_whole_matrix() -> None:
    # P = [[4, 2], [2, 3]], inverse [[3, -2], [-2, 4]] / 8; e = (2, -1): (12 + 8 + 4) / 8 = 3. The diagonal alone gives
    # 4/4 + 1/3.
    covariance = [[4.0, 2.0], [2.0, 3.0]]
    assert nees([2.0, -1.0], covariance) == pytest.approx(3.0, rel=1e-12)
    assert nis([2.0, -1.0], covariance) == pytest.approx(3.0, rel=1e-12)
    assert squared_normalised_errors([2.0, -1.0], np.sqrt([4.0, 3.0])) == pytest.approx(4.0 / 3.0, rel=1e-12)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 6))
def test_it_does_not_depend_on_the_axes_or_units(seed: int, size: int) -> None:
    rng = np.random.default_rng(seed)
    root, turn = rng.standard_normal((2, size, size)) + 2.0 * np.eye(size)
    error, covariance = rng.standard_normal(size), root @ root.T + 0.1 * np.eye(size)
    change = turn @ np.diag(10.0 ** rng.uniform(-3.0, 3.0, size))
    expected = float(error @ np.linalg.inv(covariance) @ error)
    assert nees(error, covariance) == pytest.approx(expected, rel=1e-8)
    if np.linalg.cond(change) < 1e5:
        assert nees(change @ error, change @ covariance @ change.T) == pytest.approx(expected, rel=1e-4)


def test_what_is_not_known_is_not_guessed() -> None:
    good, error = np.diag([4.0, 9.0]), np.array([2.0, 3.0])
    singular = np.array([[1.0, 1.0], [1.0, 1.0]])
    indefinite = np.array([[1.0, 2.0], [2.0, 1.0]])
    lopsided = np.array([[1.0, 0.5], [0.0, 1.0]])
    negative = np.diag([-1.0, 1.0])
    missing = np.array([[np.nan, 0.0], [0.0, 1.0]])
    matrices = np.stack([good, singular, indefinite, lopsided, negative, missing, np.zeros((2, 2))])
    values = nees(np.broadcast_to(error, (7, 2)), matrices)
    assert values[0] == pytest.approx(2.0)
    assert np.isnan(values[1:]).all()
    assert np.isnan(nees([np.nan, 1.0], good))
    assert np.isnan(squared_normalised_errors([[1.0, 1.0], [np.nan, 1.0]], [[0.0, 1.0], [1.0, 1.0]])).all()


def test_no_samples_and_shapes_that_do_not_fit() -> None:
    assert nees(np.zeros((0, 3)), np.zeros((0, 3, 3))).shape == (0,)
    assert nees(np.ones((4, 5, 3)), np.eye(3)).shape == (4, 5)
    with pytest.raises(ValueError, match=r"expected errors \(..., d\)"):
        nees(np.ones(3), np.eye(2))


def test_bounds_are_those_of_printed_tables() -> None:
    # Quantiles of chi-square at 0.025 and 0.975 as tables print them (NIST/SEMATECH e-Handbook, 1.3.6.7.4).
    low, high = bounds([1, 3, 6, 100])
    np.testing.assert_allclose(high, [5.024, 9.348, 14.449, 129.561], atol=6e-4)
    np.testing.assert_allclose(low, [0.001, 0.216, 1.237, 74.222], atol=6e-4)
    # Bar-Shalom, Li, Kirubarajan, example 5.4.2: 50 runs of 2 degrees, [1.5, 2.6] (74.22/50 and 129.56/50).
    assert average_bounds(2, 50) == pytest.approx((1.4844, 2.5912), abs=1e-4)
    assert np.isnan(bounds(0)[0]) and np.isnan(average_bounds(6, 0.5)).all()


def test_the_share_inside_counts_known_values_only() -> None:
    values = [0.2, 0.3, 5.0, 9.3, 9.4, np.nan]
    assert share_inside(values, 3) == pytest.approx(3 / 5)
    assert share_inside([1.0, 1.0], [3, 0]) == 1.0
    assert np.isnan(share_inside([np.nan], 3))


def test_a_summary_of_few_values_by_hand() -> None:
    found = summary([2.0, 6.0, np.nan, 4.0], [2, 4, 4, 0], independent=2)
    # Sums 8 and 6 over the two known values, mean 3 degrees: bounds of chi-square(6) over 6.
    assert (found.samples, found.unknown) == (2, 2)
    assert found.mean_per_degree == pytest.approx(8.0 / 6.0)
    assert found.low_per_degree == pytest.approx(1.2373 / 6.0, abs=1e-4)
    assert found.high_per_degree == pytest.approx(14.4494 / 6.0, abs=1e-4)
    assert found.inside == 1.0 and found.met is True


@pytest.mark.parametrize(("factor", "met"), [(1.0, True), (0.5, False), (2.0, False)])
def test_consistent_samples_meet_their_bounds_and_others_do_not(factor: float, met: bool) -> None:
    rng = np.random.default_rng(4)
    root = np.tril(rng.standard_normal((3, 3))) + 2.0 * np.eye(3)
    errors = rng.standard_normal((400, 3)) @ root.T
    values = nees(errors, factor * root @ root.T)
    assert summary(values, 3, independent=400).met is met
    if met:
        # 400 draws: the share is known to 0.011.
        assert share_inside(values, 3) == pytest.approx(0.95, abs=0.035)


def test_nothing_known_is_neither_met_nor_missed() -> None:
    found = summary([np.nan, np.nan], 3)
    assert (found.samples, found.unknown, found.met) == (0, 2, None)
    assert np.isnan(found.inside)


def test_correlated_samples_are_worth_fewer() -> None:
    rng = np.random.default_rng(1)
    white = rng.standard_normal(4_000)
    assert independent_samples(white) > 2_000
    # First-order autoregression with 0.9: the integrated time is (1 + 0.9) / (1 - 0.9) = 19.
    slow = np.zeros(40_000)
    for k in range(1, slow.size):
        slow[k] = 0.9 * slow[k - 1] + rng.standard_normal()
    assert independent_samples(slow) == pytest.approx(slow.size / 19.0, rel=0.25)
    assert independent_samples(np.ones(50)) == 1.0
    assert independent_samples([np.nan, 1.0]) == 1.0
