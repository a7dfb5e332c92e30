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


def test_numbers_come_back_bit_for_bit(whole_pass: PassReport) -> None:
    assert whole_pass.reference is not None
    back = np.array(json.loads(to_json(whole_pass))["reference"]["latitude_deg"])
    assert np.array_equal(back, whole_pass.reference.latitude_deg)


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
