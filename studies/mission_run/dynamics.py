"""Flight dynamics of a mission, outside of spacecraft and ground: reference ephemerides, crater catalogue, request.

Each day's orbit determination has errors of its own; the burns that it knows of are those that were planned.
"""

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from lunar.catalogue import save_catalogue
from lunar.constants import DAY_NS
from lunar.constants import NS as NS
from lunar.datafolder import DataFolder
from lunar.messages.oem import save_oem
from lunar.timescales import format_utc
from payload_emulator.session.archive.mission import OPERATIONS, default_ports, live_mission_text
from payload_emulator.session.live.contacts import station_names
from payload_emulator.session.live.session import pruned
from payload_emulator.session.scenario import Scenario
from payload_emulator.session.world.regions import observed_boxes, observed_craters
from payload_emulator.session.world.rims import Watched
from payload_emulator.session.world.world import (
    CHUNK_S,
    World,
    extended_flight,
    open_world,
    sample_truth,
    with_reference_error,
)
from studies.mission_run.disturbances import ReferenceDisturbances

BEFORE_NS = 6 * 3600 * NS
AHEAD_NS = 54 * 3600 * NS
LAST_NS = 4 * 3600 * NS
"""No windows so long before the end of a run, so that the data of the last one are down and evaluated."""

ARCS_KEPT = 4
"""Days of the flight that are kept: more than an orbit determination spans."""


@dataclass(slots=True)
class FlightDynamics:
    """The orbit of a scenario as far as it has been asked for."""

    world: World
    disturbed: ReferenceDisturbances = field(default_factory=ReferenceDisturbances)

    def is_late(self, day: int) -> bool:
        """Return whether the orbit determination of a day is not delivered on that day."""
        return day in self.disturbed.late_days

    def save_reference(self, now_utc_ns: int, path: Path) -> Path:
        """Write the orbit determination of a day: from some hours ago to two days ahead."""
        scenario = self.world.scenario
        start = max(now_utc_ns - BEFORE_NS, scenario.epoch_utc_ns)
        stop = now_utc_ns + AHEAD_NS
        while self.world.truth.stop_utc_ns < stop + 600 * NS:
            truth, burns = extended_flight(self.world, CHUNK_S)
            flown = pruned(truth, ARCS_KEPT)
            self.world = replace(self.world, truth=flown, burns=(*self.world.burns, *burns))
        span = np.array([start, stop], dtype=np.int64)
        arc = sample_truth(self.world.truth, span, scenario.spacecraft.upper())
        day = (now_utc_ns - scenario.epoch_utc_ns) // DAY_NS
        errors = scenario.reference
        if day in self.disturbed.wrong_days:
            errors = replace(errors, position_error_m=errors.position_error_m + self.disturbed.wrong_by_m)
        save_oem(with_reference_error(arc, errors, scenario.seed + 1_000 * (1 + day)), path)
        return path

    def save_craters(self, window_s: float, path: Path, watched: Watched = iter) -> int:
        """Write the craters around the places of the windows with their rim heights; their number."""
        catalogue = observed_craters(self.world, self._latitude_limit_deg(window_s), watched)
        save_catalogue(catalogue, path)
        return len(catalogue)

    def request(self, windows_per_day: int, window_s: float, days: float | None = None) -> dict[str, Any]:
        """Return a standing request as it is posted: windows over the ground that the data describe.

        With `days`, the last window is `LAST_NS` before their end.
        """
        scenario = self.world.scenario
        start = scenario.epoch_utc_ns
        return {
            "name": "observations",
            "spacecraft_id": scenario.spacecraft_id,
            "windows": windows_per_day,
            "period_days": 1.0,
            "horizon_days": 1.0,
            "start": format_utc(start),
            "stop": None if days is None else format_utc(start + round(days * DAY_NS) - LAST_NS),
            "regions": [
                {
                    "latitude_deg": {"min": one.south_deg, "max": one.north_deg},
                    "west_deg": one.west_deg,
                    "east_deg": one.east_deg,
                }
                for one in observed_boxes(self.world.terrain, self._latitude_limit_deg(window_s))
            ],
            "minimum_duration_s": 0.8 * window_s,
            "maximum_duration_s": 1.25 * window_s,
            "cadence_s": scenario.camera.frame_interval_s,
        }

    def _latitude_limit_deg(self, window_s: float) -> float:
        """Return half the band of latitudes that a pass crosses within about the duration of a window."""
        position, velocity = self.world.truth.states(self.world.truth.start_utc_ns)
        rate_deg_s = np.degrees(np.linalg.norm(velocity) / np.linalg.norm(position))
        return min(0.5 * float(rate_deg_s) * window_s, 60.0)


def write_flight(
    scenario: Scenario,
    data: DataFolder,
    mission: Path,
    windows_per_day: int,
    window_s: float,
    ports: dict[str, tuple[int, int]] | None = None,
    watched: Watched = iter,
) -> str:
    """Write what the ground posts to fly a scenario, next to its mission description; return the description.

    The files are `craters.csv`, `reference.oem` and `request.json`. `ports` are those of the stations for telemetry
    and telecommands (default: as `linna emulate --live` opens them). `watched` shows the progress of the longest step.
    """
    dynamics, folder = FlightDynamics(open_world(scenario, data)), mission.parent
    craters = folder / "craters.csv"
    dynamics.save_craters(window_s, craters, watched)
    dynamics.save_reference(scenario.epoch_utc_ns, folder / "reference.oem")
    request = dynamics.request(windows_per_day, window_s)
    (folder / "request.json").write_text(json.dumps(request, indent=2) + "\n", encoding="utf-8")
    ports = ports or default_ports(station_names(scenario, has_operator=False))
    return live_mission_text(dynamics.world, data, "127.0.0.1", ports, OPERATIONS, catalogue=craters)
