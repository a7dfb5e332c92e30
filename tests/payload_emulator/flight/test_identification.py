"""How many agreeing pairs a set needs, and what a set may hold."""

from __future__ import annotations

import math

import numpy as np
import pytest

from payload_emulator.flight.navigation.search.identification import (
    IdentificationParameters,
    _consistent,
    identify,
    minimum_members,
)
from payload_emulator.flight.navigation.sighting import Sighting
from payload_emulator.flight.vision.detections import Detections


def poisson_at_least(mean: float, count: int) -> float:
    return 1.0 - sum(math.exp(-mean) * mean**k / math.factorial(k) for k in range(count))


@pytest.mark.parametrize("loose", [0.01, 0.5, 20.0, 1e4])
@pytest.mark.parametrize("tight", [0.001, 0.05, 0.5])
@pytest.mark.parametrize("limit", [0.03, 1e-5])
def test_the_minimum_is_the_smallest_set_that_chance_makes_less_often_than_the_limit(
    loose: float, tight: float, limit: float
) -> None:
    members = minimum_members(loose, tight, limit)
    assert loose * poisson_at_least(tight, members - 1) < limit
    if members > 1:
        assert loose * poisson_at_least(tight, members - 2) >= limit


def sighting(uv: np.ndarray) -> Sighting:
    count = len(uv)
    nothing = np.zeros((count, 2, 3))
    return Sighting(np.arange(count), uv, np.full(count, 30.0), nothing, nothing, nothing, nothing[:, :, 0])


def found(uv: np.ndarray, diameter: float = 30.0) -> Detections:
    count = len(uv)
    return Detections(uv[:, 0], uv[:, 1], np.full(count, diameter), np.ones(count), np.ones(count))


def common_shift(count: int, sigma_px: float) -> np.ndarray:
    """Covariance of predicted places that all err by the same shift."""
    return np.einsum("ab,jk->jakb", np.eye(2), np.full((count, count), sigma_px**2))


def run(detected: Detections, craters: Sighting, sigma_px: float) -> list[tuple[int, int]]:
    count = len(craters)
    result = identify(
        detected,
        craters,
        common_shift(count, sigma_px),
        np.zeros((count, 2, 2)) + 0.25 * np.eye(2),
        np.ones(len(detected)),
        512.0 * 512.0,
        IdentificationParameters(),
    )
    pairs = list(zip(result.detection.tolist(), result.sighted.tolist(), strict=True))
    return sorted(pairs) if result.believed else []


def test_a_shift_larger_than_the_spacing_of_craters_is_found_by_their_agreement() -> None:
    rng = np.random.default_rng(2)
    places = rng.uniform(60.0, 450.0, (15, 2))
    shifted = places + np.array([22.0, -17.0]) + rng.normal(0.0, 0.8, (15, 2))
    clutter = rng.uniform(0.0, 511.0, (4, 2))
    pairs = run(found(np.concatenate([shifted, clutter])), sighting(places), sigma_px=15.0)
    assert {(k, k) for k in range(15)} == {pair for pair in pairs if pair[0] < 15}


def test_one_crater_is_enough_where_the_prediction_is_good_and_not_where_it_is_bad() -> None:
    places = np.random.default_rng(3).uniform(20.0, 490.0, (30, 2))
    lone = found(places[:1] + 0.5)
    assert run(lone, sighting(places), sigma_px=0.5) == [(0, 0)]
    assert run(lone, sighting(places), sigma_px=60.0) == []


def test_a_crater_of_another_size_is_no_match() -> None:
    places = np.array([[100.0, 100.0], [300.0, 200.0]])
    assert run(found(places, diameter=60.0), sighting(places), sigma_px=1.0) == []


def test_each_detection_and_each_crater_is_used_once() -> None:
    places = np.array([[100.0, 100.0], [102.0, 101.0], [300.0, 300.0]])
    pairs = run(found(np.concatenate([places, places[:1] + 0.4])), sighting(places), sigma_px=1.0)
    assert len({i for i, _ in pairs}) == len(pairs) == len({j for _, j in pairs})


def test_no_detections_and_no_craters_make_no_set() -> None:
    nothing = np.empty((0, 2))
    assert run(found(nothing), sighting(np.array([[5.0, 5.0]])), 1.0) == []
    assert run(found(np.array([[5.0, 5.0]])), sighting(nothing), 1.0) == []


def test_a_frame_full_of_detections_that_craters_hardly_explain_is_believed_less() -> None:
    places = np.random.default_rng(5).uniform(20.0, 490.0, (25, 2))
    few = places[:4] + 0.5
    clutter = np.random.default_rng(6).uniform(0.0, 511.0, (20, 2))
    assert run(found(few), sighting(places), sigma_px=3.0) == [(k, k) for k in range(4)]
    crowded = found(np.concatenate([few, clutter]))
    assert not {(k, k) for k in range(4)} <= set(run(crowded, sighting(places), sigma_px=3.0))


def test_a_lone_pair_is_refused_where_it_would_move_the_place_farther_than_it_then_claims() -> None:
    places = np.random.default_rng(3).uniform(20.0, 490.0, (4, 2))
    lone = found(places[:1] + 0.5)
    # Chance puts a detection into one of four gates less than once in a hundred frames either way; where the prediction
    # is worth three times less than the pair, the place would then follow the wrong one and believe it.
    assert run(lone, sighting(places), sigma_px=1.0) == [(0, 0)]
    assert run(lone, sighting(places), sigma_px=3.5) == []
    assert run(found(places[:3] + 0.5), sighting(places), sigma_px=3.5) == [(0, 0), (1, 1), (2, 2)]


def test_a_pair_that_contradicts_the_shift_of_all_others_is_removed() -> None:
    # Prediction off by 15 px (1 sigma) for all craters alike, 1 px of noise a pair: offsets agree or do not.
    offset = np.array([[20.0, -10.0], [20.5, -10.0], [20.0, -9.0], [50.0, -10.0]])
    every = np.arange(4)
    prior_px2 = common_shift(4, 15.0)
    noise_px2 = np.zeros((4, 2, 2)) + 0.5 * np.eye(2)
    variance_px2 = np.full(4, 0.5)
    kept = _consistent(every, every, offset, prior_px2, noise_px2, variance_px2)
    assert kept.tolist() == [0, 1, 2]
    agreeing = offset[:3]
    kept = _consistent(every[:3], every, agreeing, prior_px2, noise_px2, variance_px2)
    assert kept.tolist() == [0, 1, 2]
