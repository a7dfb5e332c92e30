"""Mission description written by the emulator, and terrain used in training."""

import hashlib
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from ground_service.missions.model import parse_mission
from lunar.camera import PinholeCamera
from lunar.datafolder import DataFolder
from lunar.frames import mcmf_from_spherical, spherical_from_mcmf
from payload_emulator.errors import ModelError
from payload_emulator.flight.models import load_shipped_model
from payload_emulator.session.archive.mission import (
    OPERATIONS,
    live_mission_text,
    mission_text,
    trained_ground,
    unseen_share,
)
from payload_emulator.session.scenario import DetectorSection, parse_scenario
from payload_emulator.session.spacecraft.loading import launch_payload
from payload_emulator.session.world.world import build_world
from payload_emulator.sim.terrain.registration import Rims, fit_registration
from tests.scenarios import still_scenario

SCENARIO = (
    still_scenario("small", 60.0)
    + """[camera]
tilt_deg = 20.0
k1 = -0.05
[requirements]
recall = -1.0
temperature_min_c = -15.0
median_error_m = 42.0
"""
)


@pytest.fixture(scope="module")
def world():
    return build_world(parse_scenario(SCENARIO), DataFolder())


def stated_of(world):
    return parse_mission(mission_text(world, DataFolder()))


def test_the_ground_reads_what_the_emulator_writes(world):
    mission = stated_of(world)
    assert (mission.name, mission.spacecraft.id) == ("small", 76)
    assert mission.frames.orientation == world.truth.orientation.name == "IAU WGCCRE 2009"
    assert mission.frames.gravity_field == world.gravity.name
    assert (mission.camera.tilt_deg, mission.camera.k1, mission.camera.fov_deg) == (20.0, -0.05, 120.0)
    assert mission.evidence.level == "2" and mission.evidence.seed == 7
    assert mission.link.frame_length == 1115 and mission.link.interleave == 5


def test_the_network_and_the_threshold_in_force_are_stated(world):
    own = stated_of(world).detector
    assert (own.network, own.max_detections) == ("craters", 120)
    assert own.sha256 == hashlib.sha256(load_shipped_model()).hexdigest()
    assert own.score_threshold == 0.44  # in the metadata of the shipped network
    detector = DetectorSection(score_threshold=0.61, max_detections=80)
    changed = replace(world, scenario=replace(world.scenario, detector=detector))
    stated = stated_of(changed).detector
    assert (stated.score_threshold, stated.max_detections) == (0.61, 80)
    lost = replace(world, scenario=replace(world.scenario, detector=DetectorSection(network="lost.onnx")))
    with pytest.raises(ModelError, match=r"expected craters.* or an ONNX file, found 'lost.onnx'"):
        mission_text(lost, DataFolder())


def test_the_registration_of_the_terrain_is_stated(world):
    assert stated_of(world).catalogue.registration_north_m is None
    latitude, longitude, _ = spherical_from_mcmf(world.truth.positions_mcmf(world.frame_utc_ns))
    # A rim every half degree around the frames, all 40 m north and 20 m west of the list.
    offsets = np.radians(np.stack(np.meshgrid(np.arange(-5.0, 5.1, 0.5), np.arange(-5.0, 5.1, 0.5))))
    places = offsets.reshape(2, -1) + np.array([[latitude[0]], [longitude[0]]])
    same = np.ones(places.shape[1])
    registration = fit_registration(Rims(*places, -20.0 * same, 40.0 * same, 60.0 * same))
    shifted = SimpleNamespace(catalogue=world.terrain.catalogue, is_real=False, registration=registration)
    stated = stated_of(replace(world, terrain=shifted)).catalogue
    assert stated.registration_north_m == pytest.approx(40.0, abs=3.0)
    assert stated.registration_east_m == pytest.approx(-20.0, abs=3.0)
    assert 10.0 <= stated.registration_sigma_m < 20.0
    assert 0 < stated.registration_rims <= same.size
    known = np.isfinite(registration.at(latitude, longitude)[1])
    assert stated.registered_share == pytest.approx(known.mean(), abs=5e-4) and known.any()
    shifted.registration = fit_registration(Rims(places[0], places[1] + np.pi, same, same, 60.0 * same))
    stated = stated_of(replace(world, terrain=shifted)).catalogue
    assert stated.registered_share == 0.0 and stated.registration_sigma_m is None


def test_limits_and_the_offset_of_the_list_that_the_payload_starts_with_are_stated(world):
    stated = stated_of(world).catalogue
    loaded = launch_payload(world.scenario, world.camera, DataFolder()).parameters.flight.anchored
    assert loaded.offset is not None
    up_m = loaded.errors.catalogue_offset_m[2]
    assert stated.offset_sigma_m == (loaded.offset.prior_m, loaded.offset.prior_m, up_m)
    assert np.radians(stated.offset_correlation_deg) == pytest.approx(loaded.offset.correlation_rad)
    requirements = stated_of(world).requirements
    assert requirements.estimator == "anchored"
    assert (requirements.median_error_m, requirements.recall, requirements.memory_mib) == (42.0, None, None)
    assert (requirements.temperature_max_c, requirements.temperature_min_c) == (60.0, -15.0)


PLACES = """
0 270 seen
0 292.5 unseen: the held-out strip
0 283.5 unseen: within 60 km (1.98 degrees at the equator) west of it
0 282.5 seen
15 35 unseen: the held-out block
40 20 seen
-45 322 seen in validation: thresholds were chosen there
0 100 unseen: far from every box
70 270 unseen: beyond the latitudes of training
0 -90 seen
0 630 seen
"""


@pytest.mark.parametrize(
    ("latitude_deg", "longitude_deg", "seen"), [line.split(maxsplit=2) for line in PLACES.strip().splitlines()]
)
def test_ground_is_seen_where_the_recipe_of_the_shipped_detector_looked(latitude_deg, longitude_deg, seen):
    place = np.array([float(latitude_deg)]), np.array([float(longitude_deg)])
    assert any(region.contains(*place).all() for region in trained_ground()) is seen.startswith("seen")


def test_what_windows_need_is_stated(world):
    """The light, and the tables that the ground uploads for each estimator."""
    scenario = world.scenario
    for mode, needed in (("paper", False), ("real", True)):
        lit = replace(world, scenario=replace(scenario, light=replace(scenario.light, mode=mode)))
        assert stated_of(lit).observation.needs_daylight is needed
    for estimators, tables in (
        (("spherical", "anchored"), ("orientation", "anchor_ephemeris", "initial_state")),
        (("anchored",), ("orientation", "initial_state")),
        (("paper",), ("anchor_ephemeris",)),
    ):
        navigation = replace(scenario.navigation, estimators=estimators)
        flown = replace(world, scenario=replace(scenario, navigation=navigation))
        text = live_mission_text(flown, DataFolder(), "127.0.0.1", {"earth": (1, 2)}, OPERATIONS)
        stated = parse_mission(text)
        assert stated.uploads is not None and stated.uploads.tables == tables
        assert stated.time.correlation == "automatic" and stated.critical_in_windows == ()


class RealTerrain:
    """A terrain that claims to be real."""

    is_real, name = True, "LROC WAC GLD100"

    def __init__(self, terrain):
        self._terrain = terrain

    def __getattr__(self, name):
        return getattr(self._terrain, name)


def flown_over(longitudes_deg, is_real=True):
    """A world whose frames are taken 20 km above the equator; a footprint is 69 km (1.14 degrees) to either side."""
    position = mcmf_from_spherical(0.0, np.radians(longitudes_deg), np.full(len(longitudes_deg), 20e3))
    return SimpleNamespace(
        terrain=SimpleNamespace(is_real=is_real),
        truth=SimpleNamespace(positions_mcmf=lambda _: position),
        frame_utc_ns=np.arange(len(longitudes_deg)),
        camera=PinholeCamera(),
    )


@pytest.mark.parametrize(
    ("longitudes_deg", "share"),
    [
        ([290.0, 292.0], 1.0),
        ([270.0], 0.0),
        ([290.0, 270.0, 271.0, 272.0], 0.25),
        ([283.5], 0.0),  # its centre is unseen, its western edge is not
        ([284.4], 1.0),
    ],
)
def test_the_unseen_share_counts_frames_whose_whole_footprint_is_unseen(longitudes_deg, share):
    assert unseen_share(flown_over(longitudes_deg)) == share


def test_the_ground_of_training_is_stated_over_real_terrain(world):
    real = replace(world, terrain=cast(Any, RealTerrain(world.terrain)))
    evidence = stated_of(real).evidence
    assert evidence.trained_regions == trained_ground()
    assert (evidence.unseen_share, evidence.level) == (None, None)  # each pass has its own


def test_there_is_no_unseen_share_away_from_real_terrain():
    assert unseen_share(flown_over([290.0], is_real=False)) is None
