"""Interfaces of the payload with the board it runs on and with the spacecraft (Fig. 1 of the paper).

Frames, attitude, time and telecommands come through `Payload.step`; everything else through a `Board`. All that
crosses is arrays, counts and octets, so that nothing of a simulated truth can.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum
from typing import Protocol

import numpy as np

from lunar.arrays import FloatArray, OctetArray

Memory = OctetArray

UNLIMITED = 1 << 62
SENSORS = ("bus_voltage_v", "bus_current_a", "temperature_c", "camera_temperature_c")
STORE_OCTETS = 4 << 20
SETTINGS_OCTETS = 64 << 10


class ResetCause(IntEnum):
    """Why the processor started: a register of the board."""

    power_on = 0
    commanded = 1
    watchdog = 2
    brown_out = 3


class Stage(IntEnum):
    """What the processor is busy with; the board's counter is read at every change."""

    idle = 0
    commands = 1
    detector = 2
    navigation = 3
    telemetry = 4
    monitoring = 5


class Load(IntEnum):
    """Switched outputs of the power supply, as bits."""

    camera = 1
    accelerator = 2


class Board(Protocol):
    """What flight software finds around itself.

    Attributes
    ----------
    reset_cause
        A `ResetCause`.
    store, settings
        Non-volatile memory for packets and for settings, uint8, kept through resets.
    """

    reset_cause: int
    store: Memory
    settings: Memory

    def sensors(self) -> FloatArray:
        """Readings in the order of `SENSORS` (EPS, thermistors), NaN where one is dead."""
        ...

    def switch(self, loads: int) -> None:
        """Power the loads whose bits are set, and no others (EPS)."""
        ...

    def enter(self, stage: int) -> int:
        """Begin a stage; the processor's time counter in nanoseconds."""
        ...

    def memory_octets(self) -> int:
        """Working memory in use."""
        ...

    def uptime_ticks(self) -> int:
        """Free-running counter of 2^-16 s since power-on, -1 where the board has none."""
        ...

    def downlink_octets(self) -> int:
        """Octets of packets that TM/TC takes now; 0 without a link."""
        ...

    def load(self, region: int, octets: bytes) -> Memory:
        """Put octets into working memory; the memory itself comes back, so that it can be checked."""
        ...

    def read_table(self, number: int) -> bytes:
        """A table or model from non-volatile memory, empty where there is none."""
        ...

    def write_table(self, number: int, octets: bytes) -> None:
        """Keep a table or model in non-volatile memory."""
        ...

    def request_reset(self, cause: int) -> None:
        """Start the processor anew once this step is over."""
        ...


@dataclass(slots=True, eq=False)
class BareBoard:
    """A board without a simulation behind it: steady sensors, no counters, a link that takes everything."""

    reset_cause: int = ResetCause.power_on
    store: Memory = field(default_factory=lambda: np.zeros(STORE_OCTETS, dtype=np.uint8))
    settings: Memory = field(default_factory=lambda: np.zeros(SETTINGS_OCTETS, dtype=np.uint8))
    readings: FloatArray = field(default_factory=lambda: np.array([12.0, 0.5, 20.0, 20.0]))
    tables: dict[int, bytes] = field(default_factory=dict)

    def sensors(self) -> FloatArray:
        return self.readings

    def switch(self, loads: int) -> None:
        pass

    def enter(self, stage: int) -> int:
        return 0

    def memory_octets(self) -> int:
        return sum(map(len, self.tables.values())) + self.store.size + self.settings.size

    def uptime_ticks(self) -> int:
        return -1

    def downlink_octets(self) -> int:
        return UNLIMITED

    def load(self, region: int, octets: bytes) -> Memory:
        return np.frombuffer(octets, dtype=np.uint8).copy()

    def read_table(self, number: int) -> bytes:
        return self.tables.get(number, b"")

    def write_table(self, number: int, octets: bytes) -> None:
        self.tables[number] = octets

    def request_reset(self, cause: int) -> None:
        self.reset_cause = cause
