"""Figures by altitude, light, place and state, against scenes whose answer is known."""

from dataclasses import replace

import numpy as np
import pytest

from payload_emulator.training.data.truth import FrameTruth
from payload_emulator.training.evaluate.metrics import Scene, Thresholds, score
from payload_emulator.training.evaluate.scoring import FrameDetections, average_precision, tally

THRESHOLDS = Thresholds(0.5, 0.3, 0.7)


def scene(u, v, *, shift=(0.0, 0.0), scale=0.0, sigma=1.0, said=0.15, depth=0.15, azimuth=0.0, found=None):
    """Craters at (u, v) and detections of all (or of a mask), moved by a shift and a scale about the middle."""
    u, v = np.array(u, float), np.array(v, float)
    n = u.size
    truth = FrameTruth(
        u, v, np.full(n, 30.0), np.full(n, 7_000.0), np.full(n, depth), np.arange(n), 512, 512, azimuth, 0
    )
    keep = np.ones(n, bool) if found is None else np.array(found)
    detections = FrameDetections(
        (u + shift[0] + scale * (u - 255.5))[keep],
        (v + shift[1] + scale * (v - 255.5))[keep],
        np.full(keep.sum(), 30.0),
        np.full(keep.sum(), 7_000.0),
        np.full(keep.sum(), 0.8),
        np.full(keep.sum(), sigma),
        np.full(keep.sum(), said),
    )
    return truth, detections


def figures_of(parts, scenes):
    return score([t for t, _ in parts], [d for _, d in parts], THRESHOLDS, scenes)


GRID = np.meshgrid(np.arange(40.0, 500.0, 60.0), np.arange(40.0, 500.0, 60.0))
LOW = Scene(16.0, 5.0, -2_000.0, "mare")
HIGH = Scene(42.0, 12.0, 500.0, "hills")


def test_groups_hold_their_own_frames_and_no_others():
    everything = scene(GRID[0].ravel(), GRID[1].ravel())
    nothing = scene(GRID[0].ravel(), GRID[1].ravel(), found=np.zeros(64, bool))
    figures = figures_of([everything, nothing], [LOW, HIGH])
    assert [row["strict"]["recall"] for row in figures["by_altitude_km"]] == [1.0, 0.0]
    assert {row["name"]: row["strict"]["recall"] for row in figures["by_terrain"]} == {
        "lowland": 1.0,
        "upland": 0.0,
    }
    assert {row["name"]: row["ignore_aware"]["recall"] for row in figures["by_source"]} == {
        "mare": 1.0,
        "hills": 0.0,
    }
    assert [(row["low"], row["strict"]["recall"]) for row in figures["by_sun_elevation_deg"]] == [
        (3.0, 1.0),
        (12.0, 0.0),
    ]


def test_a_common_shift_is_the_bias_of_its_sun_octant():
    part = scene(GRID[0].ravel(), GRID[1].ravel(), shift=(0.4, -0.2), azimuth=np.radians(100.0))
    figures = figures_of([part], [LOW])
    biased = [row for row in figures["bias_px_by_sun_octant"] if row["pairs"]]
    assert [row["octant"] for row in biased] == [2]
    assert (biased[0]["du_px"], biased[0]["dv_px"]) == pytest.approx((0.4, -0.2))


def test_sigma_is_called_calibrated_where_errors_follow_it():
    rng = np.random.default_rng(4)
    u, v = rng.uniform(30, 480, 4000), rng.uniform(30, 480, 4000)
    parts = []
    for k in range(40):
        truth, found = scene(u[[100 * k]], v[[100 * k]], sigma=0.7)
        error_u, error_v = rng.normal(0, 0.7, (2, 1))
        parts.append((truth, replace(found, u_px=found.u_px + error_u, v_px=found.v_px + error_v)))
    calibration = figures_of(parts, [LOW] * 40)["sigma_calibration"]
    # 80 draws: the rms of a unit Gaussian is known to 1 / sqrt(160) = 0.08.
    assert calibration["rms"] == pytest.approx(1.0, abs=0.25)
    assert calibration["by_altitude_km"][0]["pairs"] == 40


def test_states_said_are_counted_against_the_terrains_own():
    fresh = scene([100, 200], [100, 200], depth=0.15, said=0.15)
    wrong = scene([100], [100], depth=0.15, said=0.03)
    state = figures_of([fresh, wrong], [LOW, LOW])["degradation_state"]
    assert state["confusion"] == [[0, 0, 0], [0, 0, 0], [1, 0, 2]]
    assert state["agreement"] == pytest.approx(2 / 3)


def test_thresholds_of_three_purposes_are_scored_side_by_side():
    figures = figures_of([scene([100], [100])], [LOW])
    assert figures["micro"]["recall"] == 1.0
    assert figures["balanced"]["strict"]["recall"] == 1.0
    assert figures["navigation"]["threshold"] == 0.7


def test_no_detections_at_all_give_nan_and_zero_rather_than_an_error():
    figures = figures_of([scene([100], [100], found=[False])], [LOW])
    assert figures["micro"]["recall"] == 0.0
    assert figures["sigma_calibration"]["pairs"] == 0


def test_average_precision_of_a_ranking_done_by_hand():
    # Ranked right, wrong, right over 2 craters: areas 0.5 * 1 + 0.5 * 2/3.
    truth, _ = scene([100, 200], [100, 200])
    found = FrameDetections(
        np.array([100.0, 400.0, 200.0]),
        np.array([100.0, 400.0, 200.0]),
        np.full(3, 30.0),
        np.full(3, 7_000.0),
        np.array([0.9, 0.8, 0.7]),
        np.ones(3),
    )
    assert average_precision(tally([truth], [found])) == pytest.approx(0.5 + 0.5 * 2 / 3)
