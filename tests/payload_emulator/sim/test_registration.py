"""Registration of a catalogue to terrain: fit from rims, product, use when a terrain is opened."""

import json
from dataclasses import replace
from math import cos, exp, hypot, radians, sqrt
from types import SimpleNamespace

import numpy as np
from pytest import approx, mark, raises

from lunar.catalogue import make_catalogue, save_catalogue
from lunar.datafolder import DataFolder, find_data
from lunar.frames import mcmf_from_spherical
from payload_emulator.errors import TerrainError
from payload_emulator.session.world.world import _register, _registration_name
from payload_emulator.sim.terrain.opening import open_terrain
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


def test_a_tenth_of_wrong_rims_does_not_move_the_shift():
    good = rims(400, (-30.0, 70.0), 60.0)
    wrong = np.arange(400) % 10 == 3
    spoilt = replace(good, north_m=np.where(wrong, 1_500.0, good.north_m))
    clean, _ = middle(fit_registration(good))
    robust, _ = middle(fit_registration(spoilt))
    # A mean would move by 143 m.
    assert np.abs(robust - clean).max() < 8.0


def test_the_stated_uncertainty_is_that_of_the_errors():
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


@mark.parametrize(
    ("change", "words"),
    [
        ({"version": 9}, "expected version 1, found 9"),
        ({"kind": "x"}, "expected a registration made by linna catalogue register"),
        ({"lattice_deg": 5.0}, "expected lattice_deg 7.5, found 5.0"),
        ({"nodes": [[0.0, 1.0]]}, "expected nodes of 6 numbers"),
        ({"nodes": [[0.0, 7.5, 1.0, 1.0, 0.0, 3]]}, "positive sigma_m"),
    ],
)
def test_another_product_is_refused_in_one_line(change, words):
    text = format_registration(fit_registration(rims(20, (0.0, 0.0), 60.0)))
    with raises(TerrainError, match=words) as refused:
        parse_registration(json.dumps(json.loads(text) | change), "made.json")
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
    assert terrain.registration is not None
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
    assert data.catalogue_lu is not None
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
    ("changes_list", "message"),
    [
        (True, r"registration.json: expected a catalogue with SHA-256 .*make it again"),
        (False, r"flat_128ppd_000E_\+15.tif with SHA-256 .* found another file"),
    ],
)
def test_a_registration_of_other_files_is_refused(tmp_path, changes_list, message):
    data = folder_of(tmp_path)
    assert data.catalogue_lu is not None
    with (data.catalogue_lu if changes_list else data.dem_tiles[0]).open("ab") as file:
        file.write(b"\n")
    with raises(TerrainError, match=message):
        find_registration(data, data.catalogue_lu, data.dem_tiles)


@mark.real_data
def test_the_shipped_registration_is_of_the_tiles_of_the_project(data_path):
    data = find_data(data_path)
    assert data.catalogue_lu is not None
    found = find_registration(data, data.catalogue_lu, data.dem_tiles)
    assert found.rims.sum() > 8_000
    # Fresh craters of the strip from 285 to 300 E, 15 to 30 N lie 79 m north (32 rims, +- 19 m); south of the equator
    # none of its tiles differs by more than 30 m (medians of rims, 70 to 140 to a tile).
    shift, _ = found.at(np.radians([22.5, -22.5]), np.radians([292.5, 292.5]))
    assert shift[0, 1] == approx(79.0, abs=30.0) and abs(shift[1, 1]) < 30.0
    assert np.all(np.abs(shift[:, 0]) < 45.0)
    assert found.row.size * LATTICE_DEG**2 > 60 * 15.0**2
