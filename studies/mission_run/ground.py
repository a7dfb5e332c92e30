"""The ground service of a mission run: in this process on SQLite, with the links of its mission description.

A user posts the mission description, an ephemeris, two telecommands of commissioning and a standing request; after that
the run only reads. Flight dynamics delivers an orbit determination a day, as a system of its own.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ground_service.access.model import AuditEntry
from ground_service.access.service import RESERVED_NAMES
from ground_service.client.local import local_client
from ground_service.client.operations import Client
from ground_service.clock import ClockFile, set_mission_clock
from ground_service.ephemerides.service import add_ephemeris
from ground_service.errors import GroundError
from ground_service.ground import Ground, open_ground
from ground_service.jobs.service import unfinished_jobs
from ground_service.links.supervisor import LinkSupervisor
from ground_service.planning.model import Window
from ground_service.store.telemetry import packet_headers
from ground_service.store.vehicles import all_vehicles
from ground_service.worker.actions import has_repetitions, repeat_due
from ground_service.worker.jobs import run_job
from lunar.datafolder import DataFolder
from studies.mission_run.regions import Box

USER = "mission-run"
FLIGHT_DYNAMICS = "flight-dynamics"
SYSTEMS = (*RESERVED_NAMES, FLIGHT_DYNAMICS)
"""Actors of the audit log that are programs."""

POLL_S = 0.02
SETTLE_S = 300.0
"""Longest wait for the ground at the beginning or the end of a contact."""


@dataclass(slots=True)
class EmbeddedGround:
    """Archive, links and follow-up work in this process, operated through the client of the API."""

    ground: Ground
    client: Client
    links: LinkSupervisor

    @classmethod
    def open(cls, home: Path, data: DataFolder, clock_file: Path) -> EmbeddedGround:
        """Open the ground service under a folder; mission time comes from a file."""
        set_mission_clock(ClockFile(clock_file).read)
        ground = open_ground(home, data)
        client = local_client(ground, USER)
        links = LinkSupervisor(ground)
        links.start()
        return cls(ground, client, links)

    def close(self) -> None:
        """Stop the links with received octets ingested, and close the archive."""
        self.links.stop()
        self.client.close()
        set_mission_clock()

    def add_mission(self, text: bytes) -> None:
        """Add the mission description, and wait for its links."""
        self.client.add_mission(text)
        self._wait(lambda: bool(self.links.runners), "links of the mission description")

    def deliver_reference(self, path: Path, day: int) -> None:
        """Add the orbit determination of a day as flight dynamics; later ones are preferred."""
        add_ephemeris(
            self.ground,
            self.ground.files.put_file(path),
            name=f"orbit determination of day {day}",
            precedence=day,
            actor=FLIGHT_DYNAMICS,
        )

    def wait_sent(self) -> None:
        """Wait until the links have sent every telecommand that can be sent now."""
        self._wait(
            lambda: not any(one.commands_unsent for one in self.links.runners.values()), "telecommands sent"
        )

    def wait_received(self, sent: Mapping[str, int]) -> None:
        """Wait until all octets that stations have sent are ingested, and the work that follows is done."""

        def is_done() -> bool:
            runners = {one.declared.link.name: one for one in self.links.runners.values()}
            got = all(
                name in runners and runners[name].octets_received >= count for name, count in sent.items()
            )
            return got and not unfinished_jobs(self.ground)

        self._wait(is_done, "telemetry ingested")

    def wait_settled(self) -> None:
        """Wait until contacts that were silent for too long have ended, and the work that follows is done."""
        self._wait(
            lambda: (
                all(one.is_settled for one in self.links.runners.values())
                and not unfinished_jobs(self.ground)
                and not self._repeats_actions()
            ),
            "contacts ended",
        )

    def _repeats_actions(self) -> bool:
        """Repeat the failed actions that are due; return whether any are to be repeated later."""
        for job_id in repeat_due(self.ground):
            run_job(self.ground, job_id)
        return has_repetitions(self.ground)

    def octets_sent(self) -> dict[str, int]:
        """Return the octets of telecommands that were sent, by link."""
        return {name: one.octets_sent for name, one in self.links.runners.items()}

    def windows(self) -> list[Window]:
        """Return all windows, the earliest first."""
        return sorted(self.client.list_windows(), key=lambda one: one.start.utc_ns)

    def packets_received(self) -> int:
        """Return the number of packets in the archive."""
        with self.ground.database.reading() as connection:
            return sum(len(packet_headers(connection, one.id)["apid"]) for one in all_vehicles(connection))

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
        while not is_done():
            if time.monotonic() > until:
                raise GroundError(f"mission run: expected {what} within {SETTLE_S:.0f} s, found none")
            time.sleep(POLL_S)


def is_of_person(entry: AuditEntry) -> bool:
    """Return whether a person caused an entry of the audit log."""
    return entry.actor not in SYSTEMS


@dataclass(frozen=True, slots=True)
class PlanTerms:
    """What is asked for: windows a day until a time, over boxes on the ground, with a longest duration."""

    windows_per_day: int
    boxes: tuple[Box, ...]
    duration_s: float
    cadence_s: float
    start: str
    stop: str

    def request(self, spacecraft: int) -> dict[str, Any]:
        """Return the standing request as it is posted."""
        return {
            "name": "observations",
            "spacecraft_id": spacecraft,
            "windows": self.windows_per_day,
            "period_days": 1.0,
            "horizon_days": 1.0,
            "start": self.start,
            "stop": self.stop,
            "regions": [one.region() for one in self.boxes],
            "minimum_duration_s": 0.8 * self.duration_s,
            "maximum_duration_s": 1.25 * self.duration_s,
            "cadence_s": self.cadence_s,
        }
