"""Curation against a raster whose craters are known exactly."""

import math
from dataclasses import replace

import numpy as np
from pytest import approx, fixture, mark, raises

from lunar.catalogue import load_catalogue, make_catalogue
from lunar.datafolder import find_data
from payload_emulator.errors import TerrainError
from payload_emulator.sim.terrain.curation import CurationRules, RasterHeights, Region, curate
from tmtc.dictionary.tables import pack_catalogue_table, unpack_catalogue_table

RADIUS_M = 1_737_400.0
METRES_PER_DEG = math.radians(1.0) * RADIUS_M
WEST, SOUTH, SIZE_DEG = 300.0, 10.0, 6.0
# Registration of the craters in the raster to the list, east and north.
OFFSET_M = (-35.0, 60.0)
LIST_ERROR_M = 120.0


class Field:
    """Bowls with raised rims on a slope, at places the raster says, on pixels of 128 per degree."""

    def __init__(self, ppd=128.0, tilt=0.01):
        rng = np.random.default_rng(4)
        # One crater per cell of half a degree: none touches another.
        cells = np.arange(0.5, SIZE_DEG, 0.62)
        rows, columns = np.meshgrid(cells, cells, indexing="ij")
        self.latitude = SOUTH + rows.ravel()
        self.longitude = WEST + columns.ravel()
        self.diameter = rng.uniform(4_000.0, 9_000.0, self.latitude.size)
        self.depth = self.diameter * np.where(np.arange(self.latitude.size) % 10 == 3, 0.012, 0.12)
        self.rim = 0.2 * self.depth
        self.pixels_per_degree, self.tilt = ppd, tilt

    def base(self, latitude, longitude):
        return 800.0 + self.tilt * METRES_PER_DEG * (latitude - SOUTH)

    def window(self, south, north, west, east):
        ppd = self.pixels_per_degree
        top, left = math.ceil(north * ppd) / ppd, math.floor(west * ppd) / ppd
        rows, columns = round((top - south) * ppd) + 1, round((east - left) * ppd) + 1
        latitude = (top - np.arange(rows) / ppd)[:, None] * np.ones(columns)
        longitude = np.ones(rows)[:, None] * (left + np.arange(columns) / ppd)
        height = self.base(latitude, longitude)
        for lat, lon, d, depth, rim in zip(
            self.latitude, self.longitude, self.diameter, self.depth, self.rim, strict=True
        ):
            x = (longitude - lon) * METRES_PER_DEG * math.cos(math.radians(lat))
            y = (latitude - lat) * METRES_PER_DEG
            r = np.hypot(x, y) / (0.5 * d)
            inside = rim - depth * np.clip(1.0 - r**2, 0.0, None)
            height = height + np.where(r < 1.0, inside, rim * np.clip(r, 1.0, None) ** -4.0)
        outside = (latitude < SOUTH) | (latitude > SOUTH + SIZE_DEG)
        return np.where(outside, np.nan, height), top, left

    def listed(self, error_m=LIST_ERROR_M):
        """The list that goes with the raster: shifted as a whole, each centre and diameter a little wrong."""
        rng = np.random.default_rng(9)
        east, north = error_m * rng.standard_normal((2, self.latitude.size))
        latitude = self.latitude + (north - OFFSET_M[1]) / METRES_PER_DEG
        longitude = self.longitude + (east - OFFSET_M[0]) / METRES_PER_DEG / np.cos(np.radians(latitude))
        size = self.diameter * np.exp(0.04 * rng.standard_normal(self.diameter.size))
        return make_catalogue(np.radians(latitude), np.radians(longitude), size, source="list")


@fixture(scope="module")
def field():
    return Field()


@fixture(scope="module")
def curation(field):
    return curate(field.listed(), field)


def errors_m(field, curation):
    """Return kept centres less those of the raster, east and north."""
    table = curation.table
    rows = table.ids
    north = (np.degrees(table.latitude_rad) - field.latitude[rows]) * METRES_PER_DEG
    east = (np.degrees(table.longitude_rad) % 360.0 - field.longitude[rows]) * METRES_PER_DEG
    return np.stack([east * np.cos(table.latitude_rad), north], axis=1)


def test_the_shift_of_the_list_is_found_with_its_uncertainty(curation):
    # The list's own errors average out as 120 m / sqrt(n), n about 60 rims that tell.
    error = np.subtract(curation.offset_m, OFFSET_M)
    assert np.all(np.abs(error) < 3.0 * LIST_ERROR_M / math.sqrt(60.0))
    # The process adds the change of the shift over the region to that, and the floor of 10 m.
    assert 120.0 / math.sqrt(90.0) < curation.offset_sigma_m < 35.0
    assert 50 <= curation.registration.rims.sum() <= 90


def test_centres_sizes_and_rim_heights_are_refitted(field, curation):
    # A pixel is 237 m; 48 azimuths put the rim to a tenth of it, where the list is 120 m off.
    error = errors_m(field, curation)
    assert np.sqrt(np.mean(error**2)) < 30.0
    # Registration, 35 m and 60 m in this list, is no part of the table; half a pixel would be 118 m.
    assert np.all(np.abs(error.mean(axis=0)) < 10.0)
    rows = curation.table.ids
    assert np.median(np.abs(np.log(curation.table.diameter_m / field.diameter[rows]))) < 0.03
    rim = field.base(field.latitude[rows], field.longitude[rows]) + field.rim[rows]
    # One pixel of bilinear reading rounds a sharp crest off by some ten metres.
    assert np.abs(np.median(curation.table.rim_height_m - rim)) < 25.0


def test_craters_are_dropped_for_one_reason_shallow_without_terrain_or_below_a_deeper_one(field):
    listed = field.listed()
    curation = curate(listed, field)
    assert len(curation.table) + sum(curation.dropped.values()) == len(listed)
    shallow = set(np.flatnonzero(field.depth < 0.02 * field.diameter).tolist())
    assert not shallow & set(curation.table.ids.tolist())
    assert curation.dropped["shallow"] >= len(shallow)
    moved = replace(listed, latitude_rad=listed.latitude_rad + np.radians(20.0))
    with raises(TerrainError, match="expected heights under some of"):
        curate(moved, field)
    half = replace(listed, latitude_rad=listed.latitude_rad + np.radians(3.0))
    assert curate(half, field).dropped["no_terrain"] > 0
    listed = field.listed(error_m=0.0)
    twice = listed.select(np.r_[np.arange(len(listed)), [0]])
    twice = replace(twice, ids=np.arange(len(twice)))
    curation = curate(twice, field)
    assert curation.dropped["confusable"] == 1


def test_a_coarse_raster_is_corrected_for_low_rims_and_says_so(curation):
    coarse = Field(ppd=32.0)
    # One halving below 64 px/deg.
    assert curate(coarse.listed(), coarse).height_correction_m == approx(20.0)
    assert curation.height_correction_m == 0.0


def test_a_region_over_the_zero_meridian_holds_both_sides():
    region = Region(350.0, 370.0, -10.0, 10.0)
    inside = region.holds(np.zeros(4), np.radians([355.0, 5.0, 15.0, -5.0]))
    assert inside.tolist() == [True, True, False, True]


def test_the_table_survives_upload_and_its_sigmas_are_never_below_the_floor(curation):
    table = unpack_catalogue_table(pack_catalogue_table(curation.table))
    assert len(table) == len(curation.table)
    assert np.all(table.sigma_m[:, :2] >= CurationRules().centre_sigma_m)


@mark.real_data
def test_on_gld100_the_list_and_the_terrain_agree_to_half_a_pixel(data_path):
    data = find_data(data_path)
    tiles = [path for path in data.dem_tiles if "128ppd" in path.name]
    heights = RasterHeights(tiles)
    region = Region(285.0, 293.0, -22.0, -12.0)
    curation = curate(load_catalogue(data.catalogue_lu), heights, region, CurationRules(5_000.0))
    assert heights.pixels_per_degree == 128.0
    assert len(curation.table) > 20
    # A pixel is 237 m.
    assert np.hypot(*curation.offset_m) < 120.0
    assert abs(float(np.median(curation.table.rim_height_m))) < 4_000.0
