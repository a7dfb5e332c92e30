"""Uncatalogued landmarks: what recurs under different Suns is one, what a single light makes is none."""

from dataclasses import replace

import numpy as np
import pytest

from payload_emulator.errors import DatasetError
from payload_emulator.training.evaluate.landmarks import (
    RecurrenceRule,
    find_landmarks,
    format_landmarks,
    load_landmarks,
    study,
    with_landmarks,
)
from payload_emulator.training.evaluate.scoring import FrameDetections


def looks(dataset, count, azimuths):
    """The first frame of a data set without its craters, as if seen again under other Suns."""
    frame = dataset.frames("train")[0]
    bare = replace(frame, craters={key: values[:0] for key, values in frame.craters.items()})
    return [
        (dataset, replace(bare, number=k, values={**frame.values, "sun_azimuth_deg": azimuths[k]}))
        for k in range(count)
    ]


def hollow(u=200.0, v=150.0, diameter_px=40.0, score=0.8):
    one = (np.array([value]) for value in (u, v, diameter_px, diameter_px * 30_000 / 147.8, score, 1.0))
    return FrameDetections(*one)


def test_what_recurs_under_different_suns_is_a_landmark_where_it_was_seen(blob_dataset):
    frames = looks(blob_dataset, 4, [0.0, 90.0, 180.0, 270.0])
    found = [hollow(u=200.0 + k) for k in range(4)]
    landmarks = find_landmarks(frames, found, 0.5)
    assert len(landmarks) == 1
    assert landmarks.sightings[0] == landmarks.looks[0] == 4
    # 30 km over the point at latitude and longitude 0: 203 m to the pixel, u to the east, v to the south.
    assert np.degrees(landmarks.longitude_rad[0]) * 30_323 == pytest.approx((201.5 - 255.5) * 203.0, rel=0.02)
    assert np.degrees(landmarks.latitude_rad[0]) * 30_323 == pytest.approx((255.5 - 150.0) * 203.0, rel=0.02)


@pytest.mark.parametrize(
    ("azimuths", "seen"),
    [([0.0, 10.0, 20.0, 30.0], 4), ([0.0, 90.0, 180.0, 270.0], 2)],
    ids=["one light", "seen twice only"],
)
def test_one_light_or_too_few_sightings_make_none(blob_dataset, azimuths, seen):
    frames = looks(blob_dataset, 4, azimuths)
    nothing = FrameDetections(*(np.empty(0) for _ in range(6)))
    found = [hollow() if k < seen else nothing for k in range(4)]
    assert len(find_landmarks(frames, found, 0.5)) == 0


def test_what_the_catalogue_explains_is_no_landmark(blob_dataset):
    frame = blob_dataset.frames("train")[0]
    u, v, d = (float(frame.craters[key][0]) for key in ("u_px", "v_px", "diameter_px"))
    # 203 m to the pixel and 30,323 m to the degree at the point below.
    place = {"latitude_deg": (255.5 - v) * 203.0 / 30_323, "longitude_deg": (u - 255.5) * 203.0 / 30_323}
    craters = {key: np.full_like(frame.craters[key], value) for key, value in place.items()}
    frame = replace(frame, craters=frame.craters | craters)
    frames = [
        (blob_dataset, replace(frame, number=k, values={**frame.values, "sun_azimuth_deg": 90.0 * k}))
        for k in range(4)
    ]
    found = [hollow(u, v, d)] * 4
    assert len(find_landmarks(frames, found, 0.5)) == 0
    landmarks, figures = study(frames, found, 0.5, hidden_share=1.0)
    assert len(landmarks) == 1
    assert figures["landmarks_that_were_hidden"] == 1
    assert figures["of_these_on_landmarks"] == figures["false_alarms_off_every_crater"]


def test_landmarks_become_labels_where_they_are_in_view(blob_dataset):
    frames = looks(blob_dataset, 4, [0.0, 90.0, 180.0, 270.0])
    landmarks = find_landmarks(frames, [hollow()] * 4, 0.5)
    taught = with_landmarks(*frames[0], landmarks)
    assert taught.craters["u_px"][-1] == pytest.approx(200.0, abs=0.05)
    assert taught.craters["v_px"][-1] == pytest.approx(150.0, abs=0.05)
    assert taught.craters["diameter_px"][-1] == pytest.approx(40.0, rel=0.02)
    assert taught.craters["id"][-1] > 1_000_000_000
    assert frames[0][1].craters["u_px"].size == 0


def test_a_file_of_landmarks_is_read_as_it_was_written(blob_dataset, tmp_path):
    frames = looks(blob_dataset, 3, [0.0, 120.0, 240.0])
    landmarks = find_landmarks(frames, [hollow()] * 3, 0.5, RecurrenceRule(sightings=3))
    path = tmp_path / "l.csv"
    path.write_text(format_landmarks(landmarks))
    read = load_landmarks(path)
    # Five decimals of a degree are 0.3 m.
    assert read.latitude_rad == pytest.approx(landmarks.latitude_rad, abs=1e-6)
    assert read.sightings.tolist() == [3]


def test_a_file_that_holds_no_landmarks_is_refused(tmp_path):
    path = tmp_path / "l.csv"
    path.write_text("a,b\n1,2\n")
    with pytest.raises(DatasetError, match="expected landmarks"):
        load_landmarks(path)
