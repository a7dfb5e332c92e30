"""Contribution of the reference to observed errors: its covariance in the NEES, and the error budget.

The reference is assumed independent of the estimate: observed covariance = estimate + reference. This holds for a
filter whose initial state no longer has any influence, but not for odometry that is reset to the anchor ephemeris.
"""

from __future__ import annotations

import numpy as np

from lunar.arrays import FloatArray
from reports.values import ErrorBudget

Sigma = tuple[float, float, float]


def reference_covariance_m2(sigma_rtn_m: Sigma | None) -> FloatArray:
    """Return the covariance (3, 3) of the reference in R/T/N; zero if its error is not declared."""
    return np.diag(np.square(sigma_rtn_m or (0.0, 0.0, 0.0)))


def error_budget(error_rtn_m: FloatArray, reference_sigma_rtn_m: Sigma | None) -> ErrorBudget | None:
    """Return the error budget of an observed error (n, 3); None without errors or a declared reference error."""
    known = np.isfinite(error_rtn_m).all(axis=1)
    if reference_sigma_rtn_m is None or not known.any():
        return None
    observed = float(np.mean(np.sum(error_rtn_m[known] ** 2, axis=1)))
    reference = float(np.sum(np.square(reference_sigma_rtn_m)))
    rest = observed - reference
    return ErrorBudget(observed**0.5, reference**0.5, rest**0.5 if rest >= 0.0 else float("nan"))
