"""The board and the bus around the payload: power, heat, processor time, memory, watchdog, and injected faults.

A lumped model. Power: a battery charged by the arrays in sunlight, whose open-circuit voltage follows its charge,
behind a resistance. Heat: the processor board and the camera, each a heat
capacity tied to a structure that follows sunlight.
Processor: every stage of flight software takes a set time, with a spread of a tenth, drawn from the seed.
The counts of stages, loads and sensors are those of the interface control document.
"""

import math
import re
from dataclasses import dataclass, field

import numpy as np

from lunar.arrays import FloatArray, OctetArray
from payload_emulator.errors import ScenarioError
from tmtc.packets.pus import TICKS_PER_SECOND

Memory = OctetArray

UNLIMITED = 1 << 62
_CAMERA, _ACCELERATOR = 1, 2


@dataclass(frozen=True, slots=True)
class PlatformModel:
    """Numbers of a 16U CubeSat's bus and of an edge computer of a few watts.

    Attributes
    ----------
    idle_w, camera_w, accelerator_w
        Drawn by the processor board alone, by the camera, and by the accelerator.
    array_w, capacity_wh
        Power of the solar arrays for the payload in sunlight, and energy of its share of the battery.
    empty_v, full_v, resistance_ohm
        Battery.
    *_j_per_k, *_w_per_k
        Heat capacities, and conductances to the structure.
    lit_c, dark_c, structure_s
        Temperatures that the structure tends to in sunlight and in shadow, and how quickly.
    stage_ms
        Processor time of idle, commands, detector, navigation, telemetry, monitoring.
    program_octets
        Memory of the program itself.
    watchdog_s
        Time without a sign of life after which the watchdog resets the processor.
    """

    idle_w: float = 2.2
    camera_w: float = 1.6
    accelerator_w: float = 3.4
    array_w: float = 9.0
    capacity_wh: float = 20.0
    empty_v: float = 10.6
    full_v: float = 12.6
    resistance_ohm: float = 0.15
    board_j_per_k: float = 180.0
    board_w_per_k: float = 0.35
    camera_j_per_k: float = 120.0
    camera_w_per_k: float = 0.25
    lit_c: float = 28.0
    dark_c: float = -12.0
    structure_s: float = 2_400.0
    stage_ms: tuple[float, ...] = (0.0, 2.0, 850.0, 40.0, 8.0, 5.0)
    program_octets: int = 48 << 20
    watchdog_s: float = 30.0


@dataclass(slots=True, eq=False)
class SimulatedBoard:
    """The board that flight software runs on; `advance` lets time pass on it.

    Attributes
    ----------
    detector_factor
        How much longer than usual the detector takes.
    heat_c, drop_v
        Added to the temperature and taken from the voltage by faults.
    downlink
        Octets of packets that TM/TC takes in this step.
    readings
        What the sensors said last.
    uptime, counter_ns
        Time since the first start, in ticks, and processor time used.
    """

    model: PlatformModel
    seed: int
    store: Memory
    settings: Memory
    reset_cause: int = 0
    detector_factor: float = 1.0
    heat_c: float = 0.0
    drop_v: float = 0.0
    downlink: int = UNLIMITED
    reset_requested: int | None = None
    charge: float = 0.9
    structure_c: float = 5.0
    board_c: float = 8.0
    camera_c: float = 6.0
    tables: dict[int, bytearray] = field(default_factory=dict)
    memory: dict[int, Memory] = field(default_factory=dict)
    readings: FloatArray = field(default_factory=lambda: np.full(4, np.nan))
    _loads: int = 0
    uptime: int = 0
    counter_ns: int = 0
    _stage: int = 0
    generator: np.random.Generator = field(init=False)

    def __post_init__(self) -> None:
        self.generator = np.random.default_rng((self.seed, 2**40))

    def advance(self, seconds: float, sunlit: float) -> None:
        """Let time pass, the arrays lit by a share of the Sun."""
        model = self.model
        self.uptime += round(seconds * TICKS_PER_SECOND)
        energy_wh = (model.array_w * sunlit - self.drawn_w) * seconds / 3600.0
        self.charge = min(max(self.charge + energy_wh / model.capacity_wh, 0.0), 1.0)
        tends_c = model.dark_c + (model.lit_c - model.dark_c) * sunlit
        self.structure_c = _relax(self.structure_c, tends_c, seconds, model.structure_s)
        inside_w = model.idle_w + (model.accelerator_w if self._loads & _ACCELERATOR else 0.0)
        self.board_c = _relax(
            self.board_c,
            self.structure_c + inside_w / model.board_w_per_k,
            seconds,
            model.board_j_per_k / model.board_w_per_k,
        )
        camera_w = model.camera_w if self._loads & _CAMERA else 0.0
        self.camera_c = _relax(
            self.camera_c,
            self.structure_c + camera_w / model.camera_w_per_k,
            seconds,
            model.camera_j_per_k / model.camera_w_per_k,
        )

    @property
    def drawn_w(self) -> float:
        """Power drawn from the bus."""
        model = self.model
        return (
            model.idle_w
            + (model.camera_w if self._loads & _CAMERA else 0.0)
            + (model.accelerator_w if self._loads & _ACCELERATOR else 0.0)
        )

    @property
    def camera_on(self) -> bool:
        """Return whether the camera is powered."""
        return bool(self._loads & _CAMERA)

    def reset(self, cause: int) -> None:
        """Restart the processor: working memory is gone, the rest stays."""
        self.reset_cause, self.reset_requested = cause, None
        self.memory, self._stage, self._loads = {}, 0, 0

    def flip(self, memory: Memory, bits: int, rng: np.random.Generator) -> None:
        """Change a number of bits at random positions of a memory."""
        for at in rng.integers(0, 8 * memory.size, bits).tolist():
            memory[at >> 3] ^= 0x80 >> (at & 7)

    # What flight software sees

    def sensors(self) -> FloatArray:
        model = self.model
        open_v = model.empty_v + (model.full_v - model.empty_v) * self.charge - self.drop_v
        drawn_w = self.drawn_w
        # The current that carries the power through the resistance.
        root = math.sqrt(max(open_v**2 - 4.0 * model.resistance_ohm * drawn_w, 0.0))
        volts = 0.5 * (open_v + root)
        noise = self.generator.standard_normal(3) * (0.005, 0.05, 0.05)
        self.readings = np.array(
            [
                volts + noise[0],
                drawn_w / max(volts, 1.0),
                self.board_c + self.heat_c + noise[1],
                self.camera_c + noise[2],
            ]
        )
        return self.readings

    def switch(self, loads: int) -> None:
        self._loads = int(loads)

    def enter(self, stage: int) -> int:
        spent_ms = self.model.stage_ms[self._stage]
        if spent_ms:
            spent_ms *= 1.0 + 0.1 * float(self.generator.standard_normal())
            if self._stage == _DETECTOR:
                spent_ms *= self.detector_factor
        self.counter_ns += max(round(spent_ms * 1e6), 0)
        self._stage = stage
        return self.counter_ns

    def memory_octets(self) -> int:
        return self.model.program_octets + sum(memory.size for memory in self.memory.values())

    def uptime_ticks(self) -> int:
        return self.uptime

    def downlink_octets(self) -> int:
        return self.downlink

    def load(self, region: int, octets: bytes) -> Memory:
        self.memory[region] = np.frombuffer(octets, dtype=np.uint8).copy()
        return self.memory[region]

    def read_table(self, number: int) -> bytes:
        return bytes(self.tables.get(number, b""))

    def write_table(self, number: int, octets: bytes) -> None:
        self.tables[number] = bytearray(octets)

    def request_reset(self, cause: int) -> None:
        self.reset_requested = cause


_DETECTOR = 2


def _relax(value: float, toward: float, seconds: float, time_s: float) -> float:
    return toward + (value - toward) * math.exp(-seconds / time_s)


@dataclass(frozen=True, slots=True)
class FaultKind:
    """Effect of a kind of fault; `size` is its default and its unit."""

    name: str
    meaning: str
    size: float = 1.0
    unit: str = ""
    lasts: bool = False


FAULT_KINDS = {
    kind.name: kind
    for kind in (
        FaultKind("camera_dark", "the camera sees nothing but its noise", lasts=True),
        FaultKind("camera_saturated", "every pixel is full", lasts=True),
        FaultKind("camera_dead", "the camera gives no image until it is switched off and on", lasts=True),
        FaultKind("camera_lost", "the camera gives no image, whatever is done", lasts=True),
        FaultKind("detector_slow", "the detector takes longer", 30.0, "times", lasts=True),
        FaultKind("detector_error", "the inference library throws", lasts=True),
        FaultKind("processor_hang", "the processor stops in the detector"),
        FaultKind("model_flip", "bits of the model in memory change", 1.0, "bits"),
        FaultKind("table_flip", "bits of the catalogue in memory change", 1.0, "bits"),
        FaultKind("parameters_flip", "bits of the parameters in memory change", 1.0, "bits"),
        FaultKind("model_lost", "the model changes in memory and in its kept copy", 1.0, "bits"),
        FaultKind("store_flip", "bits of the packet store change", 64.0, "bits"),
        FaultKind("settings_flip", "bits of the newest settings change before a reset", 64.0, "bits"),
        FaultKind("settings_lost", "both copies of the settings are overwritten before a reset"),
        FaultKind("clock_jump", "the clock jumps", 30.0, "s"),
        FaultKind("attitude_lost", "the ADCS sends nothing", lasts=True),
        FaultKind("power_cut", "the supply fails for a moment"),
        FaultKind("undervoltage", "the bus voltage drops", 3.0, "V", lasts=True),
        FaultKind("overheating", "the board gets hotter", 70.0, "K", lasts=True),
    )
}
_PATTERN = re.compile(
    r"(?P<kind>\w+)\s+at\s+(?P<at>[-+.\w]+)(?:\s+for\s+(?P<lasts>[-+.\w]+))?(?:\s+size\s+(?P<size>[-+.\w]+))?"
)


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault; it is present from `at_s` to before `at_s + duration_s`."""

    kind: str
    at_s: float
    duration_s: float
    size: float

    def present(self, second: float) -> bool:
        """Return whether it is present at a second after the first frame."""
        return self.at_s <= second < self.at_s + self.duration_s


def parse_fault(text: str) -> Fault:
    """The fault of a line of text.

    Raises
    ------
    ScenarioError
        The line is of another form, or names a kind that there is not.
    """
    match = _PATTERN.fullmatch(text.strip())
    try:
        if match is None:
            raise ValueError
        at_s = float(match["at"])
        lasts_s = float(match["lasts"] or 0.0)
        size = None if match["size"] is None else float(match["size"])
    except ValueError:
        raise ScenarioError(
            f"fault {text!r}: expected KIND at SECONDS [for SECONDS] [size NUMBER], found something else"
        ) from None
    kind = FAULT_KINDS.get(match["kind"])
    if kind is None:
        raise ScenarioError(f"fault {text!r}: expected one of {', '.join(FAULT_KINDS)}, found {match['kind']!r}")
    if kind.lasts and lasts_s <= 0.0:
        raise ScenarioError(f"fault {text!r}: expected how long it lasts ('for SECONDS'), found no time above 0")
    return Fault(kind.name, at_s, lasts_s, kind.size if size is None else size)
