"""The simulated detector draws what its confusion table says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from payload_emulator.sim.detector import SimulatedDetector

CORNER = np.array([511.0, 511.0])
COUNT = 20_000


@pytest.fixture()
def rng() -> np.random.Generator:
    return np.random.default_rng(4)


def test_each_class_is_found_with_its_recall_and_no_other_size(rng) -> None:
    detector = SimulatedDetector(recall=(0.2, 0.4, 0.6, 0.8))
    for diameter_m, recall in ((7e3, 0.2), (12e3, 0.4), (20e3, 0.6), (4e3, 0.8), (2e3, 0.0), (40e3, 0.0)):
        found = detector.found(np.full(COUNT, diameter_m), rng)
        # Four standard deviations of a share of 20,000.
        assert found.size / COUNT == pytest.approx(recall, abs=4.0 * np.sqrt(0.25 / COUNT))


def test_errors_have_their_size_and_the_lasting_part_stays(rng) -> None:
    detector = SimulatedDetector(precision=1.0, sigma_px=1.5, persistence=0.64, log_diameter_sigma=0.1)
    uv, size = np.full((COUNT, 2), 100.0), np.full(COUNT, 30.0)
    lasting = rng.standard_normal((COUNT, 2))
    first, sizes = detector.detect(uv, size, CORNER, rng, lasting)
    second, _ = detector.detect(uv, size, CORNER, rng, lasting)
    assert (first - uv).std() == pytest.approx(1.5, rel=0.02)
    correlation = np.corrcoef((first - uv).reshape(-1), (second - uv).reshape(-1))[0, 1]
    assert correlation == pytest.approx(0.64, abs=0.02)
    assert np.log(sizes / size).std() == pytest.approx(0.1, rel=0.03)


def test_a_shift_moves_true_detections(rng) -> None:
    detector = SimulatedDetector(precision=1.0, sigma_px=0.0, log_diameter_sigma=0.0, bias_px=(2.0, -1.0))
    uv = np.full((5, 2), 100.0)
    np.testing.assert_array_equal(detector.detect(uv, np.ones(5), CORNER, rng)[0], uv + np.array([2.0, -1.0]))
    moved, _ = detector.detect(uv, np.ones(5), CORNER, rng, bias_px=np.array([0.5, 0.5]))
    np.testing.assert_array_equal(moved, uv + 0.5)


def test_false_detections_have_their_share_and_lie_in_the_image(rng) -> None:
    detector = SimulatedDetector(precision=0.8, log_diameter_sigma=0.0)
    uv, size = np.full((COUNT, 2), -50.0), np.full(COUNT, 33.0)
    places, sizes = detector.detect(uv, size, CORNER, rng)
    false = places[COUNT:]
    assert COUNT / len(places) == pytest.approx(0.8, abs=0.01)
    assert false.min() >= 0.0 and false.max() <= 511.0
    assert set(sizes[COUNT:]) == {33.0}
    blind = replace(detector, precision=0.05)
    sizes = np.concatenate([blind.detect(uv[:0], size[:0], CORNER, rng)[1] for _ in range(50)])
    assert sizes.size > 100 and sizes.min() >= 15.0 and sizes.max() <= 60.0


def test_the_told_error_is_the_true_one_unless_stated() -> None:
    assert SimulatedDetector(sigma_px=1.2).stated_sigma_px == 1.2
    assert SimulatedDetector(sigma_px=1.2, claimed_sigma_px=0.7).stated_sigma_px == 0.7
