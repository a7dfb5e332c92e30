"""Limits from healthy passes, against the published factors of one-sided normal tolerance bounds."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.requirement_bounds import tolerance_bound

VALUES = np.tile([-1.0, 1.0], 5)


@pytest.mark.parametrize(("confidence", "factor"), [(0.95, 2.911), (0.90, 2.568)])
def test_the_bound_of_ten_values_has_the_published_factor(confidence: float, factor: float) -> None:
    values = list(3.0 + 2.0 * VALUES / np.std(VALUES, ddof=1))
    assert tolerance_bound(values, True, 0.95, confidence) == pytest.approx(3.0 + 2.0 * factor, abs=2e-3)
    assert tolerance_bound(values, False, 0.95, confidence) == pytest.approx(3.0 - 2.0 * factor, abs=2e-3)


def test_one_pass_gives_no_bound() -> None:
    assert np.isnan(tolerance_bound([1.0], True, 0.95, 0.9))
