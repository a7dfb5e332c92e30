"""Fault detection: what the payload notices about itself. Each monitor reports once and says what is to be done."""

from dataclasses import dataclass, field
from enum import IntEnum

from lunar.arrays import FloatArray
from payload_emulator.flight.onboard.settings import ParameterStore
from payload_emulator.flight.ports import SENSORS
from payload_emulator.flight.telemetry.packets import Telemetry
from payload_emulator.flight.vision.preprocess import ImageQuality
from tmtc.packets.pus import TICKS_PER_SECOND

_VOLTAGE, _TEMPERATURE = SENSORS.index("bus_voltage_v"), SENSORS.index("temperature_c")
# A limit counts as left only when it is left by this much, so that noise makes no stream of events.
_HYSTERESIS = 0.02


class Reaction(IntEnum):
    """Reaction that a monitor requests."""

    none = 0
    cycle_camera = 1
    end_observation = 2
    go_safe = 3


@dataclass(slots=True, eq=False)
class Monitors:
    """Counters and latches of all monitors."""

    telemetry: Telemetry
    parameters: ParameterStore
    _present: set[str] = field(default_factory=set)
    _reported: dict[str, int] = field(default_factory=dict)
    _bad_images: int = 0
    _missing_images: int = 0
    _cycles: int = 0
    _detector_failures: int = 0

    def sensors(self, readings: FloatArray) -> Reaction:
        """Voltage and temperature of the board against their limits; a dead sensor breaks none."""
        voltage, temperature = float(readings[_VOLTAGE]), float(readings[_TEMPERATURE])
        limit = self.parameters
        self.latch("medium", "temperature_high", temperature, limit["temperature_high_c"], +1)
        self.latch("low", "temperature_low", temperature, limit["temperature_low_c"], -1)
        self.latch("medium", "power_low", voltage, limit["voltage_low_v"], -1)
        if temperature > limit["temperature_safe_c"] or voltage < limit["voltage_safe_v"]:
            return Reaction.go_safe
        return Reaction.none

    def memory(self, used_kib: float) -> None:
        """Memory in use against its limit."""
        self.latch("medium", "memory_high", used_kib, self.parameters["memory_high_kib"], +1)

    def store(self, overwritten: int, refused: int) -> None:
        """Packets lost from the store before they were sent, or not taken."""
        self._growing("medium", "store_overwritten", overwritten)
        self._growing("high", "storage_full", refused)

    def image(self, present: bool, quality: ImageQuality) -> Reaction:
        """Streaks of bad images are reported once; a camera without images is switched off and on, then given up."""
        limit = self.parameters
        if not present:
            self._missing_images += 1
            if self._missing_images % int(limit["camera_fault_frames"]) == 0:
                self._cycles += 1
                self.telemetry.event("high", "camera_fault", float(self._missing_images), float(self._cycles))
                if self._cycles > limit["camera_cycles"]:
                    self._missing_images = self._cycles = 0
                    return Reaction.end_observation
                return Reaction.cycle_camera
            return Reaction.none
        if self._cycles:
            self.telemetry.event("info", "camera_recovered", float(self._missing_images), float(self._cycles))
        self._missing_images = self._cycles = 0
        if quality is ImageQuality.OK:
            if self.in_streak:
                self.telemetry.event("info", "image_streak", 0.0, float(self._bad_images))
            self._bad_images = 0
            return Reaction.none
        self._bad_images += 1
        if self._bad_images == int(limit["streak_frames"]):
            self.telemetry.event("medium", "image_streak", float(quality), float(self._bad_images))
        return Reaction.none

    @property
    def in_streak(self) -> bool:
        """Return whether bad images have lasted so long that they are not reported one by one."""
        return self._bad_images >= int(self.parameters["streak_frames"])

    def detector(self, failed: bool) -> Reaction:
        """Failures of the detector in a row end in safe mode."""
        self._detector_failures = self._detector_failures + 1 if failed else 0
        if self._detector_failures >= int(self.parameters["detector_failures"]):
            self._detector_failures = 0
            return Reaction.go_safe
        return Reaction.none

    def clock(self, moved_ticks: int, uptime_moved_ticks: int | None) -> float:
        """Seconds by which the clock has jumped since the step before, 0 where it has not.

        With no free-running counter to compare with only a clock that goes back is noticed.
        """
        if uptime_moved_ticks is None:
            return moved_ticks / TICKS_PER_SECOND if moved_ticks <= 0 else 0.0
        jump_s = (moved_ticks - uptime_moved_ticks) / TICKS_PER_SECOND
        return jump_s if abs(jump_s) > self.parameters["clock_jump_s"] or moved_ticks <= 0 else 0.0

    def latch(self, severity: str, event: str, value: float, limit: float, side: int) -> None:
        """Report once that a value is beyond a limit (side +1 above, -1 below), again after it has been within."""
        beyond = side * (value - limit)
        if beyond > 0.0 and event not in self._present:
            self._present.add(event)
            self.telemetry.event(severity, event, value, limit)
        elif beyond < -_HYSTERESIS * max(abs(limit), 1.0):
            self._present.discard(event)

    def _growing(self, severity: str, event: str, count: int) -> None:
        """Report a count of losses each time that it has doubled."""
        if count.bit_length() > self._reported.get(event, 0):
            self._reported[event] = count.bit_length()
            self.telemetry.event(severity, event, float(count))
