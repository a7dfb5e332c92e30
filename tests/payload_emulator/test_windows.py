"""Observation windows of a world: the band of latitudes, and the message where terrain lacks."""

from dataclasses import replace

import numpy as np
import pytest

from lunar.datafolder import DataFolder
from lunar.frames import spherical_from_mcmf
from lunar.timescales import format_utc
from payload_emulator.errors import ScenarioError
from payload_emulator.session.archive.emulator import checked_world, emulate
from payload_emulator.session.scenario import parse_scenario
from payload_emulator.session.world import world as world_module
from payload_emulator.session.world.world import build_world

SCENARIO = parse_scenario("""
name = "band"
[dynamics]
gravity = "builtin"
orientation = "iau"
[maneuvers]
enabled = false
[window]
search_days = 0.5
latitude_min_deg = -20.0
latitude_max_deg = 50.0
[terrain]
source = "procedural"
""")


def test_frames_keep_to_the_band_of_the_window():
    world = build_world(SCENARIO, DataFolder())
    latitude, _, _ = spherical_from_mcmf(world.truth.positions_mcmf(world.frame_utc_ns))
    # A frame each 15 s moves the ground point by 0.8 degrees.
    assert np.degrees([latitude.min(), latitude.max()]) == pytest.approx([-20.0, 50.0], abs=0.9)
    assert np.degrees(latitude.min()) >= -20.0 and np.degrees(latitude.max()) <= 50.0


def test_a_search_without_a_window_names_the_latitudes_that_lack_terrain(monkeypatch):
    opened = world_module.open_terrain

    class Patchy:
        def __init__(self, terrain):
            self._terrain = terrain

        def __getattr__(self, name):
            return getattr(self._terrain, name)

        def covers(self, latitude_rad, longitude_rad):
            return np.broadcast_to(np.degrees(latitude_rad) < 30.0, np.shape(longitude_rad))

    monkeypatch.setattr(world_module, "open_terrain", lambda *a, **k: Patchy(opened(*a, **k)))
    with pytest.raises(ScenarioError, match=r"lacks terrain at latitudes (29|30|31)\.\d to (49|50)\.\d deg"):
        build_world(SCENARIO, DataFolder())
    south = replace(SCENARIO, window=replace(SCENARIO.window, latitude_max_deg=28.0))
    assert build_world(south, DataFolder()).frame_utc_ns.size > 20


def test_a_search_in_longitudes_that_no_track_crosses_says_so():
    narrow = replace(SCENARIO.window, longitude_min_deg=10.0, longitude_max_deg=11.0)
    with pytest.raises(ScenarioError, match=r"keeps its swath within longitudes 10\.0 to 11\.0 deg"):
        build_world(replace(SCENARIO, window=narrow), DataFolder())


FALLING = """
name = "falling"
[orbit]
semi_major_axis_km = 1770.0
eccentricity = 0.004
inclination_deg = 140.0
raan_deg = 10.0
argument_of_perilune_deg = 0.0
true_anomaly_deg = 60.0
[dynamics]
gravity = "builtin"
orientation = "iau"
degree = 12
[maneuvers]
enabled = false
[camera]
frame_interval_s = 60.0
[terrain]
source = "procedural"
"""


def test_a_window_before_the_impact_of_the_orbit_is_found_and_the_impact_is_named():
    world = build_world(parse_scenario(FALLING), DataFolder())
    assert format_utc(int(world.frame_utc_ns[0]), 0) == "2029-08-07T01:05:00Z"
    assert world.ends.startswith("the orbit hits the Moon at 2029-08-11T15:5")
    many = parse_scenario(f"{FALLING}[window]\npasses = 900")
    with pytest.raises(ScenarioError, match=r"within 30\.0 days .* found \d+; the orbit hits the Moon at 2029-08-11"):
        build_world(many, DataFolder())


POLAR = """
name = "pole"
[orbit]
semi_major_axis_km = 1770.0
eccentricity = 0.004
inclination_deg = 90.0
raan_deg = 10.0
argument_of_perilune_deg = 0.0
true_anomaly_deg = 60.0
[dynamics]
gravity = "builtin"
orientation = "iau"
degree = 12
[maneuvers]
enabled = false
[terrain]
source = "procedural"
[window]
search = "none"
latitude_limit_deg = 90.0
start = "2029-08-07T00:05:00Z"
duration_s = 600
"""


def test_a_flight_over_a_pole_is_refused_before_it_starts_by_its_first_frame_that_sees_too_far(tmp_path):
    message = r"expected ground within 84 deg of latitude .* found 8\d\.\d+ deg needed by frame \d of 40 at 2029"
    with pytest.raises(ScenarioError, match=message):
        checked_world(parse_scenario(POLAR), DataFolder())
    with pytest.raises(ScenarioError, match=message):
        emulate(parse_scenario(POLAR), DataFolder(), tmp_path / "p")
    assert not list(tmp_path.iterdir())
    south = POLAR.replace("00:05:00Z", "00:40:00Z").replace("duration_s = 600", "duration_s = 300")
    assert checked_world(parse_scenario(south), DataFolder()).frame_utc_ns.size == 20
