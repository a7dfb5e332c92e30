"""The calibration in a model's metadata: whose it is, and what it does to detections."""

import json

import numpy as np
from pytest import approx, fixture, mark, raises

from payload_emulator.errors import ModelError
from payload_emulator.flight.models import load_shipped_model
from payload_emulator.flight.vision.calibration import (
    CALIBRATION_KEY,
    SigmaModel,
    format_calibration,
    load_calibration,
    network_sha256,
    sigma_features,
    with_metadata,
    with_sigma,
)
from payload_emulator.flight.vision.detections import Detections
from payload_emulator.flight.vision.detector import OnnxDetector
from tests.payload_emulator.bowls import bowl_image

SUN = np.array([0.1, -0.95, -0.17])
SIGMA = SigmaModel(
    fresh=(np.log(0.5), 0.0, 0.0, 0.0, 0.0, 0.0), total=(np.log(1.0), 1.0, 0.0, 0.0, 0.0, 0.0),
    low=(1.0, -1.0, -5.0, 0.0, 0.0, 0.0), high=(1.0, 1.0, 5.0, 3.0, 10.0, 3.0)
)  # fmt: skip


@fixture(scope="module")
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


def test_the_hash_of_a_network_does_not_depend_on_its_metadata_which_are_loaded_as_stored(plain):
    other = with_metadata(plain, {"a": "b" * 300, "c": "é"})
    assert network_sha256(other) == network_sha256(plain) == network_sha256(load_shipped_model())
    assert OnnxDetector(other).metadata == {"a": "b" * 300, "c": "é"}
    changed = bytearray(plain)
    changed[len(changed) // 2] ^= 1
    assert network_sha256(bytes(changed)) != network_sha256(plain)
    assert OnnxDetector(calibrated(plain, SIGMA)).calibration == SIGMA
    assert OnnxDetector(plain).calibration is None


OTHERS = """{"version": 2} | expected version 1, found 2
{"network_sha256": "0000000000000000000000000000000000000000000000000000000000000000"} | a calibration of this network
{"sun": {}, "score": {}} | expected standard deviations alone, found score, sun
{"sigma": {"fresh": [1.0, 2.0]}} | 6 finite numbers expected, 2 values found
{"sigma": {"fresh": [NaN, NaN, NaN, NaN, NaN, NaN]}} | 6 finite numbers expected
{"sigma": {}} | fresh"""


@mark.parametrize("row", OTHERS.splitlines())
def test_a_calibration_that_does_not_fit_is_refused(plain, row):
    change, said = row.split(" | ")
    document = json.loads(format_calibration(SIGMA, plain)) | json.loads(change)
    with raises(ModelError, match=said):
        load_calibration({CALIBRATION_KEY: json.dumps(document)}, plain)


def test_text_that_is_no_calibration_is_refused(plain):
    for text in ("{", "[]", "3"):
        with raises(ModelError, match="expected"):
            load_calibration({CALIBRATION_KEY: text}, plain)
    with raises(ModelError, match="expected an ONNX file"):
        network_sha256(b"\xff\xff\xff")


def test_standard_deviations_are_stated_in_two_parts():
    found = detections()
    features = sigma_features(found, SUN, 512, 512)
    assert features[0] == approx([1.0, 0.0, np.log(2.0), 1.0, 1.7 / np.linalg.norm(SUN), 0.0], abs=1e-12)
    assert features[1, 5] == approx(255.5 / 256.0)
    stated = with_sigma(found, SIGMA, features)
    # ln(80 / 20) is beyond what was seen: the last value holds.
    assert stated.sigma_px == approx([1.0, np.e])
    assert stated.persistence == approx([0.75, 1.0 - 0.25 / np.e**2])
    assert stated.select(np.array([1])).persistence == approx(stated.persistence[1:])


def test_without_a_sun_or_on_another_size_typical_values_are_used():
    found = detections()
    assert sigma_features(found, None, 512, 512)[0, 4] == approx(1.7)
    assert sigma_features(found, np.full(3, np.nan), 512, 512)[0, 4] == approx(1.7)
    assert sigma_features(found, SUN, 300, 200, whole=False)[:, 5] == approx([0.7, 0.7])


def test_a_calibrated_detector_states_deviations_and_moves_nothing(plain):
    image = bowl_image()
    raw = OnnxDetector(plain).detect(image, SUN)
    found = OnnxDetector(calibrated(plain, SIGMA)).detect(image, SUN)
    assert found.u_px == approx(raw.u_px) and found.score == approx(raw.score)
    assert found.persistence is not None and raw.persistence is None
    assert np.all((found.persistence > 0.0) & (found.persistence < 1.0))
