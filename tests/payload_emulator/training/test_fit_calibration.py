"""The fit finds what was put in: scores by size, the pull of the Sun, registration, and two parts of sigma."""

import numpy as np
import pytest

from payload_emulator.errors import DatasetError
from payload_emulator.flight.models import load_shipped_model
from payload_emulator.flight.vision.calibration import CALIBRATION_KEY
from payload_emulator.flight.vision.detector import OnnxDetector
from payload_emulator.training.model.fit_calibration import (
    FRESH_FACTOR,
    Pairs,
    fit_calibration,
    fit_score,
    fit_sigma,
    fit_sun,
    format_calibration_figures,
    plain_model,
    sun_directions,
)
from tests.payload_emulator.training.conftest import found_at, truth_of


def scored_frames(count=150, seed=1):
    """Detections far from each other; right with the odds of exp(2 logit(score) + 1 - ln(diameter / 20))."""
    rng = np.random.default_rng(seed)
    truths, found = [], []
    u, v = (part.ravel() for part in np.meshgrid(np.arange(40.0, 500.0, 60.0), np.arange(40.0, 500.0, 60.0)))
    for _ in range(count):
        diameter = np.exp(rng.uniform(np.log(10.0), np.log(80.0), u.size))
        score = np.sort(rng.uniform(0.1, 0.9, u.size))[::-1]
        odds = np.exp(2.0 * np.log(score / (1.0 - score)) + 1.0 - np.log(diameter / 20.0))
        right = rng.uniform(size=u.size) < odds / (1.0 + odds)
        found.append(found_at(u, v, diameter, 8e3, score))
        truths.append(truth_of(u[right], v[right], diameter[right], diameter_m=8e3))
    return truths, found


def test_the_odds_put_in_are_the_odds_found():
    model = fit_score(*scored_frames())
    assert model.slope == pytest.approx(2.0, rel=0.1)
    offset = np.interp(np.log([14.0, 20.0, 40.0]), model.log_diameter_px, model.offset)
    # Some 10,000 detections: the standard error of an offset is about 0.08.
    assert offset == pytest.approx(1.0 - np.log(np.array([14.0, 20.0, 40.0]) / 20.0), abs=0.3)
    half = model.probability(np.array([0.5]), np.array([20.0]))[0]
    assert half == pytest.approx(np.e / (1.0 + np.e), abs=0.05)


def test_too_few_detections_are_refused():
    with pytest.raises(DatasetError, match="expected at least 200 detections"):
        fit_score(*scored_frames(2))


def pairs(pull=(0.3, 0.2, 0.4), ground_m=((60.0, -30.0), (-20.0, 10.0)), lasting=1.2, fresh=0.4, seed=2):
    """Craters seen four times under one Sun, with a pull, a registration of two cells, and an error in two parts."""
    rng = np.random.default_rng(seed)
    error, directions, scale, place, crater, size = [], [], [], [], [], []
    for number in range(3_000):
        azimuth = rng.uniform(-np.pi, np.pi)
        sun = np.array([np.sin(azimuth), -np.cos(azimuth), -0.2])
        diameter = float(np.exp(rng.uniform(np.log(10.0), np.log(60.0))))
        cell, m_per_px = number % 2, rng.uniform(100.0, 300.0)
        own = lasting * diameter / 20.0 * rng.standard_normal(2)
        toward = sun_directions(np.array([diameter]), sun)[0]
        east, north = ground_m[cell]
        for _ in range(4):
            moved = toward @ np.array(pull) + np.array([east, -north]) / m_per_px
            error.append(moved + own + fresh * rng.standard_normal(2))
            directions.append(toward)
            scale.append(m_per_px)
            place.append(cell)
            crater.append(number)
            size.append(np.log(diameter / 20.0))
    count = len(error)
    one = np.ones(count)
    features = np.stack([one, np.array(size), np.log(1.5) * one, one, 1.7 * one, rng.uniform(0, 1.4, count)], axis=1)
    return Pairs(np.array(error), features, np.array(directions), np.array(scale), np.array(place), np.array(crater))


def test_pull_and_registration_are_separated():
    residual, evidence = fit_sun(pairs())
    assert tuple(evidence["coefficients_px"]) == pytest.approx((0.3, 0.2, 0.4), abs=0.08)
    assert max(evidence["standard_errors_px"]) < 0.05
    for row, (east, north) in zip(evidence["registration"], ((60.0, -30.0), (-20.0, 10.0)), strict=True):
        assert row["east_m"] == pytest.approx(east, abs=8.0)
        assert row["north_m"] == pytest.approx(north, abs=8.0)
        assert row["standard_error_m"] < 6.0
    assert np.abs(residual.mean(axis=0)).max() < 0.05


def test_lasting_and_fresh_errors_are_separated():
    from dataclasses import replace

    every = pairs()
    residual, _ = fit_sun(every)
    model, evidence = fit_sigma(replace(every, error_px=residual))
    for size in (-0.5, 0.0, 0.8):
        total, fresh = model.variances_px2(np.array([[1.0, size, np.log(1.5), 1.0, 1.7, 0.5]]))
        lasting = 1.2 * np.exp(size)
        assert np.sqrt(fresh[0]) == pytest.approx(FRESH_FACTOR * 0.4, rel=0.1)
        assert np.sqrt(total[0]) == pytest.approx(np.hypot(0.4, lasting), rel=0.15)
    assert evidence["mean_square_over_variance"] == pytest.approx(1.0, abs=0.05)


def test_craters_seen_once_do_not_tell_what_lasts():
    every = pairs()
    once = every.select(np.arange(every.place.size) % 4 == 0)
    with pytest.raises(DatasetError, match="several frames under one Sun"):
        fit_sigma(once)


def test_a_data_set_without_validation_frames_is_refused(make_blob_dataset, tmp_path):
    only_test = make_blob_dataset(tmp_path / "set", {"test": 1})
    with pytest.raises(DatasetError, match="expected frames of split 'val'"):
        fit_calibration(load_shipped_model(), [only_test])


def test_a_calibrated_model_gives_back_the_plain_one():
    octets = load_shipped_model()
    plain = plain_model(octets)
    metadata = OnnxDetector(plain).metadata
    assert CALIBRATION_KEY not in metadata and metadata["score_threshold"] == "0.44"
    assert plain_model(plain) == plain


def test_the_same_frames_give_the_same_file(blob_dataset, monkeypatch):
    from payload_emulator.training.model import fit_calibration as module

    monkeypatch.setattr(module, "_pairs", lambda *_: pairs())
    monkeypatch.setattr(module, "_LEAST_ROWS", 10)
    first, document = fit_calibration(load_shipped_model(), [blob_dataset])
    again, _ = fit_calibration(first, [blob_dataset])
    assert again == first
    assert OnnxDetector(first).calibration.fresh == tuple(document["sigma"]["fresh"])
    assert plain_model(first) == plain_model(load_shipped_model())
    text = format_calibration_figures(document)
    assert "pull of the Sun" in text and "lasting share" in text and "registration" in text
