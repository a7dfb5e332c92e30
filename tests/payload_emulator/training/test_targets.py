"""Targets and what the flight decoder makes of a network that says exactly what it was told to."""

import numpy as np
import pytest

from payload_emulator.flight.vision.detector import decode
from payload_emulator.training.data.targets import Tier, make_targets


def perfect_maps(u, v, diameter):
    n = len(u)
    t = make_targets(
        512,
        512,
        np.array(u, float),
        np.array(v, float),
        np.array(diameter, float),
        np.full(n, Tier.LABEL, np.int8),
        np.ones(n),
    )
    geometry = np.concatenate([t.geometry, np.zeros((1, 128, 128), np.float32)])
    return t, geometry


def test_decoding_the_targets_returns_the_craters():
    rng = np.random.default_rng(1)
    u = np.array([20.3, 100.0, 255.5, 333.9, 480.2])
    v = np.array([30.7, 200.1, 255.5, 90.4, 470.9])
    diameter = rng.uniform(12.0, 120.0, 5)
    t, geometry = perfect_maps(u, v, diameter)
    found = decode(t.heat[0], geometry, 0.99)
    order = np.argsort(found.u_px)
    # The mean over nine cells is exact where all nine point at one centre; float32 offsets leave 1e-5 px.
    assert found.u_px[order] == pytest.approx(u, abs=1e-3)
    assert found.v_px[order] == pytest.approx(v, abs=1e-3)
    assert found.diameter_px[order] == pytest.approx(diameter, rel=1e-4)


def test_an_ignored_crater_takes_the_loss_away_around_it_and_adds_no_heat():
    t = make_targets(
        512,
        512,
        np.array([200.0]),
        np.array([100.0]),
        np.array([60.0]),
        np.array([Tier.IGNORE], np.int8),
        np.ones(1),
    )
    assert t.heat.max() == 0.0 and t.weight.max() == 0.0 and t.regressed.max() == 0.0
    assert t.negative[0, 25, 50] == 0.0
    assert t.negative[0, 25, 80] == 1.0


def test_a_label_beside_an_ignored_crater_keeps_its_own_weight():
    t = make_targets(
        512,
        512,
        np.array([200.0, 206.0]),
        np.array([100.0, 100.0]),
        np.array([60.0, 40.0]),
        np.array([Tier.IGNORE, Tier.LABEL], np.int8),
        np.array([1.0, 0.7]),
    )
    assert t.weight.max() == pytest.approx(0.7)


def test_class_heatmaps_follow_the_common_one():
    t = make_targets(
        512,
        512,
        np.array([100.0, 300.0]),
        np.array([100.0, 300.0]),
        np.array([40.0, 60.0]),
        np.full(2, Tier.LABEL, np.int8),
        np.ones(2),
        np.array([0, 3], np.int8),
    )
    assert t.heat.shape[0] == 4
    assert t.heat[1].max() == 1.0 and t.heat[2].max() == 0.0 and t.heat[3].max() == 0.0
    assert (t.heat[0] == 1.0).sum() == 2


def test_no_craters_give_a_plain_background():
    t, _ = perfect_maps([], [], [])
    assert t.heat.max() == 0.0 and t.negative.min() == 1.0


def test_heat_falls_with_distance_in_units_of_the_radius():
    t, _ = perfect_maps([257.5], [257.5], [80.0])
    # sigma = 0.22 R = 2.2 cells: one sigma away exp(-1/2).
    assert t.heat[0, 64, 64] == 1.0
    assert t.heat[0, 64, 66] == pytest.approx(np.exp(-0.5 * (2 / 2.2) ** 2), rel=1e-5)
