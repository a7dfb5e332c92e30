"""The parallax of crater walls is found where it was put in, and taken out by the flight code."""

import numpy as np
import pytest

from payload_emulator.training.data.truth import FrameTruth
from payload_emulator.training.evaluate.scoring import FrameDetections
from payload_emulator.training.model.calibrate import fit_parallax, paper_threshold, without_parallax

SHARE = 4e-4


def frames(count=12, share=SHARE, depth_said=True, noise=0.0, seed=0):
    """Frames whose detections lie inward of the rims by a share of the depth, as parallax has it."""
    rng = np.random.default_rng(seed)
    pairs = []
    for _ in range(count):
        n = 30
        place = np.arange(40.0, 480.0, 80.0)
        u, v = (part.ravel()[:n] for part in np.meshgrid(place, place))
        diameter, ratio = rng.uniform(12, 60, n), rng.uniform(0.06, 0.2, n)
        truth = FrameTruth(u, v, diameter, np.full(n, 7e3), ratio, np.arange(n), 512, 512, 0.0, 0)
        inward = 1.0 / (1.0 + share * ratio * diameter)
        found = FrameDetections(
            255.5 + (u - 255.5) * inward + rng.normal(0, noise + 1e-12, n),
            255.5 + (v - 255.5) * inward + rng.normal(0, noise + 1e-12, n),
            diameter,
            np.full(n, 7e3),
            np.full(n, 0.9),
            np.ones(n),
            ratio if depth_said else None,
        )
        pairs.append((truth, found))
    return pairs


def test_the_share_put_in_is_the_share_found():
    share, error = fit_parallax(frames())
    assert share == pytest.approx(SHARE, rel=1e-6)
    assert error < 1e-9


def test_the_standard_error_covers_the_scatter_of_the_fit():
    fits = np.array([fit_parallax(frames(noise=0.5, seed=seed)) for seed in range(12)])
    assert np.abs(fits[:, 0].mean() - SHARE) < 3 * fits[:, 1].mean() / np.sqrt(12)
    # Twelve fits know their spread to a factor of about 1.5.
    assert fits[:, 0].std() == pytest.approx(fits[:, 1].mean(), rel=0.6)


def test_detections_come_back_onto_the_rims():
    for truth, found in frames(2):
        put_right = without_parallax(found, SHARE, truth)
        assert put_right.u_px == pytest.approx(truth.u_px, abs=1e-6)
        assert put_right.v_px == pytest.approx(truth.v_px, abs=1e-6)


def test_a_network_that_tells_no_depth_is_corrected_on_the_whole():
    share, _ = fit_parallax(frames(depth_said=False))
    truth, found = frames(1, depth_said=False)[0]
    before = np.hypot(found.u_px - truth.u_px, found.v_px - truth.v_px)
    fixed = without_parallax(found, share, truth)
    after = np.hypot(fixed.u_px - truth.u_px, fixed.v_px - truth.v_px)
    assert after.mean() < 0.5 * before.mean()


def test_too_few_craters_give_no_correction():
    share, error = fit_parallax(frames(1)[:1])
    assert share == 0.0 and np.isnan(error)


def test_the_papers_threshold_is_chosen_over_its_classes_together():
    # One crater of class 0 found at 0.7, a false detection of class 1 at 0.5: anything in between is best.
    one = np.array([100.0])
    truth = FrameTruth(
        one, one, np.array([30.0]), np.array([7e3]), np.array([0.1]), np.array([1]), 512, 512, 0.0, 0
    )
    found = FrameDetections(
        np.array([100.0, 300.0]),
        np.array([100.0, 300.0]),
        np.full(2, 30.0),
        np.array([7e3, 12e3]),
        np.array([0.7, 0.5]),
        np.ones(2),
        size_class=np.array([0, 1], np.int8),
    )
    assert 0.5 < paper_threshold([truth], [found]) <= 0.7
