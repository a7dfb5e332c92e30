"""Updates of the orbit filter with scalar measurements, such as a range.

A measurement carries its own model: predicted value, derivatives by the filter states and standard deviations. The
gate uses the standard deviation of a single measurement. The update uses one that is larger where the errors of
successive measurements are correlated, so that their mean is weighted correctly.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lunar.arrays import FloatArray
from payload_emulator.flight.navigation.filter import FilterState, corrected_covariance
from payload_emulator.flight.navigation.sighting import LandmarkMap


@dataclass(frozen=True, slots=True, eq=False)
class ScalarPrediction:
    """Prediction of a measurement.

    Attributes
    ----------
    value
        In the unit of the measurement.
    design
        Derivatives by all states of the filter, shape (18 + 3 m,).
    sigma
        Standard deviation of one measurement about the value of the true state.
    lasting_share
        Correlation from 0 to below 1 of the error with that of the measurement before.
    """

    value: float
    design: FloatArray
    sigma: float
    lasting_share: float = 0.0


Model = Callable[[FilterState, FloatArray, LandmarkMap], ScalarPrediction | None]
"""From state, mcmf_from_icrf (3, 3) and landmark map to a prediction; None where there is none."""


@dataclass(frozen=True, slots=True, eq=False)
class ScalarMeasurement:
    """A measurement at an on-board time; beyond `gate_sigmas` of its predicted spread it is refused."""

    ticks: int
    value: float
    model: Model
    gate_sigmas: float


@dataclass(frozen=True, slots=True)
class Innovation:
    """Measurement minus prediction, its predicted standard deviation, and whether the filter used it."""

    residual: float
    sigma: float
    used: bool


def scalar_update(
    prior: FilterState, measurement: ScalarMeasurement, prediction: ScalarPrediction
) -> tuple[FilterState, Innovation] | None:
    """Return the state after a measurement, the prior itself where the gate refuses it; None for numbers without use.

    The mean of n values of a first-order Gauss-Markov sequence with correlation rho between neighbours has the variance
    sigma^2 (1 + rho) / (n (1 - rho)) for large n, so each value is weighted with sigma^2 (1 + rho) / (1 - rho).
    """
    design = prediction.design[None, :]
    carried = float((design @ prior.covariance @ design.T)[0, 0])
    variance = prediction.sigma**2
    spread = carried + variance
    residual = measurement.value - prediction.value
    if not (math.isfinite(residual) and math.isfinite(spread) and spread > 0.0):
        return None
    sigma = math.sqrt(spread)
    if abs(residual) > measurement.gate_sigmas * sigma:
        return prior, Innovation(residual, sigma, used=False)
    share = prediction.lasting_share
    noise = variance * (1.0 + share) / (1.0 - share)
    gain = (prior.covariance @ design.T) / (carried + noise)
    covariance = corrected_covariance(prior.covariance, design, gain, np.array([[noise]]))
    state = FilterState(prior.ticks, prior.mean + gain[:, 0] * residual, covariance, prior.craters)
    return (state, Innovation(residual, sigma, used=True)) if state.finite else None
