"""The schedule of a scenario: its frames, steps without frames, contacts, and the telecommands of its operator."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from lunar.constants import NS
from lunar.third_bodies import sun_position_icrf_m
from lunar.timescales import tdb_s_from_utc_ns
from lunar.visibility import sunlit_fraction
from payload_emulator.flight.onboard.modes import PayloadMode
from payload_emulator.flight.ports import UNLIMITED
from payload_emulator.session.spacecraft.loop import Spacecraft, StepInput, StepResult, fly
from payload_emulator.session.world.world import World, clock_ticks, sample_truth
from payload_emulator.sim.board.link import contacts
from tmtc.dictionary.payload import DICTIONARY
from tmtc.packets.pus import TICKS_PER_SECOND

# Source of the planned telecommands; a person who commands by hand has another one, with separate counts.
_PLANNING_SOURCE = 1
_TIME_RATE_EXPONENT = 1  # a clock known to be off is watched: a time report every second frame of telemetry
_BEFORE_ARC_NS = 60 * NS
_IDLE_STEP_NS = 60 * NS
_STANDBY_BEFORE_TICKS = 20 * TICKS_PER_SECOND
_IDLE_LIMIT_NS = 600 * NS
_AHEAD_NS = 12 * 3_600 * NS


def timeline(world: World) -> list[StepInput]:
    """Return the steps of a scenario: frames, a minute before and the end of each arc, each minute with stations."""
    frames, section = world.frame_utc_ns, world.scenario.link
    interval_ns = round(world.scenario.camera.frame_interval_s * NS)
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
    in_contact, light_s = contacts(sample_truth(world.truth, utc_ns), utc_ns, section)
    seconds = np.diff(utc_ns, prepend=utc_ns[:1]) / NS
    allowed = np.floor(section.rate_bps / 8.0 * seconds).astype(np.int64)
    return [
        StepInput(
            int(utc_ns[k]),
            int(number[k]),
            float(sunlit[k]),
            bool(in_contact[k]),
            (int(allowed[k]) if section.stations else UNLIMITED) if in_contact[k] else 0,
            float(light_s[k]),
            int(utc_ns[k]) if number[k] >= 0 else None,
            int(frames[number[k] + 1]) if 0 <= number[k] < frames.size - 1 else None,
        )
        for k in range(utc_ns.size)
    ]


def arcs(world: World) -> list[tuple[int, int]]:
    """First and last frame of every stretch of frames without a gap."""
    interval_ns = round(world.scenario.camera.frame_interval_s * NS)
    breaks = np.flatnonzero(np.diff(world.frame_utc_ns) > 1.5 * interval_ns)
    first = np.concatenate([[0], breaks + 1])
    last = np.concatenate([breaks, [world.frame_utc_ns.size - 1]])
    return list(zip(first.tolist(), last.tolist(), strict=True))


@dataclass(slots=True, eq=False)
class Operator:
    """Telecommands of the ground: observation windows for the schedule, modes around contacts, requests for playback.

    A telecommand that arrives was sent a light time before, by an operator who had telemetry of two light times before.
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
        """Return the next telecommand packet."""
        packet = DICTIONARY.pack_command(name, values, sequence_count=self.sequence_count, source=_PLANNING_SOURCE)
        self.sequence_count = (self.sequence_count + 1) % (1 << 14)
        return packet

    def function(self, name: str, first: float = 0.0, second: float = 0.0) -> bytes:
        """Return a telecommand that performs a function."""
        return self.command("perform_function", function_id=name, argument_1=first, argument_2=second)

    def telecommands(self, step: StepInput, mode: PayloadMode) -> bytes:
        """Return the telecommands that arrive in a step; `mode` is the payload's since the step before."""
        mode = self._mode_seen(step, mode)
        first = not self._started
        self._started = True
        if not (step.in_contact or first):
            self._end_contact(step)
            return b""
        telecommands = [*self._windows(step), *self._resumed(step, mode)]
        clock = self.world.scenario.clock
        if first and (clock.offset_s or clock.drift_ppm):
            telecommands.append(self.command("set_time_report_rate", rate_exponent=_TIME_RATE_EXPONENT))
        if self.world.scenario.link.stations:
            telecommands += self._contact(step, mode)
        if step.frame >= 0:
            telecommands.append(self._after_kidnap(step.frame))
        return b"".join(telecommands)

    def _mode_seen(self, step: StepInput, mode: PayloadMode) -> PayloadMode:
        """Return the mode in the newest telemetry that a telecommand arriving now can answer."""
        self._modes.append((self._last_utc_ns, mode))
        self._last_utc_ns = step.utc_ns
        seen_until = step.utc_ns - round(2.0 * step.light_s * NS)
        while len(self._modes) > 1 and self._modes[1][0] <= seen_until:
            self._modes.popleft()
        return self._modes[0][1]

    def _windows(self, step: StepInput) -> Iterator[bytes]:
        world, every = self.world, arcs(self.world)
        interval_s = world.scenario.camera.frame_interval_s
        while self._uploaded < len(every):
            first, last = every[self._uploaded]
            start_utc_ns = int(world.frame_utc_ns[first])
            if start_utc_ns > step.utc_ns + _AHEAD_NS:
                return
            self._uploaded += 1
            duration_s = (int(world.frame_utc_ns[last]) - start_utc_ns) / NS + 0.5 * interval_s
            if start_utc_ns <= step.utc_ns:
                late_s = (step.utc_ns - start_utc_ns) / NS
                if late_s < duration_s:
                    yield self.function("start_observation", duration_s - late_s)
                continue
            ticks = clock_ticks(world, start_utc_ns)
            if world.scenario.link.stations:
                yield self._at(ticks - _STANDBY_BEFORE_TICKS, self.function("set_mode", PayloadMode.standby))
            yield self._at(ticks, self.function("start_observation", duration_s))

    def _resumed(self, step: StepInput, mode: PayloadMode) -> Iterator[bytes]:
        """Yield a telecommand to observe again if the payload waits in a window, as after a failure of its camera."""
        if step.frame < 0 or mode is not PayloadMode.standby:
            self._idle_since_ns = None
            return
        if self._idle_since_ns is None:
            self._idle_since_ns = step.utc_ns
        if step.utc_ns - self._idle_since_ns < _IDLE_LIMIT_NS:
            return
        self._idle_since_ns = None
        last = next(stop for start, stop in arcs(self.world) if start <= step.frame <= stop)
        left_s = (int(self.world.frame_utc_ns[last]) - step.utc_ns) / NS
        yield self.function("start_observation", left_s + 0.5 * self.world.scenario.camera.frame_interval_s)

    def _at(self, ticks: int, packet: bytes) -> bytes:
        octets = np.frombuffer(packet, dtype=np.uint8)
        return self.command("insert_activity", release_ticks=ticks, items={"octet": octets})

    def _contact(self, step: StepInput, mode: PayloadMode) -> Iterator[bytes]:
        """Yield the telecommand for downlink in a contact without observation, and for a playback at its beginning."""
        if not self._in_contact:
            self._in_contact, self._contact_start = True, clock_ticks(self.world, step.utc_ns)
            if self.world.scenario.link.playback and self._last_contact and mode is not PayloadMode.observing:
                start, stop = self._last_contact
                yield self.command("replay_store", start_ticks=start, stop_ticks=start + (stop - start) // 2)
        if mode is PayloadMode.standby and not self._arc_is_near(step):
            yield self.function("set_mode", PayloadMode.downlinking)

    def _end_contact(self, step: StepInput) -> None:
        if self._in_contact:
            self._last_contact = (self._contact_start, clock_ticks(self.world, step.utc_ns))
        self._in_contact = False

    def _arc_is_near(self, step: StepInput) -> bool:
        after = np.searchsorted(self.world.frame_utc_ns, step.utc_ns)
        if after == self.world.frame_utc_ns.size:
            return False
        return int(self.world.frame_utc_ns[after]) - step.utc_ns < 2 * _BEFORE_ARC_NS

    def _after_kidnap(self, number: int) -> bytes:
        """Return the telecommand that widens the estimate at the first frame after an announced kidnap, else none."""
        section, frames = self.world.scenario.disturbances, self.world.frame_utc_ns
        if not (section.kidnap_told and section.kidnap_distance_km > 0.0):
            return b""
        moved_utc_ns = int(frames[0]) + round(section.kidnap_at_s * NS)
        if int(frames[number]) < moved_utc_ns or (number and int(frames[number - 1]) >= moved_utc_ns):
            return b""
        distance_m = 1e3 * section.kidnap_distance_km
        return DICTIONARY.pack_command(
            "perform_function",
            # A jump of place on an orbit comes with one of velocity: 1e-3 rad/s times the distance.
            {"function_id": "widen_estimate", "argument_1": distance_m, "argument_2": 1e-3 * distance_m},
            sequence_count=0,
        )


def fly_scenario(world: World, spacecraft: Spacecraft) -> Iterator[StepResult]:
    """Fly the windows of a scenario with its operator."""
    try:
        yield from fly(spacecraft, _steps_due(world, spacecraft))
    finally:
        spacecraft.camera.close()


def _steps_due(world: World, spacecraft: Spacecraft) -> Iterator[StepInput]:
    """Yield the steps of a scenario with the telecommands of its operator, which depend on the step before."""
    operator, receiver = Operator(world), spacecraft.receiver
    for step in timeline(world):
        receiver.carrier = receiver.bit_lock = step.in_contact
        telecommands = operator.telecommands(step, spacecraft.payload.mode)
        yield replace(step, telecommands=receiver.take(telecommands))
