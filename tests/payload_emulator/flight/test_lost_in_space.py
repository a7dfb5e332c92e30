"""A place without a prior: found, or refused, on a small map; on-board tables: nothing damaged is taken for one."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import pairwise
from math import exp, nan, radians, sin, sqrt, tan

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy import cos, degrees, eye, log, pi
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx, fixture, mark, raises

from lunar.camera import PinholeCamera
from lunar.constants import MOON_RADIUS_M
from lunar.frames import enu_from_mcmf, mcmf_from_spherical
from payload_emulator.flight.navigation.search._fit_kernel import DetectedCraters, Image, Seen, log_evidence
from payload_emulator.flight.navigation.search.lost_in_space import (
    NADIR_NORTH_UP,
    LostParameters,
    _affordable,
    _work_space,
    candidate_places,
    find_place,
    place_index,
)
from payload_emulator.flight.navigation.sighting import LandmarkMap, landmark_map
from payload_emulator.flight.vision.detections import Detections, no_detections
from tmtc.dictionary.tables import (
    MAP_RADIUS_M,
    CatalogueTable,
    GravityTable,
    InitialState,
    pack_anchor_table,
    pack_catalogue_table,
    pack_gravity_table,
    pack_initial_state,
    pack_orientation_table,
    unpack_anchor_table,
    unpack_catalogue_table,
    unpack_gravity_table,
    unpack_initial_state,
    unpack_orientation_table,
)
from tmtc.errors import TableError

RADIUS_M = 1_737_400.0
CAMERA = PinholeCamera()
RULES = LostParameters(attitude_sigma_rad=radians(0.5))
SIGMA_PX = 1.4


def craters(west_deg=350.0, seed=1):
    """Craters of 5 to 30 km over 20 x 40 degrees, as dense as the paper's, on two kilometres of relief."""
    rng = default_rng(seed)
    area = radians(20.0) * 2.0 * sin(radians(20.0)) * RADIUS_M**2
    count = int(area * 2.09e-9)
    latitude = np.arcsin(rng.uniform(-1.0, 1.0, count) * sin(radians(20.0)))
    longitude = np.radians(west_deg + rng.uniform(0.0, 20.0, count))
    diameter = 5e3 * (1.0 - rng.uniform(size=count) * (1.0 - 6.0**-1.77)) ** (-1.0 / 1.77)
    height = 1_500.0 * np.sin(8.0 * longitude) * cos(6.0 * latitude)
    sigma = np.full((count, 3), 80.0)
    return landmark_map(CatalogueTable(np.arange(count), latitude, longitude, diameter, height, sigma))


@fixture(scope="module")
def index():
    return place_index(craters())


def frame(landmarks, latitude_deg, longitude_deg, altitude_m, seed, recall=0.6, false=3, tilt_deg=0.5):
    """A camera's place, and what it detects: projection written out here, apart from the code under test."""
    rng = default_rng(seed)
    latitude, longitude = radians(latitude_deg), radians(longitude_deg)
    place = mcmf_from_spherical(latitude, longitude, altitude_m)
    enu = enu_from_mcmf(latitude, longitude)
    away = (landmarks.position_mcmf_m - place) @ enu.T
    away = away[away[:, 2] < 0.0], landmarks.diameter_m[away[:, 2] < 0.0]
    east, north, depth = away[0][:, 0], away[0][:, 1], -away[0][:, 2]
    tilt = radians(tilt_deg) * rng.standard_normal(3)
    seen = np.stack([east, -north, depth], axis=1)
    seen = seen - np.cross(tilt, seen)
    f = 256.0 / tan(radians(60.0))
    u, v = 255.5 + f * seen[:, 0] / seen[:, 2], 255.5 + f * seen[:, 1] / seen[:, 2]
    size = away[1] * f / seen[:, 2]
    inside = (np.abs(u - 255.5) < 256.0) & (np.abs(v - 255.5) < 256.0) & (rng.uniform(size=u.size) < recall)
    count = int(inside.sum())
    uv = np.stack([u[inside], v[inside]], axis=1) + SIGMA_PX * rng.standard_normal((count, 2))
    uv = np.concatenate([uv, rng.uniform(0.0, 511.0, (false, 2))])
    size = np.concatenate([size[inside] * np.exp(0.05 * rng.standard_normal(count)), rng.uniform(20.0, 60.0, false)])
    total = count + false
    return place, Detections(uv[:, 0], uv[:, 1], size, rng.uniform(size=total), np.full(total, SIGMA_PX))


def searched(found, index):
    return find_place(found, found.sigma_px, index, CAMERA, RULES)


def changed(found, u, v):
    return Detections(u, v, found.diameter_px, found.score, found.sigma_px)


@mark.parametrize("altitude_m", [33e3, 40e3, 49e3])
@mark.parametrize("place_deg", [(3.0, 359.7), (-12.0, 7.0)])
def test_a_place_is_found_anywhere_on_the_map_at_any_altitude(index, altitude_m, place_deg):
    place, found = frame(index.landmarks, *place_deg, altitude_m, seed=5)
    result = searched(found, index)
    error = norm(result.position_mcmf_m - place)
    # Ten detections and an attitude of half a degree leave about 1 % of the altitude; three times that here.
    assert error < 0.03 * altitude_m
    assert error < 5.0 * norm(result.sigma_m) + 100.0


def test_false_detections_mirrored_and_turned_images_find_no_place(index):
    rng = default_rng(3)
    _, found = frame(index.landmarks, 2.0, 3.0, 35e3, seed=6, false=6)
    scattered = rng.uniform(0.0, 511.0, (2, len(found)))
    hostile = [
        changed(found, scattered[0], scattered[1]), changed(found, 511.0 - found.u_px, found.v_px),
        changed(found, 511.0 - found.v_px, found.u_px), changed(found, 511.0 - found.u_px, 511.0 - found.v_px)
    ]  # fmt: skip
    assert searched(found, index) is not None
    for detections in hostile:
        assert searched(detections, index) is None


def test_a_place_off_the_map_few_detections_and_those_that_are_no_numbers_are_no_fix(index):
    _, found = frame(craters(west_deg=100.0, seed=8), 0.0, 110.0, 30e3, seed=2)
    assert searched(found, index) is None
    assert searched(no_detections(), index) is None
    _, found = frame(index.landmarks, 3.0, 359.7, 30e3, seed=5)
    assert searched(found.select(np.arange(2)), index) is None
    assert searched(changed(found, np.nan * found.u_px, found.v_px), index) is None
    place, found = frame(index.landmarks, 3.0, 359.7, 49e3, seed=5)
    u = found.u_px.copy()
    u[::7] = np.nan
    result = searched(changed(found, u, found.v_px), index)
    assert np.all(np.isfinite(u[result.detection]))
    assert norm(result.position_mcmf_m - place) < 2_000.0


def test_fewer_inliers_suffice_on_a_smaller_map():
    whole = craters()
    near = np.flatnonzero(np.abs(whole.latitude_rad) < radians(4.0))
    part = LandmarkMap(
        whole.ids[near], whole.latitude_rad[near], whole.position_mcmf_m[near], whole.enu_from_mcmf[near],
        whole.diameter_m[near], whole.sigma_m[near]
    )  # fmt: skip
    _, found = frame(whole, 0.5, 0.0, 30e3, seed=4)
    best = [candidate_places(found, found.sigma_px, place_index(m), CAMERA, RULES)[0] for m in (whole, part)]
    assert len(best[0]) == len(best[1])
    assert best[1].log_false < best[0].log_false


@mark.parametrize("west_deg", [350.0, 172.0])
def test_craters_are_sorted_by_tile_height_and_diameter(west_deg):
    landmarks = craters(west_deg)
    index = place_index(landmarks)
    assert index.bin_start[0] == 0 and index.bin_start[-1] == len(index) == len(landmarks.diameter_m)
    assert index.tile_start[0] == 0 and index.tile_start[-1] == index.bin_height.size
    tiles = []
    for first, stop in pairwise(index.tile_start):
        low, high = index.bin_start[first], index.bin_start[stop]
        longitude = degrees(index.longitude_rad[low:high]) % 360.0
        places = np.stack([degrees(index.latitude_rad[low:high]) // 15.0, longitude // 15.0])
        assert np.all(places == places[:, :1])
        tiles.append(tuple(places[:, 0]))
        assert np.all(np.diff(index.bin_height[first:stop]) > 0)
    assert len(set(tiles)) == len(tiles) > 4
    for first, stop in pairwise(index.bin_start):
        assert stop > first and np.all(np.diff(index.log_diameter[first:stop]) >= 0.0)
    assert_array_equal(np.sort(index.log_diameter), np.sort(log(landmarks.diameter_m)))


def test_a_map_without_craters_has_an_index_and_gives_no_fix():
    empty = np.empty(0)
    landmarks = landmark_map(CatalogueTable(np.empty(0, np.int64), empty, empty, empty, empty, np.empty((0, 3))))
    index = place_index(landmarks)
    assert len(index) == 0 and index.tile_start.tolist() == [0]
    assert searched(no_detections(), index) is None


@mark.parametrize("seed", range(4))
def test_tiles_do_not_change_the_place_found(seed, index):
    """One tile for the whole map, in which no detection counts twice, leads to the same place and the same pairs."""
    whole = replace(index, tile_start=np.array([0, index.bin_height.size]))
    assert index.tile_start.size > 4
    _, found = frame(index.landmarks, -8.0 + 5.0 * seed, 355.0 + 2.0 * seed, 28_000.0, seed)
    tiled, single = (searched(found, one) for one in (index, whole))
    assert_allclose(tiled.position_mcmf_m, single.position_mcmf_m, atol=1.0)
    assert_array_equal(tiled.detection, single.detection)


def test_what_a_search_left_in_memory_does_not_change_the_next(index):
    _, found = frame(index.landmarks, 3.0, 359.7, 40e3, seed=5)
    before = candidate_places(found, found.sigma_px, index, CAMERA, RULES)
    _work_space(1)[:] = default_rng(4).integers(0, 1 << 16, _work_space(1).size)
    after = candidate_places(found, found.sigma_px, index, CAMERA, RULES)
    assert [place.log_false for place in after] == [place.log_false for place in before]
    assert _work_space(1) is _work_space(2)
    with ThreadPoolExecutor(1) as other:
        assert other.submit(_work_space, 1).result() is not _work_space(1)


@mark.parametrize("beyond_deg", [-0.9, 0.9])
def test_a_camera_beyond_the_last_craters_is_found(beyond_deg, index):
    """It is over rows of the vote that belong to no tile of the map."""
    latitude = degrees(index.landmarks.latitude_rad)
    edge = latitude.min() if beyond_deg < 0.0 else latitude.max()
    place, found = frame(index.landmarks, edge + beyond_deg, 1.0, 45e3, seed=3, recall=0.9, false=1)
    assert norm(searched(found, index).position_mcmf_m - place) < 2_000.0


IMAGE = Image(100.0, np.array([50.0, 50.0]), np.array([50.0, 50.0]))
PREDICTED_PX = np.array([[20.0, 20.0], [80.0, 30.0], [40.0, 70.0], [75.0, 80.0]])


def evidence_of(uv_px, diameter_px, pairs, score=None):
    """Return the evidence of detections for four craters of 8 to 64 px predicted in an image of 100 by 100."""
    seen = Seen(PREDICTED_PX, log([8.0, 16.0, 32.0, 64.0]), np.zeros((4, 3)), np.zeros(4))
    score = np.full(len(uv_px), 0.5) if score is None else score
    found = DetectedCraters(uv_px, log(diameter_px), np.full(len(uv_px), 3.0**2), score)
    return log_evidence(np.array(pairs), seen, found, IMAGE, 0.1)


def test_scattered_detections_have_no_evidence_on_average():
    """The mean likelihood ratio is one for pairs at any distance, and less where only near ones count."""
    rng = default_rng(2)
    pairs, diameter, score = [0, 1, 3], np.array([8.5, 17.0, 60.0]), np.array([0.9, 0.3, 0.6])
    every, near = np.empty((2, 20_000))
    for k in range(every.size):
        uv = rng.uniform(0.0, 100.0, (3, 2))
        every[k] = exp(evidence_of(uv, diameter, pairs, score))
        away = norm(uv - PREDICTED_PX[pairs], axis=1)
        near[k] = exp(evidence_of(uv, diameter, np.where(away < 6.0, pairs, -1).tolist(), score))
    doubt = every.std() / sqrt(every.size)
    assert doubt < 0.1 and abs(every.mean() - 1.0) < 3.0 * doubt
    assert near.mean() < every.mean()


def test_evidence_grows_with_agreement_of_place_and_size_and_with_the_score():
    pairs, diameter = [0, 1, 3], np.array([8.0, 16.0, 64.0])
    exact = PREDICTED_PX[pairs]
    best = evidence_of(exact, diameter, pairs)
    assert best > evidence_of(exact + np.array([3.0, 0.0]), diameter, pairs) > 0.0
    assert best > evidence_of(exact, diameter * 1.15, pairs) > evidence_of(exact, diameter, [0, 1, -1])
    # A detection that resembles no crater of the map says nothing; one that does and lies elsewhere speaks against it.
    more = np.array([*exact, [50.0, 50.0]])
    assert evidence_of(more, np.append(diameter, 200.0), [*pairs, -1]) == approx(best, abs=1e-6)
    assert evidence_of(more, np.append(diameter, 32.0), [*pairs, -1]) < best - 0.1
    # Of two detections of about a crater's size, the one at its place is the evidence.
    diameter, uv = np.array([16.0, 16.5]), np.array([[80.0, 30.0], [10.0, 90.0]])
    equal, sure, doubtful = (
        evidence_of(uv, diameter, [1, -1], np.array(score)) for score in ([0.5, 0.5], [0.8, 0.2], [0.2, 0.8])
    )
    assert doubtful + 0.5 < equal < sure - 0.1
    # Scores are compared with each other: those of another detector may be lower throughout.
    assert evidence_of(uv, diameter, [1, -1], np.array([0.4, 0.1])) == approx(sure)


def test_detections_without_scores_are_searched(index):
    _, found = frame(index.landmarks, -8.0, 355.0, 28_000.0, 0)
    known, unknown = (searched(replace(found, score=np.full(len(found), score)), index) for score in (0.7, nan))
    assert unknown.log_false == approx(known.log_false)


def test_the_same_detections_vote_at_all_altitudes_within_the_bound_of_work(index):
    log_size = log(np.linspace(0.9, 0.1, 40))
    altitudes, cells = np.geomspace(12e3, 55e3, 20), np.full(20, 2e-4)
    size = np.sort(log(index.landmarks.diameter_m))
    wanted = log_size[:, None] + log(altitudes)
    gate = RULES.log_diameter_gate
    pairs = (np.searchsorted(size, wanted + gate) - np.searchsorted(size, wanted - gate)).sum(axis=1)
    for share in (0.3, 0.7):
        votes = int(share * pairs.sum())
        voters = _affordable(log_size, altitudes, cells, index, replace(RULES, votes=votes))
        assert 6 < voters < 40
        assert pairs[: voters - 1].sum() < 1.05 * votes and pairs[: voters + 1].sum() > 0.95 * votes
    assert _affordable(log_size, altitudes, cells, index, replace(RULES, votes=0)) == 6
    assert _affordable(log_size, altitudes, cells, index, replace(RULES, votes=10**9)) == 40
    # Detections whose votes would be spread over every block do not vote and cost nothing.
    assert _affordable(log_size, altitudes, np.full(20, 1.0), index, replace(RULES, votes=1)) == 40


def test_the_index_is_small_compared_with_the_table(index):
    # Four float64 per crater, a few bins and the quantiles of sizes; 22 octets per crater in the table itself.
    assert index.octets < 33 * len(index) + 5_000


def test_the_nominal_attitude_looks_down_with_north_up():
    assert NADIR_NORTH_UP @ np.array([0.0, 0.0, -1.0]) == approx([0.0, 0.0, 1.0])
    assert NADIR_NORTH_UP @ np.array([0.0, 1.0, 0.0]) == approx([0.0, -1.0, 0.0])


def small_anchor(moon):
    seconds = np.arange(0.0, 1_200.0, 60.0)
    return moon.anchor(seconds)


def catalogue_table(count=50):
    rng = default_rng(2)
    return CatalogueTable(
        np.arange(count) + 7, rng.uniform(-1.0, 1.0, count), rng.uniform(0.0, 2.0 * pi, count),
        rng.uniform(3e3, 30e3, count), rng.uniform(-8e3, 8e3, count), rng.uniform(20.0, 900.0, (count, 3))
    )  # fmt: skip


def test_an_anchor_table_interpolates_to_a_millimetre_within_its_span_and_knows_the_direction(moon):
    table = unpack_anchor_table(small_anchor(moon))
    for second in (0.0, 7.5, 333.25, 600.0, 1_100.0):
        ticks = moon.ticks_at(second)
        latitude, longitude, altitude = moon.place(moon.orbit([second])[0])
        sample = table.at(ticks)
        assert sample.latitude_rad * moon.radius_m == approx(latitude * moon.radius_m, abs=1e-3)
        assert sample.longitude_rad * moon.radius_m == approx(longitude * moon.radius_m, abs=1e-3)
        assert table.altitude_m(ticks) == approx(altitude, abs=1e-3)
    seconds = np.concatenate([np.arange(0.0, 600.0, 60.0), np.arange(2_000.0, 2_600.0, 60.0)])
    table = unpack_anchor_table(moon.anchor(seconds))
    for second in (-1.0, 1_000.0, 2_600.0):
        assert table.at(moon.ticks_at(second)) is None
        assert np.isnan(table.altitude_m(moon.ticks_at(second)))
    for second in (535.0, 2_003.0):
        _, _, altitude = moon.place(moon.orbit([second])[0])
        # Beside the gap only the nodes of one side serve: less than eight of them, still well below a metre.
        assert table.altitude_m(moon.ticks_at(second)) == approx(altitude, abs=0.1)
    seconds = np.arange(0.0, 6_600.0, 60.0)
    table = unpack_anchor_table(moon.anchor(seconds))
    z = moon.orbit(seconds)[:, 2] / norm(moon.orbit(seconds), axis=1)
    for k in range(2, seconds.size - 2, 7):
        if abs(z[k]) < 0.95:
            sample = table.at(moon.ticks_at(seconds[k]))
            assert sample.direction == np.sign(z[k + 1] - z[k - 1])


def test_a_catalogue_table_comes_back_within_its_quantisation(moon):
    table = catalogue_table()
    octets = pack_catalogue_table(table)
    back = unpack_catalogue_table(octets)
    order = np.argsort(table.latitude_rad)
    assert len(octets) == 20 + 4 + 22 * 50
    assert_array_equal(back.ids, table.ids[order])
    assert_allclose(back.latitude_rad * moon.radius_m, table.latitude_rad[order] * moon.radius_m, atol=2e-3)
    assert_allclose(back.longitude_rad * moon.radius_m, table.longitude_rad[order] * moon.radius_m, atol=2e-3)
    assert_allclose(back.diameter_m, table.diameter_m[order], atol=2.0)
    assert_allclose(back.rim_height_m, table.rim_height_m[order], atol=0.25)
    # Uncertainty is rounded up, never down.
    assert np.all(back.sigma_m >= table.sigma_m[order])
    assert np.all(back.sigma_m <= table.sigma_m[order] + 0.5)


def test_longitudes_on_either_side_of_the_meridian_survive_packing():
    table = catalogue_table(3)
    near = CatalogueTable(
        table.ids, table.latitude_rad, np.array([-1e-12, 2 * pi - 1e-12, -3.0]), table.diameter_m,
        table.rim_height_m, table.sigma_m
    )  # fmt: skip
    back = unpack_catalogue_table(pack_catalogue_table(near))
    expected = near.longitude_rad[np.argsort(near.latitude_rad)]
    assert_allclose(np.exp(1j * back.longitude_rad), np.exp(1j * expected), atol=2e-9)


def test_gravity_orientation_and_initial_state_come_back_exactly():
    rng = default_rng(3)
    lower = np.tril(rng.normal(size=(9, 9)))
    again = unpack_gravity_table(pack_gravity_table(GravityTable("TEST8", 4.9e12, 1.738e6, lower, 2.0 * lower)))
    assert (again.name, again.gm_m3_s2, again.radius_m) == ("TEST8", 4.9e12, 1.738e6)
    assert_array_equal(again.c_bar, lower)
    assert_array_equal(again.s_bar, 2.0 * lower)
    state = InitialState(5, rng.normal(size=3), rng.normal(size=3), 5_000.0, 5.0)
    back = unpack_initial_state(pack_initial_state(state))
    assert_array_equal(back.position_icrf_m, state.position_icrf_m)
    assert_array_equal(back.velocity_icrf_m_s, state.velocity_icrf_m_s)
    assert (back.ticks, back.sigma_position_m, back.sigma_velocity_m_s) == (5, 5_000.0, 5.0)


def test_an_orientation_table_of_two_hour_steps_is_a_rotation_good_to_a_millimetre():
    def matrix(second):
        # A turning Moon with a physical libration of 0.01 rad and 27 days: rates as large as the real ones.
        w, tilt = 2.6617e-6 * second, 0.4 + 1e-2 * np.sin(2.6617e-6 * second)
        rz = np.array([[cos(w), np.sin(w), 0], [-np.sin(w), cos(w), 0], [0, 0, 1]])
        return rz @ np.array([[1, 0, 0], [0, cos(tilt), np.sin(tilt)], [0, -np.sin(tilt), cos(tilt)]])

    seconds = np.arange(-36_000.0, 122_400.0, 7_200.0)
    ticks = np.round(seconds * 65_536).astype(int)
    table = unpack_orientation_table(pack_orientation_table(ticks, [matrix(second) for second in seconds], eye(3)))
    for second in (0.0, 1_234.0, 50_000.0):
        found = table.at(round(second * 65_536))
        assert_allclose(found @ found.T, eye(3), atol=1e-14)
        assert_allclose(found * 1.7374e6, matrix(second) * 1.7374e6, atol=1e-3)
    assert table.at(int(ticks[-1]) + 1) is None


def all_tables(moon):
    lower = np.tril(np.ones((4, 4)))
    return [
        (small_anchor(moon), unpack_anchor_table),
        (pack_catalogue_table(catalogue_table()), unpack_catalogue_table),
        (pack_gravity_table(GravityTable("X", 1.0, 1.0, lower, lower)), unpack_gravity_table),
        (pack_orientation_table([0, 10, 20], np.stack([eye(3)] * 3), eye(3)), unpack_orientation_table),
        (pack_initial_state(InitialState(0, np.ones(3), np.ones(3), 1.0, 1.0)), unpack_initial_state),
    ]


def test_every_table_refuses_truncation_and_every_other_kind(moon):
    packed = all_tables(moon)
    for k, (octets, unpack) in enumerate(packed):
        unpack(octets)
        for length in (0, 7, 19, 20, 24, len(octets) - 1):
            with raises(TableError):
                unpack(octets[:length])
        with raises(TableError):
            unpack(octets + b"\0")
        for j, (other, _) in enumerate(packed):
            if j != k:
                with raises(TableError, match="expected a table of kind"):
                    unpack(other)


@given(data=st.data())
@settings(max_examples=200, deadline=None)
def test_any_flipped_bit_is_refused(moon, data):
    octets, unpack = data.draw(st.sampled_from(all_tables(moon)))
    damaged = bytearray(octets)
    bit = data.draw(st.integers(0, 8 * len(octets) - 1))
    damaged[bit // 8] ^= 1 << (bit % 8)
    with raises(TableError):
        unpack(bytes(damaged))


def test_a_table_with_values_that_are_not_finite_is_refused(moon):
    seconds = np.arange(0.0, 300.0, 60.0)
    positions = moon.orbit(seconds)
    positions[2, 1] = np.nan
    octets = pack_anchor_table([moon.ticks_at(second) for second in seconds], positions)
    with raises(TableError, match="expected finite numbers, value 7 is nan"):
        unpack_anchor_table(octets)
    with raises(TableError, match="strictly increasing"):
        pack_anchor_table([3, 2], np.ones((2, 3)))


def test_heights_refer_to_the_sphere_of_the_maps():
    assert MAP_RADIUS_M == MOON_RADIUS_M
