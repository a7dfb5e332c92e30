"""The ground service of a mission run, and its embedded form: in this process on SQLite.

A user posts the crater catalogue, the mission description, an ephemeris and a standing request; after that the run only
reads. Flight dynamics delivers an orbit determination a day, as a system of its own.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from ground_service.access.model import AuditEntry
from ground_service.access.service import RESERVED_NAMES
from ground_service.client import Client
from ground_service.client.connection import Unavailable, Unreachable
from ground_service.client.local import local_client
from ground_service.clock import ClockFile, set_mission_clock
from ground_service.contacts.links import service as links
from ground_service.contacts.links.runner import INCOMING
from ground_service.contacts.links.supervisor import LinkSupervisor
from ground_service.errors import PASSING, GroundError
from ground_service.ground import Ground, open_ground
from ground_service.ingest.live import spooled_octets
from ground_service.jobs.service import unfinished_jobs as unfinished
from ground_service.planning.model import Window
from ground_service.store.events import position_of, read_events
from ground_service.store.vehicles import all_vehicles
from ground_service.telemetry.store import count_packets
from ground_service.worker.follow_up import CONSUMER, KINDS
from lunar.datafolder import DataFolder

Answer = TypeVar("Answer")
USER = "mission-run"
FLIGHT_DYNAMICS = "flight-dynamics"
SYSTEMS = (*RESERVED_NAMES, FLIGHT_DYNAMICS)
"""Actors of the audit log that are programs."""

POLL_S = 0.02
SETTLE_S = 300.0
"""Longest wait for the ground at the beginning or the end of a contact."""


@dataclass(slots=True)
class MissionGround:
    """The ground service of a mission run, operated through the client of the API.

    Attributes
    ----------
    ground
        Database and files of the service, to see whether it is idle, and for the closing figures.
    """

    ground: Ground
    client: Client
    flight_dynamics: Client

    def close(self, *, is_finished: bool = False) -> None:
        """Stop the service; `is_finished`: the run does not continue."""

    def add_mission(self, text: bytes) -> None:
        """Add the mission description, and wait for its links."""
        self.client.add_mission(text)
        self._wait(
            lambda: all(one.owner is not None for one in self.client.list_links()), "links of the mission description"
        )

    def deliver_reference(self, path: Path, day: int) -> None:
        """Add the orbit determination of a day as flight dynamics; later ones are preferred."""
        name = f"orbit determination of day {day}"
        self._wait(
            lambda: bool(self.flight_dynamics.add_ephemeris(path, name=name, precedence=day)), "upload of " + name
        )

    def wait_sent(self, station: str, spacecraft_id: int) -> None:
        """Wait until the station of a contact has every telecommand of a spacecraft that can be sent now."""

        def is_sent() -> bool:
            links_of_all = links.declared_links(self.ground).values()
            declared = [one for one in links_of_all if one.spacecraft_id == spacecraft_id]
            vehicles = {(one.spacecraft_id, one.link.instance) for one in declared if one.station == station}
            # A link whose contact has ended may have taken some, which it gives to the link in contact.
            return not any(
                links.unsent(self.ground, one) for one in declared if (one.spacecraft_id, one.link.instance) in vehicles
            )

        self._wait(is_sent, "telecommands sent")

    def wait_idle(self) -> None:
        """Wait until the work that follows from events is done."""
        self._wait(self._is_idle, "end of the work that follows from events")

    def wait_ingested(self) -> None:
        """Wait until all octets that the links have stored are ingested, and the work that follows is done."""
        self._wait(lambda: not self._spooled_octets() and self._is_idle(), "telemetry ingested")

    def wait_settled(self) -> None:
        """Wait until contacts that were silent for too long have ended, and the work that follows is done."""
        self._wait(lambda: not links.silent_contacts(self.ground) and self._is_idle(), "contacts ended")

    def _spooled_octets(self) -> int:
        return sum(spooled_octets(one) for one in (self.ground.home / INCOMING).glob("link-*"))

    def _is_idle(self) -> bool:
        """Return whether all events are handled and no job is unfinished, at one moment."""
        with self.ground.database.snapshot() as connection:
            position = position_of(connection, CONSUMER)
            return not (read_events(connection, position, 1, KINDS) or unfinished(connection))

    def windows(self, spacecraft_id: int) -> list[Window]:
        """Return all windows of a spacecraft, the earliest first."""
        found = self.read(lambda client: list(client.list_windows()))
        own = [one for one in found if one.spacecraft_id == spacecraft_id]
        return sorted(own, key=lambda one: one.start.utc_ns)

    def read(self, ask: Callable[[Client], Answer]) -> Answer:
        """Return an answer of the API, also while parts of the service start again."""
        found: list[Answer] = []

        def is_read() -> bool:
            found.append(ask(self.client))
            return True

        self._wait(is_read, "answer of the API")
        return found[0]

    def packets_received(self, spacecraft_id: int) -> int:
        """Return the number of packets of a spacecraft in the archive."""
        with self.ground.database.reading() as connection:
            mine = [one.id for one in all_vehicles(connection) if one.ccsds_id == spacecraft_id]
            return sum(count_packets(connection, vehicle) for vehicle in mine)

    def audit_head(self) -> int:
        """Return the number of the newest entry of the audit log."""
        return self.client.get_audit_head().number

    def interventions(self, posts: Iterable[tuple[int, int]]) -> list[dict[str, Any]]:
        """Return what persons did according to the audit log, outside the posts at the start of the run.

        Parameters
        ----------
        posts
            First and last number of the entries of each start.
        """
        known = list(posts)
        return [
            {"utc": str(one.time), "text": f"{one.actor}: {one.action} {one.target}"}
            for one in self.client.list_audit()
            if is_of_person(one) and not any(first <= one.number <= last for first, last in known)
        ]

    def _wait(self, is_done: Callable[[], bool], what: str) -> None:
        until = time.monotonic() + SETTLE_S
        while not self._holds(is_done):
            if time.monotonic() > until:
                raise GroundError(f"mission run: expected {what} within {SETTLE_S:.0f} s, found none")
            time.sleep(POLL_S)

    def _holds(self, is_done: Callable[[], bool]) -> bool:
        """Return whether a condition holds; False while the service cannot be asked."""
        try:
            return is_done()
        except (*PASSING, Unreachable, Unavailable):
            return False


class EmbeddedGround(MissionGround):
    """Archive, links and follow-up work in this process, on SQLite."""

    links: LinkSupervisor

    @classmethod
    def open(cls, home: Path, data: DataFolder, clock_file: Path) -> EmbeddedGround:
        """Open the ground service under a folder; mission time comes from a file."""
        set_mission_clock(ClockFile(clock_file).read)
        ground = open_ground(home, data)
        opened = cls(ground, local_client(ground, USER), local_client(ground, FLIGHT_DYNAMICS))
        opened.links = LinkSupervisor(ground)
        opened.links.start()
        return opened

    def close(self, *, is_finished: bool = False) -> None:
        """Stop the links with received octets ingested, and close the archive."""
        self.links.stop()
        self.flight_dynamics.close()
        self.client.close()
        set_mission_clock()


def is_of_person(entry: AuditEntry) -> bool:
    """Return whether a person caused an entry of the audit log."""
    return entry.actor not in SYSTEMS
