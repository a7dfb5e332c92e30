"""A scenario flown moment by moment: frames, turns without frames, contacts, and the operators' telecommands."""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lunar.arrays import FloatArray, IntArray
from lunar.camera import project_mcmf
from lunar.catalogue import CraterCatalogue
from lunar.constants import MOON_RADIUS_M
from lunar.frames import spherical_from_mcmf
from lunar.third_bodies import sun_position_icrf_m
from lunar.timescales import tdb_s_from_utc_ns
from lunar.visibility import sunlit_fraction
from payload_emulator.flight.onboard.modes import PayloadMode
from payload_emulator.flight.ports import UNLIMITED
from payload_emulator.flight.vision.detections import Detections, no_detections
from payload_emulator.flight.vision.preprocess import ImageQuality
from payload_emulator.session.instruments import InstrumentBench
from payload_emulator.session.scenario import ClockSection
from payload_emulator.session.spacecraft import Spacecraft
from payload_emulator.session.world import (
    NO_SAMPLES,
    Exposure,
    World,
    clock_ticks,
    exposures,
    orders_before,
    sample_truth,
)
from payload_emulator.sim.board.link import LIGHT_S, Receiver, Transmitter, contacts
from payload_emulator.sim.detector import SimulatedDetector
from tmtc.cuc import TICKS_PER_SECOND
from tmtc.dictionary import APID_TIME_REPORT, DICTIONARY
from tmtc.link import LinkSettings

SPACECRAFT_ID = 0x4C

_NS = 1_000_000_000
PLAYBACK_CHANNEL = 1
# Source of the planned telecommands; a person who commands by hand has another one, with separate counts.
_PLANNING_SOURCE = 1
_TIME_RATE_EXPONENT = 1  # a clock known to be off is watched: a time report every second frame of telemetry
_LATE_TICKS = 120 * TICKS_PER_SECOND
_DUMP_OCTETS = 64_000
_BEFORE_ARC_NS = 60 * _NS
_IDLE_STEP_NS = 60 * _NS
_STANDBY_BEFORE_TICKS = 20 * TICKS_PER_SECOND
_PATIENCE_NS = 600 * _NS
_AHEAD_NS = 12 * 3_600 * _NS
_NO_ATTITUDE = np.full(7, np.nan)
# A detector as the one that flies, roughly: what is drawn where no image is rendered.
_REDUCED_RECALL, _SMALLEST_PX = 0.7, 5.0
_REDUCED_DETECTOR = SimulatedDetector(precision=1.0, sigma_px=0.6, log_diameter_sigma=0.0)


@dataclass(frozen=True, slots=True)
class Moment:
    """One step of the spacecraft.

    `frame` is -1 where none is taken; `heard` tells whether a station listens, `light_s` how long it takes to there.
    """

    utc_ns: int
    frame: int
    sunlit: float
    heard: bool
    downlink_octets: int
    light_s: float = LIGHT_S


@dataclass(frozen=True, slots=True, eq=False)
class Flown:
    """Outcome of one time step; `clcw` is the state of the telecommand receiver after it, as frames carry it."""

    moment: Moment
    exposure: Exposure | None
    telecommands: bytes
    packets: list[bytes]
    clcw: bytes


@dataclass(slots=True, eq=False)
class CatalogueDetector:
    """In place of the network where no images are rendered: the craters in view, some missed, all a little off."""

    seed: int
    _rng: np.random.Generator = field(init=False)
    _next: Detections = field(default_factory=no_detections)

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng((self.seed, 2**43))

    def show(self, world: World, exposure: Exposure) -> None:
        """Prepare what is found in the next frame."""
        _, uv, diameter_px = craters_in_view(world, exposure, _SMALLEST_PX)
        seen = self._rng.random(diameter_px.size) < _REDUCED_RECALL
        camera = world.camera
        corner = np.array([camera.width_px - 1.0, camera.height_px - 1.0])
        places, sizes = _REDUCED_DETECTOR.detect(uv[seen], diameter_px[seen], corner, self._rng)
        sigma = np.full(sizes.size, _REDUCED_DETECTOR.stated_sigma_px)
        self._next = Detections(places[:, 0], places[:, 1], sizes, np.full(sizes.size, 0.9), sigma)

    def examine(
        self, image: NDArray[Any], sun_in_camera: FloatArray | None = None
    ) -> tuple[ImageQuality, Detections]:
        found, self._next = self._next, no_detections()
        if not image.size:
            return ImageQuality.INVALID, no_detections()
        if not image.any():
            return ImageQuality.DARK, no_detections()
        if image.min() == 255:
            return ImageQuality.SATURATED, no_detections()
        return ImageQuality.OK, found


def craters_in_view(
    world: World, exposure: Exposure, smallest_px: float, craters: CraterCatalogue | None = None
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return the craters in an image: index, place (n, 2) and diameter (n,) in pixels.

    Parameters
    ----------
    craters
        Catalogue with rim heights; None uses the catalogue of the terrain, whose heights may be unknown.
    """
    position = world.truth.positions_mcmf(exposure.utc_ns)[0]
    latitude, longitude, altitude = (float(value) for value in spherical_from_mcmf(position))
    craters, camera = world.terrain.catalogue if craters is None else craters, world.true_camera
    reach_m = min(2.5 * altitude * np.tan(camera.fov_rad / 2.0), 0.1 * MOON_RADIUS_M)
    near = craters.near(latitude, longitude, reach_m)
    points = craters.position_mcmf_m[near]
    uv = project_mcmf(camera, exposure.camera_from_mcmf, position, points)
    depth_m = (points - position) @ exposure.camera_from_mcmf[2]
    with np.errstate(invalid="ignore", divide="ignore"):
        diameter_px = camera.focal_px * craters.diameter_m[near] / depth_m
        inside = np.all((uv > 0.0) & (uv < np.array([camera.width_px, camera.height_px]) - 1), axis=1)
        seen = np.flatnonzero(inside & (diameter_px > smallest_px))
    return near[seen], uv[seen], diameter_px[seen]


def timeline(world: World) -> list[Moment]:
    """The moments of a scenario: frames, a minute before and the end of each arc, each minute where stations listen."""
    frames, section = world.frame_utc_ns, world.scenario.link
    interval_ns = round(world.scenario.camera.frame_interval_s * _NS)
    between = []
    for first, last in arcs(world):
        between += [int(frames[first]) - _BEFORE_ARC_NS, int(frames[last]) + interval_ns]
    if section.stations:
        between += list(range(between[0], int(frames[-1]) + interval_ns, _IDLE_STEP_NS))
    start, stop = world.truth.start_utc_ns, world.truth.stop_utc_ns
    idle = np.array([t for t in between if start <= t <= stop], dtype=np.int64)
    utc_ns = np.union1d(frames, idle)
    number = np.full(utc_ns.size, -1)
    number[np.searchsorted(utc_ns, frames)] = np.arange(frames.size)
    position, _ = world.truth.states(utc_ns)
    sunlit = sunlit_fraction(position, sun_position_icrf_m(np.asarray(tdb_s_from_utc_ns(utc_ns))))
    heard, light_s = contacts(sample_truth(world.truth, utc_ns), utc_ns, section)
    seconds = np.diff(utc_ns, prepend=utc_ns[:1]) / _NS
    allowed = np.floor(section.rate_bps / 8.0 * seconds).astype(np.int64)
    return [
        Moment(
            int(utc_ns[k]),
            int(number[k]),
            float(sunlit[k]),
            bool(heard[k]),
            (int(allowed[k]) if section.stations else UNLIMITED) if heard[k] else 0,
            float(light_s[k]),
        )
        for k in range(utc_ns.size)
    ]


def arcs(world: World) -> list[tuple[int, int]]:
    """First and last frame of every stretch of frames without a gap."""
    interval_ns = round(world.scenario.camera.frame_interval_s * _NS)
    breaks = np.flatnonzero(np.diff(world.frame_utc_ns) > 1.5 * interval_ns)
    first = np.concatenate([[0], breaks + 1])
    last = np.concatenate([breaks, [world.frame_utc_ns.size - 1]])
    return list(zip(first.tolist(), last.tolist(), strict=True))


@dataclass(slots=True, eq=False)
class Operator:
    """What the ground sends: the observation windows for the schedule, modes around contacts, requests for playback.

    What arrives at a moment was sent a light time before, by somebody who had seen telemetry of two light times before.
    """

    world: World
    sequence_count: int = 0
    _uploaded: int = 0
    _in_contact: bool = False
    _last_contact: tuple[int, int] | None = None
    _contact_start: int = 0
    _started: bool = False
    _idle_since_ns: int | None = None
    _modes: deque[tuple[int, PayloadMode]] = field(default_factory=deque)
    _last_utc_ns: int = 0

    def command(self, name: str, **values: object) -> bytes:
        """The next telecommand packet."""
        packet = DICTIONARY.pack_command(
            name, values, sequence_count=self.sequence_count, source=_PLANNING_SOURCE
        )
        self.sequence_count = (self.sequence_count + 1) % (1 << 14)
        return packet

    def function(self, name: str, first: float = 0.0, second: float = 0.0) -> bytes:
        """A telecommand that performs a function."""
        return self.command("perform_function", function_id=name, argument_1=first, argument_2=second)

    def orders(self, moment: Moment, mode: PayloadMode) -> bytes:
        """What arrives at a moment; `mode` is the payload's since the moment before."""
        mode = self._mode_seen(moment, mode)
        first = not self._started
        self._started = True
        if not (moment.heard or first):
            self._end_contact(moment)
            return b""
        orders = [*self._windows(moment), *self._resumed(moment, mode)]
        if first and self.world.scenario.clock != ClockSection():
            orders.append(self.command("set_time_report_rate", rate_exponent=_TIME_RATE_EXPONENT))
        if self.world.scenario.link.stations:
            orders += self._contact(moment, mode)
        if moment.frame >= 0:
            orders.append(orders_before(self.world, moment.frame))
        return b"".join(orders)

    def _mode_seen(self, moment: Moment, mode: PayloadMode) -> PayloadMode:
        """The mode in the newest telemetry that what arrives now can be an answer to."""
        self._modes.append((self._last_utc_ns, mode))
        self._last_utc_ns = moment.utc_ns
        seen_until = moment.utc_ns - round(2.0 * moment.light_s * _NS)
        while len(self._modes) > 1 and self._modes[1][0] <= seen_until:
            self._modes.popleft()
        return self._modes[0][1]

    def _windows(self, moment: Moment) -> Iterator[bytes]:
        world, every = self.world, arcs(self.world)
        interval_s = world.scenario.camera.frame_interval_s
        while self._uploaded < len(every):
            first, last = every[self._uploaded]
            start_utc_ns = int(world.frame_utc_ns[first])
            if start_utc_ns > moment.utc_ns + _AHEAD_NS:
                return
            self._uploaded += 1
            duration_s = (int(world.frame_utc_ns[last]) - start_utc_ns) / _NS + 0.5 * interval_s
            if start_utc_ns <= moment.utc_ns:
                late_s = (moment.utc_ns - start_utc_ns) / _NS
                if late_s < duration_s:
                    yield self.function("start_observation", duration_s - late_s)
                continue
            ticks = clock_ticks(world, start_utc_ns)
            if world.scenario.link.stations:
                yield self._at(ticks - _STANDBY_BEFORE_TICKS, self.function("set_mode", PayloadMode.standby))
            yield self._at(ticks, self.function("start_observation", duration_s))

    def _resumed(self, moment: Moment, mode: PayloadMode) -> Iterator[bytes]:
        """A payload found waiting in a window, as after a camera that it gave up, is told to observe again."""
        if moment.frame < 0 or mode is not PayloadMode.standby:
            self._idle_since_ns = None
            return
        if self._idle_since_ns is None:
            self._idle_since_ns = moment.utc_ns
        if moment.utc_ns - self._idle_since_ns < _PATIENCE_NS:
            return
        self._idle_since_ns = None
        last = next(stop for start, stop in arcs(self.world) if start <= moment.frame <= stop)
        left_s = (int(self.world.frame_utc_ns[last]) - moment.utc_ns) / _NS
        yield self.function("start_observation", left_s + 0.5 * self.world.scenario.camera.frame_interval_s)

    def _at(self, ticks: int, packet: bytes) -> bytes:
        octets = np.frombuffer(packet, dtype=np.uint8)
        return self.command("insert_activity", release_ticks=ticks, items={"octet": octets})

    def _contact(self, moment: Moment, mode: PayloadMode) -> Iterator[bytes]:
        """Downlinking while a station listens and nothing is observed; at the beginning, a playback."""
        if not self._in_contact:
            self._in_contact, self._contact_start = True, clock_ticks(self.world, moment.utc_ns)
            if self.world.scenario.link.playback and self._last_contact and mode is not PayloadMode.observing:
                start, stop = self._last_contact
                yield self.command("replay_store", start_ticks=start, stop_ticks=start + (stop - start) // 2)
        if mode is PayloadMode.standby and not self._arc_is_near(moment):
            yield self.function("set_mode", PayloadMode.downlinking)

    def _end_contact(self, moment: Moment) -> None:
        if self._in_contact:
            self._last_contact = (self._contact_start, clock_ticks(self.world, moment.utc_ns))
        self._in_contact = False

    def _arc_is_near(self, moment: Moment) -> bool:
        after = np.searchsorted(self.world.frame_utc_ns, moment.utc_ns)
        if after == self.world.frame_utc_ns.size:
            return False
        return int(self.world.frame_utc_ns[after]) - moment.utc_ns < 2 * _BEFORE_ARC_NS


class Nobody:
    """Stands in for the operator where the ground commands."""

    def orders(self, _moment: Moment, _mode: PayloadMode) -> bytes:
        return b""


def fly(world: World, spacecraft: Spacecraft) -> Generator[Flown]:
    """Fly the moments of a scenario in order."""
    operator, receiver = Operator(world), Receiver(SPACECRAFT_ID)
    frames = exposures(world, InstrumentBench(world).sample)
    for moment in timeline(world):
        exposure = next(frames) if moment.frame >= 0 else None
        receiver.carrier = receiver.bit_lock = moment.heard
        yield fly_moment(world, spacecraft, operator, receiver, moment, exposure)
    frames.close()


def fly_moment(
    world: World,
    spacecraft: Spacecraft,
    operator: Operator | Nobody,
    receiver: Receiver,
    moment: Moment,
    exposure: Exposure | None,
    by_hand: bytes = b"",
) -> Flown:
    """Fly one moment; `by_hand` are telecommand packets that were received in addition to those of the operator."""
    if exposure is not None and isinstance(spacecraft.detector, CatalogueDetector):
        spacecraft.detector.show(world, exposure)
    orders = receiver.take(operator.orders(moment, spacecraft.payload.mode)) + by_hand
    packets = spacecraft.step(
        moment.utc_ns,
        None if exposure is None else exposure.image,
        _NO_ATTITUDE if exposure is None else exposure.attitude,
        clock_ticks(world, moment.utc_ns),
        orders,
        sunlit=moment.sunlit,
        downlink_octets=moment.downlink_octets,
        instruments=NO_SAMPLES if exposure is None else exposure.instruments,
    )
    return Flown(moment, exposure, orders, packets, receiver.clcw)


@dataclass(slots=True, eq=False)
class Sender:
    """Puts what the payload hands over into dumps: one for all without stations, else several a contact.

    Packets older than `_LATE_TICKS` travel on the channel for playback. `time_reports` keeps when each was emitted
    (UTC), whenever their dump goes out: they tell the clock at that instant.
    """

    world: World
    settings: LinkSettings
    transmitter: Transmitter = field(init=False)
    time_reports: list[tuple[bytes, int]] = field(default_factory=list)
    _waiting: dict[int, list[tuple[bytes, bytes]]] = field(default_factory=dict)
    _utc_ns: int = 0
    _light_s: float = LIGHT_S

    def __post_init__(self) -> None:
        self.transmitter = Transmitter(SPACECRAFT_ID, self.settings)

    def take(self, flown: Flown) -> None:
        """Take the packets of a moment, and send what is complete."""
        self._utc_ns, self._light_s = flown.moment.utc_ns, flown.moment.light_s
        stations = bool(self.world.scenario.link.stations)
        now = clock_ticks(self.world, flown.moment.utc_ns)
        for packet in flown.packets:
            late = stations and now - int.from_bytes(packet[14:20], "big") > _LATE_TICKS
            self._waiting.setdefault(PLAYBACK_CHANNEL if late else 0, []).append((packet, flown.clcw))
            if not late and int.from_bytes(packet[:2], "big") & 0x7FF == APID_TIME_REPORT:
                self.time_reports.append((packet, flown.moment.utc_ns))
        waiting = sum(len(packet) for packets in self._waiting.values() for packet, _ in packets)
        if stations and (not flown.moment.heard or waiting > _DUMP_OCTETS):
            self.flush()

    def flush(self) -> None:
        """Send everything."""
        for channel, waiting in sorted(self._waiting.items()):
            packets, clcws = [packet for packet, _ in waiting], [clcw for _, clcw in waiting]
            self.transmitter.send(packets, self._utc_ns, channel, self._light_s, clcws)
        self._waiting = {}
