"""Pairs of detections with catalogued and anonymous craters; projections and their derivatives."""

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.random import default_rng
from numpy.testing import assert_allclose
from pytest import mark

from lunar.camera import PinholeCamera, project_mcmf
from payload_emulator.flight.navigation.odometry.matcher import GroundFeatures, match_frames
from payload_emulator.flight.navigation.search.identification import (
    IdentificationParameters,
    _consistent,
    identify,
    minimum_members,
)
from payload_emulator.flight.navigation.sighting import Pose, Sighting, in_view, landmark_map, look
from payload_emulator.flight.vision.detections import Detections
from tmtc.dictionary.tables import CatalogueTable


def poisson_at_least(mean, count):
    return 1.0 - sum(math.exp(-mean) * mean**k / math.factorial(k) for k in range(count))


@mark.parametrize("loose", [0.01, 0.5, 20.0, 1e4])
@mark.parametrize("tight", [0.001, 0.05, 0.5])
@mark.parametrize("limit", [0.03, 1e-5])
def test_the_minimum_is_the_smallest_set_that_chance_makes_less_often_than_the_limit(loose, tight, limit):
    members = minimum_members(loose, tight, limit)
    assert loose * poisson_at_least(tight, members - 1) < limit
    if members > 1:
        assert loose * poisson_at_least(tight, members - 2) >= limit


def sighting(uv):
    count = len(uv)
    nothing = np.zeros((count, 2, 3))
    return Sighting(np.arange(count), uv, np.full(count, 30.0), nothing, nothing, nothing, nothing[:, :, 0])


def found(uv, diameter=30.0):
    count = len(uv)
    return Detections(uv[:, 0], uv[:, 1], np.full(count, diameter), np.ones(count), np.ones(count))


def common_shift(count, sigma_px):
    """Covariance of predicted places that all err by the same shift."""
    return np.einsum("ab,jk->jakb", np.eye(2), np.full((count, count), sigma_px**2))


def run(detected, craters, sigma_px):
    count = len(craters)
    result = identify(
        detected, craters, common_shift(count, sigma_px), np.zeros((count, 2, 2)) + 0.25 * np.eye(2),
        np.ones(len(detected)), 512.0 * 512.0, IdentificationParameters()
    )  # fmt: skip
    pairs = list(zip(result.detection.tolist(), result.sighted.tolist(), strict=True))
    return sorted(pairs) if result.believed else []


def test_a_shift_larger_than_the_spacing_of_craters_is_found_by_their_agreement():
    rng = default_rng(2)
    places = rng.uniform(60.0, 450.0, (15, 2))
    shifted = places + np.array([22.0, -17.0]) + rng.normal(0.0, 0.8, (15, 2))
    pairs = run(found(np.concatenate([shifted, rng.uniform(0.0, 511.0, (4, 2))])), sighting(places), sigma_px=15.0)
    assert {(k, k) for k in range(15)} == {pair for pair in pairs if pair[0] < 15}


def test_one_crater_is_enough_where_the_prediction_is_good_and_not_where_it_is_bad():
    places = default_rng(3).uniform(20.0, 490.0, (30, 2))
    lone = found(places[:1] + 0.5)
    assert run(lone, sighting(places), sigma_px=0.5) == [(0, 0)]
    assert run(lone, sighting(places), sigma_px=60.0) == []


def test_pairs_are_of_one_size_use_each_crater_once_and_need_detections_and_craters():
    places = np.array([[100.0, 100.0], [300.0, 200.0]])
    assert run(found(places, diameter=60.0), sighting(places), sigma_px=1.0) == []
    places = np.array([[100.0, 100.0], [102.0, 101.0], [300.0, 300.0]])
    pairs = run(found(np.concatenate([places, places[:1] + 0.4])), sighting(places), sigma_px=1.0)
    assert len({i for i, _ in pairs}) == len(pairs) == len({j for _, j in pairs})
    nothing = np.empty((0, 2))
    assert run(found(nothing), sighting(np.array([[5.0, 5.0]])), 1.0) == []
    assert run(found(np.array([[5.0, 5.0]])), sighting(nothing), 1.0) == []


def test_frames_that_craters_hardly_explain_and_lone_pairs_that_move_the_place_are_not_believed():
    places = default_rng(5).uniform(20.0, 490.0, (25, 2))
    few = places[:4] + 0.5
    clutter = default_rng(6).uniform(0.0, 511.0, (20, 2))
    assert run(found(few), sighting(places), sigma_px=3.0) == [(k, k) for k in range(4)]
    crowded = found(np.concatenate([few, clutter]))
    assert not {(k, k) for k in range(4)} <= set(run(crowded, sighting(places), sigma_px=3.0))
    places = default_rng(3).uniform(20.0, 490.0, (4, 2))
    lone = found(places[:1] + 0.5)
    # Chance puts a detection into one of four gates less than once in a hundred frames either way; where the prediction
    # is worth three times less than the pair, the place would then follow the wrong one and believe it.
    assert run(lone, sighting(places), sigma_px=1.0) == [(0, 0)]
    assert run(lone, sighting(places), sigma_px=3.5) == []
    assert run(found(places[:3] + 0.5), sighting(places), sigma_px=3.5) == [(0, 0), (1, 1), (2, 2)]


def test_a_pair_that_contradicts_the_shift_of_all_others_is_removed():
    # Prediction off by 15 px (1 sigma) for all craters alike, 1 px of noise a pair: offsets agree or do not.
    offset = np.array([[20.0, -10.0], [20.5, -10.0], [20.0, -9.0], [50.0, -10.0]])
    every = np.arange(4)
    prior_px2 = common_shift(4, 15.0)
    noise_px2 = np.zeros((4, 2, 2)) + 0.5 * np.eye(2)
    variance_px2 = np.full(4, 0.5)
    for count in (4, 3):
        kept = _consistent(every[:count], every, offset[:count], prior_px2, noise_px2, variance_px2)
        assert kept.tolist() == [0, 1, 2]


def features(places, classes):
    places = np.asarray(places, float).reshape(-1, 2)
    return GroundFeatures(*places.T, np.asarray(classes, int).reshape(-1))


def moved(frame, east_m, north_m):
    return GroundFeatures(frame.east_m - east_m, frame.north_m - north_m, frame.size_class)


@given(seed=st.integers(0, 10_000), count=st.integers(2, 30), direction=st.sampled_from([1, -1]))
@settings(max_examples=60, deadline=None)
def test_the_common_shift_is_found_whatever_the_order_of_detections(seed, count, direction):
    rng = default_rng(seed)
    earlier = features(rng.uniform(-50e3, 50e3, (count, 2)), rng.integers(0, 3, count))
    order = rng.permutation(count)
    later = moved(earlier, 400.0, 24_500.0 * direction)
    later = GroundFeatures(later.east_m[order], later.north_m[order], later.size_class[order])
    match = match_frames(earlier, later, 15.0, direction)
    assert match.from_cluster
    # A neighbour of the same class within tau may stand in for a crater, never for most of them.
    assert np.count_nonzero(order[match.later] == match.earlier) >= 0.9 * count
    assert np.unique(match.earlier).size == len(match) == np.unique(match.later).size


def test_the_densest_cluster_wins_over_clutter_and_craters_of_different_class_never_pair():
    rng = default_rng(7)
    common = rng.uniform(-40e3, 40e3, (6, 2))
    clutter = rng.uniform(-50e3, 50e3, (2, 6, 2))
    earlier = features([*common, *clutter[0]], np.zeros(12))
    later = features([*(common - [-300.0, 24_800.0]), *clutter[1]], np.zeros(12))
    match = match_frames(earlier, later, 15.0, 1)
    pairs = set(zip(match.earlier.tolist(), match.later.tolist(), strict=True))
    assert {(k, k) for k in range(6)} <= pairs
    earlier = features([[0.0, 10e3], [5e3, 12e3]], [0, 1])
    later = GroundFeatures(earlier.east_m, earlier.north_m - 24.5e3, np.array([1, 2]))
    assert len(match_frames(earlier, later, 15.0, 1)) == 0
    unknown = GroundFeatures(earlier.east_m, earlier.north_m, np.array([-1, -1]))
    assert match_frames(unknown, moved(unknown, 0.0, 24.5e3), 15.0, 1).candidate_pairs == 0


# shift (east, north) in m and the pairs
SHIFTS = "0 17501 2, 0 17499 0, 0 32499 2, 0 32501 0, 1249 25000 2, -1251 25000 0"


@mark.parametrize("row", SHIFTS.split(","))
def test_the_paper_bounds_at_30_s_are_halved_at_15_s(row):
    *shift, pairs = map(float, row.split())
    earlier = features([[0.0, 0.0], [9e3, 1e3]], [0, 1])
    assert match_frames(earlier, moved(earlier, *shift), 15.0, 1).candidate_pairs == pairs


def test_small_clusters_fall_back_to_lone_classes_shared_craters_count_once_and_the_nearest_is_kept():
    # Two pairs that disagree by more than tau: one of a class seen once in each frame, one that is not.
    earlier = features([[0.0, 10e3], [3e3, 0.0], [-20e3, 40e3]], [2, 0, 0])
    later = features([[0.0, 10e3 - 25e3], [3e3, 0.0 - 30e3]], [2, 0])
    match = match_frames(earlier, later, 15.0, 1)
    assert not match.from_cluster
    assert match.candidate_pairs == 2
    assert (match.earlier.tolist(), match.later.tolist()) == ([0], [0])
    earlier = features([[0.0, 10e3], [500.0, 10.5e3]], [0, 0])
    later = features([[0.0, 10e3 - 25e3]], [0])
    match = match_frames(earlier, later, 15.0, 1)
    assert match.candidate_pairs == 2
    assert len(match) == 0
    earlier = features([[0.0, 10e3], [3e3, 0.0]], [1, 2])
    later = features([[0.0, 10e3 - 19e3], [3e3, -25e3]], [1, 2])
    match = match_frames(earlier, later, 15.0, 1)
    assert match.earlier.tolist() == [1]


def test_empty_frames_match_nothing_and_a_frame_full_of_false_detections_stays_bounded():
    nothing, some = features(np.empty((0, 2)), []), features([[0.0, 0.0]], [0])
    for earlier, later in ((nothing, some), (some, nothing), (nothing, nothing)):
        match = match_frames(earlier, later, 15.0, 1)
        assert (len(match), match.candidate_pairs) == (0, 0)
    rng = default_rng(1)
    crowd, again = (features(rng.uniform(-50e3, 50e3, (255, 2)), np.zeros(255)) for _ in range(2))
    match = match_frames(crowd, again, 15.0, 1)
    assert len(match) <= 255 and match.candidate_pairs < 2_000


CAMERA = PinholeCamera()
NADIR_AT_ORIGIN = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
POSITION = np.array([1_767e3, 5e3, -4e3])
INDEX = np.arange(20)


def craters():
    rng = default_rng(0)
    place = rng.uniform(-0.02, 0.02, (2, 20))
    return landmark_map(
        CatalogueTable(INDEX, place[0], place[1], np.full(20, 5e3), rng.uniform(-3e3, 3e3, 20), np.full((20, 3), 90.0))
    )


def pose(change):
    return Pose(POSITION + change[:3], NADIR_AT_ORIGIN, np.eye(3), change[3:6], change[6:8], change[8:11])


def test_derivatives_are_those_of_the_projection():
    landmarks, nothing = craters(), np.zeros(11)
    seen = look(landmarks, INDEX, pose(nothing), CAMERA)
    analytic = np.zeros((20, 2, 11))
    analytic[:, :, :6] = np.concatenate([seen.by_position, seen.by_attitude], axis=2)
    analytic[:, :, 8:] = seen.by_offset
    analytic[:, 0, 6] = analytic[:, 1, 7] = 1.0
    for k, step in enumerate([1.0] * 3 + [1e-6] * 3 + [1e-3] * 2 + [1.0] * 3):
        change = np.zeros(11)
        change[k] = step
        ahead = look(landmarks, INDEX, pose(change), CAMERA).uv_px
        numeric = (ahead - look(landmarks, INDEX, pose(-change), CAMERA).uv_px) / (2.0 * step)
        # Central differences: curvature over the step is a part in 1e8 of the largest derivative.
        assert_allclose(numeric, analytic[:, :, k], atol=1e-7 * np.abs(analytic[:, :, k]).max())


def test_the_projection_is_that_of_the_camera_of_the_library():
    landmarks = craters()
    seen = look(landmarks, INDEX, pose(np.zeros(11)), CAMERA)
    expected = project_mcmf(CAMERA, NADIR_AT_ORIGIN, POSITION, landmarks.position_mcmf_m)
    assert_allclose(seen.uv_px, expected, atol=1e-9)


def test_what_is_in_view_is_all_that_projects_into_the_image_and_is_above_the_limb():
    rng = default_rng(1)
    count = 4_000
    table = CatalogueTable(
        np.arange(count), rng.uniform(-0.2, 0.2, count), rng.uniform(-0.2, 0.2, count), np.full(count, 5e3),
        rng.uniform(-4e3, 4e3, count), np.full((count, 3), 90.0)
    )  # fmt: skip
    landmarks = landmark_map(table)
    for margin_px in (0.0, 60.0):
        found = in_view(landmarks, pose(np.zeros(11)), CAMERA, margin_px).index
        uv = project_mcmf(CAMERA, NADIR_AT_ORIGIN, POSITION, landmarks.position_mcmf_m)
        inside = np.all(np.abs(uv - 255.5) < 256.0 + margin_px, axis=1)
        away = POSITION - landmarks.position_mcmf_m
        height = np.einsum("ij,ij->i", away, landmarks.enu_from_mcmf[:, 2]) / np.linalg.norm(away, axis=1)
        assert set(np.flatnonzero(inside & (height > np.sin(np.radians(5.0)))).tolist()) == set(found.tolist())
    assert len(in_view(landmarks, pose(np.concatenate([-0.5 * POSITION, np.zeros(8)])), CAMERA, 0.0)) == 0
