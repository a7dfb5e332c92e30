"""The calibration in a model's metadata: whose it is, and what it does to detections."""

import json

import numpy as np
import pytest

from payload_emulator.errors import ModelError
from payload_emulator.flight.models import load_shipped_model
from payload_emulator.flight.vision.calibration import (
    CALIBRATION_KEY,
    Calibration,
    ScoreModel,
    SigmaModel,
    SunModel,
    format_calibration,
    load_calibration,
    network_sha256,
    sigma_features,
    sun_directions,
    with_metadata,
    with_sigma,
    without_pull,
)
from payload_emulator.flight.vision.detections import Detections
from payload_emulator.flight.vision.detector import DetectorParameters, OnnxDetector
from payload_emulator.flight.vision.picture_search import find_sun
from payload_emulator.flight.vision.preprocess import prepare_image
from tests.payload_emulator.bowls import bowl_image

SUN = np.array([0.1, -0.95, -0.17])
SCORE = ScoreModel((float(np.log(12.0)), float(np.log(40.0))), (1.0, -1.0), 2.0)
SIGMA = SigmaModel(
    fresh=(np.log(0.5), 0.0, 0.0, 0.0, 0.0, 0.0),
    total=(np.log(1.0), 1.0, 0.0, 0.0, 0.0, 0.0),
    low=(1.0, -1.0, -5.0, 0.0, 0.0, 0.0),
    high=(1.0, 1.0, 5.0, 3.0, 10.0, 3.0),
)
PULL = SunModel((0.5, 0.25, 1.0))


@pytest.fixture(scope="module")
def plain():
    """The shipped network without a calibration."""
    octets = load_shipped_model()
    metadata = dict(OnnxDetector(octets).metadata)
    metadata.pop(CALIBRATION_KEY, None)
    return with_metadata(octets, metadata | {"score_threshold": "0.3"})


def calibrated(plain, calibration, **metadata):
    own = dict(OnnxDetector(plain).metadata) | metadata
    return with_metadata(plain, own | {CALIBRATION_KEY: format_calibration(calibration, plain)})


def detections(**columns):
    values = {"u_px": [255.5, 0.0], "v_px": [255.5, 255.5], "diameter_px": [20.0, 80.0]}
    values |= {"score": [0.6, 0.6], "sigma_px": [2.0, 2.0], "depth_ratio": [0.1, 0.1]} | columns
    return Detections(**{name: np.array(column, float) for name, column in values.items()})


def test_the_hash_of_a_network_does_not_depend_on_its_metadata(plain):
    other = with_metadata(plain, {"a": "b" * 300, "c": "é"})
    assert network_sha256(other) == network_sha256(plain) == network_sha256(load_shipped_model())
    assert OnnxDetector(other).metadata == {"a": "b" * 300, "c": "é"}
    changed = bytearray(plain)
    changed[len(changed) // 2] ^= 1
    assert network_sha256(bytes(changed)) != network_sha256(plain)


def test_what_was_stored_is_what_is_loaded(plain):
    whole = Calibration(SCORE, SIGMA, PULL)
    assert OnnxDetector(calibrated(plain, whole)).calibration == whole
    assert OnnxDetector(calibrated(plain, Calibration(sun=PULL))).calibration == Calibration(sun=PULL)
    assert OnnxDetector(plain).calibration == Calibration()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"version": 2}, "expected version 1, found 2"),
        ({"network_sha256": "0" * 64}, "expected a calibration of this network"),
        ({"sun": {"coefficients": [1.0, 2.0]}}, "3 finite numbers expected, 2 values found"),
        ({"sun": {"coefficients": [1.0, 2.0, float("nan")]}}, "3 finite numbers expected"),
        ({"score": {"log_diameter_px": [2.0, 1.0], "offset": [0, 0], "slope": 1}}, "knots that do not rise"),
        ({"score": {"log_diameter_px": [1.0], "offset": [0], "slope": -1}}, "not above zero"),
        ({"sigma": {}}, "fresh"),
    ],
)
def test_a_calibration_that_does_not_fit_is_refused(plain, change, said):
    document = json.loads(format_calibration(Calibration(SCORE, SIGMA, PULL), plain)) | change
    with pytest.raises(ModelError, match=said):
        load_calibration({CALIBRATION_KEY: json.dumps(document)}, plain)


def test_text_that_is_no_calibration_is_refused(plain):
    for text in ("{", "[]", "3"):
        with pytest.raises(ModelError, match="expected"):
            load_calibration({CALIBRATION_KEY: text}, plain)
    with pytest.raises(ModelError, match="expected an ONNX file"):
        network_sha256(b"\xff\xff\xff")


def test_one_probability_is_another_score_at_every_size():
    diameter = np.geomspace(6.0, 100.0, 40)
    assert np.all(np.diff(SCORE.probability(np.full(40, 0.5), diameter)) <= 0.0)
    assert SCORE.probability(np.array([0.5]), np.array([12.0]))[0] == pytest.approx(
        1.0 / (1.0 + np.exp(-1.0))
    )
    least = SCORE.least_score(0.5)
    assert SCORE.probability(np.array([least]), np.array([12.0]))[0] == pytest.approx(0.5)
    assert SCORE.probability(np.array([least]), np.array([40.0]))[0] < 0.5


def test_the_detector_keeps_what_reaches_the_probability(plain):
    image = bowl_image()
    raw = OnnxDetector(plain, DetectorParameters(score_threshold=0.02)).detect(image, SUN)
    expected = SCORE.probability(raw.score, raw.diameter_px)
    octets = calibrated(plain, Calibration(score=SCORE), score_threshold="0.6")
    found = OnnxDetector(octets).detect(image, SUN)
    assert 0 < len(found) < len(raw)
    assert found.score == pytest.approx(np.sort(expected[expected >= 0.6])[::-1])
    # The search for the Sun goes on with the scores of the network.
    gray = prepare_image(image).gray
    assert find_sun(OnnxDetector(octets), gray) == find_sun(OnnxDetector(plain), gray)


def test_standard_deviations_are_stated_in_two_parts():
    found = detections()
    features = sigma_features(found, SUN, 512, 512)
    assert features[0] == pytest.approx(
        [1.0, 0.0, np.log(2.0), 1.0, 1.7 / np.linalg.norm(SUN), 0.0], abs=1e-12
    )
    assert features[1, 5] == pytest.approx(255.5 / 256.0)
    stated = with_sigma(found, SIGMA, features)
    # ln(80 / 20) is beyond what was seen: the last value holds.
    assert stated.sigma_px == pytest.approx([1.0, np.e])
    assert stated.persistence == pytest.approx([0.75, 1.0 - 0.25 / np.e**2])
    assert stated.select(np.array([1])).persistence == pytest.approx(stated.persistence[1:])


def test_without_a_sun_or_on_another_size_typical_values_are_used():
    found = detections()
    assert sigma_features(found, None, 512, 512)[0, 4] == pytest.approx(1.7)
    assert sigma_features(found, np.full(3, np.nan), 512, 512)[0, 4] == pytest.approx(1.7)
    assert sigma_features(found, SUN, 300, 200, whole=False)[:, 5] == pytest.approx([0.7, 0.7])


@pytest.mark.parametrize("azimuth_deg", [0.0, 30.0, 120.0, -100.0])
def test_the_pull_of_the_sun_is_taken_out_along_and_across(azimuth_deg):
    azimuth = np.radians(azimuth_deg)
    sun = np.array([np.sin(azimuth), -np.cos(azimuth), -0.2])
    found = detections()
    moved = without_pull(found, PULL, sun)
    tilt = np.radians({0.0: 0.0, 30.0: 30.0, 120.0: 30.0, -100.0: -10.0}[azimuth_deg])
    along, across = np.array([0.75, 0.5 + 0.25 * 3.0]), np.sin(2 * tilt)
    assert found.u_px - moved.u_px == pytest.approx(along * np.sin(azimuth) + across * np.cos(azimuth))
    assert found.v_px - moved.v_px == pytest.approx(-along * np.cos(azimuth) + across * np.sin(azimuth))
    assert sun_directions(found.diameter_px, sun).shape == (2, 2, 3)


def test_without_a_direction_of_the_sun_nothing_is_moved():
    found = detections()
    for sun in (None, np.full(3, np.nan), np.array([0.0, 0.0, -1.0])):
        assert without_pull(found, PULL, sun) is found


def test_a_calibrated_detector_moves_and_states(plain):
    image = bowl_image()
    raw = OnnxDetector(plain).detect(image, SUN)
    found = OnnxDetector(calibrated(plain, Calibration(sigma=SIGMA, sun=PULL))).detect(image, SUN)
    pull = sun_directions(raw.diameter_px, SUN) @ np.array(PULL.coefficients)
    # Parallax is removed after the pull, so the shift grows by the same small factor.
    assert found.u_px == pytest.approx(raw.u_px - pull[:, 0], abs=0.02)
    assert found.v_px == pytest.approx(raw.v_px - pull[:, 1], abs=0.02)
    assert found.persistence is not None and raw.persistence is None
    assert np.all((found.persistence > 0.0) & (found.persistence < 1.0))
