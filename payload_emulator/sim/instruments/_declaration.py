"""What a session needs to know of a simulated instrument, and what an instrument sees of the simulated world."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from lunar.arrays import FloatArray
from payload_emulator.sim.terrain.tiles import Terrain


class Limit(NamedTuple):
    """Whether a setting is valid, its key, what is expected and what was found."""

    good: bool
    key: str
    expected: str
    found: object


@dataclass(frozen=True, slots=True, eq=False)
class Surroundings:
    """What stays the same during a session."""

    terrain: Terrain
    seed: int

    def rng(self, name: str, *numbers: int) -> np.random.Generator:
        """Return the random numbers of an instrument and of the given numbers, such as a time of sampling."""
        return np.random.default_rng((self.seed, zlib.crc32(name.encode()), *numbers))


@dataclass(frozen=True, slots=True, eq=False)
class Situation:
    """True situation of the spacecraft at the time of a sample.

    Attributes
    ----------
    elapsed_s
        Time since the sample before; None for the first one after the instrument was switched on.
    position_icrf_m, position_mcmf_m
        From the Moon's centre, shape (3,).
    camera_from_icrf, mcmf_from_icrf
        Rotations (3, 3).
    """

    utc_ns: int
    elapsed_s: float | None
    position_icrf_m: FloatArray
    position_mcmf_m: FloatArray
    camera_from_icrf: FloatArray
    mcmf_from_icrf: FloatArray


@dataclass(frozen=True, slots=True)
class SimulatedInstrument:
    """Simulated side of an instrument. It is on while frames are taken.

    Attributes
    ----------
    name
        Name of the instrument and of its section in scenarios.
    settings
        Frozen dataclass of the section whose values all have defaults.
    limits
        From settings to the limits that they must keep.
    cadence_s
        From settings to the time between samples.
    delay_s
        From settings to the time between the newest sample before a frame and the frame.
    data_sheet
        From settings to values of the on-board parameters: what the ground knows of the instrument.
    start
        From settings and surroundings to the state of the instrument when it is switched on for the first time.
    measure
        From settings, state, surroundings and situation to the new state and one sample: the columns that the on-board
        side declares, without the time.
    replaces
        Keys of other sections that have no effect together with this instrument; they must keep their defaults.
    gives_attitude
        The message of the ADCS has no attitude where this instrument is configured.
    """

    name: str
    settings: type
    limits: Callable[[Any], tuple[Limit, ...]]
    cadence_s: Callable[[Any], float]
    delay_s: Callable[[Any], float]
    data_sheet: Callable[[Any], Mapping[str, object]]
    start: Callable[[Any, Surroundings], Any]
    measure: Callable[[Any, Any, Surroundings, Situation], tuple[Any, tuple[float, ...]]]
    replaces: tuple[str, ...] = ()
    gives_attitude: bool = False
