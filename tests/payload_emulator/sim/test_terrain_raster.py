import math

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx, mark, raises

from lunar.catalogue import load_catalogue, make_catalogue, save_catalogue
from lunar.constants import MOON_RADIUS_M
from lunar.datafolder import DataFolder, find_data
from payload_emulator.errors import TerrainError
from payload_emulator.sim.terrain import kernels
from payload_emulator.sim.terrain.opening import open_terrain
from payload_emulator.sim.terrain.raster import RasterTerrain, _window
from payload_emulator.sim.terrain.rasters import open_layers
from tests.payload_emulator.sim.rasters import write_raster

NONE = make_catalogue([], [], [], source="none")
AS_IT_IS = {"sharpen": False, "registration_north_m": 0.0, "smoothing_pixels": 0.0}


def slope(latitude, longitude):
    return 100.0 * latitude + 50.0 * longitude


def test_pixels_are_areas(tmp_path):
    terrain = RasterTerrain([write_raster(tmp_path / "a.tif", 10.0, 20.0, 8.0, slope)], NONE, **AS_IT_IS)
    latitude, longitude = np.array([15.3, 16.71]), np.array([13.2, 14.9])
    # A tilted plane passes unchanged through cubic and bilinear resampling: single precision of 2.5 km is 0.2 mm.
    heights = terrain.height_m(np.radians(latitude), np.radians(longitude))
    assert_allclose(heights, slope(latitude, longitude), atol=0.01)


def test_registration_moves_the_raster_over_the_ground(tmp_path):
    path = write_raster(tmp_path / "a.tif", 10.0, 20.0, 8.0, slope)
    moved = RasterTerrain([path], NONE, **(AS_IT_IS | {"registration_north_m": -59.0}))
    still = RasterTerrain([path], NONE, **AS_IT_IS)
    place = math.radians(15.0), math.radians(14.0)
    shift_deg = math.degrees(59.0 / MOON_RADIUS_M)
    # What was 59 m farther north is now here: higher, on ground that rises to the north.
    assert float(moved.height_m(*place) - still.height_m(*place)) == approx(100.0 * shift_deg, abs=0.01)


def test_a_scenario_may_give_the_registration_of_height_rasters(tmp_path):
    path = write_raster(tmp_path / "a.tif", 10.0, 20.0, 8.0, slope)
    catalogue = tmp_path / "craters.csv"
    save_catalogue(make_catalogue([np.radians(15.0)], [np.radians(14.0)], [8e3], source="x"), catalogue)
    data = DataFolder(dem_tiles=(path,), catalogue_lu=catalogue)
    own = open_terrain("raster", data, 1)
    given = open_terrain("raster", data, 1, registration_north_east_m=(-46.0, 13.0))
    assert (own.registration_north_m, own.registration_east_m) == (0.0, 0.0)
    assert (given.registration_north_m, given.registration_east_m) == (-46.0, 13.0)


def test_files_join_without_a_seam_and_across_the_prime_meridian(tmp_path):
    def hills(latitude, longitude):
        return 500.0 * np.sin(np.radians(8.0 * latitude)) * np.cos(np.radians(9.0 * longitude))

    west = write_raster(tmp_path / "w.tif", 352.0, 8.0, 8.0, hills)
    east = write_raster(tmp_path / "e.tif", 0.0, 8.0, 8.0, hills)
    terrain = RasterTerrain([west, east], NONE, **AS_IT_IS)
    longitude = np.linspace(-0.1, 0.1, 41)
    heights = terrain.height_m(np.radians(4.0), np.radians(longitude))
    # Cubic resampling of waves of 40 degrees from pixels of 1/32 degree: centimetres.
    assert_allclose(heights, hills(4.0, longitude), atol=0.05)
    assert_allclose(heights, terrain.height_m(np.radians(4.0), np.radians(longitude + 360.0)), atol=0.01)


def test_a_coarse_raster_fills_in_around_but_does_not_count_as_covered(tmp_path):
    fine = write_raster(tmp_path / "f.tif", 10.0, 20.0, 6.0, slope)
    coarse = write_raster(tmp_path / "c.tif", 0.0, 30.0, 30.0, slope, ppd=8)
    terrain = RasterTerrain([fine], NONE, coarse_paths=[coarse], **AS_IT_IS)
    latitude, longitude = np.array([17.0, 17.0, 12.0]), np.array([13.0, 9.0, 25.0])
    covered = terrain.covers(np.radians(latitude), np.radians(longitude))
    assert covered.tolist() == [True, False, False]
    heights = terrain.height_m(np.radians(latitude), np.radians(longitude))
    assert_allclose(heights, slope(latitude, longitude), atol=0.5)


def test_sharpening_is_seeded_and_adds_what_the_raster_cannot_hold(tmp_path):
    path = write_raster(tmp_path / "a.tif", 10.0, 20.0, 8.0, slope)
    latitude, longitude = np.radians(np.linspace(15.0, 15.3, 300)), np.radians(14.0)
    first, again, other = (
        RasterTerrain([path], NONE, seed=seed, registration_north_m=0.0).height_m(latitude, longitude)
        for seed in (1, 1, 2)
    )
    assert_array_equal(first, again)
    assert np.std(first - other) > 1.0


def test_a_raster_without_georeference_is_refused(tmp_path):
    from PIL import Image

    path = tmp_path / "plain.png"
    Image.fromarray(np.zeros((8, 8), np.uint8)).save(path)
    with raises(TerrainError, match=r"plain\.png: expected a georeferenced raster"):
        open_layers([path])


def test_a_missing_or_damaged_raster_is_named(tmp_path):
    with raises(TerrainError, match=r"gone\.tif: expected a raster"):
        open_layers([tmp_path / "gone.tif"])
    broken = tmp_path / "broken.tif"
    broken.write_bytes(b"not a raster at all")
    with raises(TerrainError, match=r"broken\.tif: expected a raster"):
        open_layers([broken])


def test_opening_says_what_is_missing():
    with raises(TerrainError, match="0 rasters and no catalogue"):
        open_terrain("raster", DataFolder(), 1)
    with raises(TerrainError, match="expected one of auto, raster, procedural, catalogue, photograph, found 'flat'"):
        open_terrain("flat", DataFolder(), 1)
    assert open_terrain("auto", DataFolder(), 1).name == "procedural Moon, seed 1"


@mark.real_data
def test_fresh_craters_of_the_real_catalogue_are_as_deep_on_gld100_as_they_should_be(data_path):
    data = find_data(data_path)
    catalogue = load_catalogue(data.catalogue_lu)
    terrain = RasterTerrain(
        data.dem_tiles, catalogue, coarse_paths=[data.dem_global], sharpen=False, smoothing_pixels=1.0
    )
    degrees = np.degrees(catalogue.latitude_rad), np.degrees(catalogue.longitude_rad)
    inside = (np.abs(degrees[0] + 37.0) < 5.0) & (np.abs(degrees[1] - 292.0) < 5.0)
    size = catalogue.diameter_m
    chosen = np.flatnonzero(inside & (size > 5e3) & (size < 15e3))
    measured = terrain.measured(chosen)
    ratio = measured.depth_m / measured.diameter_m
    assert chosen.size > 50
    # Measured independently on this raster at 256 px/deg: 98th percentile 0.178 to 0.190 for 5 to 15 km, and about a
    # quarter of the 5 to 30 km craters shallower than 0.03. One region of 10 degrees scatters by 0.03 and 0.12.
    assert np.percentile(ratio, 98) == approx(0.184, abs=0.03)
    assert np.mean(ratio < 0.03) == approx(0.25, abs=0.12)


def test_smoothing_adds_its_terms_one_by_one_to_the_last_bit():
    """Tiles must be the same on every machine: the sums are those of float32 arrays added in order."""
    values = np.random.default_rng(5).normal(0.0, 900.0, (41, 57)).astype(np.float32)
    weights = np.array([0.06, 0.24, 0.4, 0.24, 0.06], np.float32)
    half = values.copy()
    half[2:-2] = sum(w * values[k : 37 + k] for k, w in enumerate(weights))
    expected = half.copy()
    expected[:, 2:-2] = sum(w * half[:, k : 53 + k] for k, w in enumerate(weights))
    assert np.array_equal(kernels.smooth(values, weights), expected)


class Plane:
    """Layer whose heights are different everywhere, with a hole."""

    def read(self, top, left, height, width):
        y, x = np.mgrid[top : top + height, left : left + width]
        return np.where((y > 20) & (x > 15) & (x < 40), np.nan, 1000.0 * y + x).astype(np.float32)


def test_holes_take_the_nearest_height_and_weights_rise_beside_them():
    source, hole, weight = _window(Plane(), 0, 0, 50, 60, 3, {})
    assert_array_equal(source[30, 14:18], [30014.0, 30015.0, 30015.0, 30015.0])
    assert_array_equal(source[19:23, 27], [19027.0, 20027.0, 20027.0, 20027.0])
    assert_allclose(weight[30, 11:17], [1.0, 1.0, 20 / 27, 7 / 27, 0.0, 0.0], atol=1e-6)
    assert_allclose(weight[16:22, 27], [1.0, 1.0, 20 / 27, 7 / 27, 0.0, 0.0], atol=1e-6)
    assert hole[30, 16] and not hole[30, 15]


def test_a_window_cut_from_a_wider_one_is_the_window_read_alone():
    layer, windows = Plane(), {}
    for part, kept in (((0, 0, 50, 60), 0), ((9, 7, 30, 40), 0), ((9, 7, 30, 60), 7), ((12, 9, 10, 5), 7)):
        cut, alone = _window(layer, *part, 3, windows), _window(layer, *part, 3, {})
        assert all(np.array_equal(one, other) for one, other in zip(cut[:2], alone[:2], strict=True))
        assert not cut[1].any() or (np.array_equal(cut[2], alone[2]) and cut[2].min() == 0.0 and cut[2].max() == 1.0)
        assert windows[layer][1] == kept
