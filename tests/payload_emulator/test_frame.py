import dataclasses
import json

import numpy as np
import pytest

from lunar.datafolder import DataFolder
from lunar.timescales import parse_utc
from payload_emulator.errors import ScenarioError
from payload_emulator.session.scenario import SHIPPED, load_scenario
from payload_emulator.session.world.frame import render_frame

EPOCH = parse_utc("2029-08-07T00:10:00Z")


@pytest.fixture(scope="module")
def scenario():
    scenario = load_scenario(SHIPPED / "selenita.toml")
    terrain = dataclasses.replace(scenario.terrain, source="procedural")
    return dataclasses.replace(scenario, terrain=terrain)


@pytest.fixture(scope="module")
def frame(scenario):
    return render_frame(scenario, DataFolder(), EPOCH)


def test_a_frame_tells_where_it_was_taken_and_under_what_sun(frame):
    assert frame.image.shape == (512, 512, 3) and frame.image.dtype == np.uint8
    assert frame.metadata["epoch"] == "2029-08-07T00:10:00.000Z"
    # The paper's light, and its orbit's altitudes.
    assert 5.0 <= frame.metadata["sun_elevation_deg"] <= 15.0
    assert -45.0 <= frame.metadata["sun_azimuth_deg"] <= 45.0
    assert 10.0 < frame.metadata["altitude_km"] < 60.0
    assert len(frame.metadata["corners_deg"]) == 4


def test_metadata_and_labels_are_json_without_nan(frame):
    text = json.dumps({"metadata": frame.metadata, "labels": frame.labels}, allow_nan=False)
    assert json.loads(text)["labels"] == frame.labels
    assert any(label["inside"] for label in frame.labels)


def test_the_same_scenario_and_epoch_give_the_same_picture(scenario, frame):
    again = render_frame(scenario, DataFolder(), EPOCH)
    np.testing.assert_array_equal(again.image, frame.image)
    assert again.labels == frame.labels


def test_an_epoch_before_the_orbit_is_refused(scenario):
    with pytest.raises(ScenarioError, match="at or after the scenario's"):
        render_frame(scenario, DataFolder(), EPOCH - 10**15)


def test_an_unknown_renderer_is_refused(scenario):
    with pytest.raises(ScenarioError, match="fast, raymarch, cycles, found 'magic'"):
        render_frame(scenario, DataFolder(), EPOCH, "magic")
