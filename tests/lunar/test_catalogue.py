"""Crater catalogues: the spatial index against brute force, the published files, our own file."""

import gzip
import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal
from pytest import approx, mark, raises

from lunar import catalogue
from lunar.catalogue import (
    PAPER_CLASS_COUNTS,
    class_counts,
    completed_to_paper,
    load_catalogue,
    make_catalogue,
    paper_density_catalogue,
    save_catalogue,
    size_class,
)
from lunar.constants import MOON_RADIUS_M
from lunar.errors import DataFileError, LunarError


def random_catalogue(n, seed=0):
    rng = np.random.default_rng(seed)
    return make_catalogue(
        np.arcsin(rng.uniform(-1, 1, n)), rng.uniform(-np.pi, np.pi, n), rng.uniform(3e3, 30e3, n), source="random",
        rim_height_m=np.where(rng.random(n) < 0.5, np.nan, rng.uniform(-3e3, 3e3, n)),
    )  # fmt: skip


CATALOGUE = random_catalogue(5000)


def distances_m(latitude, longitude):
    other, apart = CATALOGUE.latitude_rad, CATALOGUE.longitude_rad - longitude
    h = np.sin((other - latitude) / 2) ** 2 + np.cos(latitude) * np.cos(other) * np.sin(apart / 2) ** 2
    return 2 * MOON_RADIUS_M * np.arcsin(np.sqrt(np.clip(h, 0, 1)))


@given(st.floats(-math.pi / 2, math.pi / 2), st.floats(-7.0, 7.0), st.floats(0.0, 5.6e6))
def test_the_index_finds_what_brute_force_finds(latitude, longitude, radius_m):
    distance = distances_m(latitude, longitude)
    found = CATALOGUE.near(latitude, longitude, radius_m)
    assert np.all(np.diff(found) > 0)
    # A millimetre either side of the radius may go either way; near the far side haversine is good to 0.1 m.
    slack = 1e-3 if radius_m < 5e6 else 1.0
    assert set(np.flatnonzero(distance < radius_m - slack)) <= set(found)
    assert set(found) <= set(np.flatnonzero(distance < radius_m + slack))


@mark.parametrize("place_deg", [(0.0, 0.0), (0.0, 360.0), (10.0, -0.1), (90.0, 12.0), (-89.5, 200.0)])
def test_the_index_holds_over_the_meridian_and_at_the_poles(place_deg):
    latitude, longitude = np.radians(place_deg)
    distance = distances_m(latitude, longitude)
    found = CATALOGUE.near(latitude, longitude, 200e3)
    assert len(found) > 3
    assert np.array_equal(found, np.flatnonzero(distance <= 200e3))


def test_classes_hold_their_limits_positions_stand_at_rim_height_and_nothing_answers_with_nothing():
    empty = CATALOGUE.select(np.zeros(0, dtype=bool))
    assert (len(empty), empty.near(0.0, 0.0, 1e6).shape, empty.position_mcmf_m.shape) == (0, (0,), (0, 3))
    assert class_counts(empty).tolist() == [0, 0, 0]
    assert len(CATALOGUE.select([])) == 0
    diameters = [2999.9, 3000, 4999.9, 5000, 9999.9, 10_000, 14_999.9, 15_000, 30_000, 30_000.1, np.nan]
    assert size_class(diameters).tolist() == [-1, 3, 3, 0, 0, 1, 1, 2, 2, -1, -1]
    assert size_class(7000.0).shape == ()
    radius = np.linalg.norm(CATALOGUE.position_mcmf_m, axis=1)
    assert np.isnan(radius).any()
    assert np.allclose(radius, MOON_RADIUS_M + CATALOGUE.rim_height_m, atol=1e-6, equal_nan=True)


def test_our_own_file_gives_back_what_was_saved(tmp_path):
    path = tmp_path / "own.csv"
    save_catalogue(CATALOGUE, path)
    back = load_catalogue(path)
    assert np.array_equal(back.ids, CATALOGUE.ids)
    # 1e-9 deg is 30 um on the ground.
    assert np.max(np.abs(back.latitude_rad - CATALOGUE.latitude_rad)) * MOON_RADIUS_M < 1e-4
    assert np.max(np.abs(back.diameter_m - CATALOGUE.diameter_m)) <= 5.1e-4
    assert np.array_equal(np.isnan(back.rim_height_m), np.isnan(CATALOGUE.rim_height_m))
    assert np.all(np.isnan(back.depth_m))
    assert back.complete.all()
    save_catalogue(back, tmp_path / "again.csv")
    assert (tmp_path / "again.csv").read_bytes() == path.read_bytes()


@mark.real_data
def test_published_catalogues_have_the_class_counts_of_their_readme(data_path):
    whole, composite, robbins = (
        load_catalogue(data_path / "craters" / name)
        for name in ("lu1319381_ge2km.csv.gz", "composite_ge5km.csv.gz", "lunar_craters_ge20km.csv")
    )
    for complete in (whole, composite.select(composite.complete)):
        assert class_counts(complete).tolist() == [30_494, 6_677, 3_983]
    # 222,451 and 52,554 lines, of which four and two repeat the place and diameter of another.
    assert (len(whole), len(composite), len(robbins)) == (222_447, 52_552, 6_973)
    assert whole.longitude_rad.min() >= 0.0 and whole.longitude_rad.max() < 2 * np.pi
    assert np.nanmedian(whole.depth_m / whole.diameter_m) == approx(0.1, abs=0.05)
    assert robbins.diameter_m.min() >= 20e3


def test_the_synthetic_catalogue_has_the_papers_class_counts_and_is_the_same_again():
    catalogue = paper_density_catalogue(7)
    assert tuple(class_counts(catalogue)) == PAPER_CLASS_COUNTS
    again = paper_density_catalogue(7)
    assert np.array_equal(catalogue.latitude_rad, again.latitude_rad)
    # Imbrium's inner 400 km against the same area of far-side highland.
    mare, highland = (len(catalogue.near(*np.radians(p), 400e3)) for p in ((32.8, -15.6), (10.0, 180.0)))
    assert mare < 0.1 * highland


def test_completing_fills_the_empty_tiles_up_to_the_papers_counts():
    east = random_catalogue(3000, seed=3)
    east = east.select(east.longitude_rad < np.pi)
    whole = completed_to_paper(east, 1)
    assert tuple(class_counts(whole)) == PAPER_CLASS_COUNTS
    assert np.all(whole.longitude_rad[whole.ids < 0] >= np.pi)
    with raises(LunarError, match="empty tiles"):
        completed_to_paper(paper_density_catalogue(1), 1)


FAULTS = """
 | line 1: expected the column names
a,b/1,2 | line 1: expected the columns of a crater catalogue
lat,lon,diam/1,2 | line 2: expected 3 values, found 2
lat,lon,diam/1,2,3/1,2,x | line 3, column diam: expected a number, found 'x'
lat,lon,diam/91,2,3 | line 2: expected a latitude
lat,lon,diam/1,2,-3 | line 2: expected a diameter of 1 to 2600000 m, found -3000
lat,lon,diam/1,2,8200 | line 2: expected a diameter of 1 to 2600000 m, found 8200000
lat,lon,diam/1,nan,3 | line 2: expected a longitude
lat;lon;diam/1,5;2,5;3,5 | line 1: expected column names of a crater catalogue, separated by commas, found lat;lon;diam
id,lat,lon,diam/7,1,2,3/7,1,3,3 | lines 2 and 3, column id: expected an id of its own
"""


@mark.parametrize("row", FAULTS.strip("\n").splitlines())
def test_a_faulty_file_is_refused_with_file_line_and_what_was_found(tmp_path, row):
    text, place = row.split(" | ")
    path = tmp_path / "faulty.csv"
    path.write_text(text.replace("/", "\n"))
    with raises(DataFileError) as caught:
        load_catalogue(path)
    assert str(caught.value).startswith(f"{path}: {place}") and "\n" not in str(caught.value)


def test_a_missing_file_a_folder_and_a_cut_gzip_are_refused(tmp_path):
    cut = tmp_path / "cut.csv.gz"
    cut.write_bytes(gzip.compress(b"lat,lon,diam\n" + b"1,2,3\n" * 1000)[:-20])
    for path in (tmp_path / "none.csv", tmp_path, cut):
        with raises(DataFileError, match="expected"):
            load_catalogue(path)


@mark.parametrize("quote", ["", '"'])
def test_a_file_is_read_by_blocks_and_a_fault_has_its_line(tmp_path, monkeypatch, quote):
    rows = [f"{k},{k % 60}.25,{k}.5,{5000 + k},{quote}1{quote},,1" for k in range(200)]
    head = "id,latitude_deg,longitude_deg,diameter_m,rim_height_m,depth_m,complete"
    path = tmp_path / "c.csv"
    text = "\n".join([head, *rows])
    path.write_text(text + "\n")
    whole = load_catalogue(path)
    monkeypatch.setattr(catalogue, "BLOCK_OCTETS", 300)
    found = load_catalogue(path)
    assert len(found) == 200
    for name in ("ids", "latitude_rad", "longitude_rad", "diameter_m", "rim_height_m", "complete"):
        assert_array_equal(getattr(found, name), getattr(whole, name))
    path.write_text(text.replace(",5150,", ",x,"))
    with raises(DataFileError, match="line 152, column diameter_m"):
        load_catalogue(path)
    monkeypatch.setattr(catalogue, "ROWS_LIMIT", 199)
    path.write_text(text)
    with raises(DataFileError, match="at most 199 craters"):
        load_catalogue(path)


def test_blocks_of_a_composite_have_the_sources_and_numbers_of_the_whole(tmp_path, monkeypatch):
    rows = [f"{k % 60},{k},6.0,{'ab'[k > 50]},1" for k in range(100)]
    path = tmp_path / "c.csv"
    path.write_text("\n".join(["latitude_deg,longitude_deg,diameter_km,source,tile_complete", *rows]))
    monkeypatch.setattr(catalogue, "BLOCK_OCTETS", 300)
    found = load_catalogue(path)
    assert found.source == "composite of a, b" and found.ids.tolist() == list(range(100))


def test_quoted_values_are_read_too(tmp_path):
    path = tmp_path / "quoted.csv"
    path.write_text('"lat","lon","diam"\n"1.5","-10","25"\n')
    catalogue = load_catalogue(path)
    assert np.degrees(catalogue.longitude_rad) == approx([350.0])


OWN = """id,latitude_deg,longitude_deg,diameter_m,rim_height_m,depth_m,complete
1,-35.1,259.8,5931.0,112.0,1060.0,1
1,-36.2,260.3,8000.0,10.0,1200.0,1
2,-36.2,260.3,8000.0,10.0,1200.0,1
"""


@mark.parametrize("identity, old, new, message", [
    ("1", "", "", "lines 2 and 3, column id: expected an id of its own for each crater .* found 1 twice"),
    ("1.7", "", "", "line 3, column id: expected a whole number, found 1.7"),
    ("3", ",112.0,", ",1737512.0,", "line 2: expected a rim height"),
    ("3", ",1060.0,1", ",1060.0,yes", "line 2, column complete"),
    ("3", "depth_m,complete", "depth_m,depth_m", "line 1: expected each column once, found depth_m 2 times"),
])  # fmt: skip
def test_two_craters_of_one_id_and_impossible_values_are_refused(tmp_path, identity, old, new, message):
    path = tmp_path / "own.csv"
    path.write_text(OWN.replace("\n1,-36", f"\n{identity},-36").replace(old or "?", new))
    with raises(DataFileError, match=message):
        load_catalogue(path)


def test_a_crater_that_is_listed_twice_with_one_id_counts_once_and_a_worn_one_on_a_hill_is_read(tmp_path):
    path = tmp_path / "own.csv"
    path.write_text(OWN.replace("\n1,-36", "\n2,-36"))
    assert load_catalogue(path).ids.tolist() == [1, 2]
    path.write_text(OWN.replace("\n1,-36.2,260.3,8000.0,10.0,1200.0", "\n3,-36.4,260.3,8000.0,10.0,-8.0"))
    assert load_catalogue(path).depth_m.min() == -8.0


def test_craters_that_are_listed_twice_with_two_ids_count_once_and_are_reported(tmp_path, caplog):
    path = tmp_path / "own.csv"
    path.write_text(OWN.replace("\n1,-36", "\n3,-36"))
    assert load_catalogue(path).ids.tolist() == [1, 3]
    path.rename(tmp_path / "lu1319381_ge2km.csv")
    load_catalogue(tmp_path / "lu1319381_ge2km.csv")
    assert caplog.messages == [f"{path}: left out 1 of 3 craters, equal to one before but for the id"]


def test_ids_rim_heights_and_flags_are_read_in_every_list_that_has_them(tmp_path):
    path = tmp_path / "own.csv"
    path.write_text("id,lat,lon,diam\n70,1,2,3\n71,1,3,3\n")
    assert load_catalogue(path).ids.tolist() == [70, 71]
    path.write_text("id,latitude_deg,longitude_deg,diameter_m,depth_m,rim_height_m,complete\n1,2,3,4000,,-512.5,0\n")
    own = load_catalogue(path)
    path.write_text("id,latitude_deg,longitude_deg,diameter_m,depth_m,rim_height_m\n1,2,3,4000,,-512.5\n")
    assert own.rim_height_m == load_catalogue(path).rim_height_m == -512.5
    assert not own.complete.any() and load_catalogue(path).complete.all()


@mark.parametrize("column", ["latitude_deg", "longitude_deg", "diameter_m", "rim_height_m", "depth_m"])
@mark.parametrize("factor", [1e-3, 1e3, math.pi / 180.0])
def test_a_column_in_another_unit_is_refused(tmp_path, column, factor):
    rng = np.random.default_rng(3)
    diameter_m = 3_000.0 * (1.0 - rng.random(60)) ** -0.5
    table = {
        "id": np.arange(60), "latitude_deg": rng.uniform(20.0, 24.0, 60),
        "longitude_deg": rng.uniform(30.0, 34.0, 60), "diameter_m": diameter_m,
        "rim_height_m": rng.normal(-1_000.0, 800.0, 60), "depth_m": 0.15 * diameter_m, "complete": np.ones(60),
    }  # fmt: skip
    path = tmp_path / "own.csv"

    def written(values):
        rows = np.column_stack(list(values.values()))
        np.savetxt(path, rows, "%.9g", ",", header=",".join(values), comments="")
        return load_catalogue(path)

    assert len(written(table)) == 60
    changed = [column]
    if factor == math.pi / 180.0:
        if column not in ("latitude_deg", "longitude_deg"):
            return
        changed = ["latitude_deg", "longitude_deg"]  # angles come in one unit
    changes = {name: table[name] * factor for name in changed}
    with raises(DataFileError, match="expected"):
        written(table | changes)
