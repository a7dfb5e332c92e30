"""The spacecraft: the payload on its simulated board, its camera and receiver, and the loop that flies it.

Every way to fly is `fly` over a schedule of steps: a scenario with its operator, a process commanded by the ground.
Time, power, faults and resets are around `Payload.step`.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lunar.arrays import FloatArray, OctetArray
from lunar.constants import NS
from payload_emulator.flight.onboard.loads import MODEL_NUMBER, TABLE_NUMBERS
from payload_emulator.flight.onboard.machine import PARAMETERS_NUMBER
from payload_emulator.flight.payload import Payload
from payload_emulator.flight.ports import SETTINGS_OCTETS, STORE_OCTETS, UNLIMITED, ResetCause
from payload_emulator.flight.vision.detections import Detections, Detector
from payload_emulator.flight.vision.preprocess import ImageQuality
from payload_emulator.session.spacecraft.loading import LoadedPayload
from payload_emulator.session.world.camera import Camera, CatalogueDetector, Exposure
from payload_emulator.session.world.world import World, clock_ticks
from payload_emulator.sim.board.link import LIGHT_S, Receiver
from payload_emulator.sim.board.platform import Fault, PlatformModel, SimulatedBoard, parse_fault
from payload_emulator.sim.orbit.truth import ReadCount, counted_reads
from tmtc.packets.pus import TICKS_PER_SECOND

PLAYBACK_CHANNEL = 1
"""Virtual channel of packets that are sent long after they were made."""

_NO_ATTITUDE = np.full(7, np.nan)
_NO_IMAGE = np.zeros((0, 0), dtype=np.uint8)
_PLATFORM = PlatformModel()
_REGIONS = {
    "model_flip": MODEL_NUMBER,
    "model_lost": MODEL_NUMBER,
    "table_flip": TABLE_NUMBERS["catalogue"],
    "parameters_flip": PARAMETERS_NUMBER,
}


@dataclass(frozen=True, slots=True)
class StepInput:
    """Input of one step of the spacecraft.

    Attributes
    ----------
    frame
        Number of the frame of the scenario; -1 where it has none.
    in_contact
        Whether a station receives.
    light_s
        Light time to there.
    image_utc_ns, next_image_utc_ns
        Time of the image that the camera takes in this step, None without one, and of the one that probably follows.
    telecommands
        Telecommand packets that reach the payload.
    """

    utc_ns: int
    frame: int
    sunlit: float
    in_contact: bool
    downlink_octets: int
    light_s: float = LIGHT_S
    image_utc_ns: int | None = None
    next_image_utc_ns: int | None = None
    telecommands: bytes = b""


@dataclass(frozen=True, slots=True, eq=False)
class StepResult:
    """Outcome of one step; `clcw` is the state of the telecommand receiver after it, as frames carry it."""

    step: StepInput
    exposure: Exposure | None
    packets: list[bytes]
    clcw: bytes


@dataclass(frozen=True, slots=True, eq=False)
class PayloadInput:
    """Inputs of the payload in a step, and values of its board.

    Attributes
    ----------
    boot
        Cause of the start of the processor before this step, None without one.
    sensors
        Readings of the board (4,), NaN before the first.
    """

    image: NDArray[Any]
    attitude: FloatArray
    clock_ticks: int
    telecommands: bytes
    boot: int | None
    sensors: FloatArray
    uptime_ticks: int
    downlink_octets: int


class ProcessorHang(BaseException):
    """The simulated processor stands still; nothing that runs on it can catch this."""


@dataclass(slots=True)
class BreakableDetector:
    """Detector that fails on command."""

    detector: Detector
    throws: bool = False
    hangs: bool = False

    def examine(self, image: NDArray[Any], sun_in_camera: FloatArray | None = None) -> tuple[ImageQuality, Detections]:
        if self.hangs:
            self.hangs = False
            raise ProcessorHang
        if self.throws:
            raise RuntimeError("injected fault of the inference library")
        return self.detector.examine(image, sun_in_camera)


def new_board(seed: int, store_octets: int = STORE_OCTETS) -> SimulatedBoard:
    """Return a new board, all memory zero."""
    return SimulatedBoard(
        _PLATFORM, seed, np.zeros(store_octets, dtype=np.uint8), np.zeros(SETTINGS_OCTETS, dtype=np.uint8)
    )


@dataclass(slots=True, eq=False)
class Spacecraft:
    """Payload and its environment, simulated step by step.

    Attributes
    ----------
    camera
        Takes the images, and holds the world.
    faults
        Faults; seconds count from `first_utc_ns`.
    detector
        In place of the network; None uses the network.
    receiver
        Belongs to the platform: a restart of the payload leaves it as it is.
    resets
        Starts of the processor after the first, by cause.
    payload_input
        Inputs of the payload in the last step; None while the processor was down.
    truth_reads
        Number of reads of the simulated truth during payload steps; the payload must not have access to it.
    """

    loaded: LoadedPayload
    board: SimulatedBoard
    camera: Camera
    first_utc_ns: int
    receiver: Receiver
    faults: Sequence[Fault] = ()
    detector: Detector | None = None
    resets: list[int] = field(default_factory=list)
    payload: Payload = field(init=False)
    payload_input: PayloadInput | None = None
    truth_reads: ReadCount = field(default_factory=ReadCount)
    _booted: int | None = None
    _breakable: BreakableDetector = field(init=False)
    _begun: set[Fault] = field(default_factory=set)
    _rng: np.random.Generator = field(init=False)
    _clock_error_ticks: int = 0
    _last_utc_ns: int | None = None
    _down_until_ns: int | None = None
    _frames_before: int = 0
    _camera_dead: bool = False

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng((self.board.seed, 2**41))
        self._breakable = BreakableDetector(self.detector or self.loaded.detector)
        self.payload = self._boot()

    @property
    def world(self) -> World:
        """World with the flight so far."""
        return self.camera.world

    @world.setter
    def world(self, world: World) -> None:
        self.camera.world = world

    def fly_step(self, step: StepInput) -> StepResult:
        """Take the image that is due, and let the payload make one step."""
        exposure = None
        if step.image_utc_ns is not None:
            exposure = self.camera.take(step.image_utc_ns, step.next_image_utc_ns)
            if isinstance(self.detector, CatalogueDetector):
                self.detector.show(self.world, exposure)
        packets = self.step(
            step.utc_ns,
            None if exposure is None else exposure.image,
            _NO_ATTITUDE if exposure is None else exposure.attitude,
            clock_ticks(self.world, step.utc_ns),
            step.telecommands,
            sunlit=step.sunlit,
            downlink_octets=step.downlink_octets,
        )
        return StepResult(step, exposure, packets, self.receiver.clcw)

    def step(
        self,
        utc_ns: int,
        image: NDArray[Any] | None,
        attitude: FloatArray,
        clock_ticks: int,
        telecommands: bytes = b"",
        *,
        sunlit: float = 1.0,
        downlink_octets: int = UNLIMITED,
    ) -> list[bytes]:
        """Return the packets for downlink after a step; `image` is None without one. Faults change the inputs."""
        board = self.board
        if self._last_utc_ns is not None:
            board.advance((utc_ns - self._last_utc_ns) / NS, sunlit)
        self._last_utc_ns = utc_ns
        self.payload_input = None
        board.downlink = downlink_octets
        picture, message = self._break(utc_ns, image, attitude)
        if self._down_until_ns is not None:
            if utc_ns < self._down_until_ns:
                return []
            self._down_until_ns = None
            self._reset(ResetCause.watchdog)
        if self._camera_dead and not board.camera_on:
            self._camera_dead = False
        ticks = clock_ticks + self._clock_error_ticks
        cause, self._booted = self._booted, None
        try:
            with counted_reads(self.truth_reads):
                packets = self.payload.step(picture, message, ticks, telecommands)
        except ProcessorHang:
            self._down_until_ns = utc_ns + round(board.model.watchdog_s * NS)
            packets = []
        self.payload_input = PayloadInput(
            _NO_IMAGE if picture is None else picture,
            message,
            ticks,
            telecommands,
            cause,
            board.readings,
            board.uptime_ticks(),
            downlink_octets,
        )
        if self._down_until_ns is not None:
            return []
        if self._camera_dead and not board.camera_on:
            self._camera_dead = False
        if board.reset_requested is not None:
            self._reset(board.reset_requested)
        return packets

    @property
    def frames(self) -> int:
        """Frames that the payload has processed; an image for a refused command does not count."""
        return self._frames_before + self.payload.frames

    @property
    def clock_error_ticks(self) -> int:
        """Sum of the clock jumps: on-board clock minus clock of the scenario."""
        return self._clock_error_ticks

    def _boot(self) -> Payload:
        self._booted = self.board.reset_cause
        return self.loaded.boot(self.board, self._breakable)

    def _reset(self, cause: int) -> None:
        self.resets.append(int(cause))
        self._frames_before += self.payload.frames
        self.board.reset(cause)
        self.payload = self._boot()

    def _break(
        self, utc_ns: int, image: NDArray[Any] | None, attitude: FloatArray
    ) -> tuple[NDArray[Any] | None, FloatArray]:
        """Apply the present faults; return the remaining image and message of the ADCS."""
        second = (utc_ns - self.first_utc_ns) / NS
        present = {fault.kind: fault for fault in self.faults if fault.present(second)}
        for fault in self.faults:
            if fault.at_s <= second and fault not in self._begun:
                self._begun.add(fault)
                self._strike(fault)
        board = self.board
        board.detector_factor = present["detector_slow"].size if "detector_slow" in present else 1.0
        board.drop_v = present["undervoltage"].size if "undervoltage" in present else 0.0
        board.heat_c = present["overheating"].size if "overheating" in present else 0.0
        self._breakable.throws = "detector_error" in present
        if image is not None and image.size:
            if self._camera_dead or "camera_lost" in present:
                image = _NO_IMAGE
            elif "camera_dark" in present:
                image = np.zeros_like(image)
            elif "camera_saturated" in present:
                image = np.full_like(image, 255)
        if "attitude_lost" in present:
            attitude = np.full(7, np.nan)
        return image, attitude

    def _strike(self, fault: Fault) -> None:
        """Apply the change that a fault makes once, when it begins."""
        board, bits = self.board, int(fault.size)
        if fault.kind in _REGIONS:
            region = _REGIONS[fault.kind]
            if region in board.memory:
                board.flip(board.memory[region], bits, self._rng)
            if fault.kind == "model_lost" and region in board.tables:
                board.flip(np.frombuffer(board.tables[region], dtype=np.uint8), bits, self._rng)
        elif fault.kind == "store_flip":
            self._flip_used(board.store, bits)
        elif fault.kind == "settings_flip":
            # The beginning of one of the two copies.
            board.flip(board.settings[:256], bits, self._rng)
            self._reset(ResetCause.brown_out)
        elif fault.kind == "settings_lost":
            board.settings[:] = self._rng.integers(0, 256, board.settings.size, dtype=np.uint8)
            self._reset(ResetCause.brown_out)
        elif fault.kind == "clock_jump":
            self._clock_error_ticks += round(fault.size * TICKS_PER_SECOND)
        elif fault.kind == "power_cut":
            self._reset(ResetCause.brown_out)
        elif fault.kind == "processor_hang":
            self._breakable.hangs = True
        elif fault.kind == "camera_dead":
            self._camera_dead = True

    def _flip_used(self, memory: OctetArray, bits: int) -> None:
        """Flip bits where something is written, so that a nearly empty store is hit too."""
        used = np.flatnonzero(memory)
        for at in self._rng.choice(used, min(bits, used.size), replace=False).tolist() if used.size else ():
            memory[at] ^= 1 << int(self._rng.integers(0, 8))


def fly(spacecraft: Spacecraft, schedule: Iterable[StepInput]) -> Iterator[StepResult]:
    """Fly the steps of a schedule, which may depend on the spacecraft after the step before."""
    for step in schedule:
        yield spacecraft.fly_step(step)


def new_spacecraft(world: World, loaded: LoadedPayload, first_utc_ns: int | None = None) -> Spacecraft:
    """Return the payload of a scenario on a new board, with the faults of the scenario ahead of it.

    Parameters
    ----------
    first_utc_ns
        Time from which the seconds of faults count; None: the first frame.
    """
    scenario = world.scenario
    return Spacecraft(
        loaded,
        new_board(scenario.seed),
        Camera(world),
        int(world.frame_utc_ns[0]) if first_utc_ns is None else first_utc_ns,
        Receiver(scenario.spacecraft_id),
        tuple(parse_fault(text) for text in scenario.faults.events),
        CatalogueDetector(scenario.seed) if scenario.camera.images == "reduced" else None,
    )
