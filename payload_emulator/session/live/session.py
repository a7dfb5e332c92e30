"""The spacecraft as a process: flown at any speed, commanded and watched over TCP.

Without its operator, the spacecraft flies from the scenario's epoch on and is commanded by the ground. Images are made
only where the payload looks at them, in commanded windows; in between, time passes in steps of a minute with
housekeeping, power, heat and the Sun of the orbit. Contacts follow from the geometry of the stations: telecommands
reach the spacecraft in contacts alone, at the rate of the uplink; telemetry leaves it at the rate of the downlink.
Without stations, one that always sees the spacecraft takes their place. With its operator, the spacecraft flies the
moments of the scenario, as in an archive of it.

Ports: a telemetry and a telecommand port for each station (`StationPorts`), the mission description, and a console with
one JSON object a line out and one word a line in: `run`, `pause`, `step`, `state`, `watch`, `save`, `until UTC`,
`rate X`, `quit`. With `holds`, simulated time stands still at the beginning and at the end of each contact until `run`,
so that a ground service can send its telecommands and finish its work however fast the simulation is. A step by hand,
or going on after `pause`, breaks the continuity of time for those who watch: as in the simulator of the paper, the
odometries are told to start again (trigger `manual_step`).
"""

from __future__ import annotations

import json
import selectors
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from kernels.memory import give_back
from lunar.errors import LunarError
from lunar.third_bodies import sun_position_icrf_m
from lunar.timescales import format_utc, parse_utc, tdb_s_from_utc_ns
from lunar.visibility import sunlit_fraction
from payload_emulator.errors import LinkError
from payload_emulator.flight.onboard.modes import PayloadMode
from payload_emulator.flight.ports import UNLIMITED
from payload_emulator.session.live.state import load_state, save_state
from payload_emulator.session.live.station_ports import (
    KEPT_LIMIT_OCTETS,
    JournalEntry,
    Server,
    StationPorts,
    TelecommandBuffer,
    add_to_journal,
    load_journal,
)
from payload_emulator.session.live.viewing import rims_in_view, step_message
from payload_emulator.session.scenario import Scenario
from payload_emulator.session.spacecraft.loading import LoadedPayload
from payload_emulator.session.spacecraft.loop import Spacecraft, StepInput, StepResult, fly, new_spacecraft
from payload_emulator.session.spacecraft.schedule import Operator, timeline
from payload_emulator.session.world.world import (
    CHUNK_S,
    World,
    clock_ticks,
    extended_flight,
    frame_utc_ns,
    sample_truth,
)
from payload_emulator.sim.board.contact_plan import StationContact, parse_clock_error, plan_contacts
from payload_emulator.sim.board.link import Transmitter, light_to_earth_s, transmit
from payload_emulator.sim.orbit.truth import Spliced, Truth
from tmtc.dictionary.payload import DICTIONARY
from tmtc.link.settings import LinkSettings

ALWAYS_HEARD = "earth"
"""Station that always sees the spacecraft, at the light time to the Earth's centre, with no limit of its rates."""

STEP_S = 60.0
"""Longest step."""

_AHEAD_S = 4.0 * 3600.0
_NS = 1_000_000_000
_POLL_S = 0.05
# Two steps at one reading of the on-board clock would look like a clock that stands still.
_LEAST_STEP_NS = 20_000_000
_FIRST_DOWNLINK_S = 2.0
_CLOCK = struct.Struct("<q")
_ARCS_KEPT = 2
_CONSOLE_SOURCE = 2
_CONSOLE_COUNTS = 1 << 13  # the ground's counts begin at 0: reports name a telecommand by its count
_EXACT = (
    "utc_ns", "spacecraft", "account", "contact", "_contacts", "_planned_until_ns", "_transmitter", "_uplinks",
    "_uplinked", "_last_heard_ns", "_last_image_ns", "_waiting", "_sent_up", "_operator", "_discontinuous",
    "_console_count",
)  # fmt: skip
"""Fields of a session that make up its exact state outside of observations, with the flight."""


@dataclass(slots=True)
class Account:
    """What a session has done since its start.

    Attributes
    ----------
    images_lost
        Images that the payload did not get because the ground in view could not be rendered.
    """

    frames: int = 0
    images_lost: int = 0
    packets: int = 0
    frames_sent: int = 0
    frames_lost: int = 0
    packets_lost_on_link: int = 0
    contacts: int = 0
    telecommands: int = 0
    telecommand_octets_lost: int = 0
    resets: int = 0


@dataclass(slots=True, eq=False)
class LiveSession:
    """A spacecraft that flies until it is told to stop.

    Attributes
    ----------
    world, loaded
        From the epoch on without operator; with one, with the windows of the scenario and the tables for them.
    has_operator
        Whether the operator of the scenario commands its windows; they are the schedule until they are over.
    rate
        Simulated seconds per second; 0: as fast as possible.
    holds
        Whether time stands still at the beginning and the end of contacts until the console says `run`.
    stop_utc_ns
        End of the session; None: none.
    ends_with_scenario
        Whether the session of an operator ends with the windows of the scenario.
    state_file
        Where the exact state is written outside of observations: after each contact, when the console says `save`, and
        at the end. A start goes on from it.
    journal_file
        Where transmissions that the stations confirm are recorded. A start from a state repeats those after it at their
        times, so that the session goes on as if the process had not ended.
    clock_file
        Where the mission time is written for the ground (`LINNA_CLOCK_FILE`).
    keeps
        Whether the stations keep records until they are acknowledged.
    ends_with_console
        Whether the session ends when the last connection of the console ends.
    mission
        From the ports in use (station: telemetry, telecommand) to the text of the mission description.
    """

    world: World
    loaded: LoadedPayload
    has_operator: bool = False
    rate: float = 0.0
    holds: bool = False
    stop_utc_ns: int | None = None
    ends_with_scenario: bool = False
    paused: bool = False
    host: str = "127.0.0.1"
    console_port: int = 0
    mission_port: int = 0
    station_ports: dict[str, tuple[int, int]] = field(default_factory=dict)
    state_file: Path | None = None
    journal_file: Path | None = None
    clock_file: Path | None = None
    keeps: bool = False
    ends_with_console: bool = False
    mission: Callable[[World, dict[str, tuple[int, int]]], str] = lambda world, ports: ""
    stopping: threading.Event = field(default_factory=threading.Event)
    account: Account = field(default_factory=Account)
    spacecraft: Spacecraft = field(init=False)
    utc_ns: int = field(init=False)
    contact: StationContact | None = None
    stations: dict[str, StationPorts] = field(default_factory=dict)
    console: Server = field(init=False)
    mission_server: Server = field(init=False)
    _slots: deque[StepInput] = field(default_factory=deque)
    _operator: Operator | None = None
    _contacts: deque[StationContact] = field(default_factory=deque)
    _planned_until_ns: int = 0
    _transmitter: Transmitter = field(init=False)
    _uplinks: dict[tuple[str, int], TelecommandBuffer] = field(default_factory=dict)
    _uplinked: deque[tuple[tuple[str, int], bytes]] = field(default_factory=deque)
    _sent_up: set[int] = field(default_factory=set)
    _to_repeat: deque[JournalEntry] = field(default_factory=deque)
    _words: dict[int, bytes] = field(default_factory=dict)
    _watching: set[int] = field(default_factory=set)
    _held: bool = False
    _steps: int = 0
    _discontinuous: bool = False
    _console_count: int = _CONSOLE_COUNTS
    _last_heard_ns: int = 0
    _last_image_ns: int = 0
    _waiting: int = 0
    _until_ns: int | None = None
    _clock_map: Any = None
    _is_continued: bool = False

    def __post_init__(self) -> None:
        world, scenario = self.world, self.world.scenario
        self._transmitter = Transmitter(scenario.spacecraft_id, LinkSettings(coding=scenario.link.coding))
        self.utc_ns = self._planned_until_ns = world.truth.start_utc_ns
        if scenario.orbit.oem:
            self.stop_utc_ns = min(self.stop_utc_ns or world.truth.stop_utc_ns, world.truth.stop_utc_ns)
        if self.has_operator:
            self._operator = Operator(world)
        self.spacecraft = new_spacecraft(world, self.loaded, None if self.has_operator else self.utc_ns)
        if self.state_file is not None:
            self._continue_from(self.state_file)
        if self.has_operator:
            self._slots.extend(
                one for one in timeline(world) if not self._is_continued or one.utc_ns > self.utc_ns
            )
            if not self._is_continued:
                self.utc_ns = self._slots[0].utc_ns
        if self._names == (ALWAYS_HEARD,) and not self._is_continued:
            self._begin_contact(self._always())
        if self.journal_file is not None:
            left = [one for one in load_journal(self.journal_file) if one.number not in self._sent_up]
            self._to_repeat.extend(sorted(left, key=lambda one: one.utc_ns))
        self._write_clock()
        self._open_ports()

    @property
    def ports(self) -> dict[str, int]:
        """The ports in use, by name."""
        found = {"console": self.console.port, "mission": self.mission_server.port}
        for name, station in self.stations.items():
            found[f"telemetry {name}"] = station.telemetry.port
            found[f"telecommand {name}"] = station.telecommand.port
        return found

    def run(self) -> None:
        """Fly until the end, or until told to stop; then keep the state and close everything."""
        with selectors.DefaultSelector() as selector:
            for server in self._servers():
                server.attach(selector)
            try:
                for result in fly(self.spacecraft, self._steps_due(selector)):
                    self._take(result)
            finally:
                self._save()
                self._send_message({"kind": "end", "utc": format_utc(self.utc_ns)})
                self.close()

    def close(self) -> None:
        """Close all connections and end the camera."""
        self.spacecraft.camera.close()
        for server in self._servers():
            server.close()

    # Time

    def _steps_due(self, selector: selectors.BaseSelector) -> Iterator[StepInput]:
        """Yield the moments when their time has come, and serve the ports in between."""
        is_first = not self._is_continued
        while not self.stopping.is_set():
            is_over = self.ends_with_scenario and self.has_operator and not self._slots
            if is_over or (not is_first and self.stop_utc_ns is not None and self.utc_ns >= self.stop_utc_ns):
                self._finish(selector)
                return
            slot = self._slots[0] if self._slots else None
            if slot is None:
                self._plan_ahead()
            due_ns = slot.utc_ns if slot else self.utc_ns if is_first else self._next_turn_ns()
            if not self._wait(selector, due_ns):
                return
            self.utc_ns, is_first = due_ns, False
            self._write_clock()
            before = self.contact
            if slot is not None:
                self._slots.popleft()
            yield self._ground_moment() if slot is None else self._scenario_moment(slot)
            if self.contact is not before:
                self._hold(selector)
            elif self._until_ns is not None and self.utc_ns >= self._until_ns:
                self._until_ns, self.paused = None, True
                self._send_message({"kind": "paused", "utc": format_utc(self.utc_ns)})

    def _scenario_moment(self, slot: StepInput) -> StepInput:
        """Return a moment of the scenario with the telecommands of its operator, and with those that came by hand."""
        assert self._operator is not None
        if not slot.in_contact:
            self._end_contact()
        elif self.contact is None:
            self._begin_contact(self._always())
        receiver = self.spacecraft.receiver
        receiver.carrier = receiver.bit_lock = slot.in_contact
        telecommands = receiver.take(self._operator.telecommands(slot, self.spacecraft.payload.mode))
        by_hand = self._uplinked_telecommands(None) if slot.in_contact else b""
        return replace(slot, telecommands=telecommands + by_hand + self._manual_step())

    def _ground_moment(self) -> StepInput:
        """Return what is due now where the ground commands."""
        utc_ns, spacecraft, link = self.utc_ns, self.spacecraft, self.world.scenario.link
        seconds = self._change_contact(utc_ns)
        contact = self.contact
        limited = self._names != (ALWAYS_HEARD,)
        in_contact = contact is not None and (seconds > 0.0 or not limited)
        telecommands = self._uplinked_telecommands(seconds if limited else None) if in_contact else b""
        telecommands += self._manual_step()
        octets = int(link.rate_bps / 8.0 * seconds) if limited else UNLIMITED
        spacecraft.receiver.carrier = spacecraft.receiver.bit_lock = in_contact
        position, _ = self.world.truth.states(utc_ns)
        sun = sun_position_icrf_m(float(tdb_s_from_utc_ns(utc_ns)))
        image_ns = self._image_ns(utc_ns, telecommands)
        return StepInput(
            utc_ns,
            -1,
            float(sunlit_fraction(position[0], sun)),
            in_contact,
            octets if in_contact else 0,
            0.0 if contact is None else self._light_s(contact, utc_ns),
            image_ns,
            None if image_ns is None else self._next_image_ns(utc_ns),
            telecommands,
        )

    def _image_ns(self, utc_ns: int, telecommands: bytes) -> int | None:
        """Return the time of the image that is due; None without one.

        It is that of the tick: what the telemetry says of its time is enough to make it again.
        """
        payload, ticks = self.spacecraft.payload, self._ticks(utc_ns)
        if not payload.will_look(ticks, telecommands):
            return None
        observing = payload.mode is PayloadMode.observing
        if observing and not payload.has_cadence and utc_ns < self._last_image_ns + self._interval_ns:
            return None
        self._last_image_ns = utc_ns
        return frame_utc_ns(self.world, ticks - self.spacecraft.clock_error_ticks)

    def _next_image_ns(self, utc_ns: int) -> int | None:
        """Return the time of the image that probably follows one of now; None without one."""
        payload = self.spacecraft.payload
        if payload.mode is not PayloadMode.observing:
            return None
        ticks = payload.next_turn_ticks
        if not payload.has_cadence or ticks is None or ticks <= self._ticks(utc_ns):
            # This frame is the one that is due; the next follows by the same interval.
            return utc_ns + self._interval_ns
        return frame_utc_ns(self.world, ticks - self.spacecraft.clock_error_ticks)

    def _manual_step(self) -> bytes:
        """Return the telecommand that tells an observing payload of a step by hand; no octets without one."""
        self._discontinuous &= self.spacecraft.payload.mode is PayloadMode.observing
        if not self._discontinuous or not self.spacecraft.payload.frames:
            return b""
        self._discontinuous = False
        count = self._console_count
        self._console_count = _CONSOLE_COUNTS | (count + 1) & (_CONSOLE_COUNTS - 1)
        values = {"function_id": "manual_step", "argument_1": 0.0, "argument_2": 0.0}
        return DICTIONARY.pack_command(
            "perform_function", values, sequence_count=count, source=_CONSOLE_SOURCE
        )

    def _finish(self, selector: selectors.BaseSelector) -> None:
        """Say that the end is reached; wait for `run` where time holds or a console, which may come later, ends it."""
        self._held = self.holds or self.ends_with_console
        message = {**self._contact_message(), "kind": "finished"}
        self._send_message(message)
        told = set(self.console.clients)
        while self._held and not self.stopping.is_set():
            self._serve(selector, _POLL_S)
            if not told.issuperset(self.console.clients):
                told.update(self.console.clients)
                self._send_message(message)

    def _next_turn_ns(self) -> int:
        """Return the time of the next step: of the payload, of the link, or the longest step there is."""
        step_ns, epoch_ns = round(STEP_S * _NS), self.world.scenario.epoch_utc_ns
        due = [epoch_ns + ((self.utc_ns - epoch_ns) // step_ns + 1) * step_ns]
        if self.contact is not None:
            due.append(self.contact.stop_utc_ns)
        elif self._contacts:
            due.append(self._contacts[0].start_utc_ns)
        payload = self.spacecraft.payload
        ticks = payload.next_turn_ticks
        if ticks is not None:
            due.append(frame_utc_ns(self.world, ticks - self.spacecraft.clock_error_ticks))
        if payload.mode is PayloadMode.observing and not payload.has_cadence:
            due.append(self._last_image_ns + self._interval_ns)
        due += [bound for bound in (self.stop_utc_ns, self._until_ns) if bound is not None]
        return max(min(due), self.utc_ns + _LEAST_STEP_NS)

    @property
    def _interval_ns(self) -> int:
        return round(self.world.scenario.camera.frame_interval_s * _NS)

    def _ticks(self, utc_ns: int) -> int:
        return clock_ticks(self.world, utc_ns) + self.spacecraft.clock_error_ticks

    def _wait(self, selector: selectors.BaseSelector, due_ns: int) -> bool:
        """Serve the ports until it is time for the next step; False where the session is to stop."""
        self._repeat_journal()
        due = time.monotonic() + (due_ns - self.utc_ns) / _NS / self.rate if self.rate > 0.0 else 0.0
        self._serve(selector, 0.0)
        while not self.stopping.is_set():
            left = due - time.monotonic()
            if self._steps > 0:
                self._steps -= 1
                return True
            if self.paused or self._is_behind:
                self._serve(selector, _POLL_S)
            elif left <= 0.0:
                return True
            else:
                self._serve(selector, min(left, _POLL_S))
        return False

    @property
    def _is_behind(self) -> bool:
        """Whether the ground has fallen so far behind that time must not go on."""
        return any(one.waiting > KEPT_LIMIT_OCTETS // 16 for one in self.stations.values())

    def _hold(self, selector: selectors.BaseSelector) -> None:
        """Let time stand still after a contact has begun or ended, until the console says `run`."""
        self._held = self.holds
        self._send_message(self._contact_message())
        while self._held and not self.stopping.is_set():
            self._serve(selector, _POLL_S)
        if self.contact is None:
            self._save()

    def _contact_message(self) -> dict[str, Any]:
        return {
            "kind": "contact",
            "state": "ended" if self.contact is None else "started",
            "station": "" if self.contact is None else self.contact.station,
            "utc": format_utc(self.utc_ns),
            "mode": self.spacecraft.payload.mode.name,
            "waiting": self._waiting if self.contact is not None else self.spacecraft.payload.waiting,
            "sent": {name: one.sent for name, one in self.stations.items()},
            "unacknowledged": sum(one.unacknowledged for one in self.stations.values()),
            **asdict(self.account),
        }

    def _plan_ahead(self) -> None:
        """Propagate the orbit and find the contacts of the coming hours."""
        world = self.world
        if world.scenario.orbit.oem:
            return
        while world.truth.stop_utc_ns < self.utc_ns + round(_AHEAD_S * _NS) + _NS * 600:
            truth, burns = extended_flight(world, CHUNK_S)
            world = replace(world, truth=pruned(truth, _ARCS_KEPT), burns=(*world.burns, *burns))
        if world is not self.world:
            self._enter(world)
        if self._planned_until_ns < self.utc_ns + round(_AHEAD_S * _NS / 2):
            self._plan_contacts()

    def _enter(self, world: World) -> None:
        """Go on in a world whose flight is another one."""
        self.world = self.spacecraft.world = world
        if self._operator is not None:
            self._operator.world = world

    def _plan_contacts(self) -> None:
        if self._names == (ALWAYS_HEARD,):
            return
        stop_ns = self.world.truth.stop_utc_ns - 300 * _NS
        # A contact that was cut off by the end of the plan is found again as a whole.
        while self._contacts and self._contacts[-1].stop_utc_ns >= self._planned_until_ns - _NS:
            self._planned_until_ns = self._contacts.pop().start_utc_ns
        start_ns = max(self._planned_until_ns, self.world.truth.start_utc_ns + 300 * _NS)
        if self.contact is not None:
            start_ns = max(start_ns, self.contact.stop_utc_ns)
        ephemeris = sample_truth(self.world.truth, np.array([start_ns, stop_ns], dtype=np.int64))
        self._contacts.extend(plan_contacts(ephemeris, self.world.scenario.link, start_ns, stop_ns))
        self._planned_until_ns = stop_ns

    # Link

    def _take(self, result: StepResult) -> None:
        """Count what a step has done, and hand it to the station of the contact and to those who watch."""
        self._count(result)
        contact = self.contact
        if contact is not None:
            self._send(contact, result)
            if self.utc_ns >= contact.stop_utc_ns:
                self._end_contact()
        camera = self.spacecraft.camera
        if self._watching:
            message = step_message(self.spacecraft, result, camera.shown)
            message |= {"paused": self.paused, "rate": self.rate}
            line = json.dumps(message).encode() + b"\n"
            for number in self._watching:
                self.console.reply(number, line)
        rendered = self.world.scenario.camera.images != "reduced"
        camera.beside = rims_in_view if self._watching and rendered else None

    def _count(self, result: StepResult) -> None:
        account = self.account
        if result.exposure is not None and result.exposure.fault:
            account.images_lost += 1
            self._send_message(
                {
                    "kind": "fault",
                    "utc": format_utc(self.utc_ns),
                    "text": f"no image: {result.exposure.fault}",
                }
            )
        account.frames, account.resets = self.spacecraft.frames, len(self.spacecraft.resets)

    @property
    def _names(self) -> tuple[str, ...]:
        return station_names(self.world.scenario, self.has_operator)

    def _always(self) -> StationContact:
        empty = np.zeros(0)
        return StationContact(ALWAYS_HEARD, self.utc_ns, UNLIMITED, empty.astype(np.int64), empty)

    def _light_s(self, contact: StationContact, utc_ns: int) -> float:
        if contact.light_utc_ns.size:
            return contact.light_s(utc_ns)
        at = np.array([utc_ns], dtype=np.int64)
        return float(light_to_earth_s(self.world.truth.states(at)[0], at)[0])

    def _change_contact(self, utc_ns: int) -> float:
        """Begin the contact that is due; the seconds of contact since the step before."""
        if self.contact is None and self._contacts and self._contacts[0].start_utc_ns <= utc_ns:
            self._begin_contact(self._contacts.popleft())
            return _FIRST_DOWNLINK_S
        if self.contact is None:
            return 0.0
        seconds = (utc_ns - self._last_heard_ns) / _NS
        self._last_heard_ns = utc_ns
        return seconds

    def _begin_contact(self, contact: StationContact) -> None:
        self.contact = contact
        self._waiting = self.spacecraft.payload.waiting
        self.account.contacts += 1
        self._last_heard_ns = self.utc_ns

    def _end_contact(self) -> None:
        """End a contact: telecommands that are still on their way are lost. Free memory goes back to the system."""
        self.account.telecommand_octets_lost += sum(len(octets) for _, octets in self._uplinked)
        self._uplinked.clear()
        self._uplinks.clear()
        self.contact = None
        give_back()

    def _uplinked_telecommands(self, seconds: float | None) -> bytes:
        """Return the telecommand packets that reach the spacecraft in some seconds of uplink; None: all that wait."""
        allowed = UNLIMITED if seconds is None else int(self.world.scenario.link.uplink_bps / 8.0 * seconds)
        packets: list[bytes] = []
        while self._uplinked and allowed > 0:
            connection, octets = self._uplinked.popleft()
            if len(octets) > allowed:
                self._uplinked.appendleft((connection, octets[allowed:]))
                octets = octets[:allowed]
            allowed -= len(octets)
            buffer = self._uplinks.setdefault(connection, TelecommandBuffer(self.spacecraft.receiver))
            packets += buffer.take(octets)
        self.account.telecommands += len(packets)
        return b"".join(packets)

    def _send(self, contact: StationContact, result: StepResult) -> None:
        """Send packets, or an idle frame, to the station of the contact, over the link of the scenario."""
        transmitter, account = self._transmitter, self.account
        scenario, light_s = self.world.scenario, result.step.light_s
        if result.packets:
            transmitter.send(result.packets, self.utc_ns, light_s=light_s, clcw=result.clcw)
            dump = transmitter.dumps.pop()
            reception = transmit(
                [dump], transmitter.settings, scenario.link, scenario.seed + account.frames_sent
            )
            octets = reception.octets
            account.packets += len(result.packets)
            account.packets_lost_on_link += reception.account["packets_lost"]
            account.frames_lost += reception.account["frames_lost_on_link"]
            account.frames_sent += reception.account["frames_sent"]
        else:
            octets = transmitter.idle(result.clcw)
        stated = dict(map(parse_clock_error, scenario.link.clock_errors))
        received_ns = self.utc_ns + round(light_s * _NS) + stated.get(contact.station, 0)
        self.stations[contact.station].send(received_ns, octets, transmitter.settings.cadu_length)

    # Ports

    def _open_ports(self) -> None:
        try:
            for name in self._names:
                telemetry, telecommand = self.station_ports.get(name, (0, 0))
                self.stations[name] = StationPorts(
                    name,
                    self.host,
                    partial(self._take_telecommands, name),
                    telemetry,
                    telecommand,
                    self.keeps,
                    taken=self._sent_up.union(one.number for one in self._to_repeat),
                )
            used = {name: (one.telemetry.port, one.telecommand.port) for name, one in self.stations.items()}
            text = self.mission(self.world, used).encode()
            self.mission_server = Server(
                "mission", self.mission_port, self.host, lambda number, octets: None, document=text
            )
            # Last: who reaches the console reaches everything.
            words, ended = self._take_words, self._end_console
            self.console = Server("console", self.console_port, self.host, words, ended)
        except LinkError:
            self.close()
            raise

    def _servers(self) -> Iterator[Server]:
        for station in self.stations.values():
            yield from (station.telemetry, station.telecommand)
        for name in ("console", "mission_server"):
            if hasattr(self, name):
                yield getattr(self, name)

    def _serve(self, selector: selectors.BaseSelector, timeout_s: float) -> None:
        for key, events in selector.select(timeout_s):
            server, client = key.data
            server.serve(client, events)

    def _take_telecommands(self, station: str, number: int, octets: bytes) -> bool:
        """Take octets that a station is to send up; return whether it does.

        Without a contact of that station, a transmission that is to be confirmed is refused and other octets are lost.
        """
        has_contact = self.contact is not None and self.contact.station == station
        if self.keeps and not has_contact:
            return False
        if self.keeps and self.journal_file is not None:
            add_to_journal(self.journal_file, JournalEntry(self.utc_ns, station, number, octets))
        if has_contact:
            self._send_up(station, number, octets)
        else:
            self.account.telecommand_octets_lost += len(octets)
        return has_contact

    def _repeat_journal(self) -> None:
        """Send up what stations had confirmed at this time before the session was killed."""
        while self._to_repeat and self._to_repeat[0].utc_ns <= self.utc_ns:
            entry = self._to_repeat.popleft()
            self._send_up(entry.station, entry.number, entry.octets)

    def _send_up(self, station: str, number: int, octets: bytes) -> None:
        """Send octets up; no octets: the connection has ended, and what it has not finished is forgotten."""
        if octets:
            self._uplinked.append(((station, number), octets))
        elif not self._uplinked:
            self._uplinks.pop((station, number), None)
        if self.keeps:
            self._sent_up.add(number)

    def _take_words(self, connection: int, octets: bytes) -> None:
        *lines, rest = (self._words.get(connection, b"") + octets)[-4096:].split(b"\n")
        self._words[connection] = rest
        for line in lines:
            self._execute(connection, line.decode("utf-8", "replace").split())

    def _end_console(self, number: int) -> None:
        """Forget what a connection of the console has not finished, and end the session with the last one."""
        self._words.pop(number, None)
        self._watching.discard(number)
        if self.ends_with_console and not self.console.clients:
            self.stopping.set()

    def _execute(self, connection: int, words: list[str]) -> None:
        if words == ["run"]:
            self._held = self.paused = False
        elif words == ["pause"]:
            self.paused = self._discontinuous = True
        elif words == ["step"]:
            self.paused = self._discontinuous = True
            self._steps += 1
        elif words == ["watch"]:
            self._watching.add(connection)
        elif words == ["save"]:
            self._send_message({"kind": "saved", "saved": self._save()})
        elif words == ["quit"]:
            self.stopping.set()
        elif words == ["state"]:
            self._send_message(
                {**self._contact_message(), "kind": "state", "paused": self.paused or self._held}
            )
        elif len(words) == 2 and words[0] == "rate" and _number(words[1]) is not None:
            self.rate = _number(words[1]) or 0.0
        elif len(words) == 2 and words[0] == "until":
            try:
                self._until_ns = parse_utc(words[1])
                self._held = self.paused = False
            except LunarError as error:
                self._send_message({"kind": "error", "text": str(error)})
        elif words:
            text = " ".join(words)[:80]
            expected = "expected run, pause, step, state, watch, save, until UTC, rate X or quit"
            self._send_message({"kind": "error", "text": f"{expected}, found {text!r}"})

    def _send_message(self, message: dict[str, Any]) -> None:
        self.console.send(json.dumps(message).encode() + b"\n")

    # State

    def _write_clock(self) -> None:
        if self.clock_file is None:
            return
        if self._clock_map is None:
            self.clock_file.parent.mkdir(parents=True, exist_ok=True)
            # Other processes have mapped the file of an earlier session: it must not become shorter.
            with self.clock_file.open("r+b" if self.clock_file.exists() else "w+b") as file:
                file.write(_CLOCK.pack(self.utc_ns))
            self._clock_map = np.memmap(self.clock_file, dtype="<i8", mode="r+", shape=(1,))
        self._clock_map[0] = self.utc_ns

    def _save(self) -> bool:
        """Write the exact state, outside of observations; return whether it was written."""
        if self.state_file is None or self.spacecraft.payload.mode is PayloadMode.observing:
            return False
        values = {name: getattr(self, name) for name in _EXACT}
        values |= {"truth": self.world.truth, "burns": self.world.burns}
        save_state(self.state_file, self.world.scenario.name, values, self._known_objects())
        return True

    def _continue_from(self, path: Path) -> None:
        """Go on from a state, if the file is there, as if the process had not ended."""
        values = load_state(path, self.world.scenario.name, self._known_objects())
        if values is None:
            return
        world = replace(self.world, truth=values.pop("truth"), burns=values.pop("burns"))
        for name, value in values.items():
            setattr(self, name, value)
        self._enter(world)
        self._is_continued = True

    def _known_objects(self) -> dict[str, object]:
        """Return the objects that every session of the scenario makes alike."""
        loaded = self.loaded
        return {
            "loaded": loaded,
            "detector": loaded.detector,
            "tables": loaded.tables,
            "camera": self.spacecraft.camera,
            "world": self.world,
            "orientation": self.world.truth.orientation,
        }


def station_names(scenario: Scenario, has_operator: bool) -> tuple[str, ...]:
    """Return the stations that have ports: those of the scenario, which the schedule of an operator includes."""
    return (ALWAYS_HEARD,) if has_operator else scenario.link.stations or (ALWAYS_HEARD,)


def pruned(truth: Truth, days: int) -> Truth:
    """Return a flight without its arcs of former days; the last ones, two or more, are kept."""
    arcs = truth.state_icrf
    if not isinstance(arcs, Spliced) or len(arcs.arcs) <= days:
        return truth
    joints = arcs.joints_tdb_s[-days + 1 :]
    start_ns = truth.stop_utc_ns - round(days * CHUNK_S * _NS)
    breaks = tuple(one for one in truth.breaks_utc_ns if one >= start_ns)
    return Truth(Spliced(joints, arcs.arcs[-days:]), start_ns, truth.stop_utc_ns, truth.orientation, breaks)


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if 0.0 <= value < 1e9 else None
