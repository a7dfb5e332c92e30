"""Worlds and payloads that a flight begins with: loaded for the windows of its scenario, or launched for the ground."""

from __future__ import annotations

from pathlib import Path

from lunar.catalogue import CraterCatalogue, load_catalogue, save_catalogue
from lunar.datafolder import DataFolder
from lunar.ephemeris import Ephemeris
from payload_emulator.session.scenario import Scenario
from payload_emulator.session.spacecraft.loading import LoadedPayload, launch_payload, load_payload
from payload_emulator.session.world.regions import observed_craters
from payload_emulator.session.world.world import (
    World,
    catalogue_near_track,
    open_world,
    sample_truth,
    with_reference_error,
)


def load_scenario_payload(world: World, data: DataFolder) -> tuple[LoadedPayload, Ephemeris, CraterCatalogue]:
    """The payload loaded for a world, with the reference and the catalogue that the ground made its tables of."""
    scenario = world.scenario
    truth_ephemeris = sample_truth(world.truth, world.frame_utc_ns, scenario.spacecraft.upper())
    reference = with_reference_error(truth_ephemeris, scenario.reference, scenario.seed)
    catalogue = catalogue_near_track(world)
    loaded = load_payload(
        scenario,
        world.camera,
        reference,
        catalogue,
        world.truth.orientation,
        data,
        int(world.frame_utc_ns[0]),
        world.burns,
    )
    return loaded, reference, catalogue


def launch(scenario: Scenario, data: DataFolder, craters: Path | None = None) -> tuple[World, LoadedPayload]:
    """Return the world from the epoch on and the payload as launched; the ground uploads the tables of each window.

    Parameters
    ----------
    craters
        Catalogue on board, written if the file does not exist; None: none is kept, and none is on board unless an
        estimator needs it.
    """
    world = open_world(scenario, data)
    catalogue = None
    if craters is None and "anchored" not in scenario.navigation.estimators:
        pass
    elif craters is not None and craters.is_file():
        catalogue = load_catalogue(craters)
    else:
        catalogue = observed_craters(world)
        if craters is not None:
            save_catalogue(catalogue, craters)
            # The ground makes its tables of the file, in which numbers are rounded.
            catalogue = load_catalogue(craters)
    return world, launch_payload(world.scenario, world.camera, data, catalogue)
