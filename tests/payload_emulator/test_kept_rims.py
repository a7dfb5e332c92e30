"""Tiles and measured rims are kept on disk and are never those of another ground."""

import os
from dataclasses import replace

import numpy as np
from numpy import array_equal
from numpy.testing import assert_allclose
from pytest import fixture

from lunar.catalogue import make_catalogue
from lunar.datafolder import DataFolder
from payload_emulator.session.scenario import Scenario
from payload_emulator.session.world import rims
from payload_emulator.session.world.rims import rims_of, sources_of
from payload_emulator.sim.terrain import tiles
from payload_emulator.sim.terrain.procedural import ProceduralTerrain

SCENARIO = Scenario(name="rims", seed=5)
ALL = np.arange(6)


@fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    opened().measured(ALL[:1])  # compiled code comes from its own folder
    # Ground lies next to the folder of compiled code, which builds under test read.
    monkeypatch.setattr("kernels.cache_folder", lambda: tmp_path / "code")
    return tmp_path / "code-ground"


def opened(sources="one", shift_rad=0.0):
    """Return a terrain with six craters in a row."""
    places = np.linspace(0.1, 0.11, 6)
    craters = make_catalogue(places + shift_rad, places, 4e3 + 2e6 * (places - 0.1), source="a row")
    terrain = ProceduralTerrain(5, cache_tiles=8, catalogue=craters)
    terrain.sources = sources
    return terrain


def makes_ground(terrain, craters=ALL):
    """Return whether the rims of these craters are measured."""
    rims_of(SCENARIO, terrain, craters)
    return bool(terrain._slots)


def test_rims_are_measured_once_and_again_for_other_ground(folder, monkeypatch):
    first, second = opened(), opened()
    found = rims_of(SCENARIO, first, ALL)
    assert not makes_ground(second)
    again = second.measured(ALL)
    assert array_equal(found.rim_height_m, again.rim_height_m)
    assert array_equal(found.depth_m, again.depth_m)
    assert array_equal(first.rim_tilts_m(ALL), second.rim_tilts_m(ALL))
    assert first.rim_tilts_m(ALL).all() and not second._slots

    monkeypatch.setattr("lunar.plausible.Limit.holds", lambda _, heights_m: heights_m > np.median(heights_m))
    assert np.isnan(rims_of(SCENARIO, second, ALL).depth_m).sum() == 5  # beyond the Moon's: unknown
    assert makes_ground(opened(sources="other"))
    assert makes_ground(opened(shift_rad=1e-9))
    assert makes_ground(opened(sources=""))  # not known
    assert makes_ground(opened(), ALL[1:])
    assert not makes_ground(opened())
    for file in folder.glob("rims-*"):
        file.write_bytes(file.read_bytes()[:-1])
    assert makes_ground(opened())


def test_tiles_are_made_once_and_again_for_other_ground(folder, monkeypatch):
    made, make = list[ProceduralTerrain](), ProceduralTerrain.make_heights

    def counted(terrain, *places):
        made.append(terrain)
        return make(terrain, *places)

    def tile(terrain, latitude_rad=0.1):
        patch = terrain.patch(latitude_rad, 0.1)
        return patch.heights[patch.table[0, 0]]

    monkeypatch.setattr(ProceduralTerrain, "make_heights", counted)
    first = opened()
    assert array_equal(tile(first), tile(opened()))
    assert made == [first]
    for terrain in (opened("other"), opened("one", 1e-9), opened(""), opened("")):  # two are not known
        tile(terrain)
        assert made.pop() is terrain
    for file in folder.glob("tile-*"):
        file.write_bytes(file.read_bytes()[:-1])
    damaged = opened()
    assert array_equal(tile(first), tile(damaged))
    assert made.pop() is damaged

    monkeypatch.setattr(tiles, "FILED_TILES", 1)
    monkeypatch.setattr(rims, "KEPT", 1)
    tile(damaged, 0.2)
    tile(opened(), 0.2)
    assert made == [first, damaged]
    rims_of(SCENARIO, first, ALL)
    rims_of(SCENARIO, first, ALL[1:])
    rims_of(SCENARIO, newest := opened(), ALL[1:])
    assert not newest._slots
    assert sorted(file.name[:5] for file in folder.iterdir()) == ["rims-", "tile-"]


def test_sources_change_with_the_seed_the_section_and_each_file_of_a_raster(tmp_path):
    raster, label = tmp_path / "heights.IMG", tmp_path / "heights.LBL"
    for file in (raster, label):
        file.write_bytes(b"heights")
    data = DataFolder(dem_sldem=(label,))
    texts = [sources_of(SCENARIO, data), sources_of(replace(SCENARIO, seed=6), data)]
    texts.append(sources_of(replace(SCENARIO, terrain=replace(SCENARIO.terrain, source="procedural")), data))
    os.utime(raster, ns=(0, 1))
    texts.append(sources_of(SCENARIO, data))
    raster.write_bytes(b"other heights")
    os.utime(raster, ns=(0, 1))
    texts.append(sources_of(SCENARIO, data))
    assert len(set(texts)) == len(texts)


def test_a_long_measurement_is_watched_in_parts_and_a_kept_one_is_not(monkeypatch):
    monkeypatch.setattr(rims, "PART", 4)
    seen = []

    def watched(parts):
        seen.extend(part.tolist() for part in parts)
        return parts

    whole = rims_of(SCENARIO, opened("other"), ALL)
    found = rims_of(SCENARIO, opened(), ALL, watched)
    assert seen == [[0, 1, 2], [3, 4, 5]]
    assert_allclose(found.rim_height_m, whole.rim_height_m, rtol=0, atol=1e-9)
    rims_of(SCENARIO, opened(), ALL, watched)
    assert len(seen) == 2
