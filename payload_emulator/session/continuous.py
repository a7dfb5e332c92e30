"""The spacecraft in continuous operation: from the scenario's epoch for any duration, at any speed, over TCP.

Images are made only where the payload looks at them, in commanded windows; in between, time passes in steps of a
minute with housekeeping, power, heat and the Sun of the orbit. Contacts follow from the geometry of the stations.
Telecommands reach the spacecraft in contacts alone, at the rate of the uplink; telemetry leaves it at the rate of the
downlink. The orbit is propagated a day at a time.

Ports: a telemetry and a telecommand port for each station (`StationPorts`), the mission description, and a console
with one JSON object a line out and one word a line in: `run`, `pause`, `state`, `save`, `until UTC`,
`rate X`, `quit`. With
`holds`, simulated time stands still at the beginning and at the end of each contact until `run`, so that a ground
service can send its telecommands and finish its work however fast the simulation is.
"""

from __future__ import annotations

import json
import selectors
import struct
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lunar.catalogue import CraterCatalogue
from lunar.datafolder import DataFolder
from lunar.errors import LunarError
from lunar.third_bodies import sun_position_icrf_m
from lunar.timescales import format_utc, parse_utc, tdb_s_from_utc_ns
from lunar.visibility import sunlit_fraction
from payload_emulator.flight.onboard.modes import PayloadMode
from payload_emulator.session.flying import SPACECRAFT_ID, CatalogueDetector
from payload_emulator.session.instruments import InstrumentBench
from payload_emulator.session.live import TelecommandBuffer
from payload_emulator.session.live_ports import Server
from payload_emulator.session.loading import LoadedPayload, launch_payload
from payload_emulator.session.scenario import Scenario
from payload_emulator.session.spacecraft import Spacecraft, new_board
from payload_emulator.session.state import load_state, save_state
from payload_emulator.session.station_ports import KEPT_LIMIT_OCTETS, StationPorts
from payload_emulator.session.uplink_journal import JournalEntry, add_to_journal, load_journal
from payload_emulator.session.world import (
    NO_SAMPLES,
    Exposure,
    World,
    clock_ticks,
    expose_at,
    extended_flight,
    first_utc_ns,
    open_world,
    sample_truth,
)
from payload_emulator.sim.board.contact_plan import StationContact, plan_contacts
from payload_emulator.sim.board.faults import parse_fault
from payload_emulator.sim.board.link import Receiver, Transmitter, transmit
from payload_emulator.sim.orbit.truth import Spliced, Truth
from tmtc.link import LinkSettings

CHUNK_S = 86_400.0
"""Time that the orbit is propagated ahead at once."""

IDLE_STEP_S = 60.0
"""Longest step outside contacts and windows."""

CONTACT_STEP_S = 60.0
"""Longest step in a contact."""

_AHEAD_S = 4.0 * 3600.0
_NS = 1_000_000_000
_POLL_S = 0.05
# Two steps at one reading of the on-board clock would look like a clock that stands still.
_LEAST_STEP_NS = 20_000_000
_FIRST_DOWNLINK_S = 2.0
_NO_ATTITUDE = np.full(7, np.nan)
_CLOCK = struct.Struct("<q")
_ARCS_KEPT = 2
_EXACT = (
    "utc_ns", "spacecraft", "account", "contact", "_contacts", "_planned_until_ns", "_receiver",
    "_transmitter", "_uplinks", "_uplinked", "_last_heard_ns", "_waiting", "_sent_up",
)  # fmt: skip
"""Fields of a session that make up its exact state outside of observations, with the flight."""


@dataclass(slots=True)
class Account:
    """What a session has done since its epoch."""

    frames: int = 0
    packets: int = 0
    frames_sent: int = 0
    frames_lost: int = 0
    packets_lost_on_link: int = 0
    contacts: int = 0
    telecommands: int = 0
    telecommand_octets_lost: int = 0
    resets: int = 0


@dataclass(slots=True, eq=False)
class ContinuousSession:
    """A spacecraft that flies until it is told to stop.

    Attributes
    ----------
    rate
        Simulated seconds per second; 0: as fast as possible.
    holds
        Whether time stands still at the beginning and the end of contacts until the console says `run`.
    stop_utc_ns
        End of the session; None: none.
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
    catalogue
        Craters of the anchoring catalogue that is loaded at launch; None: none.
    mission
        From the ports in use (station: telemetry, telecommand) to the text of the mission description.
    """

    scenario: Scenario
    data: DataFolder
    rate: float = 0.0
    holds: bool = False
    stop_utc_ns: int | None = None
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
    catalogue: CraterCatalogue | None = None
    mission: Callable[[World, dict[str, tuple[int, int]]], str] = lambda world, ports: ""
    stopping: threading.Event = field(default_factory=threading.Event)
    account: Account = field(default_factory=Account)
    world: World = field(init=False)
    spacecraft: Spacecraft = field(init=False)
    utc_ns: int = field(init=False)
    contact: StationContact | None = None
    stations: dict[str, StationPorts] = field(default_factory=dict)
    console: Server = field(init=False)
    mission_server: Server = field(init=False)
    _loaded: LoadedPayload = field(init=False)
    _contacts: deque[StationContact] = field(default_factory=deque)
    _planned_until_ns: int = 0
    _receiver: Receiver = field(default_factory=lambda: Receiver(SPACECRAFT_ID))
    _transmitter: Transmitter = field(init=False)
    _uplinks: dict[int, TelecommandBuffer] = field(default_factory=dict)
    _uplinked: deque[tuple[int, bytes]] = field(default_factory=deque)
    _sent_up: set[int] = field(default_factory=set)
    _to_repeat: deque[JournalEntry] = field(default_factory=deque)
    _bench: InstrumentBench = field(init=False)
    _executor: ThreadPoolExecutor = field(init=False)
    _next_image: tuple[int, Future[Exposure]] | None = None
    _words: dict[int, bytes] = field(default_factory=dict)
    _held: bool = False
    _last_heard_ns: int = 0
    _waiting: int = 0
    _until_ns: int | None = None
    _clock_map: Any = None
    _is_continued: bool = False

    def __post_init__(self) -> None:
        scenario = self.scenario
        self._transmitter = Transmitter(SPACECRAFT_ID, LinkSettings(coding=scenario.link.coding))
        self.world = open_world(scenario, self.data, CHUNK_S)
        self._loaded = launch_payload(scenario, self.world.camera, self.data, self.catalogue)
        self.utc_ns = scenario.epoch_utc_ns
        self._planned_until_ns = self.utc_ns
        self.spacecraft = Spacecraft(
            self._loaded,
            new_board(scenario.seed),
            scenario.epoch_utc_ns,
            tuple(parse_fault(text) for text in scenario.faults.events),
            CatalogueDetector(scenario.seed) if scenario.camera.images == "reduced" else None,
        )
        if self.state_file is not None:
            self._continue_from(self.state_file)
        if scenario.camera.images != "reduced":
            self.world.terrain.reserve()
        if self.journal_file is not None:
            left = [one for one in load_journal(self.journal_file) if one.number not in self._sent_up]
            self._to_repeat.extend(sorted(left, key=lambda one: one.utc_ns))
        self._bench = InstrumentBench(self.world)
        self._executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix="render")
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
                self._fly(selector)
            finally:
                self._save()
                self._send_message({"kind": "end", "utc": format_utc(self.utc_ns)})
                self._executor.shutdown(cancel_futures=True)
                for server in self._servers():
                    server.close()

    # Time

    def _fly(self, selector: selectors.BaseSelector) -> None:
        if not self._is_continued:
            self._turn()
        while not self.stopping.is_set():
            if self.stop_utc_ns is not None and self.utc_ns >= self.stop_utc_ns:
                self._finish(selector)
                return
            self._plan_ahead()
            due_ns = self._next_turn_ns()
            if not self._wait(selector, due_ns):
                return
            self.utc_ns = due_ns
            self._write_clock()
            before = self.contact
            self._turn()
            if self.contact is not before:
                self._hold(selector)
            elif self._until_ns is not None and self.utc_ns >= self._until_ns:
                self._until_ns, self.paused = None, True
                self._send_message({"kind": "paused", "utc": format_utc(self.utc_ns)})

    def _finish(self, selector: selectors.BaseSelector) -> None:
        """Say that the end is reached and wait for `run` where time holds, also to a console that connects later."""
        self._held = self.holds
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
        step_s = IDLE_STEP_S if self.contact is None else CONTACT_STEP_S
        step_ns = round(step_s * _NS)
        epoch_ns = self.scenario.epoch_utc_ns
        due = [epoch_ns + ((self.utc_ns - epoch_ns) // step_ns + 1) * step_ns]
        if self.contact is not None:
            due.append(self.contact.stop_utc_ns)
        elif self._contacts:
            due.append(self._contacts[0].start_utc_ns)
        payload = self.spacecraft.payload
        ticks = payload.next_turn_ticks
        if ticks is not None:
            due.append(self._utc_of(ticks))
        elif payload.mode is PayloadMode.observing:
            due.append(self.utc_ns + round(self.scenario.camera.frame_interval_s * _NS))
        due += [bound for bound in (self.stop_utc_ns, self._until_ns) if bound is not None]
        return max(min(due), self.utc_ns + _LEAST_STEP_NS)

    def _utc_of(self, ticks: int) -> int:
        """Return the first time at which the on-board clock reads `ticks`."""
        return first_utc_ns(self.world, ticks - self.spacecraft.clock_error_ticks)

    def _ticks(self, utc_ns: int) -> int:
        return clock_ticks(self.world, utc_ns) + self.spacecraft.clock_error_ticks

    def _wait(self, selector: selectors.BaseSelector, due_ns: int) -> bool:
        """Serve the ports until it is time for the next step; False where the session is to stop."""
        self._repeat_journal()
        due = time.monotonic() + (due_ns - self.utc_ns) / _NS / self.rate if self.rate > 0.0 else 0.0
        self._serve(selector, 0.0)
        while not self.stopping.is_set():
            left = due - time.monotonic()
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
            "frames": self.account.frames,
            "packets": self.account.packets,
            "telecommands": self.account.telecommands,
            "packets_lost_on_link": self.account.packets_lost_on_link,
            "telecommand_octets_lost": self.account.telecommand_octets_lost,
            "resets": self.account.resets,
        }

    def _plan_ahead(self) -> None:
        """Propagate the orbit and find the contacts of the coming hours."""
        world = self.world
        while world.truth.stop_utc_ns < self.utc_ns + round(_AHEAD_S * _NS) + _NS * 600:
            truth, burns = extended_flight(world, CHUNK_S)
            world = self.world = replace(world, truth=pruned(truth, _ARCS_KEPT), burns=(*world.burns, *burns))
            self._bench.world = world
        if self._planned_until_ns < self.utc_ns + round(_AHEAD_S * _NS / 2):
            self._plan_contacts()

    def _plan_contacts(self) -> None:
        link = self.scenario.link
        stop_ns = self.world.truth.stop_utc_ns - 300 * _NS
        # A contact that was cut off by the end of the plan is found again as a whole.
        while self._contacts and self._contacts[-1].stop_utc_ns >= self._planned_until_ns - _NS:
            self._planned_until_ns = self._contacts.pop().start_utc_ns
        start_ns = max(self._planned_until_ns, self.world.truth.start_utc_ns + 300 * _NS)
        if self.contact is not None:
            start_ns = max(start_ns, self.contact.stop_utc_ns)
        ephemeris = sample_truth(self.world.truth, np.array([start_ns, stop_ns], dtype=np.int64))
        self._contacts.extend(plan_contacts(ephemeris, link, start_ns, stop_ns))
        self._planned_until_ns = stop_ns

    # One step

    def _turn(self) -> None:
        """Let the spacecraft do what is due at this time, and send its telemetry."""
        utc_ns, spacecraft = self.utc_ns, self.spacecraft
        seconds = self._change_contact(utc_ns)
        contact = self.contact
        heard = contact is not None and seconds > 0.0
        link = self.scenario.link
        orders = self._take_orders(seconds) if heard else b""
        ticks = self._ticks(utc_ns)
        # The image is that of the tick: what the telemetry says of its time is enough to make it again.
        will_look = spacecraft.payload.will_look(ticks, orders)
        exposure = self._image(self._utc_of(ticks)) if will_look else None
        if exposure is not None and isinstance(spacecraft.detector, CatalogueDetector):
            spacecraft.detector.show(self.world, exposure)
        resets, payload = len(spacecraft.resets), spacecraft.payload
        frames = payload.frames
        packets = spacecraft.step(
            utc_ns,
            None if exposure is None else exposure.image,
            _NO_ATTITUDE if exposure is None else exposure.attitude,
            clock_ticks(self.world, utc_ns),
            orders,
            sunlit=self._sunlit(utc_ns),
            downlink_octets=int(link.rate_bps / 8.0 * seconds) if heard else 0,
            instruments=NO_SAMPLES if exposure is None else exposure.instruments,
        )
        self._receiver.carrier = self._receiver.bit_lock = heard
        # An image that the payload did not look at, such as one made for a command that it refused, is no frame.
        rebooted = spacecraft.payload is not payload
        self.account.frames += payload.frames - frames + (spacecraft.payload.frames if rebooted else 0)
        self.account.resets += len(spacecraft.resets) - resets
        if contact is not None:
            self._send(contact, packets)
        if contact is not None and utc_ns >= contact.stop_utc_ns:
            self._end_contact()

    def _change_contact(self, utc_ns: int) -> float:
        """Begin the contact that is due; the seconds of contact since the step before."""
        if self.contact is None and self._contacts and self._contacts[0].start_utc_ns <= utc_ns:
            self.contact = self._contacts.popleft()
            self._waiting = self.spacecraft.payload.waiting
            self.account.contacts += 1
            self._last_heard_ns = utc_ns
            return _FIRST_DOWNLINK_S
        if self.contact is None:
            return 0.0
        seconds = (utc_ns - self._last_heard_ns) / _NS
        self._last_heard_ns = utc_ns
        return seconds

    def _end_contact(self) -> None:
        """End a contact: telecommands that are still on their way are lost."""
        self.account.telecommand_octets_lost += sum(len(octets) for _, octets in self._uplinked)
        self._uplinked.clear()
        self._uplinks.clear()
        self.contact = None

    def _take_orders(self, seconds: float) -> bytes:
        """Return the telecommand packets that reach the spacecraft in some seconds at the rate of the uplink."""
        allowed = int(self.scenario.link.uplink_bps / 8.0 * seconds)
        packets: list[bytes] = []
        while self._uplinked and allowed > 0:
            connection, octets = self._uplinked.popleft()
            if len(octets) > allowed:
                self._uplinked.appendleft((connection, octets[allowed:]))
                octets = octets[:allowed]
            allowed -= len(octets)
            packets += self._uplinks.setdefault(connection, TelecommandBuffer(self._receiver)).take(octets)
        self.account.telecommands += len(packets)
        return b"".join(packets)

    def _image(self, utc_ns: int) -> Exposure:
        """Return the frame of this moment, and begin to render the next one."""
        prepared, self._next_image = self._next_image, None
        if prepared is not None and prepared[0] == utc_ns:
            exposure = prepared[1].result()
        else:
            if prepared is not None:
                prepared[1].cancel()
            exposure = self._executor.submit(self._expose, utc_ns).result()
        window = self.spacecraft.payload.mode is PayloadMode.observing
        if window:
            following = utc_ns + round(self.scenario.camera.frame_interval_s * _NS)
            ticks = self.spacecraft.payload.next_turn_ticks
            if ticks is not None and ticks <= self._ticks(utc_ns):
                # This frame is the one that is due; the next follows by the same interval.
                ticks = None
            at_ns = following if ticks is None else self._utc_of(ticks)
            self._next_image = (at_ns, self._executor.submit(self._expose, at_ns))
        return exposure

    def _expose(self, utc_ns: int) -> Exposure:
        return expose_at(self.world, utc_ns, self._bench.sample)

    def _sunlit(self, utc_ns: int) -> float:
        position, _ = self.world.truth.states(utc_ns)
        return float(sunlit_fraction(position[0], sun_position_icrf_m(float(tdb_s_from_utc_ns(utc_ns)))))

    def _send(self, contact: StationContact, packets: list[bytes]) -> None:
        """Send packets, or an idle frame, to the station of the contact, over the link of the scenario."""
        transmitter, station = self._transmitter, self.stations[contact.station]
        clcw = self._receiver.clcw
        length = transmitter.settings.cadu_length
        light_s = contact.light_s(self.utc_ns)
        received_ns = self.utc_ns + round(light_s * _NS)
        if packets:
            transmitter.send(packets, self.utc_ns, light_s=light_s, clcw=clcw)
            dump = transmitter.dumps.pop()
            seed = self.scenario.seed + self.account.frames_sent
            reception = transmit([dump], transmitter.settings, self.scenario.link, seed)
            octets = reception.octets
            self.account.packets += len(packets)
            self.account.packets_lost_on_link += reception.account["packets_lost"]
            self.account.frames_lost += reception.account["frames_lost_on_link"]
            self.account.frames_sent += reception.account["frames_sent"]
        else:
            octets = transmitter.idle(clcw)
        station.send(received_ns, octets, length)

    # Ports

    def _open_ports(self) -> None:
        for name in self.scenario.link.stations:
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
        self.console = Server(
            "console",
            self.console_port,
            self.host,
            self._take_words,
            self._end_console,
        )
        used = {name: (one.telemetry.port, one.telecommand.port) for name, one in self.stations.items()}
        text = self.mission(self.world, used)
        self.mission_server = Server(
            "mission", self.mission_port, self.host, lambda number, octets: None, document=text.encode()
        )

    def _servers(self) -> Iterator[Server]:
        yield from (self.console, self.mission_server)
        for station in self.stations.values():
            yield from (station.telemetry, station.telecommand)

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
        if octets:
            self._uplinked.append((hash((station, number)), octets))
        if self.keeps:
            self._sent_up.add(number)

    def _take_words(self, connection: int, octets: bytes) -> None:
        *lines, rest = (self._words.get(connection, b"") + octets)[-4096:].split(b"\n")
        self._words[connection] = rest
        for line in lines:
            self._execute(line.decode("utf-8", "replace").split())

    def _end_console(self, number: int) -> None:
        """Forget what a connection of the console has not finished, and end the session with the last one."""
        self._words.pop(number, None)
        if self.ends_with_console and not self.console.clients:
            self.stopping.set()

    def _execute(self, words: list[str]) -> None:
        if words == ["run"]:
            self._held = self.paused = False
        elif words == ["pause"]:
            self.paused = True
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
            expected = "expected run, pause, state, save, until UTC, rate X or quit"
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
        save_state(self.state_file, self.scenario.name, values, self._known_objects())
        return True

    def _continue_from(self, path: Path) -> None:
        """Go on from a state, if the file is there, as if the process had not ended."""
        values = load_state(path, self.scenario.name, self._known_objects())
        if values is None:
            return
        self.world = replace(self.world, truth=values.pop("truth"), burns=values.pop("burns"))
        for name, value in values.items():
            setattr(self, name, value)
        self._is_continued = True

    def _known_objects(self) -> dict[str, object]:
        """Return the objects that every session of the scenario makes alike."""
        loaded = self._loaded
        return {
            "loaded": loaded,
            "detector": loaded.detector,
            "tables": loaded.tables,
            "orientation": self.world.truth.orientation,
        }


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
