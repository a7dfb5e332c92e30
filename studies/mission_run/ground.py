"""The ground service of a mission run: in this process on SQLite, with the links of its mission description."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from ground_service.client.local import local_client
from ground_service.client.operations import Client
from ground_service.client.problems import InvalidRequest
from ground_service.clock import ClockFile, set_mission_clock
from ground_service.errors import GroundError
from ground_service.ground import Ground, open_ground
from ground_service.jobs.service import unfinished_jobs
from ground_service.links.supervisor import LinkSupervisor
from ground_service.planning.model import Window
from lunar.datafolder import DataFolder
from lunar.timescales import format_utc

POLL_S = 0.05
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
        client = local_client(ground, "mission-run")
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

    def wait_sent(self) -> None:
        """Wait until the links have sent every telecommand that can be sent now."""
        self._wait(
            lambda: not any(one.commands_unsent for one in self.links.runners.values()), "telecommands sent"
        )

    def wait_received(self, sent: Mapping[str, int]) -> None:
        """Wait until all octets that stations have sent are ingested, and the work that follows is done."""
        runners = {one.declared.link.name: one for one in self.links.runners.values()}

        def is_done() -> bool:
            got = all(
                runners[name].octets_received >= count for name, count in sent.items() if name in runners
            )
            return got and not unfinished_jobs(self.ground)

        self._wait(is_done, "telemetry ingested")

    def windows(self) -> list[Window]:
        """Return all windows, the earliest first."""
        return sorted(self.client.list_windows(), key=lambda one: one.start.utc_ns)

    def state_counts(self) -> Counter[str]:
        """Return the number of windows by state."""
        return Counter(one.state for one in self.client.list_windows())

    def _wait(self, is_done: object, what: str) -> None:
        assert callable(is_done)
        until = time.monotonic() + SETTLE_S
        while not is_done():
            if time.monotonic() > until:
                raise GroundError(f"mission run: expected {what} within {SETTLE_S:.0f} s, found none")
            time.sleep(POLL_S)


@dataclass(frozen=True, slots=True)
class PlanTerms:
    """What is asked for: windows a day, over latitudes, with a longest duration."""

    windows_per_day: int
    latitude_limit_deg: float
    duration_s: float
    cadence_s: float


def fill_plan(
    ground: EmbeddedGround, terms: PlanTerms, now_utc_ns: int, epoch_utc_ns: int, spacecraft: int
) -> int:
    """Enter, approve and release windows until each of the coming two days has its number; the number added."""
    day_ns = 86_400_000_000_000
    added = 0
    windows = [one for one in ground.windows() if one.state != "failed"]
    today = (now_utc_ns - epoch_utc_ns) // day_ns
    for day in (today, today + 1):
        begin = max(epoch_utc_ns + day * day_ns, now_utc_ns + 3 * 3600 * 10**9)
        end = epoch_utc_ns + (day + 1) * day_ns
        have = sum(epoch_utc_ns + day * day_ns <= one.start.utc_ns < end for one in windows)
        wanted = terms.windows_per_day - have
        if wanted <= 0 or end - begin < 2 * 3600 * 10**9:
            continue
        found = ground.client.search_windows(
            {
                "start": format_utc(begin),
                "stop": format_utc(end),
                "spacecraft_id": spacecraft,
                "cadence_s": terms.cadence_s,
                "latitude_deg": {"min": -terms.latitude_limit_deg, "max": terms.latitude_limit_deg},
                "minimum_duration_s": 0.8 * terms.duration_s,
                "maximum_duration_s": 1.25 * terms.duration_s,
                "step_s": 20.0,
            }
        )
        spread = max(1, len(found.candidates) // wanted)
        for candidate in found.candidates[::spread][:wanted]:
            window = ground.client.add_window(
                {
                    "name": f"day {day}",
                    "start": format_utc(candidate.start.utc_ns),
                    "stop": format_utc(candidate.stop.utc_ns),
                    "cadence_s": terms.cadence_s,
                    "spacecraft_id": spacecraft,
                }
            )
            try:
                ground.client.change_window(window.id, {"state": "approved"})
                ground.client.uplink_window(window.id)
            except InvalidRequest as error:
                raise GroundError(f"window {window.id}: {error}") from None
            added += 1
    return added
