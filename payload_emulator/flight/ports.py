"""Interfaces of the payload with the board it runs on and with the spacecraft (Fig. 1 of the paper).

Frames, attitude, time and telecommands come through `Payload.step`; everything else through a `Board`. Only
arrays, counts and octets cross these interfaces, so that no simulated truth can.
"""

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
    """Cause of the last processor start, from a register of the board."""

    power_on = 0
    commanded = 1
    watchdog = 2
    brown_out = 3


class Stage(IntEnum):
    """Current task of the processor; the board's counter is read at every change."""

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
    """Hardware interface of the flight software.

    Attributes
    ----------
    reset_cause
        Value of `ResetCause`.
    store, settings
        Non-volatile memory for packets and for settings, uint8, retained over resets.
    """

    reset_cause: int
    store: Memory
    settings: Memory

    def sensors(self) -> FloatArray:
        """Return readings in the order of `SENSORS` (EPS, thermistors); NaN for a failed sensor."""
        ...

    def switch(self, loads: int) -> None:
        """Switch on the loads whose bits are set, and switch off all others (EPS)."""
        ...

    def enter(self, stage: int) -> int:
        """Begin a stage; return the processor's time counter in nanoseconds."""
        ...

    def memory_octets(self) -> int:
        """Return the octets of working memory in use."""
        ...

    def uptime_ticks(self) -> int:
        """Return the free-running counter of 2^-16 s since power-on; -1 if the board has none."""
        ...

    def downlink_octets(self) -> int:
        """Return the octets of packets that TM/TC accepts now; 0 without a link."""
        ...

    def load(self, region: int, octets: bytes) -> Memory:
        """Write octets to working memory; return the memory itself, so that it can be checked."""
        ...

    def read_table(self, number: int) -> bytes:
        """Return a table or model from non-volatile memory; empty if there is none."""
        ...

    def write_table(self, number: int, octets: bytes) -> None:
        """Store a table or model in non-volatile memory."""
        ...

    def request_reset(self, cause: int) -> None:
        """Restart the processor at the end of this step."""
        ...


@dataclass(slots=True, eq=False)
class BareBoard:
    """Board without a simulation: constant sensor readings, no counters and an unlimited link."""

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
