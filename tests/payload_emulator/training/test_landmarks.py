"""Learned craters as labels of a training: where they are in view, and how their file is read."""

from dataclasses import replace

import numpy as np
import pytest

from payload_emulator.errors import DatasetError
from payload_emulator.training.data.landmarks import load_landmarks, with_landmarks

HEADER = "latitude_deg,longitude_deg,height_m,diameter_m,sightings,looks,score\n"


@pytest.fixture
def landmarks(tmp_path):
    # 30 km over latitude and longitude 0: 203 m to the pixel, u to the east, v to the south, 30,323 m to the degree.
    place = f"{(255.5 - 150.0) * 203.0 / 30_323:.6f},{(200.0 - 255.5) * 203.0 / 30_323:.6f}"
    path = tmp_path / "labels.csv"
    path.write_text(f"{HEADER}{place},0,8119,4,5,0.800\n")
    return load_landmarks(path)


def test_landmarks_become_labels_where_they_are_in_view(blob_dataset, landmarks):
    frame = blob_dataset.frames("train")[0]
    bare = replace(frame, craters={key: values[:0] for key, values in frame.craters.items()})
    taught = with_landmarks(blob_dataset, bare, landmarks)
    # 21 and 11 km from the point below, the ground lies 167 m lower: 0.6 % closer to the middle.
    assert taught.craters["u_px"][-1] == pytest.approx(255.5 - 55.5 * 0.9944, abs=0.05)
    assert taught.craters["v_px"][-1] == pytest.approx(255.5 - 105.5 * 0.9944, abs=0.05)
    assert taught.craters["diameter_px"][-1] == pytest.approx(40.0, rel=0.02)
    assert taught.craters["id"][-1] > 1_000_000_000
    assert bare.craters["u_px"].size == 0
    away = replace(bare, position_mcmf_m=bare.position_mcmf_m + np.array([0.0, 90_000.0, 0.0]))
    assert with_landmarks(blob_dataset, away, landmarks).craters["u_px"].size == 0


def test_a_file_that_holds_no_landmarks_is_refused(tmp_path):
    path = tmp_path / "l.csv"
    path.write_text("a,b\n1,2\n")
    with pytest.raises(DatasetError, match="expected landmarks"):
        load_landmarks(path)
