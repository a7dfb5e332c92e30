"""Flight dynamics of a mission run, outside of spacecraft and ground: reference ephemerides and the crater catalogue.

Each day's orbit determination has errors of its own; the burns that it knows of are those that were planned.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lunar.catalogue import save_catalogue
from lunar.constants import NANOSECONDS_PER_SECOND as NS
from lunar.datafolder import DataFolder
from lunar.messages.oem import save_oem
from payload_emulator.session.live import pruned
from payload_emulator.session.recipe import Box
from payload_emulator.session.regions import observed_boxes, observed_craters
from payload_emulator.session.scenario import Scenario
from payload_emulator.session.world import (
    CHUNK_S,
    World,
    extended_flight,
    open_world,
    sample_truth,
    with_reference_error,
)

DAY_NS = 86_400 * NS
BEFORE_NS = 6 * 3600 * NS
AHEAD_NS = 54 * 3600 * NS
ARCS_KEPT = 4
"""Days of the flight that are kept: more than an orbit determination spans."""


@dataclass(slots=True)
class FlightDynamics:
    """The orbit of a scenario as far as it has been asked for."""

    world: World

    @classmethod
    def of(cls, scenario: Scenario, data: DataFolder) -> FlightDynamics:
        """Return the flight dynamics of a scenario from its epoch on."""
        return cls(open_world(scenario, data))

    def save_reference(self, now_utc_ns: int, path: Path) -> Path:
        """Write the orbit determination of a day: from some hours ago to two days ahead."""
        scenario = self.world.scenario
        start = max(now_utc_ns - BEFORE_NS, scenario.epoch_utc_ns)
        stop = now_utc_ns + AHEAD_NS
        while self.world.truth.stop_utc_ns < stop + 600 * NS:
            truth, burns = extended_flight(self.world, CHUNK_S)
            flown = pruned(truth, ARCS_KEPT)
            self.world = replace(self.world, truth=flown, burns=(*self.world.burns, *burns))
        arc = sample_truth(self.world.truth, np.array([start, stop], dtype=np.int64))
        day = (now_utc_ns - scenario.epoch_utc_ns) // DAY_NS
        save_oem(with_reference_error(arc, scenario.reference, scenario.seed + 1_000 * (1 + day)), path)
        return path

    def boxes(self, latitude_limit_deg: float) -> list[Box]:
        """Return where windows are requested: on the ground that the data describe, see `observed_boxes`."""
        return observed_boxes(self.world.terrain, latitude_limit_deg)

    def save_craters(self, latitude_limit_deg: float, path: Path) -> int:
        """Write the craters around the places of the windows with their rim heights; their number."""
        catalogue = observed_craters(self.world, latitude_limit_deg)
        save_catalogue(catalogue, path)
        return len(catalogue)
