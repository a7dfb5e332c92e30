"""Telemetry of the laser altimeter."""

from __future__ import annotations

from tmtc.fields import Field
from tmtc.instruments import InstrumentTelemetry, Residual, sample_packet

TELEMETRY = InstrumentTelemetry(
    "altimeter",
    "Laser altimeter",
    4,
    sample_packet(
        "altimeter",
        16,
        "Ranges of the laser altimeter since the frame before, and what the filter made of them",
        (
            Field("range_m", "f32", "Range along the boresight of the camera, NaN without an echo", "m"),
            Field("innovation", "f32", "Range minus prediction, NaN where there is none", "m"),
            Field(
                "innovation_sigma",
                "f32",
                "Standard deviation of it as predicted, NaN where there is none",
                "m",
            ),
        ),
    ),
    (Residual("range", "innovation", "innovation_sigma", "m"),),
)
