"""Telemetry of the star tracker with its gyroscopes."""

from __future__ import annotations

from tmtc.fields import Field
from tmtc.instruments import ATTITUDE, InstrumentTelemetry, Residual, sample_packet

TELEMETRY = InstrumentTelemetry(
    "star_tracker",
    "Star tracker",
    5,
    sample_packet(
        "star_tracker",
        17,
        "Attitude from star tracker and gyroscopes at a frame, and the residuals of the star tracker before it",
        (
            Field(
                "cross_x_arcsec",
                "f32",
                "Residual about the first cross-boresight axis, NaN without one",
                "arcsec",
            ),
            Field(
                "cross_y_arcsec",
                "f32",
                "Residual about the second cross-boresight axis, NaN without one",
                "arcsec",
            ),
            Field("roll_arcsec", "f32", "Residual about the boresight, NaN without one", "arcsec"),
            Field(
                "cross_x_sigma_arcsec", "f32", "Standard deviation of cross_x_arcsec as predicted", "arcsec"
            ),
            Field(
                "cross_y_sigma_arcsec", "f32", "Standard deviation of cross_y_arcsec as predicted", "arcsec"
            ),
            Field("roll_sigma_arcsec", "f32", "Standard deviation of roll_arcsec as predicted", "arcsec"),
        ),
        (
            Field(
                ATTITUDE,
                "f64",
                "Quaternion w, x, y, z of camera from ICRF at the frame, NaN if unknown",
                size=4,
            ),
            Field(
                "attitude_sigma_deg", "f32", "Standard deviation about the worst axis, NaN if unknown", "deg"
            ),
            Field("gyro_bias_deg_h", "f32", "Estimated bias of the gyroscopes, camera axes", "deg/h", size=3),
            Field("tracking_age_s", "f32", "Time since the star tracker was last used, NaN if never", "s"),
        ),
    ),
    (
        Residual("cross-boresight x", "cross_x_arcsec", "cross_x_sigma_arcsec", "arcsec"),
        Residual("cross-boresight y", "cross_y_arcsec", "cross_y_sigma_arcsec", "arcsec"),
        Residual("roll", "roll_arcsec", "roll_sigma_arcsec", "arcsec"),
    ),
)
