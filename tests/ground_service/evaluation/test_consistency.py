"""Consistency against values from outside: printed tables of the chi-square distribution, hand-computed quadratics."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ground_service.evaluation.navigation.consistency import (
    bounds,
    bounds_per_degree,
    independent_samples,
    nees,
    squared_normalised_errors,
)


def test_a_correlated_error_is_weighted_with_the_whole_matrix() -> None:
    # P = [[4, 2], [2, 3]], inverse [[3, -2], [-2, 4]] / 8; e = (2, -1): (12 + 8 + 4) / 8 = 3. The diagonal alone gives
    # 4/4 + 1/3.
    covariance = [[4.0, 2.0], [2.0, 3.0]]
    assert nees([2.0, -1.0], covariance) == pytest.approx(3.0, rel=1e-12)
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
    assert bounds_per_degree(2, 50, 0.95) == pytest.approx((1.4844 / 2, 2.5912 / 2), abs=1e-4)
    assert np.isnan(bounds(0)[0]) and np.isnan(bounds_per_degree(6, 0.5, 0.95)).all()


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
