"""What flight software needs to know of an instrument, and what passes between the instrument and the navigation."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from lunar.arrays import FloatArray
from payload_emulator.flight.navigation.filter import AttitudeError
from payload_emulator.flight.navigation.scalar import ScalarMeasurement


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeEstimate:
    """Attitude of the camera at the time of a frame; None: unknown.

    Attributes
    ----------
    sigma_rad
        Standard deviation about each axis.
    error
        How the error depends on that of the frame before; None: it is independent in each frame.
    """

    camera_from_icrf: FloatArray | None
    sigma_rad: float | None = None
    error: AttitudeError | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Knowledge:
    """What is known on board when the samples of a frame are processed.

    Attributes
    ----------
    ticks
        On-board time of the frame.
    attitude
        Attitude at that time.
    before
        On-board time and rotation camera_from_icrf (3, 3) of the newest earlier frame with attitude.
    """

    ticks: int
    attitude: AttitudeEstimate
    before: tuple[int, FloatArray] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """A measurement for the orbit filter and the row of the sample that it comes from."""

    row: int
    measurement: ScalarMeasurement


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """Outcome of the samples of a frame.

    Attributes
    ----------
    state
        State of the instrument's processing after them.
    rows
        Fields of the telemetry packet for each sample. For measurements of the orbit the status, `innovation` and
        `innovation_sigma` are added once the filter has processed them.
    frame
        Fields of the packet for the frame as a whole.
    measurements
        For the orbit filter, in order of time.
    attitude
        None: the instrument gives none.
    """

    state: Any
    rows: tuple[Mapping[str, object], ...] = ()
    frame: Mapping[str, object] = field(default_factory=dict)
    measurements: tuple[Measured, ...] = ()
    attitude: AttitudeEstimate | None = None


@dataclass(frozen=True, slots=True)
class FlightInstrument:
    """On-board side of an instrument.

    Attributes
    ----------
    name
        Name of the instrument, of its telemetry packet and of its parameters.
    columns
        Numbers of one sample; the first is always the on-board time, `ticks`.
    parameters
        Frozen dataclass whose values are all defaults: what the data sheet says and how samples are used.
    start
        From parameters to the state of the processing after a boot.
    step
        From parameters, state, samples (n, k) in order of time and present knowledge to a reading. Called once for
        every frame, also without samples.
    gives_attitude
        The instrument gives the attitude in place of the message of the ADCS.
    """

    name: str
    columns: tuple[str, ...]
    parameters: type
    start: Callable[[Any], Any]
    step: Callable[[Any, Any, FloatArray, Knowledge], Reading]
    gives_attitude: bool = False
