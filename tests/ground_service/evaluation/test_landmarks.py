"""The payload's own map beside the catalogue."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ground_service.evaluation.detection.fixes import IdentificationSamples
from ground_service.evaluation.detection.landmarks import (
    FIRST_LANDMARK_ID,
    MappedCraters,
    compare_map,
    latest,
    mapped_craters,
    payload_map,
)
from lunar.catalogue import CraterCatalogue, make_catalogue

METRES_PER_DEG = math.radians(1.0) * 1_737_400.0


def catalogue(count: int = 200) -> CraterCatalogue:
    rng = np.random.default_rng(1)
    # A grid of a degree, over the zero meridian: no two craters near each other.
    latitude, longitude = np.arange(count) % 20 - 10.0, (355.0 + np.arange(count) // 20) % 360.0
    return make_catalogue(
        np.radians(latitude), np.radians(longitude), rng.uniform(5e3, 9e3, count), source="grid",
        rim_height_m=np.full(count, 100.0),
    )  # fmt: skip


def mapped(known: CraterCatalogue, sigma_m: float, seed: int = 2, shift_m: float = 0.0) -> MappedCraters:
    rng = np.random.default_rng(seed)
    east, north, up = sigma_m * rng.standard_normal((3, len(known)))
    latitude = np.degrees(known.latitude_rad) + (north + shift_m) / METRES_PER_DEG
    longitude = np.degrees(known.longitude_rad) + east / (METRES_PER_DEG * np.cos(known.latitude_rad))
    return MappedCraters(
        3_000_000_000 + np.arange(len(known)),
        latitude,
        longitude % 360.0,
        known.rim_height_m + up,
        known.diameter_m * np.exp(0.05 * rng.standard_normal(len(known))),
        np.full((len(known), 3), sigma_m),
        np.ones(len(known), dtype=np.int64),
    )


def test_landmarks_are_found_in_the_catalogue_on_both_sides_of_the_meridian_with_honest_sigmas() -> None:
    craters = catalogue()
    result = compare_map(mapped(craters, 150.0), craters)
    assert result.crater.tolist() == list(range(len(craters)))
    # Median distance of a plane Gaussian: 1.177 sigma; 400 draws leave 5 %.
    assert result.median_horizontal_m == pytest.approx(1.177 * 150.0, rel=0.15)
    assert result.normalised_square == pytest.approx(1.0, abs=0.15)


def test_a_common_shift_of_the_map_shows() -> None:
    craters = catalogue()
    result = compare_map(mapped(craters, 100.0, shift_m=-250.0), craters)
    assert result.median_offset_m[1] == pytest.approx(-250.0, abs=30.0)
    assert result.normalised_square > 3.0


def test_what_the_catalogue_lacks_is_new_and_a_crater_serves_one_landmark_only() -> None:
    craters = catalogue()
    listed = craters.select(np.arange(0, 200, 2))
    result = compare_map(mapped(craters, 100.0), listed)
    assert result.known == 100
    assert np.all(np.isnan(result.offset_m[result.crater < 0]))
    first = mapped(craters.select(np.array([5, 5])), 100.0)
    assert compare_map(first, craters).known == 1


def test_the_last_report_of_a_landmark_counts() -> None:
    craters = catalogue(4)
    early, late = mapped(craters, 300.0, 3), mapped(craters, 50.0, 4)
    both = MappedCraters(
        *(np.concatenate([getattr(early, name), getattr(late, name)]) for name in MappedCraters.__slots__)
    )
    assert np.array_equal(latest(both).latitude_deg, late.latitude_deg)


def test_an_empty_map_compares_to_nothing() -> None:
    nothing = mapped(catalogue(0), 100.0)
    result = compare_map(nothing, catalogue())
    assert result.known == 0
    assert math.isnan(result.median_horizontal_m)


def test_a_report_counts_the_landmarks_the_fixes_that_used_them_and_their_distance_from_the_catalogue() -> (
    None
):
    craters = catalogue()
    reports = mapped(craters, 100.0)
    # The catalogue's crater 7, and landmark 0 twice and landmark 1 once.
    named = np.array([7, FIRST_LANDMARK_ID, FIRST_LANDMARK_ID, FIRST_LANDMARK_ID + 1])
    pairs = IdentificationSamples(np.arange(4), np.zeros(4, dtype=np.int64), named)
    result = payload_map(reports, pairs, craters.select(np.arange(100)))
    assert result is not None
    assert (result.mapped, result.used, result.pairs, result.pairs_of_all) == (200, 2, 3, 4)
    assert (result.mapped_again, result.catalogued) == (0, 100)
    # Two axes of 100 m: the root mean square of the distance is 141 m; 200 draws leave 5 %.
    assert result.horizontal_rms_m == pytest.approx(141.0, rel=0.15)


def test_a_pass_without_landmarks_has_no_map() -> None:
    assert payload_map(None, None, catalogue()) is None
    assert payload_map(mapped_craters(None), None, catalogue()) is None
