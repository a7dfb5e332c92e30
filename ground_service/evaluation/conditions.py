"""Conditions of a pass, by which performance over many passes is grouped."""

from __future__ import annotations

from typing import Any

import numpy as np

from ground_service.evaluation.core import PassInputs
from ground_service.evaluation.extras import sun_angles
from ground_service.evaluation.navigation.alignment import reference_states
from lunar.arrays import FloatArray

SAMPLES = 61
"""Epochs of the reference over the pass, from which the medians are computed."""


def conditions_of(inputs: PassInputs) -> dict[str, Any]:
    """Return median altitude and elevation of the Sun along the reference, the build, and the judged estimator.

    Altitude is above the sphere, elevation at the sub-satellite point; both are None where the reference or the
    orientation is unknown, the elevation also where the images had another light than that of the ephemeris.
    """
    utc_ns = np.linspace(inputs.start_utc_ns, inputs.stop_utc_ns, SAMPLES).astype(np.int64)
    track = reference_states(inputs.reference, inputs.orientation, utc_ns)
    return {
        "altitude_km": _median(track.altitude_m / 1e3),
        "sun_elevation_deg": _median(sun_angles(track).elevation_deg) if inputs.sun_known else None,
        "build": inputs.build,
        "estimator": inputs.limits.estimator,
    }


def _median(values: FloatArray) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else None
