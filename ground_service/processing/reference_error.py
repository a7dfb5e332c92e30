"""What the reference contributes to an observed error: its covariance in NEES, and the error budget.

The reference is taken to be independent of the estimate: observed covariance = estimate + reference. That holds for a
filter that has forgotten its start state, not for odometry that is reset to the anchor ephemeris.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from reports.values import ErrorBudget

FloatArray = NDArray[np.float64]

Sigma = tuple[float, float, float]


def reference_covariance_m2(sigma_rtn_m: Sigma | None) -> FloatArray:
    """Return the covariance (3, 3) of the reference in R/T/N; zero where its error is not declared."""
    return np.diag(np.square(sigma_rtn_m or (0.0, 0.0, 0.0)))


def error_budget(error_rtn_m: FloatArray, reference_sigma_rtn_m: Sigma | None) -> ErrorBudget | None:
    """Return how the observed error (n, 3) splits; None without errors or without a declared reference error."""
    known = np.isfinite(error_rtn_m).all(axis=1)
    if reference_sigma_rtn_m is None or not known.any():
        return None
    observed = float(np.mean(np.sum(error_rtn_m[known] ** 2, axis=1)))
    reference = float(np.sum(np.square(reference_sigma_rtn_m)))
    rest = observed - reference
    return ErrorBudget(observed**0.5, reference**0.5, rest**0.5 if rest >= 0.0 else float("nan"))
