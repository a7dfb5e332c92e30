import math
from math import radians

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx, mark

from lunar.catalogue import class_counts, make_catalogue
from lunar.constants import MOON_RADIUS_M
from payload_emulator.sim.terrain.craters import SmallCraters
from payload_emulator.sim.terrain.procedural import ProceduralTerrain
from payload_emulator.sim.terrain.tiles import LEVELS, tile_angles


def test_the_classes_hold_the_papers_counts(procedural):
    # The paper, section V-B.2: 58,649 / 12,830 / 7,908 craters of 5-10, 10-15 and 15-30 km.
    assert class_counts(procedural.catalogue).tolist() == [58_649, 12_830, 7_908]
    assert np.count_nonzero(procedural.catalogue.diameter_m > 30e3) == 3_674


@mark.parametrize("level", [0, 2])
@mark.parametrize("row, column", [(16, 7), (18, -1)])
def test_neighbouring_tiles_repeat_each_others_edges(procedural, level, row, column):
    columns = 2 * procedural._level_rows[level]
    ppd = procedural._level_rows[level] * 512 / 180.0
    west = procedural.make_heights(*tile_angles(row, column % columns, ppd))
    east = procedural.make_heights(*tile_angles(row, (column + 1) % columns, ppd))
    south = procedural.make_heights(*tile_angles(row + 1, column % columns, ppd))
    # Craters are stamped in single precision from each tile's own corner: 1 cm.
    assert_allclose(west[:, 512:515], east[:, 0:3], atol=1e-2, rtol=0.0)
    assert_allclose(west[512:515, :], south[0:3, :], atol=1e-2, rtol=0.0)


def test_heights_depend_neither_on_what_was_asked_before_nor_on_the_tiles_that_are_kept(monkeypatch, drawn_moons):
    for name, draw in zip(("_plains_map", "_draw_catalogue"), drawn_moons, strict=True):
        monkeypatch.setattr(f"payload_emulator.sim.terrain.procedural.{name}", draw)
    latitude, longitude = np.radians(np.linspace(8.0, 12.0, 7)), np.radians(np.linspace(358.0, 362.0, 7))
    first = ProceduralTerrain(5, cache_tiles=8)
    monkeypatch.setattr("payload_emulator.sim.terrain.tiles.KEPT_TILES", 1)
    second = ProceduralTerrain(5, cache_tiles=8)
    forward = [first.height_m(a, b) for a, b in zip(latitude, longitude, strict=True)]
    monkeypatch.setattr("payload_emulator.sim.terrain.craters.KEPT_CELLS", 3)
    backward = [second.height_m(a, b) for a, b in zip(latitude[::-1], longitude[::-1], strict=True)]
    assert_array_equal(forward, backward[::-1])
    assert_array_equal(first.height_m(latitude, longitude), second.height_m(latitude, longitude))
    assert len(second._slots) <= 4 < len(first._slots)
    # Room that a wide view needed goes with its tiles.
    second.patch(latitude[3:], longitude[3:])
    assert len(second._slots) > 1
    second.release_ground()
    assert [second.height_m(one, one) is not None and len(second._slots) for one in (0.1, 0.5, 0.9)] == [1, 1, 1]
    assert len(second._small._cells) == 3


def test_small_craters_have_their_density_and_the_power_law_of_their_diameters():
    found = SmallCraters(3, 500.0, 2_000.0, 0.5, 2.2).around(*np.radians([[10.2, 11.8], [20.2, 21.8]]))
    latitude, longitude = np.degrees(found.latitude_rad), np.degrees(found.longitude_rad)
    inside = (latitude > 10.0) & (latitude < 12.0) & (longitude > 20.0) & (longitude < 22.0)
    diameter_m = 2.0 * found.radius_rad[inside] * MOON_RADIUS_M
    expected = 0.5 * (MOON_RADIUS_M / 1e3) ** 2 * radians(2.0) * (math.sin(radians(12.0)) - math.sin(radians(10.0)))
    assert diameter_m.size == approx(expected, abs=4.0 * math.sqrt(expected))
    share = (2.0**-2.2 - 4.0**-2.2) / (1.0 - 4.0**-2.2)  # over 1 km
    assert np.mean(diameter_m > 1_000.0) == approx(share, abs=4.0 * math.sqrt(share / expected))


def test_there_is_no_step_at_the_prime_meridian_and_other_seeds_are_other_worlds(procedural):
    latitude = np.radians(np.linspace(9.0, 11.0, 200))
    step = radians(0.5 / 256.0)
    across = procedural.height_m(latitude, 2.0 * math.pi - step) - procedural.height_m(latitude, step)
    nearby = procedural.height_m(latitude, step) - procedural.height_m(latitude, 3.0 * step)
    assert np.sqrt(np.mean(across**2)) < 2.0 * np.sqrt(np.mean(nearby**2)) + 1.0
    other = ProceduralTerrain(4)
    latitude, longitude = np.radians([10.0, 11.0]), np.radians([20.0, 21.0])
    assert np.abs(procedural.height_m(latitude, longitude) - other.height_m(latitude, longitude)).min() > 0.1


def test_craters_are_as_deep_as_they_were_drawn(procedural):
    drawn = procedural._shapes
    latitude, longitude = radians(10.0), radians(20.0)
    near = procedural.catalogue.near(latitude, longitude, 90e3)
    near = near[procedural.catalogue.diameter_m[near] > 4e3]
    measured = procedural.measured(near)
    assert near.size > 30
    ratio = (measured.depth_m - drawn.depth_m[near]) / measured.diameter_m
    # Others lie in and over most craters; the typical one keeps its depth to 3 % of its diameter.
    assert np.median(np.abs(ratio)) < 0.03


def test_levels_of_detail_show_the_same_ground(procedural):
    latitude, longitude = np.radians(np.linspace(9.2, 10.8, 60)), np.radians(np.linspace(19.2, 20.8, 60))
    fine = procedural.height_m(latitude, longitude, 0)
    for level in range(1, LEVELS):
        coarse = procedural.height_m(latitude, longitude, level)
        # What is left out is small craters and waves: tens of metres where they lie.
        assert np.median(np.abs(coarse - fine)) < 25.0


def test_craters_of_a_given_catalogue_stand_where_it_says():
    places = np.radians([[10.0, 10.4], [20.0, 20.6]])
    given = make_catalogue(*places, [8000.0, 12000.0], source="two", depth_m=[1500.0, np.nan])
    terrain = ProceduralTerrain(3, catalogue=given)
    assert terrain.catalogue is given
    assert "two" in terrain.name
    measured = terrain.measured(np.array([0, 1]))
    # The base's own relief and the drawn craters below 2 km move it by some tens of metres.
    assert measured.depth_m[0] == approx(1500.0, abs=200.0)
    assert measured.depth_m[1] > 50.0
