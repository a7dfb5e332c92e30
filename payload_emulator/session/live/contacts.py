"""Contacts of a live session: their plan, telecommands up and telemetry down.

Contacts follow from the geometry of the stations: telecommands reach the spacecraft in contacts alone, at the rate of
the uplink; telemetry leaves it at the rate of the downlink. Without stations, one that always sees the spacecraft takes
their place.
"""

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from kernels.memory import give_back
from lunar.constants import NS
from payload_emulator.flight.ports import UNLIMITED
from payload_emulator.session.live import station_ports
from payload_emulator.session.scenario import Scenario
from payload_emulator.session.spacecraft.loop import Spacecraft, StepResult
from payload_emulator.session.world.world import sample_truth
from payload_emulator.sim.board.contact_plan import StationContact, parse_clock_error, plan_contacts
from payload_emulator.sim.board.link import Receiver, Transmitter, light_to_earth_s, transmit
from payload_emulator.sim.orbit.truth import Truth
from tmtc.link.settings import LinkSettings

ALWAYS_IN_CONTACT = "earth"
"""Station that always sees the spacecraft, at the light time to the Earth's centre, with no limit of its rates."""

CONTACTS_EXACT = {
    "account": "account", "contact": "contact", "_contacts": "_planned", "_planned_until_ns": "planned_until_ns",
    "_transmitter": "_transmitter", "_uplinks": "_buffers", "_uplinked": "_uplink", "_last_heard_ns": "_last_step_ns",
    "_waiting": "waiting", "_sent_up": "_sent_up",
}  # fmt: skip
"""Attributes of `Contacts` in an exact state, by their names there."""

_FIRST_DOWNLINK_S = 2.0
_MARGIN_NS = 300 * NS


@dataclass(slots=True)
class Account:
    """Counts of a session since its start.

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
class Contacts:
    """Contacts of a spacecraft with its stations, one at a time.

    Attributes
    ----------
    names
        Stations that have ports.
    keeps
        Whether stations keep records until they are acknowledged, and confirm transmissions.
    journal_file
        File of confirmed transmissions. A start from a state repeats those after it at their times, so that the session
        goes on as if the process had not ended.
    waiting
        Packets that waited for downlink when the contact began.
    """

    scenario: Scenario
    names: tuple[str, ...]
    planned_until_ns: int
    keeps: bool = False
    journal_file: Path | None = None
    account: Account = field(default_factory=Account)
    stations: dict[str, station_ports.StationPorts] = field(default_factory=dict)
    contact: StationContact | None = None
    waiting: int = 0
    _planned: deque[StationContact] = field(default_factory=deque)
    _transmitter: Transmitter = field(init=False)
    _buffers: dict[tuple[str, int], station_ports.TelecommandBuffer] = field(default_factory=dict)
    _uplink: deque[tuple[tuple[str, int], bytes]] = field(default_factory=deque)
    _sent_up: set[int] = field(default_factory=set)
    _to_repeat: deque[station_ports.JournalEntry] = field(default_factory=deque)
    _last_step_ns: int = 0

    def __post_init__(self) -> None:
        self._transmitter = Transmitter(self.scenario.spacecraft_id, LinkSettings(coding=self.scenario.link.coding))

    @property
    def is_limited(self) -> bool:
        """Return whether contacts follow from geometry and have rates."""
        return self.names != (ALWAYS_IN_CONTACT,)

    @property
    def next_change_ns(self) -> int | None:
        """End of the present contact, or beginning of the next; None if there is neither."""
        if self.contact is not None:
            return self.contact.stop_utc_ns
        return self._planned[0].start_utc_ns if self._planned else None

    @property
    def is_behind(self) -> bool:
        """Return whether the ground has fallen so far behind that time must not go on."""
        return any(one.waiting > station_ports.KEPT_LIMIT_OCTETS // 16 for one in self.stations.values())

    def plan(self, truth: Truth) -> None:
        """Find the contacts up to the end of the propagated orbit."""
        if not self.is_limited:
            return
        stop_ns = truth.stop_utc_ns - _MARGIN_NS
        # A contact that was cut off by the end of the plan is found again as a whole.
        while self._planned and self._planned[-1].stop_utc_ns >= self.planned_until_ns - NS:
            self.planned_until_ns = self._planned.pop().start_utc_ns
        start_ns = max(self.planned_until_ns, truth.start_utc_ns + _MARGIN_NS)
        if self.contact is not None:
            start_ns = max(start_ns, self.contact.stop_utc_ns)
        ephemeris = sample_truth(truth, np.array([start_ns, stop_ns], dtype=np.int64))
        self._planned.extend(plan_contacts(ephemeris, self.scenario.link, start_ns, stop_ns))
        self.planned_until_ns = stop_ns

    def advance(self, spacecraft: Spacecraft, utc_ns: int) -> float:
        """Begin the contact that is due; return the seconds of contact since the step before."""
        if self.contact is None and self._planned and self._planned[0].start_utc_ns <= utc_ns:
            self.begin(spacecraft, utc_ns, self._planned.popleft())
            return _FIRST_DOWNLINK_S
        if self.contact is None:
            return 0.0
        seconds = (utc_ns - self._last_step_ns) / NS
        self._last_step_ns = utc_ns
        return seconds

    def begin(self, spacecraft: Spacecraft, utc_ns: int, contact: StationContact | None = None) -> None:
        """Begin a contact; None: one without an end, with the station that always sees the spacecraft."""
        empty = np.zeros(0)
        endless = StationContact(ALWAYS_IN_CONTACT, utc_ns, UNLIMITED, empty.astype(np.int64), empty)
        self.contact = contact or endless
        self.waiting = spacecraft.payload.waiting
        self.account.contacts += 1
        self._last_step_ns = utc_ns

    def end(self) -> None:
        """End the contact: telecommands on their way are lost. Free memory is returned to the system."""
        self.account.telecommand_octets_lost += sum(len(octets) for _, octets in self._uplink)
        self._uplink.clear()
        self._buffers.clear()
        self.contact = None
        give_back()

    def light_s(self, truth: Truth, utc_ns: int) -> float:
        """Return the light time to the station of the contact; 0 without a contact."""
        if self.contact is None:
            return 0.0
        if self.contact.light_utc_ns.size:
            return self.contact.light_s(utc_ns)
        at = np.array([utc_ns], dtype=np.int64)
        return float(light_to_earth_s(truth.states(at)[0], at)[0])

    def telecommands(self, receiver: Receiver, seconds: float | None) -> bytes:
        """Return the telecommand packets that reach the spacecraft in some seconds of uplink; None: all that wait."""
        allowed = UNLIMITED if seconds is None else int(self.scenario.link.uplink_bps / 8.0 * seconds)
        packets: list[bytes] = []
        while self._uplink and allowed > 0:
            connection, octets = self._uplink.popleft()
            if len(octets) > allowed:
                self._uplink.appendleft((connection, octets[allowed:]))
                octets = octets[:allowed]
            allowed -= len(octets)
            buffer = self._buffers.setdefault(connection, station_ports.TelecommandBuffer(receiver))
            packets += buffer.take(octets)
        self.account.telecommands += len(packets)
        return b"".join(packets)

    def send(self, result: StepResult) -> None:
        """Send the packets of a step, or an idle frame, to the station; end the contact whose end is reached."""
        if self.contact is None:
            return
        transmitter, account, link = self._transmitter, self.account, self.scenario.link
        utc_ns, light_s = result.step.utc_ns, result.step.light_s
        if result.packets:
            transmitter.send(result.packets, utc_ns, light_s=light_s, clcw=result.clcw)
            dump = transmitter.dumps.pop()
            reception = transmit([dump], transmitter.settings, link, self.scenario.seed + account.frames_sent)
            octets = reception.octets
            account.packets += len(result.packets)
            account.packets_lost_on_link += reception.account["packets_lost"]
            account.frames_lost += reception.account["frames_lost_on_link"]
            account.frames_sent += reception.account["frames_sent"]
        else:
            octets = transmitter.idle(result.clcw)
        stated = dict(map(parse_clock_error, link.clock_errors))
        received_ns = utc_ns + round(light_s * NS) + stated.get(self.contact.station, 0)
        self.stations[self.contact.station].send(received_ns, octets, transmitter.settings.cadu_length)
        if utc_ns >= self.contact.stop_utc_ns:
            self.end()

    # Ports

    def open_ports(self, host: str, ports: Mapping[str, tuple[int, int]], clock: Callable[[], int]) -> None:
        """Open the ports of the stations; 0 or none stated: a free one. `clock` returns the time of the session."""
        if self.journal_file is not None:
            left = [one for one in station_ports.load_journal(self.journal_file) if one.number not in self._sent_up]
            self._to_repeat.extend(sorted(left, key=lambda one: one.utc_ns))
        taken = self._sent_up.union(one.number for one in self._to_repeat)
        for name in self.names:
            receive = partial(self.receive, clock, name)
            self.stations[name] = station_ports.StationPorts(
                name, host, receive, *ports.get(name, (0, 0)), self.keeps, taken={*taken}
            )

    def receive(self, clock: Callable[[], int], station: str, number: int, octets: bytes) -> bool:
        """Receive octets that a station is to send up; return whether it does.

        Without a contact of that station, a transmission that is to be confirmed is refused and other octets are lost.
        """
        has_contact = self.contact is not None and self.contact.station == station
        if self.keeps and not has_contact:
            return False
        if self.keeps and self.journal_file is not None:
            station_ports.add_to_journal(
                self.journal_file, station_ports.JournalEntry(clock(), station, number, octets)
            )
        if has_contact:
            self._send_up(station, number, octets)
        else:
            self.account.telecommand_octets_lost += len(octets)
        return has_contact

    def repeat_journal(self, utc_ns: int) -> None:
        """Send up the transmissions that stations had confirmed up to this time before the session was killed."""
        while self._to_repeat and self._to_repeat[0].utc_ns <= utc_ns:
            entry = self._to_repeat.popleft()
            self._send_up(entry.station, entry.number, entry.octets)

    def _send_up(self, station: str, number: int, octets: bytes) -> None:
        """Queue octets for the uplink; no octets: the connection has ended, and its incomplete packets are dropped."""
        if octets:
            self._uplink.append(((station, number), octets))
        elif not self._uplink:
            self._buffers.pop((station, number), None)
        if self.keeps:
            self._sent_up.add(number)


def station_names(scenario: Scenario, has_operator: bool) -> tuple[str, ...]:
    """Return the stations that have ports: those of the scenario, which the schedule of an operator includes."""
    return (ALWAYS_IN_CONTACT,) if has_operator else scenario.link.stations or (ALWAYS_IN_CONTACT,)
