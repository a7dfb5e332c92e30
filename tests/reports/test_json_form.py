"""The JSON form of a report."""

import hashlib
import json

import numpy as np

from reports.json_form import to_json
from reports.values import GalleryFrame, PassReport
from tests.reports import example


def test_the_same_value_gives_the_same_text(whole_pass: PassReport) -> None:
    assert to_json(whole_pass) == to_json(example.pass_report(gallery=3, worst=5))


def test_all_fields_are_there_under_their_own_names(whole_pass: PassReport) -> None:
    body = json.loads(to_json(whole_pass))
    assert body["kind"] == "PassReport" and body["schema_version"] == 1
    assert set(PassReport.__dataclass_fields__) <= set(body)
    assert [s["name"] for s in body["navigation"]][:3] == ["paper", "spherical", "anchored"]
    assert body["packets"]["by_apid"]["160"]["name"] == "housekeeping"


def test_times_stay_whole_nanoseconds(whole_pass: PassReport) -> None:
    body = json.loads(to_json(whole_pass))
    assert body["reference"]["utc_ns"][0] == int(whole_pass.navigation[0].utc_ns[0])
    assert isinstance(body["reference"]["utc_ns"][0], int)


def test_numbers_come_back_to_nine_digits(whole_pass: PassReport) -> None:
    assert whole_pass.reference is not None
    back = np.array(json.loads(to_json(whole_pass))["reference"]["latitude_deg"])
    np.testing.assert_allclose(back, whole_pass.reference.latitude_deg, rtol=5.1e-9, atol=0)


def test_every_number_with_a_fraction_has_at_most_nine_digits_and_is_the_nearest_such() -> None:
    signs = np.random.default_rng(1).choice((-1.0, 1.0), 2000)
    values = signs * 10.0 ** np.random.default_rng(2).uniform(-11, 8, 2000)
    edges = [0.1, 1 / 3, 9.9999999996, 0.99999999951, 123456.7890123, 1e-5, 99999999.96]
    ours = np.concatenate([values, edges])
    report = PassReport("a", "b", configuration={"x": {"y": ours}})
    text = to_json(report).split('"y":[', 1)[1].split("]", 1)[0].split(",")
    assert [float(one) for one in text] == [float(f"{value:.9g}") for value in ours]
    assert max(len(one.split("e")[0].removesuffix(".0").replace(".", "").lstrip("-0")) for one in text) == 9


def test_whole_numbers_and_the_very_small_stay_as_they_are() -> None:
    values = [1.8e18 + 256.0, 2_000_000_001.0, 0.0, 1.2345678912345e-13]
    report = PassReport("a", "b", configuration={"x": {"y": np.array(values), "z": 2_000_000_001.0}})
    assert json.loads(to_json(report))["configuration"]["x"] == {"y": values, "z": values[1]}


def test_values_that_are_no_number_become_null(whole_pass: PassReport) -> None:
    text = to_json(whole_pass)
    assert "NaN" not in text and "Infinity" not in text
    snapshot = next(s for s in json.loads(text)["navigation"] if s["name"] == "snapshot fix")
    assert any(row == [None, None, None] for row in snapshot["error_rtn_m"])
    assert snapshot["statistics"]["drift_percent"] is None


def test_images_are_named_by_their_hash(whole_pass: PassReport) -> None:
    frame: GalleryFrame = whole_pass.gallery[0]
    image = json.loads(to_json(whole_pass))["gallery"][0]["image"]
    assert image == {"shape": [512, 512], "sha256": hashlib.sha256(frame.image.tobytes()).hexdigest()}
