"""Two networks on the same frames: the difference is paired, and the picture shows both."""

import pytest

from payload_emulator.flight.models import load_shipped_model
from payload_emulator.flight.vision.calibration import with_metadata
from payload_emulator.flight.vision.detector import OnnxDetector
from payload_emulator.training.evaluate.compare import compare, format_comparison
from payload_emulator.training.evaluate.scoring import bootstrap_f1_difference, tally
from payload_emulator.training.model.fit_calibration import plain_model


@pytest.fixture(scope="module")
def compared(blob_dataset):
    """The shipped network against itself at a threshold that hardly any detection reaches."""
    plain = plain_model(load_shipped_model())
    metadata = dict(OnnxDetector(plain).metadata)
    at = {limit: with_metadata(plain, metadata | {"score_threshold": limit}) for limit in ("0.2", "0.95")}
    return compare((at["0.2"], at["0.95"]), [blob_dataset], "test")


def test_each_network_is_scored_at_its_own_threshold(compared):
    document, (one, other) = compared
    assert (document["network"]["threshold"], document["reference"]["threshold"]) == (0.2, 0.95)
    strict = document["network"]["strict_5_to_30_km"]
    expected = tally(one.truths, one.found).figures(0.2)
    assert strict["f1"] == expected.f1 > document["reference"]["strict_5_to_30_km"]["f1"]
    difference = document["f1_difference"]["strict_5_to_30_km"]
    assert difference["value"] == pytest.approx(
        strict["f1"] - document["reference"]["strict_5_to_30_km"]["f1"]
    )
    low, high = difference["interval_95"]
    assert 0.0 < low <= difference["value"] <= high
    assert document["level"].startswith("2 ") and document["frames"] == len(one.frames) == len(other.frames)
    text = format_comparison(document)
    assert "difference of F1" in text and "without registration" in text and "rms of error over sigma" in text


def test_a_network_does_not_differ_from_itself(compared):
    _, (one, _) = compared
    tallied = tally(one.truths, one.found)
    assert bootstrap_f1_difference(tallied, tallied, 0.2) == (0.0, 0.0)
    low, high = bootstrap_f1_difference(tallied, tallied, 0.2, reference_threshold=0.95)
    assert 0.0 < low <= high
