"""The state of the payload as a machine, and what of it survives a reset."""

import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from payload_emulator.flight.onboard.commanding import CommandHistory
from payload_emulator.flight.onboard.fdir import Monitors
from payload_emulator.flight.onboard.housekeeping import STATE, Housekeeping, StageTimer, Structure
from payload_emulator.flight.onboard.loads import MODEL_NUMBER, FlightParameters, FlightTables
from payload_emulator.flight.onboard.modes import PayloadMode
from payload_emulator.flight.onboard.observer import Observer
from payload_emulator.flight.onboard.schedule import Schedule
from payload_emulator.flight.onboard.settings import ParameterStore, Settings
from payload_emulator.flight.ports import Board, Load, Memory
from payload_emulator.flight.telemetry.packets import Telemetry
from payload_emulator.flight.telemetry.store import PacketStore
from tmtc.dictionary.payload import STRUCTURES
from tmtc.dictionary.tables import table_hash
from tmtc.packets.large_data import LargeDataReceiver


@dataclass(slots=True, eq=False)
class ProtectedMemory:
    """Regions of working memory, by number of the dictionary's table of tables.

    Attributes
    ----------
    repairs
        Regions restored since boot.
    """

    board: Board
    repairs: int = 0
    _regions: dict[int, Memory] = field(default_factory=dict)
    _hashes: dict[int, int] = field(default_factory=dict)

    def load(self, number: int, octets: bytes, *, keep: bool = True) -> None:
        """Put octets into working memory, and keep a copy that survives resets."""
        if keep and self.board.read_table(number) != octets:
            self.board.write_table(number, octets)
        self._regions[number] = self.board.load(number, octets)
        self._hashes[number] = table_hash(octets)

    def hash_of(self, number: int) -> int:
        """First 32 bits of the SHA-256 of what was loaded, 0 where nothing was."""
        return self._hashes.get(number, 0)

    def damaged(self) -> list[tuple[int, int]]:
        """(region, hash found) of every region that is not what was loaded."""
        found = [(number, table_hash(memory.tobytes())) for number, memory in self._regions.items()]
        return [(number, value) for number, value in found if value != self._hashes[number]]

    def repair(self, number: int) -> bytes | None:
        """Restore a region from its kept copy; its octets, None where that copy is damaged too."""
        octets = self.board.read_table(number)
        if not octets or table_hash(octets) != self._hashes[number]:
            return None
        self._regions[number] = self.board.load(number, octets)
        self.repairs += 1
        return octets

    @property
    def octets(self) -> int:
        """Octets of all regions."""
        return sum(memory.size for memory in self._regions.values())


PARAMETERS_NUMBER = 4
_UPLINK_LIMIT_OCTETS = 16 << 20
_LOADS = {
    PayloadMode.safe: 0,
    PayloadMode.standby: 0,
    PayloadMode.observing: Load.camera | Load.accelerator,
    PayloadMode.downlinking: 0,
}


@dataclass(slots=True)
class ObservationWindow:
    """The observation window in progress; `stop_ticks` 0: until commanded, `cadence_ticks` 0: every frame."""

    stop_ticks: int = 0
    cadence_ticks: int = 0
    next_ticks: int = 0


@dataclass(slots=True, eq=False)
class Machine:
    """Everything that telecommands act on."""

    board: Board
    telemetry: Telemetry
    store: PacketStore
    timer: StageTimer
    settings: Settings
    observer: Observer
    monitors: Monitors
    parameters: ParameterStore
    memory: ProtectedMemory
    tables: FlightTables
    mode: PayloadMode
    build: FlightParameters
    model_hash: int = 0
    model_octets: int = 0
    schedule: Schedule = field(default_factory=Schedule)
    history: CommandHistory = field(default_factory=CommandHistory)
    housekeeping: Housekeeping = field(default_factory=Housekeeping)
    uplink: LargeDataReceiver = field(default_factory=lambda: LargeDataReceiver(_UPLINK_LIMIT_OCTETS))
    observation: ObservationWindow = field(default_factory=ObservationWindow)
    counts: Counter[str] = field(default_factory=Counter)
    boot_count: int = 1
    watchdog_ticks: list[int] = field(default_factory=list)
    time_exponent: int = -1
    transaction: int = 0
    thumbnail_wanted: bool = False
    reset_wanted: int | None = None
    changed: bool = True

    def enter(self, mode: PayloadMode) -> None:
        """Change the mode: report it, switch the loads, begin or end an observation."""
        if mode is self.mode:
            return
        before, self.mode, self.changed = self.mode, mode, True
        self.telemetry.event("info", "mode_changed", float(before), float(mode))
        if before is PayloadMode.observing:
            self.telemetry.event("info", "observation_stopped", float(self.observer.counts["frames"]))
            self.observation = ObservationWindow()
        self.switch_loads()

    def observe(self, duration_ticks: int, cadence_ticks: int) -> None:
        """Begin an observation, or give the one in progress another end and cadence."""
        ticks = self.telemetry.ticks
        self.enter(PayloadMode.observing)
        stop = ticks + duration_ticks if duration_ticks else 0
        self.observation, self.changed = ObservationWindow(stop, cadence_ticks, ticks), True
        self.telemetry.event("info", "observation_started", float(stop), float(cadence_ticks))

    def switch_loads(self) -> None:
        """Power what the mode needs."""
        self.board.switch(_LOADS[self.mode])

    def protect_parameters(self) -> None:
        """Put the changed parameters under the protection of memory."""
        self.memory.load(PARAMETERS_NUMBER, json.dumps(self.parameters.changed, sort_keys=True).encode())

    @property
    def parameters_hash(self) -> int:
        """First 32 bits of the SHA-256 of the build's parameters and of what was changed in flight."""
        return self.build.hash if not self.parameters.changed else self.memory.hash_of(PARAMETERS_NUMBER)

    @property
    def model_identity(self) -> int:
        """First 32 bits of the SHA-256 of the detector model."""
        return self.memory.hash_of(MODEL_NUMBER) or self.model_hash

    def quantities(self) -> dict[str, float]:
        """Return the data pool: all housekeeping parameters by name."""
        volts, amperes, board_c, camera_c = self.board.sensors().tolist()
        observer, store = self.observer, self.store
        return {
            "boot_count": self.boot_count & 0xFFFF,
            "mode": int(self.mode),
            "frames_processed": observer.counts["frames"],
            "frames_bad": observer.counts["frames_bad"],
            "detections_total": observer.counts["detections"],
            "packets_sent": self.telemetry.counts["packets"],
            "anchor_reads": observer.anchor_reads,
            "events_sent": self.telemetry.counts["events"],
            "telecommands_accepted": self.counts["telecommands_accepted"] & 0xFFFF,
            "telecommands_rejected": self.counts["telecommands_rejected"] & 0xFFFF,
            "last_image_quality": int(observer.last_quality),
            "temperature_c": _reading(board_c),
            "bus_voltage_v": _reading(volts),
            "power_w": _reading(volts * amperes),
            "memory_used_kib": (self.board.memory_octets() + self.model_octets) // 1024,
            "queue_depth": min(store.waiting, 0xFFFF),
            "storage_used_permille": store.used_permille,
            "clock_status": self.counts["clock_status"],
            "watchdog_resets": self.counts["watchdog_resets"] & 0xFFFF,
            "camera_temperature_c": _reading(camera_c),
            "bus_current_a": _reading(amperes),
            "detector_latency_max_ms": self.timer.detector_max_ms,
            "detector_timeouts": observer.counts["detector_timeouts"] & 0xFFFF,
            "activities": len(self.schedule.activities),
            "memory_repairs": self.memory.repairs,
            "storage_errors": store.damaged,
            "store_overwritten": store.overwritten,
            "last_command_count": self.history.newest_count & 0xFFFF,
        }

    def start_housekeeping(self, state_interval_s: float) -> None:
        """The structures that every build sends."""
        further = self.parameters["performance_interval_s"]
        self.housekeeping.structures = {
            number: Structure(state_interval_s if number == STATE else further) for number in STRUCTURES
        }

    def save(self) -> None:
        """Keep what has changed."""
        if self.changed:
            self.settings.write(self._to_plain())
            self.changed = False

    def _to_plain(self) -> dict[str, Any]:
        return {
            "boot_count": self.boot_count,
            "mode": int(self.mode),
            "observation": [self.observation.stop_ticks, self.observation.cadence_ticks],
            "parameters": self.parameters.changed,
            "schedule": self.schedule.to_plain(),
            "schedule_enabled": self.schedule.enabled,
            "history": self.history.to_plain(),
            "housekeeping": self.housekeeping.to_plain(),
            "disabled_events": sorted(self.telemetry.disabled),
            "time_exponent": self.time_exponent,
            "transaction": self.transaction,
            "watchdog_resets": self.counts["watchdog_resets"],
            "watchdog_ticks": self.watchdog_ticks,
        }

    def restore(self, values: Mapping[str, Any]) -> PayloadMode:
        """Take the settings kept before a reset; the mode of that time."""
        self.boot_count = int(values["boot_count"]) + 1
        self.observation = ObservationWindow(*(int(value) for value in values["observation"]))
        self.parameters.restore(values["parameters"])
        self.schedule.restore(values["schedule"])
        self.schedule.enabled = bool(values["schedule_enabled"])
        self.history.restore(values["history"])
        self.housekeeping.restore(values["housekeeping"])
        self.telemetry.disabled = {int(code) for code in values["disabled_events"]}
        self.time_exponent = int(values["time_exponent"])
        self.transaction = int(values["transaction"])
        self.counts["watchdog_resets"] = int(values["watchdog_resets"])
        self.watchdog_ticks = [int(ticks) for ticks in values["watchdog_ticks"]]
        return PayloadMode(int(values["mode"]))


def _reading(value: float) -> float:
    """A sensor's value as integers of the dictionary can carry it; a dead one reads 0."""
    return value if value == value else 0.0
