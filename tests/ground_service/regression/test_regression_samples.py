"""Figures of one estimator by frame: what it claims against what it errs by."""

from __future__ import annotations

import numpy as np
import pytest

from ground_service.regression.gates.samples import _estimator


def test_squared_normalised_errors_are_summed_over_the_axes_and_unknown_without_every_sigma() -> None:
    error = np.array([[3.0, 8.0, 10.0], [3.0, 8.0, 10.0], [3.0, 8.0, 10.0], [np.nan, 8.0, 10.0]])
    sigma = np.array([[1.0, 2.0, 5.0], [1.0, 2.0, np.nan], [1.0, 0.0, 5.0], [1.0, 2.0, 5.0]])
    frames = _estimator(error, sigma, {})
    # 3^2 + 4^2 + 2^2; a sigma of zero is no claim that can be judged.
    assert frames.squared_normalised_error[0] == pytest.approx(29.0)
    assert np.isnan(frames.squared_normalised_error[1:]).all()
    assert not hasattr(frames, "nees")
