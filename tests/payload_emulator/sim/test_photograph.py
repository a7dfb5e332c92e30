"""Worlds whose light is that of a photograph, against the sphere; kidnaps and burns of the true flight."""

from math import cos, degrees, radians, sin

import numpy as np
from numpy.linalg import norm
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx, fixture, mark, raises

from lunar.camera import PinholeCamera, ground_point_sphere, pointed_camera_from_mcmf
from lunar.catalogue import make_catalogue, save_catalogue
from lunar.constants import MOON_RADIUS_M
from lunar.datafolder import DataFolder
from lunar.elements import Elements, icrf_state_from_elements
from lunar.frames import IauOrientation, spherical_from_mcmf
from lunar.gravity import builtin_gravity
from lunar.propagation import ForceModel, propagate
from lunar.timescales import parse_utc, tdb_s_from_utc_ns
from payload_emulator.errors import ScenarioError, TerrainError
from payload_emulator.session.archive.mission import level_of
from payload_emulator.session.scenario import parse_scenario
from payload_emulator.sim.orbit.truth import Truth, changed, executed, turned_state
from payload_emulator.sim.render.light import sun_direction_mcmf
from payload_emulator.sim.render.renderer import PHOTOGRAPH_RADIANCE, render
from payload_emulator.sim.terrain.opening import open_terrain
from payload_emulator.sim.terrain.photograph import PhotographTerrain
from tests.payload_emulator.sim.rasters import write_raster

NONE = make_catalogue([], [], [], source="none")
LATITUDE, LONGITUDE = 15.0, 14.0
PLACE = np.radians([[[LATITUDE]], [[LONGITUDE]]])


def flat(latitude, longitude):
    return 0.0 * latitude + 0.0 * longitude


def ramp(latitude, longitude):
    """Brightness of .5 in the middle, falling to the north and rising to the east."""
    return 0.5 - 0.1 * (latitude - LATITUDE) + 0.2 * (longitude - LONGITUDE)


def terrain_of(folder, formula=ramp, size_deg=4.0, **options):
    heights = write_raster(folder / "h.tif", 2.0, 29.0, 28.0, flat, ppd=16)
    corner = LONGITUDE - 0.5 * size_deg, LATITUDE + 0.5 * size_deg
    photograph = write_raster(folder / "p.tif", *corner, size_deg, formula, ppd=64, **options)
    return PhotographTerrain([heights], [photograph], NONE, registration_north_m=0.0)


def pose(altitude_m, tilt_deg=0.0):
    latitude, longitude = radians(LATITUDE), radians(LONGITUDE)
    up = np.array([cos(latitude) * cos(longitude), cos(latitude) * sin(longitude), sin(latitude)])
    position = (MOON_RADIUS_M + altitude_m) * up
    rotation = pointed_camera_from_mcmf(position, radians(tilt_deg), 0.3)
    return position, rotation, sun_direction_mcmf(radians(20.0), radians(90.0), latitude, longitude)


@mark.parametrize("tilt_deg", [0.0, 12.0])
def test_each_pixel_has_the_brightness_of_the_ground_it_looks_at(tmp_path, tilt_deg):
    camera = PinholeCamera(64, 48, radians(90.0))
    position, rotation, sun = pose(20_000.0, tilt_deg)
    radiance = render(terrain_of(tmp_path), camera, position, rotation, sun).radiance
    u, v = np.meshgrid(np.arange(64), np.arange(48))
    ground = ground_point_sphere(camera, rotation, position, np.stack([u, v], axis=-1).astype(float))
    latitude, longitude, _ = spherical_from_mcmf(ground)
    expected = PHOTOGRAPH_RADIANCE * ramp(np.degrees(latitude), np.degrees(longitude))
    # The renderer finds the ground to some metres; the ramp changes by .007 in a kilometre.
    assert_allclose(radiance, expected, atol=2e-4)
    assert np.ptp(radiance) > 0.05


def test_ground_outside_the_photograph_is_black_and_not_covered(tmp_path):
    terrain = terrain_of(tmp_path, size_deg=0.5)
    position, rotation, sun = pose(20_000.0)
    picture = render(terrain, PinholeCamera(64, 64, radians(90.0)), position, rotation, sun)
    assert picture.radiance[32, 32] > 0.1 and picture.radiance[0, 0] == 0.0
    places = np.radians([LATITUDE, LATITUDE]), np.radians([LONGITUDE, LONGITUDE + 0.3])
    assert terrain.covers(*places).tolist() == [True, False]


def test_the_registration_of_the_heights_moves_the_photograph_too(tmp_path):
    terrain_of(tmp_path)
    moved = PhotographTerrain(
        [tmp_path / "h.tif"], [tmp_path / "p.tif"], NONE, registration_north_m=3_000.0,
        registration_east_m=-2_000.0
    )  # fmt: skip
    north_deg = degrees(3_000.0 / MOON_RADIUS_M)
    east_deg = degrees(-2_000.0 / MOON_RADIUS_M) / cos(radians(LATITUDE))
    # What the file has 3 km farther south and 2 km farther east is here.
    assert moved.brightness(*PLACE, 10.0)[0, 0] == approx(ramp(LATITUDE - north_deg, LONGITUDE - east_deg), abs=1e-4)


def test_a_finer_photograph_is_averaged_to_the_pixels_of_the_camera(tmp_path):
    def board(latitude, longitude):
        return (np.floor(latitude * 64.0) + np.floor(longitude * 64.0)) % 2.0

    terrain = terrain_of(tmp_path, board)
    latitude, longitude = np.radians(
        np.meshgrid(LATITUDE + (np.arange(9) + 0.5) / 64, LONGITUDE + (np.arange(9) + 0.5) / 64)
    )
    fine = terrain.brightness(latitude, longitude, 100.0)
    coarse = terrain.brightness(latitude, longitude, 3_000.0)
    assert np.ptp(coarse) < 0.02 < 0.3 < float(np.abs(fine - 0.5).max())
    assert coarse == approx(0.5, abs=0.02)


def test_eight_bits_are_a_share_of_full_scale(tmp_path):
    terrain = terrain_of(tmp_path, lambda latitude, longitude: 51.0 + flat(latitude, longitude), dtype="uint8")
    assert terrain.brightness(*PLACE, 100.0)[0, 0] == approx(0.2, abs=1e-6)


def test_no_data_of_the_photograph_is_not_a_number(tmp_path):
    terrain = terrain_of(tmp_path, lambda a, b: np.where(a > LATITUDE, -1.0, 0.5 + 0 * b), nodata=-1.0)
    places = np.radians([[LATITUDE + 0.5, LATITUDE - 0.5]]), np.radians([[LONGITUDE, LONGITUDE]])
    seen = terrain.brightness(*places, 100.0)
    assert np.isnan(seen[0, 0]) and seen[0, 1] == 0.5


def test_files_are_named_in_the_data_folder(tmp_path):
    terrain_of(tmp_path)
    catalogue = tmp_path / "craters.csv"
    save_catalogue(make_catalogue([0.26], [0.24], [8e3], source="x"), catalogue)
    data = DataFolder(root=tmp_path, catalogue_lu=catalogue)
    terrain = open_terrain("photograph", data, 1, photographs=("p.tif",), heights=("h.tif",))
    assert terrain.name == "photograph p.tif"
    assert terrain.data_names[:2] == ("photograph p.tif", "height raster h.tif")
    assert terrain.registration_north_m == 0.0 and terrain.registration is None
    with raises(TerrainError, match=r"expected the photograph .*none\.tif, found none"):
        open_terrain("photograph", data, 1, photographs=("none.tif",), heights=("h.tif",))
    with raises(TerrainError, match="found 1 photographs, 0 rasters and a catalogue"):
        open_terrain("photograph", data, 1, photographs=("p.tif",))


@mark.parametrize(
    ("section", "words"),
    [
        ('source = "photograph"', "terrain.photographs must be files where terrain.source is 'photograph'"),
        ('source = "raster"\nphotographs = ["a.tif"]', "terrain.photographs must be files where"),
        ('source = "raster"\nheights = ["a.tif"]', "terrain.heights must be empty where terrain.source is 'raster'"),
    ],
)
def test_a_scenario_has_photographs_where_its_terrain_is_photographic(section, words):
    with raises(ScenarioError) as refusal:
        parse_scenario(f'name = "x"\n[terrain]\n{section}', "x.toml")
    assert words in str(refusal.value)


def test_photographs_are_level_five():
    assert level_of("photographs", None) == "5"
    assert level_of("procedural", None) == "2"


EPOCH = parse_utc("2029-08-07T00:00:00Z")
MODEL = ForceModel(builtin_gravity(), IauOrientation(), 8)
JUMP = EPOCH + 600 * 10**9


@fixture(scope="module")
def truth():
    epoch_s = float(tdb_s_from_utc_ns(EPOCH))
    position, velocity = icrf_state_from_elements(
        Elements(1_768_180.0, 0.006908, *np.radians([89.076, 3.164, 333.604, 8.882])),
        epoch_s,
        builtin_gravity().gm_m3_s2,
    )
    flown = propagate(epoch_s, position, velocity, 1_900.0, MODEL)
    return Truth(flown.state, EPOCH, EPOCH + 1_800 * 10**9, IauOrientation())


@mark.parametrize("heading_rad", [0.0, 1.0, 4.0])
def test_a_kidnap_moves_by_its_distance_on_the_sphere_and_keeps_the_shape_of_the_orbit(truth, heading_rad):
    before = np.concatenate([part[0] for part in truth.states(JUMP)])
    after = turned_state(before, 20e3, heading_rad)
    radius = norm(before[:3])
    angle = np.arccos(before[:3] @ after[:3] / radius**2)
    assert radius * angle == approx(20e3, rel=1e-6)
    assert norm(after[:3]) == approx(radius, rel=1e-12)
    assert after[:3] @ after[3:] == approx(before[:3] @ before[3:], abs=1e-3)


def test_before_a_change_the_flight_is_the_old_one_and_after_it_goes_on_from_the_new_state(truth):
    kick = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 5.0])
    burnt = changed(truth, JUMP, lambda state: state + kick, MODEL)
    times = EPOCH + np.array([0, 599, 600, 601, 1_700]) * 10**9
    old, new = np.concatenate(truth.states(times), axis=1), np.concatenate(burnt.states(times), axis=1)
    assert_array_equal(new[:2], old[:2])
    assert_allclose(new[2], old[2] + kick, atol=1e-6)
    # A second later the place differs by the kick's length, half an hour later by more than the kick times the time.
    assert norm(new[3, :3] - old[3, :3]) == approx(5.0, rel=1e-3)
    assert norm(new[4, :3] - old[4, :3]) > 2_000.0
    assert burnt.breaks_utc_ns == (JUMP,)


def test_plans_differ_from_burns_by_the_declared_share():
    done = np.array([3.0, -4.0, 0.0])
    burns = [executed(EPOCH + k, done, 0.02, (1, 2)) for k in range(400)]
    errors = np.array([burn.planned_m_s - burn.done_m_s for burn in burns])
    assert_allclose([burn.sigma_m_s for burn in burns], 0.1, rtol=1e-12)
    # 1,200 draws: the standard deviation is known to 2 %.
    assert errors.std() == approx(0.1, rel=0.1)
    again = executed(EPOCH, done, 0.02, (1, 2))
    assert_array_equal(again.planned_m_s, burns[0].planned_m_s)


def test_a_scenario_cannot_move_the_spacecraft_and_maintain_its_orbit_at_once():
    text = 'name = "x"\n[disturbances]\nkidnap_distance_km = 5.0\n'
    with raises(ScenarioError, match=r"maneuvers.enabled must be false.*where \[disturbances\]"):
        parse_scenario(text)
    assert parse_scenario(text + "[maneuvers]\nenabled = false\n").disturbances.kidnap_distance_km == 5.0
