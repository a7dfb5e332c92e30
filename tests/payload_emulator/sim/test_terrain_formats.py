"""Rasters: pixels, registration, detail; and as their publishers write them, from PDS3 to JPEG 2000."""

import math
from math import radians

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx, mark, raises

from lunar.catalogue import load_catalogue, make_catalogue, save_catalogue
from lunar.constants import MOON_RADIUS_M
from lunar.datafolder import DataFolder, find_data
from payload_emulator.errors import TerrainError
from payload_emulator.sim.terrain import kernels
from payload_emulator.sim.terrain.albedo import open_albedo
from payload_emulator.sim.terrain.opening import open_terrain
from payload_emulator.sim.terrain.raster import RasterTerrain, _window
from payload_emulator.sim.terrain.rasters import CHUNK_LIMIT_OCTETS, ChunkCache, RasterFile, open_layers
from tests.lazy import Lazy
from tests.payload_emulator.sim.rasters import write_raster

rasterio, warp = Lazy("rasterio"), Lazy("rasterio.warp")

MOON = "+proj=longlat +R=1737400 +no_defs"
NONE = make_catalogue([], [], [], source="none")
AS_IT_IS = {"sharpen": False, "registration_north_m": 0.0, "smoothing_pixels": 0.0}
METRES_PER_DEGREE = radians(MOON_RADIUS_M)


def plane(latitude, longitude):
    """Heights in m that resampling leaves alone."""
    return 100.0 * latitude + 50.0 * longitude - 2000.0


def grid(west=8.0, north=22.0, rows=160, columns=160, ppd=16):
    latitude = north - (np.arange(rows) + 0.5) / ppd
    longitude = west + (np.arange(columns) + 0.5) / ppd
    return latitude[:, None], longitude[None, :]


def write_pds3(
    stem, values, kind="PC_REAL", unit="KILOMETER", offset=0, middle_deg=180.0, west=8.0, north=22.0, ppd=16
):
    """An image with a detached label, keywords as in the labels of LOLA's and LROC's archives."""
    rows, columns = values.shape
    bits = values.dtype.itemsize * 8
    label = f"""PDS_VERSION_ID            = "PDS3"
RECORD_TYPE               = FIXED_LENGTH
FILE_RECORDS              = {rows}
RECORD_BYTES              = {columns * bits // 8}
^IMAGE                    = "{stem.name}.IMG"
TARGET_NAME               = MOON
OBJECT                    = IMAGE
  LINES                   = {rows}
  LINE_SAMPLES            = {columns}
  SAMPLE_TYPE             = {kind}
  SAMPLE_BITS             = {bits}
  UNIT                    = {unit}
  SCALING_FACTOR          = 1
  OFFSET                  = {offset}
END_OBJECT                = IMAGE
OBJECT                    = IMAGE_MAP_PROJECTION
  MAP_PROJECTION_TYPE     = "SIMPLE CYLINDRICAL"
  MAP_RESOLUTION          = {ppd:.1f} <PIXEL/DEGREE>
  MAP_SCALE               = {METRES_PER_DEGREE / ppd / 1000.0:.12f} <KM/PIXEL>
  A_AXIS_RADIUS           = 1737.4 <KILOMETER>
  B_AXIS_RADIUS           = 1737.4 <KILOMETER>
  C_AXIS_RADIUS           = 1737.4 <KILOMETER>
  POSITIVE_LONGITUDE_DIRECTION = "EAST"
  CENTER_LATITUDE         = 0.0 <DEGREE>
  CENTER_LONGITUDE        = {middle_deg} <DEGREE>
  LINE_PROJECTION_OFFSET  = {north * ppd - 0.5}
  SAMPLE_PROJECTION_OFFSET = {(middle_deg - west) * ppd - 0.5}
  MAXIMUM_LATITUDE        = {north} <DEGREE>
  MINIMUM_LATITUDE        = {north - rows / ppd} <DEGREE>
  WESTERNMOST_LONGITUDE   = {west} <DEGREE>
  EASTERNMOST_LONGITUDE   = {west + columns / ppd} <DEGREE>
END_OBJECT                = IMAGE_MAP_PROJECTION
END
"""
    stem.with_suffix(".LBL").write_text(label.replace("\n", "\r\n"))
    values.tofile(stem.with_suffix(".IMG"))
    return stem.with_suffix(".LBL")


def write_tiff(path, transform, values, crs, **profile):
    settings = {"driver": "GTiff", "count": 1, "dtype": values.dtype.name} | profile
    with rasterio.open(
        path, "w", width=values.shape[1], height=values.shape[0], crs=crs, transform=transform, **settings
    ) as target:
        target.write(values, 1)
    return path


def heights_agree(terrain, latitude, longitude, within_m):
    found = terrain.height_m(np.radians(latitude), np.radians(longitude))
    assert_allclose(found, plane(latitude, longitude), atol=within_m)


@mark.parametrize(
    "unit, offset, middle_deg", [("KILOMETER", 1737.4, 180.0), ("KILOMETER", 0, 0.0), ("METER", 1_737_400, 0.0)]
)
def test_the_unit_of_a_label_holds_without_and_with_an_offset(tmp_path, unit, offset, middle_deg):
    """The labels of SLDEM2015 give OFFSET = 1737.4 and kilometres, and count longitudes from 180 degrees."""
    values = (plane(*grid()) / (1000.0 if unit == "KILOMETER" else 1.0)).astype("<f4")
    path = write_pds3(tmp_path / "A", values, "PC_REAL", unit, offset, middle_deg)
    # Single precision of 2 km in kilometres is 0.1 mm; pixels from projected metres are good to a millimetre.
    heights_agree(RasterTerrain([path], NONE, **AS_IT_IS), np.array([14.3, 17.1]), np.array([12.2, 15.9]), 0.05)


def test_gld100_metres_of_16_bits_with_holes(tmp_path):
    latitude, longitude = grid()
    values = np.rint(plane(latitude, longitude)).astype("<i2")
    values[(np.abs(latitude - 15.0) < 0.2) & (np.abs(longitude - 13.0) < 0.2)] = -32768
    fine = write_pds3(tmp_path / "GLD", values, "LSB_INTEGER", "METER", 1_737_400)
    coarse = write_tiff(
        tmp_path / "c.tif",
        rasterio.Affine(0.25, 0, 0.0, 0, -0.25, 30.0),
        plane(*grid(0.0, 30.0, 120, 120, 4)).astype("float32"),
        MOON,
    )
    terrain = RasterTerrain([fine], NONE, coarse_paths=[coarse], **AS_IT_IS)
    # Whole metres, and the hole from pixels of 7.6 km.
    heights_agree(terrain, np.array([17.1, 15.0]), np.array([15.9, 13.0]), 3.0)
    alone = RasterTerrain([fine], NONE, **AS_IT_IS)
    with raises(TerrainError, match=r"expected heights at latitude .*, found none"):
        alone.height_m(radians(15.0), radians(13.0))


def test_projected_metres_join_across_tiles_whose_pixels_do_not_divide_the_degree(tmp_path):
    # LROC's products of 100 m have 303.23 pixels per degree; tiles of 90 degrees are 27,291.02 pixels wide.
    step, rows, columns = 100.0, 60, 27_291
    north = 0.5 * rows * step
    values = np.repeat(np.rint(north - (np.arange(rows) + 0.5) * step)[:, None], columns, axis=1).astype("int16")
    crs = "+proj=eqc +lat_ts=0 +lat_0=0 +lon_0=180 +x_0=0 +y_0=0 +R=1737400 +units=m +no_defs"
    paths = []
    for name, west in (("w", 270.0), ("e", 0.0)):
        transform = rasterio.Affine(step, 0, (west - 180.0) * METRES_PER_DEGREE, 0, -step, north)
        paths.append(write_tiff(tmp_path / f"{name}.tif", transform, values, crs, compress="deflate"))
    (layer,) = open_layers(paths)
    first_row, turn = round(90.0 * layer.pixels_per_degree) - rows // 2, round(layer.turn)
    for first_column in (turn - 6, -6, 2 * turn - 6):
        window = layer.read(first_row, first_column, rows, 12)
        # The file's own rows, the same in the columns on both sides of the meridian: nothing lost between the tiles.
        assert_array_equal(window, np.repeat(values[:, :1], 12, axis=1))
    places = np.radians([-0.05, 0.05]), np.radians([359.9999, 90.1])
    assert layer.holds(*places).tolist() == [True, False]


def test_jpeg_2000_of_16_bits_is_decoded_once_until_the_kept_pixels_are_damaged(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kept"))
    values = np.rint(plane(*grid())).astype("int16")
    path = write_tiff(
        tmp_path / "a.jp2", rasterio.Affine(1 / 16, 0, 8.0, 0, -1 / 16, 22.0), values,
        MOON, driver="JP2OpenJPEG", quality="100", reversible="YES"
    )  # fmt: skip
    heights_agree(RasterTerrain([path], NONE, **AS_IT_IS), np.array([14.3]), np.array([12.2]), 1.0)
    (kept,) = (tmp_path / "kept-ground").glob("pixels-*")
    (layer,) = open_layers([path])
    with monkeypatch.context() as patch:
        patch.setattr(RasterFile, "opened", None)
        assert_array_equal(layer.read(68 * 16, 8 * 16, 160, 160), values)
    kept.write_bytes(kept.read_bytes()[:-1] + b"?")
    assert_array_equal(open_layers([path])[0].read(68 * 16, 8 * 16, 160, 160), values)


def test_decoded_pixels_stay_within_their_limit_after_a_week_of_passes():
    chunks, newest, chunk = ChunkCache(), 7 * 13 * 90, np.zeros((1024, 1024), np.float32)
    for number in range(newest + 1):
        chunks.put((0, 0, number, 0), chunk)
    held = [number for number in range(newest + 1) if chunks.get((0, 0, number, 0)) is not None]
    assert held == list(range(newest - 5, newest + 1))
    assert chunks.octets == CHUNK_LIMIT_OCTETS == len(held) << 22


def test_reflectance_tiles_are_averaged_over_the_grid_and_relative_to_their_median(tmp_path):
    ppd = 64
    latitude, longitude = grid(300.0, 10.0, 640, 640, ppd)
    checks = 0.02 * np.where((np.arange(640)[:, None] + np.arange(640)[None, :]) % 2, 1.0, -1.0)
    values = (np.where(longitude < 305.0, 0.03, 0.06) + checks + 0.0 * latitude).astype("<f4")
    values[:32] = -3.4028227e38  # missing in the archive's floating-point images
    albedo = open_albedo([write_pds3(tmp_path / "WAC", values, unit="N/A", west=300.0, north=10.0, ppd=ppd)])
    places = np.radians(np.linspace(8.0, 2.0, 13)), np.radians(np.linspace(301.0, 309.0, 17))
    found = albedo.relative(*places)
    median = float(np.median(values[32:][values[32:] > 0]))
    assert_allclose(found[:, :7], 0.03 / median, rtol=0.03)
    assert_allclose(found[:, -7:], 0.06 / median, rtol=0.03)
    assert_array_equal(albedo.relative(np.radians([9.9, 9.8]), np.radians([304.0, 306.0])), 1.0)


def test_a_folder_with_sldem2015_uses_it_before_gld100(tmp_path):
    (tmp_path / "dem").mkdir()
    (tmp_path / "craters").mkdir()
    values = (plane(*grid()) / 1000.0).astype("<f4")
    write_pds3(tmp_path / "dem/SLDEM2015_256_0N_60N_000_120_FLOAT", values, offset=1737.4)
    (tmp_path / "craters/lunar_crater_database_robbins_2018.csv").write_text(
        "CRATER_ID,LAT_CIRC_IMG,LON_CIRC_IMG,LAT_ELLI_IMG,LON_ELLI_IMG,DIAM_CIRC_IMG,DIAM_CIRC_SD_IMG,ARC_IMG\n"
        "00-1-000000,15.0,12.0,15.0,12.0,6.5,0.1,0.9\n00-1-000001,16.0,360.0,16.0,360.0,9.5,0.1,0.9\n"
    )
    terrain = open_terrain("raster", find_data(tmp_path), 1)
    assert terrain.name == "SLDEM2015"
    assert terrain.catalogue.diameter_m.tolist() == [6500.0, 9500.0]
    assert any("SLDEM2015" in name for name in terrain.data_names)
    # Its own resolution is finer than the smallest crater that could be stamped: it is left as it stands.
    heights_agree(terrain, np.array([14.3]), np.array([12.2]), 0.05)
    assert len(terrain.small_craters(np.radians([14.0, 15.0]), np.radians([12.0, 13.0]))) == 0


PLACES = np.array([75.3, 77.9, 79.2]), np.array([18.2, 21.7, 15.4])


def ground(latitude, longitude):
    """Heights in m, smooth and of more relief than any unit hides."""
    return 1500.0 * np.cos(np.radians(6.0 * latitude)) + 800.0 * np.sin(np.radians(5.0 * longitude))


def radius(height):
    return height + 1_737_400.0


def write_form(
    path, crs=MOON, west=10.0, wide=1 / 16, high=1 / 16, scale=1.0, convert=lambda h: h, dtype="float32",
    unit=None, scales=None, count=1, nodata=None, edge=None, mask=False
):  # fmt: skip
    """The ground from 72 to 82 N and 10 to 25 E as a raster in longitude and latitude times ``scale``, in one form."""
    rows, columns = round(10 / abs(high)), round(15 / wide)
    latitude = 82.0 - (np.arange(rows) + 0.5) * abs(high)
    longitude = 10.0 + (np.arange(columns) + 0.5) * wide
    values = convert(ground(latitude[:, None], longitude[None, :]))
    if edge is not None:
        values[:8] = edge
    if high < 0:
        values = values[::-1]
    start = 82.0 if high > 0 else 72.0
    transform = rasterio.Affine(wide * scale, 0, west * scale, 0, -high * scale, start * scale)
    shape = {"width": columns, "height": rows, "count": count, "dtype": dtype, "nodata": nodata}
    with rasterio.open(path, "w", driver="GTiff", crs=crs, transform=transform, **shape) as target:
        for band in range(1, count + 1):
            target.write(values.astype(dtype), band)
        if unit:
            target.units = (unit,) * count
        if scales:
            target.scales, target.offsets = (scales[0],), (scales[1],)
        if mask:
            target.write_mask((np.arange(rows) >= 8)[:, None] & np.ones((rows, columns), bool))
    return path


@mark.parametrize(
    "form",
    [
        {}, {"convert": radius, "dtype": "float64"}, {"convert": radius},
        {"convert": lambda h: h / 1e3 + 1_737.4, "dtype": "float64"}, {"convert": lambda h: h / 1e3, "unit": "km"},
        {"convert": lambda h: h / 1e3 + 1_737.4, "unit": "km"}, {"convert": lambda h: h / 0.3048, "unit": "ft"},
        {"convert": lambda h: h * 3937 / 1200, "unit": "US survey foot"},
        {"convert": lambda h: h * 10.0, "unit": "dm"},
        {"convert": lambda h: np.rint(2 * h), "dtype": "int16", "scales": (0.5, 0.0)},
        {"convert": lambda h: np.rint(2 * h), "dtype": "int16", "scales": (0.5, 1_737_400.0)},
        {"convert": lambda h: h / 1e3, "scales": (1.0, 1_737.4)},
        {"convert": np.rint, "dtype": "int16", "edge": -32768}, {"edge": -32768.0}, {"edge": -99_999.0},
        {"edge": 1e20}, {"edge": np.nan}, {"edge": 0.0, "mask": True}, {"edge": 5.0, "nodata": 5.0},
        {"west": -350.0}, {"west": 370.0}, {"crs": "+proj=longlat +R=1737400 +pm=180", "west": -170.0},
        {"crs": "+proj=eqc +R=1737400 +units=km", "scale": METRES_PER_DEGREE / 1e3},
        {"crs": "+proj=eqc +R=1737400 +lon_0=180", "scale": METRES_PER_DEGREE, "west": -170.0},
        {"crs": "+proj=eqc +R=1737400", "scale": METRES_PER_DEGREE, "west": -350.0}, {"high": 1 / 32},
        {"high": -1 / 16}
    ]
)  # fmt: skip
def test_a_form_of_the_same_ground_gives_the_same_heights(tmp_path, form):
    found = RasterTerrain([write_form(tmp_path / "a.tif", **form)], NONE, **AS_IT_IS).height_m(*np.radians(PLACES))
    # Half a metre of whole and half metres, and what one pixel of 1.9 km bends.
    assert_allclose(found, ground(*PLACES), atol=1.0)


@mark.parametrize(
    "form, message",
    [
        ({"convert": lambda h: h / 1e3}, r"differ by 3 m .* found 0\.\d+ .* no unit stated\): kilometres"),
        ({"convert": lambda h: h * 1e3}, r"expected heights of -9200 to 10800 m .* found -\d+ to \d\.\d+e\+06"),
        ({"convert": lambda h: h / 1e3 + 1_737.4, "unit": "m"}, None),
        ({"convert": lambda h: 30.0 * h}, "expected heights of -9200 to 10800 m"),
        ({"unit": "K"}, "in a unit of length .* found 'k'"),
        ({"count": 2}, "one band of heights of 16 bits or more, found 2 of float32"),
        ({"convert": lambda h: h / 20 + 120, "dtype": "uint8"}, "found 1 of uint8: a picture"),
        ({"crs": "+proj=longlat +a=1738100 +b=1736000 +no_defs"}, "found an ellipsoid of 1738.1 by 1736.0 km"),
        ({"crs": "+proj=longlat +R=1738000 +no_defs"}, r"a sphere of 1737\.4 km, found one of 1738\.000 km"),
        ({"crs": "EPSG:4326"}, r"a\.tif: expected a raster of the Moon .* found a body of 6378"),
    ],
)
def test_a_raster_with_another_unit_zero_or_body_is_refused_with_both_numbers(tmp_path, form, message):
    path = write_form(tmp_path / "a.tif", **form)
    if message is None:
        # What a file states of its unit counts: this ground is flat, at 1,737 m.
        assert_allclose(RasterTerrain([path], NONE, **AS_IT_IS).height_m(*np.radians(PLACES)), 1737.4, atol=2.0)
        return
    with raises(TerrainError, match=message):
        RasterTerrain([path], NONE, **AS_IT_IS).height_m(*np.radians(PLACES))


@mark.parametrize(
    "convert, message",
    [
        (lambda h: h, None),
        (lambda h: 2.0 * h, "found 2 times their relief"),
        (lambda h: h / 0.3048, "found 3.28 times their relief"),
        (lambda h: 0.5 * h, "found 0.5 times their relief"),
        (lambda h: h - 600.0, "-600 m above them"),
    ],
)
def test_heights_of_the_form_of_the_coarse_relief_have_its_scale_and_zero(tmp_path, convert, message):
    fine = write_form(tmp_path / "fine.tif", convert=convert)
    (relief,) = open_layers([write_form(tmp_path / "coarse.tif", wide=1 / 4, high=1 / 4)])
    (layer,) = open_layers([fine], relief=relief)
    if message is None:
        layer.read(128, 160, 160, 240)
        assert "1.00 times the relief of coarse.tif" in layer.readings[0]
        return
    with raises(TerrainError, match=message):
        layer.read(128, 160, 160, 240)


def test_a_layer_says_how_the_values_of_its_files_are_taken(tmp_path):
    (layer,) = open_layers([write_form(tmp_path / "a.tif", convert=radius, edge=-32768.0)])
    layer.read(128, 160, 160, 240)
    (words,) = layer.readings
    assert "a.tif: unit not stated, scale 1, zero 0, no data None; values of 17" in words
    assert "as radii in metres; -32768 (not stated) as no data" in words


@mark.parametrize(
    "crs",
    [
        "+proj=stere +lat_0=90 +R=1737400",
        "+proj=stere +lat_0=90 +lon_0=100 +R=1737400 +units=km",
        "+proj=laea +lat_0=78 +lon_0=17 +R=1737400",
        "+proj=sinu +lon_0=17 +R=1737400",
    ],
)
def test_any_projection_that_gdal_knows_is_read_at_its_places(tmp_path, crs):
    step, size = (1.0 if "km" in crs else 1_000.0), 900
    (x,), (y,) = warp.transform(MOON, crs, [17.0], [77.5])
    transform = rasterio.Affine(step, 0, x - 0.5 * size * step, 0, -step, y + 0.5 * size * step)
    column, row = np.meshgrid(np.arange(size) + 0.5, np.arange(size) + 0.5)
    across, down = transform.c + step * column, transform.f - step * row
    east, north = map(np.array, warp.transform(crs, MOON, across.ravel(), down.ravel()))
    values = ground(north, east).reshape(size, size).astype("float32")
    terrain = RasterTerrain([write_tiff(tmp_path / "a.tif", transform, values, crs)], NONE, **AS_IT_IS)
    # Two resamplings of pixels of 1 km.
    assert_allclose(terrain.height_m(*np.radians(PLACES)), ground(*PLACES), atol=1.0)
    assert terrain.covers(*np.radians([(77.5, 10.0), (17.0, 200.0)])).tolist() == [True, False]


def test_a_polar_map_holds_the_pole_and_nothing_beyond_its_edge(tmp_path):
    transform = rasterio.Affine(1e4, 0, -3e5, 0, -1e4, 3e5)
    values = np.arange(3600, dtype="float32").reshape(60, 60)
    (layer,) = open_layers([write_tiff(tmp_path / "a.tif", transform, values, "+proj=stere +lat_0=-90 +R=1737400")])
    latitude, longitude = np.radians([-90.0, -81.0, -79.5, -79.5]), np.radians([0.0, 271.0, 45.0, 0.0])
    assert layer.holds(latitude, longitude).tolist() == [True, True, True, False]


@mark.parametrize(
    "line, message",
    [
        ('POSITIVE_LONGITUDE_DIRECTION = "WEST"', "expected longitudes to the east, found"),
        ("MAP_PROJECTION_ROTATION = 90.0", "expected MAP_PROJECTION_ROTATION = 0"),
    ],
)
def test_a_label_whose_axes_gdal_does_not_read_is_refused(tmp_path, line, message):
    path = write_pds3(tmp_path / "A", np.zeros((32, 32), "<i2"), "LSB_INTEGER", "METER", 0, 0.0)
    label = path.read_text().replace('POSITIVE_LONGITUDE_DIRECTION = "EAST"', line)
    path.write_text(label)
    with raises(TerrainError, match=message):
        open_layers([path])


def test_a_map_is_read_alike_on_both_sides_of_the_meridian_where_pixels_do_not_divide_the_circle(tmp_path):
    # 250 m: a turn has 43,665.6 pixels.
    step, size, path = 250.0, 960, tmp_path / "a.tif"
    west = -0.5 * size * step
    transform = rasterio.Affine(step, 0, west, 0, -step, 0.5 * size * step)
    longitude = np.degrees((west + (np.arange(size) + 0.5) * step) / MOON_RADIUS_M)
    values = np.repeat((2000.0 * longitude)[None, :], size, axis=0).astype("float32")
    write_tiff(path, transform, values, "+proj=eqc +R=1737400")
    terrain = RasterTerrain([path], NONE, **AS_IT_IS)
    longitude = np.array([-1.2, -0.3, -0.01, 0.0, 0.02, 0.7, 1.3])
    for turn in (0.0, 360.0):
        found = terrain.height_m(np.zeros(7), np.radians(longitude + turn))
        # 0.07 m of 2000 m in a degree are a metre on the ground.
        assert_allclose(found, 2000.0 * longitude, atol=0.07)


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
    place = radians(15.0), radians(14.0)
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
    terrain = RasterTerrain([west, write_raster(tmp_path / "e.tif", 0.0, 8.0, 8.0, hills)], NONE, **AS_IT_IS)
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
    assert terrain.covers(np.radians(latitude), np.radians(longitude)).tolist() == [True, False, False]
    assert_allclose(terrain.height_m(np.radians(latitude), np.radians(longitude)), slope(latitude, longitude), atol=0.5)


def test_sharpening_is_seeded_and_adds_what_the_raster_cannot_hold(tmp_path):
    path = write_raster(tmp_path / "a.tif", 10.0, 20.0, 8.0, slope)
    latitude, longitude = np.radians(np.linspace(15.0, 15.3, 300)), np.radians(14.0)
    first, again, other = (
        RasterTerrain([path], NONE, seed=seed, registration_north_m=0.0).height_m(latitude, longitude)
        for seed in (1, 1, 2)
    )
    assert_array_equal(first, again)
    assert np.std(first - other) > 1.0


def test_a_raster_that_is_missing_damaged_or_without_georeference_is_named(tmp_path):
    from PIL import Image

    path = tmp_path / "plain.png"
    Image.fromarray(np.zeros((8, 8), np.uint8)).save(path)
    with raises(TerrainError, match=r"plain\.png: expected a georeferenced raster"):
        open_layers([path])
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


def test_holes_take_the_nearest_height_and_weights_rise_away_from_them():
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
