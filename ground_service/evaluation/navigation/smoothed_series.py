"""Smoothed orbit of a pass as a navigation series of the report."""

from __future__ import annotations

import numpy as np

from ground_service.evaluation.navigation.alignment import (
    ReferenceStates,
    drift_by_length,
    error_of_positions_rtn_m,
    navigation_statistics,
    nees,
    places_of_positions,
)
from ground_service.evaluation.navigation.smoother import CommandedBurn, FilterStates, SmootherModel, smooth
from lunar.arrays import FloatArray
from lunar.frames import Orientation
from lunar.gravity import GravityField
from lunar.gravity_omission import field_noise
from lunar.propagation import ForceModel
from reports.values import NavigationSeries

SMOOTHED = "smoothed"
SMOOTHER_DEGREE = 100
MAP_SIGMA_RTN_M, MAP_CORRELATION_RAD = (10.0, 40.0, 40.0), float(np.radians(30.0))
"""Remainder of the registration of the catalogue, as in the filter (`CommonErrors`)."""


def smoother_model(
    gravity: GravityField, orientation: Orientation, burns: tuple[CommandedBurn, ...]
) -> SmootherModel:
    """Return the smoother's model of the motion, with gravity to `SMOOTHER_DEGREE` or the degree of the field.

    The process noise is that of the filter: of the field, by its name, and of the map.
    """
    degree = min(SMOOTHER_DEGREE, gravity.degree)
    return SmootherModel(
        ForceModel(gravity, orientation, degree),
        burns=burns,
        field_noise=field_noise(gravity.name, degree),
        map_sigma_rtn_m=MAP_SIGMA_RTN_M,
        map_correlation_rad=MAP_CORRELATION_RAD,
    )


def smoothed_series(
    filtered: FilterStates,
    track: ReferenceStates,
    path_m: FloatArray,
    model: SmootherModel,
    reference_covariance_m2: FloatArray,
) -> NavigationSeries | None:
    """Return the errors of the smoothed orbit relative to the reference; None with fewer than two states.

    Parameters
    ----------
    filtered
        States in ICRF.
    track
        Reference at the times of `filtered`.
    path_m
        Length of the ground path up to each time (n,).
    reference_covariance_m2
        Covariance of the reference (3, 3), R/T/N, which the NEES adds to that of the estimate.
    """
    if len(filtered) < 2:
        return None
    smoothed = smooth(filtered, model)
    position = smoothed.state[:, :3]
    latitude, longitude, altitude = places_of_positions(track, position)
    error = error_of_positions_rtn_m(track, position)
    never = np.zeros(len(filtered), dtype=np.bool_)
    return NavigationSeries(
        name=SMOOTHED,
        kind=SMOOTHED,
        utc_ns=filtered.utc_ns,
        latitude_deg=latitude,
        longitude_deg=longitude,
        altitude_m=altitude,
        error_rtn_m=error,
        sigma_rtn_m=smoothed.sigma_rtn_m,
        statistics=navigation_statistics(error, path_m, never),
        description=(
            f"the filter smoothed on the ground with {model.forces.gravity.name} to degree "
            f"{model.forces.degree}, Earth and Sun"
        ),
        nees=nees(error, smoothed.position_covariance_rtn_m2 + reference_covariance_m2),
        drift_by_length=drift_by_length(error, path_m, never),
    )
