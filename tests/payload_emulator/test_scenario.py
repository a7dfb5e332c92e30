"""Scenario files: what is read comes back, what cannot be flown is refused; orbits, craters and windows of them."""

import tomllib
from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx, mark, raises

from lunar.catalogue import CraterCatalogue
from lunar.datafolder import DataFolder, find_data
from lunar.frames import mci_from_icrf, spherical_from_mcmf
from lunar.propagation import SolarPressure
from lunar.timescales import format_utc, tdb_s_from_utc_ns
from payload_emulator.errors import ScenarioError
from payload_emulator.session.archive.emulator import checked_world, emulate
from payload_emulator.session.scenario import SHIPPED, Scenario, format_scenario, load_scenario, parse_scenario
from payload_emulator.session.spacecraft.loading import SEEN_BELOW_RIM_M, onboard_catalogue
from payload_emulator.session.world import world as world_module
from payload_emulator.session.world.orbit import (
    force_model,
    initial_state_icrf,
    propagate_scenario,
    propagate_to_impact,
    sample,
)
from payload_emulator.session.world.world import build_world

# A file with a [dataset] table is a recipe of a data set, not a scenario to fly.
FLOWN = [file for file in sorted(SHIPPED.glob("*.toml")) if "dataset" not in tomllib.loads(file.read_text())]


@mark.parametrize("file", FLOWN, ids=lambda file: file.stem)
def test_each_shipped_scenario_reads_and_survives_a_round_trip(file):
    scenario = load_scenario(file)
    assert parse_scenario(format_scenario(scenario)) == scenario


def test_a_bare_name_means_a_shipped_scenario_and_an_empty_one_is_the_papers_orbit():
    assert load_scenario("selenita").orbit.semi_major_axis_km == 1768.180  # paper, Table I
    assert parse_scenario('name = "x"') == Scenario(name="x")


NOT_FLOWN = """
 -> key 'name' is missing
name = 3 -> name must be a text, found 3
name = "x" ; sed = 4 -> unknown key 'sed'; did you mean 'seed'?
name = "x" ; [orbit] ; excentricity = 0.1 -> unknown key 'orbit.excentricity'; did you mean 'eccentricity'?
name = "x" ; [orbit] ; eccentricity = "round" -> orbit.eccentricity must be a number, found 'round'
name = "x" ; [dynamics] ; solar_area_to_mass_m2_kg = -1.0 -> dynamics.solar_area_to_mass_m2_kg must be from 0 to\
 1000, found -1.0
name = "x" ; [orbit] ; eccentricity = 1.2 -> orbit.eccentricity must be from 0 to below 1, found 1.2
name = "x" ; [orbit] ; semi_major_axis_km = 1700.0 -> an orbit above the ground
name = "x" ; [orbit] ; epoch = "tomorrow" -> orbit.epoch must be a UTC time
name = "x" ; [orbit] ; raan_deg = nan -> orbit.raan_deg must be finite
name = "x" ; [orbit] ; position_km = [1800.0, 0.0] ; velocity_km_s = [0.0, 1.6, 0.0] -> orbit.position_km must be\
 three numbers, found (1800.0, 0.0)
name = "x" ; [orbit] ; position_km = [1800.0, 0.0, 0.0] -> orbit.velocity_km_s must be three numbers, found ()
name = "x" ; [orbit] ; position_km = [1700.0, 0.0, 0.0] ; velocity_km_s = [0.0, 1.6, 0.0] -> orbit.position_km must\
 be a place above the ground
name = "x" ; [orbit] ; position_km = [1800.0, 0.0, 0.0] ; velocity_km_s = [0.0, 1.6, 0.0] ; raan_deg = 4.0 ->\
 orbit.raan_deg must be absent where orbit.position_km is given, found 4.0
name = "x" ; [orbit] ; position_km = ["far", 0.0, 0.0] -> orbit.position_km[0] must be a number, found 'far'
name = "x" ; [window] ; latitude_min_deg = 30.0 ; latitude_max_deg = 20.0 -> window.latitude_min_deg and\
 latitude_max_deg must be a band of latitudes
name = "x" ; [window] ; latitude_min_deg = 70.0 -> window.latitude_min_deg and latitude_max_deg must be a band of\
 latitudes
name = "x" ; [detector] ; score_threshold = 1.5 -> detector.score_threshold must be between 0 and 1, or negative for\
 that of the network, found 1.5
name = "x" ; [detector] ; max_detections = 256 -> detector.max_detections must be from 1 to 255, found 256
name = "x" ; [terrain] ; registration_north_east_m = [10.0] -> terrain.registration_north_east_m must be empty or two\
 numbers of at most 5000 m, found (10.0,)
name = "x" ; [terrain] ; source = "procedural" ; registration_north_east_m = [10.0, 0.0] ->\
 terrain.registration_north_east_m must be empty where terrain.source is 'procedural'
name = "x" ; [camera] ; tilt_deg = 75.0 -> camera.tilt_deg must be from -60 to 60, found 75.0
name = "x" ; [light] ; mode = "moonlight" -> light.mode must be one of 'paper', 'real'
name = "x" ; [navigation] ; estimators = ["oracle"] -> navigation.estimators must be of paper, spherical, anchored
name = "x" ; [camera] ; fov_deg = 180 -> camera.fov_deg must be from 1 to 170
name = "x" ; [window] ; search = "none" -> window.duration_s must be positive
name = -> not TOML
name = "x" ; [dynamics] ; integrator = "dop853" -> dynamics.integrator: only 'rkn86' is left
name = "x" ; [altimeter] -> section [altimeter]: instruments other than the camera were withdrawn
name = "x" ; [orbit] ; semi_major_axis_km = 1768180.0 -> semi_major_axis_km must be of an orbit about the Moon
name = "x" ; [orbit] ; position_km = [1768180.0, 0, 0] ; velocity_km_s = [0, 1.6, 0] -> orbit.position_km must be of\
 1737400 to 66000000 m in all, stated with km, found
name = "x" ; [orbit] ; position_km = [1768.18, 0, 0] ; velocity_km_s = [0, 1600.0, 0] -> orbit.velocity_km_s must be\
 of 0 to 3500 m/s in all, stated with km, found
name = "x" ; [orbit] ; epoch = "0029-08-07T00:00:00Z" -> orbit.epoch must be a UTC time such as
name = "x" ; [orbit] ; epoch = "2129-08-07T00:00:00Z" -> from 1972 to 2100, found '2129
name = "x" ; [link] ; clock_errors = ["madrid 1", "madrid 2"] -> link.clock_errors must be one entry for each\
 station, found ['madrid', 'madrid']
"""


@mark.parametrize("text, message", [line.replace(" ; ", "\n").split(" -> ") for line in NOT_FLOWN.splitlines()[1:]])
def test_what_cannot_be_flown_is_refused(text, message):
    with raises(ScenarioError, match="scenario: ") as refusal:
        parse_scenario(text)
    assert message in str(refusal.value)
    assert "\n" not in str(refusal.value)


WITHOUT_EFFECT = """
[window] ; duration_s = 600 -> window.duration_s has no effect without window.search = 'none'
[window] ; search = "none" ; duration_s = 600 ; search_days = 3 -> window.search_days has no effect where\
 window.search is 'none': expected it left out, found 3.0
[orbit] ; oem = "a.oem" ; inclination_deg = 40 -> orbit.inclination_deg has no effect with orbit.oem
[dynamics] ; solar_reflection = 2 -> solar_reflection has no effect without a solar area
[maneuvers] ; enabled = false ; eccentricity = 0.1 -> maneuvers.eccentricity has no effect without
[maneuvers] ; enabled = false ; execution_error_fraction = 0.1 -> no effect without burns
[light] ; mode = "real" ; elevation_max_deg = 50 -> light.elevation_max_deg has no effect where
[camera] ; images = "reduced" ; [sensor] ; bits = 12 -> sensor.bits has no effect with reduced images
[navigation] ; anchoring_catalogue = "a" ; catalogue_height_error_m = 9 -> catalogue_height_error_m has no effect\
 with anchoring_catalogue
[navigation] ; catalogue_distortion_deg = 9 -> catalogue_distortion_deg has no effect without catalogue_distortion_m
[disturbances] ; kidnap_told = true -> kidnap_told has no effect without kidnap_distance_km
[disturbances] ; outage_at_s = 9 -> outage_at_s has no effect without outage_duration_s
[disturbances] ; burn_at_s = 9 -> burn_at_s has no effect without burn_delta_v_m_s
[link] ; burst_end = 0.5 -> link.burst_end has no effect without burst_start
[link] ; playback = true -> link.playback has no effect without link.stations
"""


@mark.parametrize(
    "text, message", [line.replace(" ; ", "\n").split(" -> ") for line in WITHOUT_EFFECT.splitlines()[1:]]
)
def test_a_stated_key_without_effect_is_refused_and_an_archive_that_states_all_is_read(tmp_path, text, message):
    file = tmp_path / "a.toml"
    file.write_text(f'name = "x"\n{text}')
    with raises(ScenarioError) as refusal:
        load_scenario(file)
    assert message in str(refusal.value) and str(file) in str(refusal.value)
    archived = parse_scenario(file.read_text())
    assert parse_scenario(format_scenario(archived)) == archived


def test_a_scenario_of_an_older_archive_reads_as_before():
    older = 'name = "x"\n[dynamics]\ndegree = 8\nintegrator = "rkn86"'
    assert parse_scenario(older) == parse_scenario('name = "x"\n[dynamics]\ndegree = 8')


def measured(source):
    count = 5
    return CraterCatalogue(
        np.arange(count), np.linspace(-0.1, 0.1, count), np.linspace(0.2, 0.3, count), np.full(count, 5_000.0),
        np.linspace(-2_000.0, 2_000.0, count), np.full(count, 400.0), source, np.ones(count, dtype=bool),
    )  # fmt: skip


def on_board(source, fraction=0.0):
    """On-board table with errors of its centres of a fraction of the diameter, and none of its heights."""
    scenario = load_scenario("selenita")
    navigation = replace(
        scenario.navigation, catalogue_error_fraction_of_diameter=fraction, catalogue_height_error_m=0.0
    )
    return onboard_catalogue(replace(scenario, navigation=navigation), measured(source))


def test_real_craters_are_placed_below_their_rims_where_the_network_sees_them_and_procedural_ones_on_them():
    rims = measured("LU1319381").rim_height_m
    assert_allclose(on_board("LU1319381").rim_height_m - rims, -SEEN_BELOW_RIM_M, atol=1e-9)
    # Of the order of the measured 16 to 23 m: another sign would double the error of the altitude.
    assert 14.0 <= SEEN_BELOW_RIM_M <= 24.0
    assert_array_equal(on_board("synthetic, seed 1").rim_height_m, measured("").rim_height_m)


@mark.parametrize("source", ["LU1319381", "synthetic, seed 1"])
def test_centres_have_the_errors_that_are_added_the_error_of_the_list_is_the_detectors(source):
    assert_array_equal(on_board(source, 0.03).sigma_m[:, :2], 150.0)
    assert_array_equal(on_board(source).sigma_m[:, :2], 10.0)


BARE = 'name = "x"\n[maneuvers]\nenabled = false\n[dynamics]\ngravity = "builtin"\norientation = "iau"\n'


def test_sunlight_pushes_only_the_scenarios_that_ask_for_it():
    data = find_data(None)
    assert force_model(parse_scenario(BARE), data).solar_pressure is None
    lit = parse_scenario(BARE + "solar_area_to_mass_m2_kg = 0.02\nsolar_reflection = 1.4\n")
    assert force_model(lit, data).solar_pressure == SolarPressure(0.02, 1.4)


def test_a_revolution_in_sunlight_moves_the_orbit_by_metres_at_the_most():
    data = find_data(None)
    ends = []
    for extra in ("", "solar_area_to_mass_m2_kg = 0.02\n"):
        scenario = parse_scenario(BARE + extra)
        orbit = propagate_scenario(scenario, force_model(scenario, data), 7_200.0)
        ends.append(orbit.trajectory.state_after(7_200.0)[:3])
    # 4.5e-6 Pa x 0.02 m2/kg x 1.3 = 1.2e-7 m/s^2; over a revolution it moves the orbit by metres at the most.
    assert 0.01 < np.linalg.norm(ends[1] - ends[0]) < 10.0  # m


def test_a_cartesian_state_flies_the_orbit_of_the_elements_it_came_from():
    data = find_data(None)
    elements = parse_scenario(BARE)
    gm_m3_s2 = force_model(elements, data).gm_m3_s2
    icrf = initial_state_icrf(elements, gm_m3_s2)
    mci_from_icrf_now = np.asarray(mci_from_icrf(tdb_s_from_utc_ns(elements.epoch_utc_ns)))
    mci = np.concatenate([mci_from_icrf_now @ icrf[:3], mci_from_icrf_now @ icrf[3:]])
    for frame, state in (("ICRF", icrf), ("MCI", mci)):
        position, velocity = (state[:3] / 1e3).tolist(), (state[3:] / 1e3).tolist()
        text = f'{BARE}[orbit]\nframe = "{frame}"\nposition_km = {position}\nvelocity_km_s = {velocity}\n'
        scenario = parse_scenario(text)
        # Doubles of 1.8e6 m carry 2e-10 m; the factor of 1000 costs one rounding.
        assert_allclose(initial_state_icrf(scenario, gm_m3_s2), icrf, atol=1e-8)
        assert parse_scenario(format_scenario(scenario)) == scenario
        ends = [
            propagate_scenario(one, force_model(one, data), 600.0).trajectory.state_after(600.0)
            for one in (elements, scenario)
        ]
        assert_allclose(ends[0][:3], ends[1][:3], atol=1e-5)  # m


def test_an_orbit_into_the_ground_is_propagated_until_then():
    low = parse_scenario(
        'name = "x"\n[orbit]\nsemi_major_axis_km = 1745.0\neccentricity = 0.004\n[dynamics]\ndegree = 8\n'
        'gravity = "builtin"\n[maneuvers]\nenabled = false'
    )
    model = force_model(low, find_data(None))
    orbit, impact = propagate_to_impact(low, model, 30 * 86_400.0)
    lived_s = (impact.utc_ns - low.epoch_utc_ns) / 1e9
    assert orbit.trajectory.elapsed_s[-1] == approx(lived_s - 1.0, abs=1e-3)
    ephemeris, _ = sample(orbit, 60.0)
    assert impact.utc_ns - 61_000_000_000 < ephemeris.stop_utc_ns < impact.utc_ns
    assert propagate_to_impact(low, model, 0.5 * lived_s)[1] is None


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
    assert np.degrees([latitude.min(), latitude.max()]) == approx([-20.0, 50.0], abs=0.9)
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
    with raises(ScenarioError, match=r"lacks terrain at latitudes (29|30|31)\.\d to (49|50)\.\d deg"):
        build_world(SCENARIO, DataFolder())
    south = replace(SCENARIO, window=replace(SCENARIO.window, latitude_max_deg=28.0))
    assert build_world(south, DataFolder()).frame_utc_ns.size > 20


def test_a_search_in_longitudes_that_no_track_crosses_says_so():
    narrow = replace(SCENARIO.window, longitude_min_deg=10.0, longitude_max_deg=11.0)
    with raises(ScenarioError, match=r"keeps its swath within longitudes 10\.0 to 11\.0 deg"):
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
    with raises(ScenarioError, match=r"within 30\.0 days .* found \d+; the orbit hits the Moon at 2029-08-11"):
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
    with raises(ScenarioError, match=message):
        checked_world(parse_scenario(POLAR), DataFolder())
    with raises(ScenarioError, match=message):
        emulate(parse_scenario(POLAR), DataFolder(), tmp_path / "p")
    assert not list(tmp_path.iterdir())
    south = POLAR.replace("00:05:00Z", "00:40:00Z").replace("duration_s = 600", "duration_s = 300")
    assert checked_world(parse_scenario(south), DataFolder()).frame_utc_ns.size == 20
