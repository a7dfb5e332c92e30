"""Mission description written by the emulator, and terrain used in training."""

from types import SimpleNamespace

import numpy as np
import pytest

from ground_service.missions.model import parse_mission
from lunar.datafolder import DataFolder
from lunar.frames import mcmf_from_spherical
from payload_emulator.session.mission import mission_text, seen_in_training, unseen_share
from payload_emulator.session.scenario import parse_scenario
from payload_emulator.session.world import build_world

SCENARIO = """
name = "small"
seed = 7
[dynamics]
gravity = "builtin"
orientation = "iau"
[window]
search = "none"
start = "2029-08-07T01:40:00Z"
duration_s = 60.0
[terrain]
source = "procedural"
[camera]
tilt_deg = 20.0
k1 = -0.05
[requirements]
recall = -1.0
median_error_m = 42.0
"""


@pytest.fixture(scope="module")
def world():
    return build_world(parse_scenario(SCENARIO), DataFolder())


def test_the_ground_reads_what_the_emulator_writes(world) -> None:
    mission = parse_mission(mission_text(world, DataFolder()))
    assert (mission.name, mission.spacecraft.id) == ("small", 76)
    assert mission.frames.orientation == world.truth.orientation.name == "IAU WGCCRE 2009"
    assert mission.frames.gravity_field == world.gravity.name
    assert (mission.camera.tilt_deg, mission.camera.k1, mission.camera.fov_deg) == (20.0, -0.05, 120.0)
    assert mission.evidence.level == "2" and mission.evidence.seed == 7
    assert mission.link.frame_length == 1115 and mission.link.interleave == 5


def test_limits_of_the_scenario_are_stated_and_negative_ones_are_not(world) -> None:
    requirements = parse_mission(mission_text(world, DataFolder())).requirements
    assert requirements.estimator == "anchored"
    assert (requirements.median_error_m, requirements.recall, requirements.memory_mib) == (42.0, None, None)


@pytest.mark.parametrize(
    ("latitude_deg", "longitude_deg", "seen"),
    [
        (0.0, 270.0, True),
        (0.0, 292.5, False),  # the held-out strip
        (0.0, 283.5, False),  # within 60 km (1.98 degrees at the equator) west of it
        (0.0, 282.5, True),
        (15.0, 35.0, False),  # the held-out block
        (40.0, 20.0, True),
        (-45.0, 322.0, True),  # validation: thresholds were chosen there
        (0.0, 100.0, False),  # far from every box
        (70.0, 270.0, False),  # beyond the latitudes of training
        (0.0, -90.0, True),
        (0.0, 360.0 + 270.0, True),
    ],
)
def test_ground_is_seen_where_the_recipe_of_the_shipped_detector_looked(
    latitude_deg: float, longitude_deg: float, seen: bool
) -> None:
    assert seen_in_training(np.array([latitude_deg]), np.array([longitude_deg])).tolist() == [seen]


def flown_over(longitudes_deg: list[float], is_real: bool = True) -> SimpleNamespace:
    """A world whose frames are taken 20 km above the equator; a footprint is 69 km (1.14 degrees) to either side."""
    position = mcmf_from_spherical(0.0, np.radians(longitudes_deg), np.full(len(longitudes_deg), 20e3))
    return SimpleNamespace(
        terrain=SimpleNamespace(is_real=is_real),
        truth=SimpleNamespace(positions_mcmf=lambda _: position),
        frame_utc_ns=np.arange(len(longitudes_deg)),
        scenario=parse_scenario(SCENARIO),
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
def test_the_unseen_share_counts_frames_whose_whole_footprint_is_unseen(longitudes_deg, share) -> None:
    assert unseen_share(flown_over(longitudes_deg)) == share


def test_there_is_no_unseen_share_away_from_real_terrain() -> None:
    assert unseen_share(flown_over([290.0], is_real=False)) is None
