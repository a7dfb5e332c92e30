"""Prediction of the orbit estimate to the time of a frame, over the planned burns."""

from __future__ import annotations

import numpy as np

from payload_emulator.flight.navigation import filter as kalman
from payload_emulator.flight.navigation.anchored_parameters import AnchoredLimits
from payload_emulator.flight.navigation.dynamics import OrbitModel
from payload_emulator.flight.navigation.filter import CommonErrors, FilterState
from tmtc.tables import BurnTable


def predicted(
    estimate: FilterState, ticks: int, model: OrbitModel, burns: BurnTable, errors: CommonErrors
) -> FilterState | None:
    """Return the estimate at another on-board time; None outside the orientation table.

    Burns between the two times are applied, in reverse where the prediction goes back in time.
    """
    sense = 1.0 if ticks >= estimate.ticks else -1.0
    low, high = np.searchsorted(burns.ticks, sorted((estimate.ticks, ticks)), side="right")
    for k in range(low, high)[:: int(sense)]:
        reached = kalman.predict(estimate, int(burns.ticks[k]), model, errors)
        if reached is None:
            return None
        estimate = kalman.burn(reached, sense * burns.delta_v_icrf_m_s[k], float(burns.sigma_m_s[k]))
    return kalman.predict(estimate, ticks, model, errors)


def is_usable(estimate: FilterState, limits: AnchoredLimits) -> bool:
    """Return whether an estimate is finite and within the allowed distances from the Moon's centre."""
    radius_m = float(np.linalg.norm(estimate.mean[kalman.POSITION]))
    return estimate.finite and limits.lowest_radius_m < radius_m < limits.highest_radius_m
