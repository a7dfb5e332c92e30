"""Pairs of anonymous craters between two frames."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from payload_emulator.flight.navigation.odometry.matcher import (
    GroundFeatures,
    MatcherParameters,
    match_frames,
)


def features(places: object, classes: object) -> GroundFeatures:
    places = np.asarray(places, dtype=np.float64).reshape(-1, 2)
    return GroundFeatures(places[:, 0], places[:, 1], np.asarray(classes, dtype=np.int64).reshape(-1))


def moved(frame: GroundFeatures, east_m: float, north_m: float) -> GroundFeatures:
    return GroundFeatures(frame.east_m - east_m, frame.north_m - north_m, frame.size_class)


@given(seed=st.integers(0, 10_000), count=st.integers(2, 30), direction=st.sampled_from([1, -1]))
@settings(max_examples=60, deadline=None)
def test_the_common_shift_is_found_whatever_the_order_of_detections(
    seed: int, count: int, direction: int
) -> None:
    rng = np.random.default_rng(seed)
    earlier = features(rng.uniform(-50e3, 50e3, (count, 2)), rng.integers(0, 3, count))
    order = rng.permutation(count)
    later = moved(earlier, 400.0, 24_500.0 * direction)
    later = GroundFeatures(later.east_m[order], later.north_m[order], later.size_class[order])
    match = match_frames(earlier, later, 15.0, direction)
    assert match.from_cluster
    # A neighbour of the same class within tau may stand in for a crater, never for most of them.
    right = np.count_nonzero(order[match.later] == match.earlier)
    assert right >= 0.9 * count
    assert np.unique(match.earlier).size == len(match) == np.unique(match.later).size


def test_the_densest_cluster_wins_over_clutter_of_the_same_class() -> None:
    rng = np.random.default_rng(7)
    common = features(rng.uniform(-40e3, 40e3, (6, 2)), np.zeros(6))
    clutter = [rng.uniform(-50e3, 50e3, (6, 2)) for _ in range(2)]
    shifted = moved(common, -300.0, 24_800.0)
    earlier = features(
        np.concatenate([np.stack([common.east_m, common.north_m], 1), clutter[0]]), np.zeros(12)
    )
    later = features(
        np.concatenate([np.stack([shifted.east_m, shifted.north_m], 1), clutter[1]]), np.zeros(12)
    )
    match = match_frames(earlier, later, 15.0, 1)
    pairs = set(zip(match.earlier.tolist(), match.later.tolist(), strict=True))
    assert {(k, k) for k in range(6)} <= pairs


def test_craters_of_different_class_never_pair() -> None:
    earlier = features([[0.0, 10e3], [5e3, 12e3]], [0, 1])
    later = GroundFeatures(earlier.east_m, earlier.north_m - 24.5e3, np.array([1, 2]))
    assert len(match_frames(earlier, later, 15.0, 1)) == 0
    unknown = GroundFeatures(earlier.east_m, earlier.north_m, np.array([-1, -1]))
    assert match_frames(unknown, moved(unknown, 0.0, 24.5e3), 15.0, 1).candidate_pairs == 0


@pytest.mark.parametrize(
    "shift, inside",
    [
        ((0.0, 17_501.0), True),
        ((0.0, 17_499.0), False),
        ((0.0, 32_499.0), True),
        ((0.0, 32_501.0), False),
        ((1_249.0, 25_000.0), True),
        ((-1_251.0, 25_000.0), False),
    ],
)
def test_the_paper_bounds_at_30_s_are_halved_at_15_s(shift: tuple[float, float], inside: bool) -> None:
    earlier = features([[0.0, 0.0], [9e3, 1e3]], [0, 1])
    assert match_frames(earlier, moved(earlier, *shift), 15.0, 1).candidate_pairs == (2 if inside else 0)


def test_too_small_a_cluster_falls_back_to_the_class_with_one_crater_in_each_frame() -> None:
    # Two pairs that disagree by more than tau: one of a class seen once in each frame, one that is not.
    earlier = features([[0.0, 10e3], [3e3, 0.0], [-20e3, 40e3]], [2, 0, 0])
    later = features([[0.0, 10e3 - 25e3], [3e3, 0.0 - 30e3]], [2, 0])
    match = match_frames(earlier, later, 15.0, 1)
    assert not match.from_cluster
    assert match.candidate_pairs == 2
    assert (match.earlier.tolist(), match.later.tolist()) == ([0], [0])


def test_two_pairs_that_share_a_crater_are_not_two_pieces_of_evidence() -> None:
    earlier = features([[0.0, 10e3], [500.0, 10.5e3]], [0, 0])
    later = features([[0.0, 10e3 - 25e3]], [0])
    match = match_frames(earlier, later, 15.0, 1)
    assert match.candidate_pairs == 2
    assert len(match) == 0


def test_of_disagreeing_lone_pairs_the_one_nearest_the_orbital_prior_is_kept() -> None:
    earlier = features([[0.0, 10e3], [3e3, 0.0]], [1, 2])
    later = features([[0.0, 10e3 - 19e3], [3e3, -25e3]], [1, 2])
    match = match_frames(earlier, later, 15.0, 1)
    assert match.earlier.tolist() == [1]


def test_empty_frames_match_nothing() -> None:
    nothing, some = features(np.empty((0, 2)), []), features([[0.0, 0.0]], [0])
    for earlier, later in ((nothing, some), (some, nothing), (nothing, nothing)):
        match = match_frames(earlier, later, 15.0, 1)
        assert (len(match), match.candidate_pairs) == (0, 0)


def test_a_frame_full_of_false_detections_stays_bounded() -> None:
    rng = np.random.default_rng(1)
    crowd = features(rng.uniform(-50e3, 50e3, (255, 2)), np.zeros(255))
    again = features(rng.uniform(-50e3, 50e3, (255, 2)), np.zeros(255))
    match = match_frames(crowd, again, 15.0, 1, MatcherParameters())
    assert len(match) <= 255
    assert match.candidate_pairs < 2_000
