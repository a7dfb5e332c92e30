"""What a number of frames can detect, stated before anything is run."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from ground_service.regression.gates.core import POWER, WINDOW_FRAMES, GatePolicy
from ground_service.regression.gates.statistics import student_quantile

SPREAD = {
    "detector.recall": 0.08,
    "detector.precision": 0.09,
    "detector.localisation": 0.3,
    "navigation.anchored.fixes": 0.13,
}
"""Standard error of the change by a threshold of 0.3, times the root of the number of frames.

Measured over the 42 windows of `python -m benchmarks.gate_error_rates`. For a network of similar quality it is a fifth.
"""

MINUTES_PER_FRAME = 0.005
"""Time of a candidate from stored frames on one core."""


def detectable(policy: GatePolicy, frames: int, passes: int) -> list[dict[str, Any]]:
    """Return the loss of each primary metric that fails with a power of 0.8."""
    found = []
    for rule in policy.rules:
        if rule.metric in SPREAD and frames:
            level = policy.fail_level * rule.weight / (2.0 if passes > 1 else 1.0)
            reach = student_quantile(1.0 - level, 1e9) + student_quantile(POWER, 1e9)
            materiality, _ = rule.sizes(frames < WINDOW_FRAMES)
            change = round(materiality + reach * SPREAD[rule.metric] / math.sqrt(frames), 3)
            minutes = round(frames * MINUTES_PER_FRAME, 1)
            found.append({"metric": rule.metric, "change": change, "frames": frames, "minutes": minutes})
    return found


def power_text(found: Sequence[dict[str, Any]]) -> str:
    """Return the frames and minutes of all passes together and the losses that they detect, as one line."""
    told = ", ".join(f"{one['metric']} {one['change']:.2g}" for one in found)
    cost = "{frames} frames, {minutes} minutes of a core for the candidate".format(**found[0])
    return f"all passes together ({cost}) find with a power of {POWER:g} a loss of: {told}"
