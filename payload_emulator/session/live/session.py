"""The spacecraft as a process: flown at any speed, commanded and watched over TCP.

Without its operator, the spacecraft flies from the scenario's epoch on and is commanded by the ground. Images are made
only where the payload looks at them, in commanded windows; in between, time passes in steps of a minute with
housekeeping, power, heat and the Sun of the orbit. With its operator, the spacecraft flies the steps of the scenario,
as in an archive of it.

Ports: a telemetry and a telecommand port for each station (`Contacts`), the mission description, and a `Console`. With
`holds`, simulated time stands still at the beginning and at the end of each contact until `run`, so that a ground
service can send its telecommands and finish its work however fast the simulation is. A step by hand, or going on after
`pause`, breaks the continuity of time for those who watch: as in the simulator of the paper, a telecommand restarts the
odometries (trigger `manual_step`).
"""

import selectors
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import InitVar, asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from lunar.constants import NS
from lunar.third_bodies import sun_position_icrf_m
from lunar.timescales import format_utc, tdb_s_from_utc_ns
from lunar.visibility import sunlit_fraction
from payload_emulator.errors import LinkError
from payload_emulator.flight.onboard.modes import PayloadMode
from payload_emulator.flight.ports import UNLIMITED
from payload_emulator.session.live.console import CONSOLE_EXACT, Console, rims_in_view, step_message
from payload_emulator.session.live.contacts import CONTACTS_EXACT, Account, Contacts, station_names
from payload_emulator.session.live.state import ClockFile, load_state, save_state
from payload_emulator.session.live.station_ports import Server
from payload_emulator.session.spacecraft.loading import LoadedPayload
from payload_emulator.session.spacecraft.loop import Spacecraft, StepInput, StepResult, fly, new_spacecraft
from payload_emulator.session.spacecraft.schedule import Operator, timeline
from payload_emulator.session.world.world import CHUNK_S, World, clock_ticks, extended_flight, frame_utc_ns
from payload_emulator.sim.orbit.truth import Spliced, Truth

STEP_S = 60.0
"""Longest step."""

_AHEAD_S = 4.0 * 3600.0
_POLL_S = 0.05
# Two steps at one reading of the on-board clock would look like a clock that stands still.
_LEAST_STEP_NS = 20_000_000
_ARCS_KEPT = 2
_EXACT = {"utc_ns": "utc_ns", "spacecraft": "spacecraft", "_last_image_ns": "_last_image_ns", "_operator": "_operator"}
"""Attributes of a session in an exact state, with those of contacts, console and flight, by their names there."""


@dataclass(slots=True, eq=False)
class LiveSession:
    """A spacecraft that flies until `stopping` is set.

    Attributes
    ----------
    world, loaded
        From the epoch on without operator; with one, with the windows of the scenario and the tables for them.
    has_operator
        Whether the operator of the scenario commands its windows; they are the schedule until they are over.
    rate, paused, ends_with_console
        See `Console`.
    keeps, journal_file
        See `Contacts`.
    holds
        Whether time stands still at the beginning and the end of contacts until the console says `run`.
    stop_utc_ns
        End of the session; None: none.
    ends_with_scenario
        Whether the session of an operator ends with the windows of the scenario.
    state_file
        File of the exact state, written outside of observations: after each contact, when the console says `save`, and
        at the end. A start goes on from it.
    clock_file
        File of the mission time for the ground (`LINNA_CLOCK_FILE`).
    mission
        From the ports in use (station: telemetry, telecommand) to the text of the mission description.
    """

    world: World
    loaded: LoadedPayload
    has_operator: bool = False
    rate: InitVar[float] = 0.0
    holds: bool = False
    stop_utc_ns: int | None = None
    ends_with_scenario: bool = False
    paused: InitVar[bool] = False
    host: str = "127.0.0.1"
    console_port: int = 0
    mission_port: int = 0
    station_ports: dict[str, tuple[int, int]] = field(default_factory=dict)
    state_file: Path | None = None
    journal_file: InitVar[Path | None] = None
    clock_file: InitVar[Path | None] = None
    keeps: InitVar[bool] = False
    ends_with_console: InitVar[bool] = False
    mission: Callable[[World, dict[str, tuple[int, int]]], str] = lambda world, ports: ""
    stopping: threading.Event = field(default_factory=threading.Event)
    spacecraft: Spacecraft = field(init=False)
    utc_ns: int = field(init=False)
    contacts: Contacts = field(init=False)
    console: Console = field(init=False)
    mission_server: Server = field(init=False)
    _slots: deque[StepInput] = field(default_factory=deque)
    _operator: Operator | None = None
    _last_image_ns: int = 0
    _clock: ClockFile = field(init=False)
    _is_continued: bool = False

    def __post_init__(
        self,
        rate: float,
        paused: bool,
        journal_file: Path | None,
        clock_file: Path | None,
        keeps: bool,
        ends_with_console: bool,
    ) -> None:
        world, scenario = self.world, self.world.scenario
        self.utc_ns = world.truth.start_utc_ns
        names = station_names(scenario, self.has_operator)
        self.contacts = Contacts(scenario, names, self.utc_ns, keeps, journal_file)
        answers = {"state": self._state_message, "save": lambda: {"kind": "saved", "saved": self._save()}}
        self.console = Console(answers, self.stopping, ends_with_console, rate, paused)
        if scenario.orbit.oem:
            self.stop_utc_ns = min(self.stop_utc_ns or world.truth.stop_utc_ns, world.truth.stop_utc_ns)
        if self.has_operator:
            self._operator = Operator(world)
        self.spacecraft = new_spacecraft(world, self.loaded, None if self.has_operator else self.utc_ns)
        if self.state_file is not None:
            self._continue_from(self.state_file)
        if self.has_operator:
            self._slots.extend(one for one in timeline(world) if not self._is_continued or one.utc_ns > self.utc_ns)
            if not self._is_continued:
                self.utc_ns = self._slots[0].utc_ns
        if not self.contacts.is_limited and not self._is_continued:
            self.contacts.begin(self.spacecraft, self.utc_ns)
        self._clock = ClockFile(clock_file)
        self._clock.write(self.utc_ns)
        self._open_ports()

    @property
    def account(self) -> Account:
        """Counts since the start."""
        return self.contacts.account

    @property
    def ports(self) -> dict[str, int]:
        """The ports in use, by name."""
        found = {"console": self.console.server.port, "mission": self.mission_server.port}
        for name, station in self.contacts.stations.items():
            found[f"telemetry {name}"] = station.telemetry.port
            found[f"telecommand {name}"] = station.telecommand.port
        return found

    def run(self) -> None:
        """Fly until the end, or until `stopping` is set; then save the state and close everything."""
        with selectors.DefaultSelector() as selector:
            for server in self._servers():
                server.attach(selector)
            try:
                for result in fly(self.spacecraft, self._steps_due(selector)):
                    self._finish_step(result)
            finally:
                self._save()
                self.console.send({"kind": "end", "utc": format_utc(self.utc_ns)})
                self.close()

    def close(self) -> None:
        """Close all connections and end the camera."""
        self.spacecraft.camera.close()
        for server in self._servers():
            server.close()

    # Time

    def _steps_due(self, selector: selectors.BaseSelector) -> Iterator[StepInput]:
        """Yield the steps when their time has come, and serve the ports in between."""
        is_first = not self._is_continued
        while not self.stopping.is_set():
            is_over = self.ends_with_scenario and self.has_operator and not self._slots
            if is_over or (not is_first and self.stop_utc_ns is not None and self.utc_ns >= self.stop_utc_ns):
                self._finish(selector)
                return
            slot = self._slots[0] if self._slots else None
            if slot is None:
                self._plan_ahead()
            due_ns = slot.utc_ns if slot else self.utc_ns if is_first else self._next_step_ns()
            if not self._wait(selector, due_ns):
                return
            self.utc_ns, is_first = due_ns, False
            self._clock.write(self.utc_ns)
            before = self.contacts.contact
            if slot is not None:
                self._slots.popleft()
            yield self._ground_step() if slot is None else self._scenario_step(slot)
            if self.contacts.contact is not before:
                self._hold(selector)
            else:
                self.console.pause_at(self.utc_ns)

    def _scenario_step(self, slot: StepInput) -> StepInput:
        """Return a step of the scenario with the telecommands of its operator, and with those sent by hand."""
        assert self._operator is not None
        contacts, spacecraft = self.contacts, self.spacecraft
        if not slot.in_contact:
            contacts.end()
        elif contacts.contact is None:
            contacts.begin(spacecraft, self.utc_ns)
        receiver = spacecraft.receiver
        receiver.carrier = receiver.bit_lock = slot.in_contact
        telecommands = receiver.take(self._operator.telecommands(slot, spacecraft.payload.mode))
        if slot.in_contact:
            telecommands += contacts.telecommands(receiver, None)
        return replace(slot, telecommands=telecommands + self.console.manual_step(spacecraft.payload))

    def _ground_step(self) -> StepInput:
        """Return the step that is due now where the ground commands."""
        utc_ns, spacecraft, contacts = self.utc_ns, self.spacecraft, self.contacts
        seconds, limited = contacts.advance(spacecraft, utc_ns), contacts.is_limited
        in_contact = contacts.contact is not None and (seconds > 0.0 or not limited)
        receiver = spacecraft.receiver
        telecommands = contacts.telecommands(receiver, seconds if limited else None) if in_contact else b""
        telecommands += self.console.manual_step(spacecraft.payload)
        receiver.carrier = receiver.bit_lock = in_contact
        octets = int(self.world.scenario.link.rate_bps / 8.0 * seconds) if limited else UNLIMITED
        position, _ = self.world.truth.states(utc_ns)
        sun = sun_position_icrf_m(float(tdb_s_from_utc_ns(utc_ns)))
        image_ns = self._image_ns(utc_ns, telecommands)
        return StepInput(
            utc_ns,
            -1,
            float(sunlit_fraction(position[0], sun)),
            in_contact,
            octets if in_contact else 0,
            contacts.light_s(self.world.truth, utc_ns),
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

    def _finish(self, selector: selectors.BaseSelector) -> None:
        """Report the end; wait for `run` where time holds or a console, which may connect later, ends the session."""
        console = self.console
        console.held = self.holds or console.ends_session
        message = {**self._contact_message(), "kind": "finished"}
        console.send(message)
        informed = set(console.server.clients)
        while console.held and not self.stopping.is_set():
            self._serve(selector, _POLL_S)
            if not informed.issuperset(console.server.clients):
                informed.update(console.server.clients)
                console.send(message)

    def _next_step_ns(self) -> int:
        """Return the time of the next step: of the payload, of the link, or the longest step there is."""
        step_ns, epoch_ns = round(STEP_S * NS), self.world.scenario.epoch_utc_ns
        due = [epoch_ns + ((self.utc_ns - epoch_ns) // step_ns + 1) * step_ns]
        payload = self.spacecraft.payload
        ticks = payload.next_turn_ticks
        if ticks is not None:
            due.append(frame_utc_ns(self.world, ticks - self.spacecraft.clock_error_ticks))
        if payload.mode is PayloadMode.observing and not payload.has_cadence:
            due.append(self._last_image_ns + self._interval_ns)
        bounds = (self.contacts.next_change_ns, self.stop_utc_ns, self.console.until_ns)
        due += [bound for bound in bounds if bound is not None]
        return max(min(due), self.utc_ns + _LEAST_STEP_NS)

    @property
    def _interval_ns(self) -> int:
        return round(self.world.scenario.camera.frame_interval_s * NS)

    def _ticks(self, utc_ns: int) -> int:
        return clock_ticks(self.world, utc_ns) + self.spacecraft.clock_error_ticks

    def _wait(self, selector: selectors.BaseSelector, due_ns: int) -> bool:
        """Serve the ports until it is time for the next step; False where the session is to stop."""
        console = self.console
        self.contacts.repeat_journal(self.utc_ns)
        due = time.monotonic() + (due_ns - self.utc_ns) / NS / console.rate if console.rate > 0.0 else 0.0
        self._serve(selector, 0.0)
        while not self.stopping.is_set():
            left = due - time.monotonic()
            if console.steps > 0:
                console.steps -= 1
                return True
            if console.paused or self.contacts.is_behind:
                self._serve(selector, _POLL_S)
            elif left <= 0.0:
                return True
            else:
                self._serve(selector, min(left, _POLL_S))
        return False

    def _hold(self, selector: selectors.BaseSelector) -> None:
        """Let time stand still after a contact has begun or ended, until the console says `run`.

        The ground of an observation that is over is dropped: the next one is over other ground.
        """
        self.console.held = self.holds
        if self.spacecraft.payload.mode is not PayloadMode.observing:
            self.spacecraft.camera.release_ground()
        self.console.send(self._contact_message())
        while self.console.held and not self.stopping.is_set():
            self._serve(selector, _POLL_S)
        if self.contacts.contact is None:
            self._save()

    def _contact_message(self) -> dict[str, Any]:
        contacts, payload = self.contacts, self.spacecraft.payload
        contact, stations = contacts.contact, contacts.stations
        return {
            "kind": "contact",
            "state": "ended" if contact is None else "started",
            "station": "" if contact is None else contact.station,
            "utc": format_utc(self.utc_ns),
            "mode": payload.mode.name,
            "waiting": payload.waiting if contact is None else contacts.waiting,
            "sent": {name: one.sent for name, one in stations.items()},
            "unacknowledged": sum(one.unacknowledged for one in stations.values()),
            **asdict(self.account),
        }

    def _state_message(self) -> dict[str, Any]:
        paused = self.console.paused or self.console.held
        return {**self._contact_message(), "kind": "state", "paused": paused}

    def _plan_ahead(self) -> None:
        """Propagate the orbit and find the contacts of the coming hours."""
        world = self.world
        if world.scenario.orbit.oem:
            return
        while world.truth.stop_utc_ns < self.utc_ns + round(_AHEAD_S * NS) + NS * 600:
            truth, burns = extended_flight(world, CHUNK_S)
            world = replace(world, truth=pruned(truth, _ARCS_KEPT), burns=(*world.burns, *burns))
        if world is not self.world:
            self._enter(world)
        if self.contacts.planned_until_ns < self.utc_ns + round(_AHEAD_S * NS / 2):
            self.contacts.plan(world.truth)

    def _enter(self, world: World) -> None:
        """Go on in a world whose flight is another one."""
        self.world = self.spacecraft.world = world
        if self._operator is not None:
            self._operator.world = world

    def _finish_step(self, result: StepResult) -> None:
        """Count a step, send its packets to the station of the contact, and show it on consoles that watch."""
        account = self.account
        if result.exposure is not None and result.exposure.fault:
            account.images_lost += 1
            text = f"no image: {result.exposure.fault}"
            self.console.send({"kind": "fault", "utc": format_utc(self.utc_ns), "text": text})
        account.frames, account.resets = self.spacecraft.frames, len(self.spacecraft.resets)
        self.contacts.send(result)
        camera, watched = self.spacecraft.camera, self.console.is_watched
        if watched:
            self.console.show(step_message(self.spacecraft, result, camera.shown))
        rendered = self.world.scenario.camera.images != "reduced"
        camera.overlay = rims_in_view if watched and rendered else None

    # Ports

    def _open_ports(self) -> None:
        try:
            self.contacts.open_ports(self.host, self.station_ports, lambda: self.utc_ns)
            stations = self.contacts.stations.items()
            used = {name: (one.telemetry.port, one.telecommand.port) for name, one in stations}
            text = self.mission(self.world, used).encode()
            self.mission_server = Server(
                "mission", self.mission_port, self.host, lambda number, octets: None, document=text
            )
            # Last: who reaches the console reaches everything.
            self.console.open(self.host, self.console_port)
        except LinkError:
            self.close()
            raise

    def _servers(self) -> Iterator[Server]:
        for station in self.contacts.stations.values():
            yield from (station.telemetry, station.telecommand)
        for owner, name in ((self.console, "server"), (self, "mission_server")):
            if hasattr(owner, name):
                yield getattr(owner, name)

    def _serve(self, selector: selectors.BaseSelector, timeout_s: float) -> None:
        for key, events in selector.select(timeout_s):
            server, client = key.data
            server.serve(client, events)

    # State

    def _save(self) -> bool:
        """Write the exact state, outside of observations; return whether it was written."""
        if self.state_file is None or self.spacecraft.payload.mode is PayloadMode.observing:
            return False
        values = {name: getattr(owner, attribute) for name, owner, attribute in self._exact()}
        values |= {"truth": self.world.truth, "burns": self.world.burns}
        save_state(self.state_file, self.world.scenario.name, values, self._known_objects())
        return True

    def _continue_from(self, path: Path) -> None:
        """Go on from a state, if the file is there, as if the process had not ended."""
        values = load_state(path, self.world.scenario.name, self._known_objects())
        if values is None:
            return
        world = replace(self.world, truth=values.pop("truth"), burns=values.pop("burns"))
        for name, owner, attribute in self._exact():
            setattr(owner, attribute, values[name])
        self._enter(world)
        self._is_continued = True

    def _exact(self) -> Iterator[tuple[str, object, str]]:
        """Yield each value of the exact state: its name in the file, and owner and name of the attribute."""
        for owner, names in ((self, _EXACT), (self.contacts, CONTACTS_EXACT), (self.console, CONSOLE_EXACT)):
            yield from ((name, owner, attribute) for name, attribute in names.items())

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


def pruned(truth: Truth, days: int) -> Truth:
    """Return a flight without its arcs of former days; the last ones, two or more, are kept."""
    arcs = truth.state_icrf
    if not isinstance(arcs, Spliced) or len(arcs.arcs) <= days:
        return truth
    joints = arcs.joints_tdb_s[-days + 1 :]
    start_ns = truth.stop_utc_ns - round(days * CHUNK_S * NS)
    breaks = tuple(one for one in truth.breaks_utc_ns if one >= start_ns)
    return Truth(Spliced(joints, arcs.arcs[-days:]), start_ns, truth.stop_utc_ns, truth.orientation, breaks)
