"""Registration of a catalogue to terrain; worlds whose light is that of a photograph; kidnaps and burns."""

import json
from dataclasses import replace
from math import cos, degrees, exp, hypot, radians, sin, sqrt
from types import SimpleNamespace

import numpy as np
from numpy.linalg import norm
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx, fixture, mark, raises

from lunar.camera import PinholeCamera, ground_point_sphere, pointed_camera_from_mcmf
from lunar.catalogue import make_catalogue, save_catalogue
from lunar.constants import MOON_RADIUS_M
from lunar.datafolder import DataFolder, find_data
from lunar.elements import Elements, icrf_state_from_elements
from lunar.frames import IauOrientation, mcmf_from_spherical, spherical_from_mcmf
from lunar.gravity import builtin_gravity
from lunar.propagation import ForceModel, propagate
from lunar.timescales import parse_utc, tdb_s_from_utc_ns
from payload_emulator.errors import ScenarioError, TerrainError
from payload_emulator.session.archive.mission import level_of
from payload_emulator.session.scenario import parse_scenario
from payload_emulator.session.world.world import _register, _registration_name
from payload_emulator.sim.orbit.truth import Truth, changed, executed, turned_state
from payload_emulator.sim.render.light import sun_direction_mcmf
from payload_emulator.sim.render.renderer import PHOTOGRAPH_RADIANCE, render
from payload_emulator.sim.terrain.opening import open_terrain
from payload_emulator.sim.terrain.photograph import PhotographTerrain
from payload_emulator.sim.terrain.registering import PRODUCT, file_sha256, find_registration, save_registration
from payload_emulator.sim.terrain.registration import (
    FLOOR_SIGMA_M,
    LATTICE_DEG,
    PROCESS_ANGLE_DEG,
    PROCESS_SIGMA_M,
    Registration,
    Rims,
    by_tile,
    fit_registration,
    format_registration,
    parse_registration,
    registered,
)
from tests.payload_emulator.sim.rasters import write_raster
from tests.payload_emulator.test_curation import OFFSET_M, Field

RADIUS_M = 1_737_400.0


def rims(count, shift_m, noise_m, seed=1):
    """Rims spread over a square about 300 E, 10 N, with a constant shift and normal errors."""
    rng = np.random.default_rng(seed)
    latitude, longitude = rng.uniform(-0.5, 0.5, (2, count)) * 15.0
    east, north = noise_m * rng.standard_normal((2, count))
    return Rims(
        np.radians(10.0 + latitude), np.radians(300.0 + longitude), shift_m[0] + east, shift_m[1] + north,
        np.full(count, noise_m)
    )  # fmt: skip


def middle(registration):
    shift, sigma = registration.at(np.radians([10.0]), np.radians([300.0]))
    return shift[0], float(sigma[0])


def test_many_rims_give_the_shift_few_are_not_believed_and_none_change_nothing():
    shift, sigma = middle(fit_registration(rims(600, (-30.0, 70.0), 60.0)))
    # 60 m / sqrt(600) is 2.4 m; the shift may change by 21 m over ten degrees, and the floor is 10 m.
    assert shift == approx([-30.0, 70.0], abs=8.0)
    assert FLOOR_SIGMA_M <= sigma < 20.0
    shift, sigma = middle(fit_registration(rims(2, (300.0, 0.0), 400.0)))
    assert 0.0 <= shift[0] < 30.0 and sigma > 0.95 * PROCESS_SIGMA_M
    far = fit_registration(rims(50, (30.0, 0.0), 60.0))
    away, unknown = far.at(np.radians([-50.0]), np.radians([100.0]))
    assert away.tolist() == [[0.0, 0.0]] and np.isnan(unknown).all()


def test_wrong_rims_do_not_move_the_shift_and_its_uncertainty_is_that_of_the_errors():
    good = rims(400, (-30.0, 70.0), 60.0)
    wrong = np.arange(400) % 10 == 3
    spoilt = replace(good, north_m=np.where(wrong, 1_500.0, good.north_m))
    clean, _ = middle(fit_registration(good))
    robust, _ = middle(fit_registration(spoilt))
    # A mean would move by 143 m.
    assert np.abs(robust - clean).max() < 8.0
    errors, sigmas = [], []
    for seed in range(40):
        shift, sigma = middle(fit_registration(rims(30, (0.0, 0.0), 150.0, seed)))
        errors.append(shift)
        sigmas.append(sigma)
    # Zero is the mean of the process, so shrinking makes the errors smaller than those of another truth would be.
    assert 0.3 < np.sqrt(np.mean(np.square(errors))) / np.mean(sigmas) < 1.2


def test_the_shift_follows_the_place_without_steps():
    latitude, longitude = np.meshgrid(np.radians(np.arange(-30.0, 30.1, 0.5)), np.radians(np.arange(290.0, 310.1, 0.5)))
    latitude, longitude = latitude.ravel(), longitude.ravel()
    slope = Rims(latitude, longitude, 0.0 * latitude, np.degrees(latitude), np.full(latitude.size, 30.0))
    registration = fit_registration(slope)
    track = np.radians(np.arange(-25.0, 25.0, 0.1))
    shift, _ = registration.at(track, np.full(track.size, np.radians(300.0)))
    assert shift[:, 1] == approx(np.degrees(track), abs=6.0)
    assert np.abs(np.diff(shift[:, 1])).max() < 0.5


def test_a_catalogue_is_moved_by_its_place_also_over_the_zero_meridian():
    row, column = (part.ravel() for part in np.meshgrid([0, 1], [47, 48, 49]))
    same = np.ones(row.size)
    registration = Registration(row, column % 48, 50.0 * same, -20.0 * same, 12.0 * same, 9 * row)
    craters = make_catalogue(np.radians([3.0, 3.0]), np.radians([358.0, 2.0]), [5e3, 6e3], source="x")
    moved = registered(craters, registration)
    assert (moved.latitude_rad - craters.latitude_rad) * RADIUS_M == approx([-20.0, -20.0])
    east = (moved.longitude_rad - craters.longitude_rad) * RADIUS_M * cos(radians(3.0))
    assert east == approx([50.0, 50.0])
    assert registered(craters, None) is craters


def test_tiles_are_summed_up():
    tiles = by_tile(fit_registration(rims(300, (-30.0, 70.0), 60.0)))
    (tile,) = [one for one in tiles if (one.south_deg, one.west_deg) == (0.0, 300.0)]
    assert tile.east_m == approx(-30.0, abs=10.0) and tile.north_m == approx(70.0, abs=10.0)
    assert 50 < tile.rims <= 300


def test_a_product_is_read_as_it_was_written():
    made = replace(
        fit_registration(rims(100, (-30.0, 70.0), 60.0)), catalogue="ab", terrain={"a.tif": "cd"},
        made_utc="2026-11-23T00:00:00Z"
    )  # fmt: skip
    read = parse_registration(format_registration(made), "x")
    for name in ("row", "column", "rims"):
        assert np.array_equal(getattr(read, name), getattr(made, name))
    for name in ("east_m", "north_m", "sigma_m"):
        assert getattr(read, name) == approx(getattr(made, name), abs=0.051)
    assert (read.catalogue, read.terrain, read.made_utc) == (made.catalogue, made.terrain, made.made_utc)


OTHERS = """{"version": 9} | expected version 1, found 9
{"kind": "x"} | expected a registration made by linna catalogue register
{"lattice_deg": 5.0} | expected lattice_deg 7.5, found 5.0
{"nodes": [[0.0, 1.0]]} | expected nodes of 6 numbers
{"nodes": [[0.0, 7.5, 1.0, 1.0, 0.0, 3]]} | positive sigma_m"""


@mark.parametrize("row", OTHERS.splitlines())
def test_another_product_is_refused_in_one_line(row):
    change, words = row.split(" | ")
    text = format_registration(fit_registration(rims(20, (0.0, 0.0), 60.0)))
    with raises(TerrainError, match=words) as refused:
        parse_registration(json.dumps(json.loads(text) | json.loads(change)), "made.json")
    assert str(refused.value).startswith("made.json: ") and "\n" not in str(refused.value)
    with raises(TerrainError, match=r"expected a registration \(JSON\)"):
        parse_registration(text[:40], "made.json")


def folder_of(root, *others):
    """A data folder with a raster, a list of one crater and the registration of the list to the raster.

    The list has other craters, of which no raster is registered: latitudes, longitudes in degrees, diameters.
    """
    (root / "dem").mkdir()
    raster = write_raster(root / "dem/flat_128ppd_000E_+15.tif", 10.0, 20.0, 8.0, lambda lat, _: 0.0 * lat)
    catalogue = root / "craters.csv"
    latitude, longitude, size_m = np.concatenate([[[15.0], [14.0], [8e3]], *others], axis=1)
    listed = make_catalogue(np.radians(latitude), np.radians(longitude), size_m, source="x")
    save_catalogue(listed, catalogue)
    made = rims(100, (-30.0, 70.0), 60.0)
    made = replace(made, longitude_rad=made.longitude_rad - radians(286.0))
    save_registration(
        root / PRODUCT,
        replace(fit_registration(made), catalogue=file_sha256(catalogue), terrain={raster.name: file_sha256(raster)}),
    )
    return DataFolder(root=root, dem_tiles=(raster,), catalogue_lu=catalogue)


def test_terrain_is_opened_with_its_catalogue_registered(tmp_path):
    data = folder_of(tmp_path)
    terrain = open_terrain("raster", data, 1)
    north_m = (terrain.catalogue.latitude_rad[0] - radians(15.0)) * RADIUS_M
    assert north_m == approx(70.0, abs=15.0)
    (tmp_path / PRODUCT).unlink()
    plain = open_terrain("raster", data, 1)
    assert plain.registration is None
    assert plain.catalogue.latitude_rad[0] == approx(radians(15.0), abs=1e-12)


def test_sigma_grows_beyond_the_nodes():
    row, column = np.meshgrid([1, 2], [39, 40])
    same = np.ones(4)
    made = Registration(row.ravel(), column.ravel(), 50.0 * same, 0.0 * same, 12.0 * same, row.ravel())
    shift, sigma = made.at(np.radians([10.0] * 3), np.radians([299.0, 303.75, 306.5]))
    assert shift[:2, 0] == approx([50.0, 50.0])
    # Half a spacing beyond the last node the process has moved by this; from three quarters on nothing is known.
    moved = PROCESS_SIGMA_M * sqrt(1.0 - exp(-2.0 * 3.75 / PROCESS_ANGLE_DEG))
    assert sigma[:2] == approx([12.0, hypot(12.0, moved)]) and np.isnan(sigma[2])


def test_a_registration_holds_on_the_rasters_that_it_was_made_of(tmp_path):
    data = folder_of(tmp_path)
    made = parse_registration((tmp_path / PRODUCT).read_text(), "made")
    save_registration(tmp_path / PRODUCT, replace(made, terrain={**made.terrain, "not-here.tif": "00"}))
    found = find_registration(data, data.catalogue_lu, data.dem_tiles)
    assert made.row.size > 1
    # Of the nodes at multiples of 7.5 degrees only this one lies on the raster, 10 to 18 E, 12 to 20 N.
    assert (found.row * LATTICE_DEG).tolist() == [15.0] and (found.column * LATTICE_DEG).tolist() == [15.0]


def test_ground_without_a_product_is_registered_from_its_rims(tmp_path):
    field = Field()
    heights, top, left = field.window(10.0, 16.0, 300.0, 306.0)
    listed = field.listed(40.0)
    places = np.degrees([listed.latitude_rad, listed.longitude_rad])
    data = folder_of(tmp_path, [*places, listed.diameter_m])

    def drawn(latitude_deg, longitude_deg):
        rows, columns = np.rint((top - latitude_deg) * 128.0), np.rint((longitude_deg - left) * 128.0)
        return heights[rows.astype(int), columns.astype(int)]

    own = write_raster(tmp_path / "dem/own.tif", 300.0, 16.0, 6.0, drawn, ppd=128)
    terrain = open_terrain("raster", replace(data, dem_tiles=(*data.dem_tiles, own)), 1)

    def beneath(latitude_deg, longitude_deg):
        place = mcmf_from_spherical(np.radians([latitude_deg]), np.radians([longitude_deg]), 30e3)
        return SimpleNamespace(positions_mcmf=lambda utc_ns: place)

    times = np.zeros(1, int)
    stated = _registration_name(terrain, beneath(13.0, 303.0), times)
    assert stated == ("crater list not registered to the terrain",)
    _register(terrain, beneath(13.0, 303.0), times)
    shift, sigma = terrain.registration.at(np.radians([13.0, 15.0]), np.radians([303.0, 14.0]))
    assert shift[0] == approx(OFFSET_M, abs=20.0) and shift[1, 1] == approx(70.0, abs=15.0)
    assert np.all(sigma < 30.0)
    # The list is moved once, by the shift of its place.
    north_m = (terrain.catalogue.latitude_rad - terrain.listed.latitude_rad) * RADIUS_M
    assert north_m[0] == approx(70.0, abs=15.0) and north_m[1:] == approx(OFFSET_M[1], abs=20.0)
    assert _registration_name(terrain, beneath(13.0, 303.0), times)[0].endswith("in 100 % of the frames")
    _register(terrain, beneath(-40.0, 100.0), times)
    assert "not registered" in _registration_name(terrain, beneath(-40.0, 100.0), times)[0]


@mark.parametrize(
    "changes_list, message",
    [
        (True, r"registration.json: expected a catalogue with SHA-256 .*make it again"),
        (False, r"flat_128ppd_000E_\+15.tif with SHA-256 .* found another file"),
    ],
)
def test_a_registration_of_other_files_is_refused(tmp_path, changes_list, message):
    data = folder_of(tmp_path)
    with (data.catalogue_lu if changes_list else data.dem_tiles[0]).open("ab") as file:
        file.write(b"\n")
    with raises(TerrainError, match=message):
        find_registration(data, data.catalogue_lu, data.dem_tiles)


@mark.real_data
def test_the_shipped_registration_is_of_the_tiles_of_the_project(data_path):
    data = find_data(data_path)
    found = find_registration(data, data.catalogue_lu, data.dem_tiles)
    assert found.rims.sum() > 8_000
    # Fresh craters of the strip from 285 to 300 E, 15 to 30 N lie 79 m north (32 rims, +- 19 m); south of the equator
    # none of its tiles differs by more than 30 m (medians of rims, 70 to 140 to a tile).
    shift, _ = found.at(np.radians([22.5, -22.5]), np.radians([292.5, 292.5]))
    assert shift[0, 1] == approx(79.0, abs=30.0) and abs(shift[1, 1]) < 30.0
    assert np.all(np.abs(shift[:, 0]) < 45.0)
    assert found.row.size * LATTICE_DEG**2 > 60 * 15.0**2


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
    "section, words",
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
