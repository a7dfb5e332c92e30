"""Conditions of a pass, by which performance over many passes is grouped."""

from __future__ import annotations

from typing import Any

import numpy as np

from ground_service.evaluation.core import PassInputs
from ground_service.evaluation.navigation.alignment import reference_states
from lunar.arrays import FloatArray
from lunar.third_bodies import sun_position_icrf_m
from lunar.timescales import tdb_s_from_utc_ns
from lunar.visibility import sun_elevation_azimuth

SAMPLES = 61
"""Epochs of the reference over the pass, from which the medians are computed."""


def conditions_of(inputs: PassInputs) -> dict[str, Any]:
    """Return median altitude and elevation of the Sun along the reference, the build, and the judged estimator.

    Altitude is above the sphere, elevation at the sub-satellite point; both are None where the reference or the
    orientation is unknown.
    """
    utc_ns = np.linspace(inputs.start_utc_ns, inputs.stop_utc_ns, SAMPLES).astype(np.int64)
    track = reference_states(inputs.reference, inputs.orientation, utc_ns)
    tdb_s = np.asarray(tdb_s_from_utc_ns(utc_ns))
    sun_mcmf_m = np.einsum("nij,nj->ni", track.mcmf_from_icrf, sun_position_icrf_m(tdb_s))
    latitude, longitude = np.radians(track.latitude_deg), np.radians(track.longitude_deg)
    elevation_rad, _ = sun_elevation_azimuth(latitude, longitude, sun_mcmf_m)
    return {
        "altitude_km": _median(track.altitude_m / 1e3),
        "sun_elevation_deg": _median(np.degrees(elevation_rad)),
        "build": inputs.build,
        "estimator": inputs.limits.estimator,
    }


def _median(values: FloatArray) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else None
