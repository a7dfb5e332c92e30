"""All instruments of a payload together: samples of a frame in, attitude, measurements and telemetry out."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np

from lunar.arrays import FloatArray
from payload_emulator.flight.instruments import (
    AttitudeEstimate,
    Knowledge,
    Reading,
    flight_instruments,
)
from payload_emulator.flight.navigation.scalar import Innovation, ScalarMeasurement
from tmtc.cuc import TICKS_LIMIT

Samples = Mapping[str, FloatArray]
"""Samples of each instrument by its name, (n, k): rows, the on-board time first."""

NO_SAMPLES: Samples = MappingProxyType({})

# A packet counts its samples with one octet.
_MOST_SAMPLES = 255
_NAN = float("nan")
_STATUS_USED, _STATUS_GATED, _STATUS_NO_MODEL = "used", "gated", "no_model"


@dataclass(frozen=True, slots=True, eq=False)
class SuiteState:
    """State of the processing of each installed instrument, and the newest attitude of a frame."""

    states: Mapping[str, Any] = field(default_factory=dict)
    before: tuple[int, FloatArray] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class FrameReadings:
    """Readings of all installed instruments at a frame, and the attitude that follows from them."""

    attitude: AttitudeEstimate
    readings: tuple[tuple[str, Reading], ...] = ()

    @property
    def measurements(self) -> tuple[tuple[str, int, ScalarMeasurement], ...]:
        """Measurements for the orbit filter in order of time: instrument, row, measurement."""
        found = (
            (name, one.row, one.measurement)
            for name, reading in self.readings
            for one in reading.measurements
        )
        return tuple(sorted(found, key=lambda one: one[2].ticks))


def start_suite(parameters: Mapping[str, Any]) -> SuiteState:
    """Return the state after a boot; `parameters` holds those of each installed instrument by name."""
    return SuiteState({name: flight_instruments()[name].start(values) for name, values in parameters.items()})


def read_frame(
    parameters: Mapping[str, Any],
    state: SuiteState,
    samples: Samples,
    ticks: int,
    camera_from_icrf: FloatArray | None,
) -> tuple[SuiteState, FrameReadings]:
    """Return the state after the samples of a frame, and their readings.

    Samples of instruments that are not installed, of another shape or without a time are ignored.

    Parameters
    ----------
    ticks
        On-board time of the frame.
    camera_from_icrf
        Attitude from the message of the ADCS, shape (3, 3), None without one. It is not used where an installed
        instrument gives the attitude.
    """
    attitude = AttitudeEstimate(camera_from_icrf)
    states, readings = dict(state.states), list[tuple[str, Reading]]()
    for name, instrument in flight_instruments().items():
        if name not in parameters:
            continue
        usable = _usable(samples.get(name), len(instrument.columns), ticks)
        reading = instrument.step(
            parameters[name], states[name], usable, Knowledge(ticks, attitude, state.before)
        )
        states[name] = reading.state
        if instrument.gives_attitude:
            attitude = reading.attitude or AttitudeEstimate(None)
        readings.append((name, reading))
    known = attitude.camera_from_icrf
    before = state.before if known is None else (ticks, known)
    return SuiteState(states, before), FrameReadings(attitude, tuple(readings))


def packets(
    found: FrameReadings,
    innovations: Sequence[Innovation | None],
    frame_number: int,
    ticks: int,
) -> Iterator[tuple[str, dict[str, object]]]:
    """Yield name and values of the telemetry packet of each instrument that had samples.

    Parameters
    ----------
    innovations
        Of `found.measurements`, in their order; None where the filter could not predict the measurement.
    """
    outcome = {
        (name, row): innovation
        for (name, row, _), innovation in zip(found.measurements, innovations, strict=True)
    }
    for name, reading in found.readings:
        rows = [
            {**row, **_outcome_fields(outcome[name, k])} if (name, k) in outcome else row
            for k, row in enumerate(reading.rows)
        ]
        if rows:
            yield (
                name,
                {"frame_number": frame_number, "frame_ticks": ticks, **reading.frame, "items": rows},
            )


def _outcome_fields(innovation: Innovation | None) -> dict[str, object]:
    if innovation is None:
        return {"sample_status": _STATUS_NO_MODEL, "innovation": _NAN, "innovation_sigma": _NAN}
    return {
        "sample_status": _STATUS_USED if innovation.used else _STATUS_GATED,
        "innovation": innovation.residual,
        "innovation_sigma": innovation.sigma,
    }


def _usable(samples: FloatArray | None, columns: int, ticks: int) -> FloatArray:
    """Return the newest samples up to the time of the frame in order of time, shape (n, columns)."""
    if samples is None or samples.ndim != 2 or samples.shape[1] != columns:
        return np.zeros((0, columns))
    with np.errstate(invalid="ignore"):
        timed = samples[(samples[:, 0] >= 0.0) & (samples[:, 0] <= min(ticks, TICKS_LIMIT - 1))]
    return timed[np.argsort(timed[:, 0], kind="stable")][-_MOST_SAMPLES:]
