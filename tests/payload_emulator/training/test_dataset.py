"""Data sets on disk: what is written can be read, checked and refused."""

import json
import shutil

import numpy as np
import pytest

from payload_emulator.errors import DatasetError
from payload_emulator.training import dataset as store
from payload_emulator.training.integrity import check
from payload_emulator.training.targets import Tier


@pytest.fixture
def copy(blob_dataset, tmp_path):
    shutil.copytree(blob_dataset.folder, tmp_path / "set")
    return tmp_path / "set"


def test_frames_come_back_by_split(blob_dataset):
    assert {split: len(blob_dataset.frames(split)) for split in ("train", "val", "test")} == {
        "train": 24,
        "val": 6,
        "test": 4,
    }
    frame = blob_dataset.frames("val")[0]
    assert blob_dataset.image(frame).shape == (512, 512)
    assert frame.craters["u_px"].shape == frame.craters["id"].shape


def test_a_whole_data_set_has_no_problems(blob_dataset):
    assert check(blob_dataset.folder) == []


def test_every_missing_or_damaged_file_is_named(copy):
    (copy / "images" / "000003.png").unlink()
    (copy / "images" / "000004.png").write_bytes(b"\x89PNG broken")
    (copy / "metadata" / "000005.json").unlink()
    problems = "\n".join(check(copy))
    for name in ("000003.png", "000004.png", "000005.json"):
        assert name in problems


def test_changed_labels_are_found_by_their_hash(copy):
    path = copy / "shards" / "00000.npz"
    labels = store.load_shard(path)
    labels.craters["u_px"][0] += 1.0
    store.write_shard(copy, "00000", labels)
    assert any("SHA-256" in problem for problem in check(copy))


def test_a_folder_without_a_data_set_is_refused(tmp_path):
    with pytest.raises(DatasetError, match="expected a data set"):
        store.Dataset(tmp_path)


def test_a_data_set_of_another_schema_is_refused(copy):
    index = json.loads((copy / "dataset.json").read_text())
    index["schema_version"] = 99
    (copy / "dataset.json").write_text(json.dumps(index))
    with pytest.raises(DatasetError, match="schema_version: expected 1, found 99"):
        store.Dataset(copy)


def test_a_damaged_shard_is_refused(copy):
    (copy / "shards" / "00001.npz").write_bytes(b"PK damaged")
    with pytest.raises(DatasetError, match=r"00001\.npz"):
        store.Dataset(copy)


def test_coco_boxes_surround_their_centres(blob_dataset):
    coco = json.loads((blob_dataset.folder / "coco_train.json").read_text())
    assert len(coco["images"]) == 24
    assert {c["id"] for c in coco["categories"]} == {0, 1, 2, 3}
    for a in coco["annotations"]:
        x, y, w, h = a["bbox"]
        # COCO counts from the corner of the first pixel, labels from its centre; both are rounded to 0.01 px.
        assert x + w / 2 == pytest.approx(a["centre"][0] + 0.5, abs=0.02)
        assert y + h / 2 == pytest.approx(a["centre"][1] + 0.5, abs=0.02)


def test_the_ground_diameter_undoes_the_projection(blob_dataset):
    frame = blob_dataset.frames("test")[0]
    c = frame.craters
    ground = store.diameter_on_ground_m(blob_dataset, frame, c["u_px"], c["v_px"], c["diameter_px"])
    # Labels of this set were made flat; the curved ground is up to 4 % farther in the corners from 30 km.
    assert ground == pytest.approx(c["diameter_m"], rel=0.05)
    middle = store.diameter_on_ground_m(
        blob_dataset, frame, np.array([255.5]), np.array([255.5]), np.array([25.0])
    )
    assert middle == pytest.approx(25.0 * 30_000.0 / 147.8017, rel=1e-6)


def craters(**changes):
    base = {
        "id": 7,
        "u_px": 100.0,
        "v_px": 100.0,
        "diameter_px": 30.0,
        "diameter_m": 6000.0,
        "depth_ratio": 0.12,
        "lit": 0.9,
        "hidden": 0,
    } | changes
    return {key: np.array([value]) for key, value in base.items()}


@pytest.mark.parametrize(
    ("change", "tier"),
    [
        ({}, Tier.LABEL),
        ({"depth_ratio": 0.01}, Tier.IGNORE),
        ({"depth_ratio": np.nan}, Tier.IGNORE),
        ({"diameter_px": 6.0}, Tier.IGNORE),
        ({"diameter_m": 2200.0}, Tier.IGNORE),
        ({"diameter_m": 1200.0, "id": -4}, Tier.LABEL),
        ({"lit": 0.0}, Tier.IGNORE),
        ({"hidden": 1}, Tier.IGNORE),
        ({"u_px": -5.0}, Tier.IGNORE),
    ],
)
def test_what_can_be_seen_is_a_label_and_the_rest_is_ignored(change, tier):
    tiers, weights = store.choose_tiers(craters(**change), 512, 512, complete=False)
    assert tiers[0] == tier
    assert 0.3 <= weights[0] <= 1.0


def test_deeper_craters_weigh_more():
    _, shallow = store.choose_tiers(craters(depth_ratio=0.03), 512, 512, False)
    _, deep = store.choose_tiers(craters(depth_ratio=0.1), 512, 512, False)
    assert shallow[0] < deep[0] == 1.0
