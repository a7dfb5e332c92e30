"""Data sets on disk: what is written can be read, checked and refused."""

import json
import shutil

import numpy as np
import pytest
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from lunar.catalogue import size_class
from payload_emulator.errors import DatasetError
from payload_emulator.training.data import dataset as store
from payload_emulator.training.data.finishing import clipped, ellipse_polygon, polygon_area
from payload_emulator.training.data.integrity import check, summarise
from payload_emulator.training.data.targets import Tier
from payload_emulator.training.evaluate.sheets import CLASS_COLOURS, draw_frame, draw_sheet


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
    (copy / "coco_val.json").unlink()
    coco = copy / "coco_train.json"
    coco.write_bytes(coco.read_bytes().replace(b"2", b"3", 1))
    problems = "\n".join(check(copy))
    for name in ("000003.png", "000004.png", "000005.json", "coco_val.json", "coco_train.json"):
        assert name in problems


@pytest.mark.parametrize("missing", [True, False])
def test_a_lost_shard_does_not_hide_the_rest(copy, missing):
    (copy / "images" / "000025.png").unlink()
    path = copy / "shards" / "00000.npz"
    if missing:
        path.unlink()
    else:
        path.write_bytes(path.read_bytes()[:-30])
    problems = check(copy)
    assert any("00000.npz" in problem and "build again" in problem for problem in problems)
    assert any("000025.png" in problem for problem in problems)


def test_a_changed_index_is_found(copy):
    path = copy / "dataset.json"
    index = json.loads(path.read_text())
    index["camera"]["fov_deg"] = 119.0
    path.write_text(json.dumps(index))
    assert any("dataset.json" in problem for problem in check(copy))
    path.write_text("{")
    assert any("dataset.json: expected a JSON object" in problem for problem in check(copy))


def test_an_unfinished_data_set_is_told_from_none(copy):
    (copy / "dataset.json").unlink()
    with pytest.raises(DatasetError, match="found none"):
        check(copy)
    (copy / "recipe.json").write_text("{}")
    for open_it in (check, store.Dataset):
        with pytest.raises(DatasetError, match="found an unfinished one"):
            open_it(copy)


def test_rims_of_older_data_sets_are_round(copy):
    frame = store.Dataset(copy).frames()[0]
    np.testing.assert_array_equal(frame.craters["major_px"], frame.craters["diameter_px"])
    assert set(frame.craters["visible"]) == {1.0}


def test_counts_stand_beside_the_papers(blob_dataset):
    figures = summarise(blob_dataset.folder)
    assert figures["frames"] == 34 and figures["split"] == {"train": 24, "val": 6, "test": 4}
    assert [sum(k) for k in zip(*figures["instances_by_split"].values(), strict=True)] == figures["instances"]
    # The paper, section V-B.4: 51,924 frames, 72.8, 16.9 and 10.3 per cent.
    assert figures["paper"]["instances"] == [956_110, 221_860, 135_098]
    assert [round(100 * share, 1) for share in figures["paper"]["shares"]] == [72.8, 16.9, 10.3]
    assert figures["paper"]["instances_per_frame"][0] == pytest.approx(18.41, abs=0.01)


def test_a_sheet_shows_rims_in_the_papers_colours(blob_dataset):
    frame = blob_dataset.frames("train")[0]
    picture = draw_frame(blob_dataset, frame)
    for k in range(frame.craters["id"].size):
        u, v, d = (float(frame.craters[name][k]) for name in ("u_px", "v_px", "diameter_px"))
        colour = CLASS_COLOURS[int(size_class(np.array([frame.craters["diameter_m"][k]]))[0])]
        top = picture[round(v - d / 2) - 1 : round(v - d / 2) + 2, round(u)].astype(int)
        # The line is one pixel wide and smoothed: nearest the colour of its class somewhere across it.
        assert np.abs(top - colour).sum(axis=1).min() < 250
    sheet = draw_sheet(blob_dataset, "test", columns=2, rows=2, tile_px=128)
    assert sheet.shape == (2 * (128 + 22) + 3 * 4, 2 * 128 + 3 * 4, 3)  # captions of 22 px, gaps of 4
    with pytest.raises(DatasetError, match="expected frames of split 'night', found none"):
        draw_sheet(blob_dataset, "night")


def test_sixteen_bits_are_stored_and_read_as_eight(tmp_path):
    deep = (np.arange(64 * 64, dtype=np.uint16) * 16).reshape(64, 64)
    store.write_frame(tmp_path / "a.png", deep)
    import cv2

    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "a.png"), cv2.IMREAD_UNCHANGED), deep)
    # The reader keeps the upper octet, to a rounding.
    assert np.abs(store.read_gray(tmp_path / "a.png").astype(int) - (deep >> 8)).max() <= 1


def test_nothing_half_written_stays_when_the_disk_is_full(tmp_path, monkeypatch):
    def full(path, octets):
        path.touch()
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr("pathlib.Path.write_bytes", full)
    with pytest.raises(OSError, match="No space left"):
        store.write_json(tmp_path / "a.json", {})
    assert list(tmp_path.iterdir()) == []


def test_changed_labels_are_found_by_their_hash(copy):
    path = copy / "shards" / "00000.npz"
    labels = store.load_shard(path)
    labels.craters["u_px"][0] += 1.0
    store.write_shard(copy, "00000", labels)
    assert any("SHA-256" in problem for problem in check(copy))


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


def far_corner(annotation):
    x, y, w, h = annotation["bbox"]
    return x + w, y + h


@pytest.mark.parametrize("split", ["train", "val", "test"])
def test_coco_has_the_fields_that_its_readers_need(blob_dataset, split):
    coco = json.loads((blob_dataset.folder / f"coco_{split}.json").read_text())
    assert set(coco) == {"info", "licenses", "images", "annotations", "categories"}
    images = {image["id"]: image for image in coco["images"]}
    categories = {category["id"] for category in coco["categories"]}
    numbers = [frame.number for frame in blob_dataset.frames(split)]
    assert [images[number + 1]["file_name"] for number in numbers] == [f"images/{n:06d}.png" for n in numbers]
    assert min(images) >= 1 and min(categories) == 1
    assert all((i["width"], i["height"]) == (512, 512) for i in images.values())
    assert [a["id"] for a in coco["annotations"]] == list(range(1, len(coco["annotations"]) + 1))
    names = {c["id"]: c["name"] for c in coco["categories"]}
    assert names == {1: "5-10 km", 2: "10-15 km", 3: "15-30 km", 4: "3-5 km"}
    for a in coco["annotations"]:
        assert a["image_id"] in images and a["category_id"] in categories and a["iscrowd"] == 0
        x, y, w, h = a["bbox"]
        assert min(x, y) >= 0.0 and w > 0.0 and h > 0.0 and max(far_corner(a)) <= 512.0 + 0.01  # rounded
        (ring,) = a["segmentation"]
        points = np.array(ring).reshape(-1, 2)
        assert len(points) >= 3 and points.min() >= 0.0 and points.max() <= 512.0
        np.testing.assert_allclose([*points.min(axis=0), *np.ptp(points, axis=0)], a["bbox"], atol=0.015)
        assert 0.0 < a["area"] <= w * h
        assert names[a["category_id"]] in ("5-10 km", "10-15 km")  # blobs are 5.3 to 10.1 km wide


def test_an_ellipse_in_the_image_keeps_its_box_and_area():
    # Half-axes 20 and 10, turned by 30 degrees: half extents sqrt(300 + 25) and sqrt(100 + 75).
    rim = clipped(ellipse_polygon(100.0, 50.0, 20.0, 10.0, np.radians(30.0)), 512, 512)
    half = np.sqrt([325.0, 175.0])
    np.testing.assert_allclose(rim.min(axis=0), np.array([100.0, 50.0]) - half, atol=1e-9)
    np.testing.assert_allclose(rim.max(axis=0), np.array([100.0, 50.0]) + half, atol=1e-9)
    assert polygon_area(rim) == pytest.approx(np.pi * 200.0, rel=0.0065)


@pytest.mark.parametrize(
    ("centre", "box", "share"),
    [
        ((0.0, 40.0), (0.0, 30.0, 10.0, 50.0), 0.5),
        ((200.0, 40.0), (190.0, 30.0, 200.0, 50.0), 0.5),
        ((100.0, 0.0), (90.0, 0.0, 110.0, 10.0), 0.5),
        ((100.0, 80.0), (90.0, 70.0, 110.0, 80.0), 0.5),
        ((200.0, 80.0), (190.0, 70.0, 200.0, 80.0), 0.25),
    ],
)
def test_a_crater_on_the_border_is_clipped_to_the_image(centre, box, share):
    rim = clipped(ellipse_polygon(*centre, 10.0, 10.0, 0.0), 200, 80)
    np.testing.assert_allclose([*rim.min(axis=0), *rim.max(axis=0)], box, atol=1e-9)
    assert polygon_area(rim) == pytest.approx(share * np.pi * 100.0, rel=0.0065)


def test_nothing_is_left_of_a_crater_outside_of_the_image():
    assert clipped(ellipse_polygon(-20.0, 5.0, 10.0, 5.0, 0.3), 200, 80).shape == (0, 2)


def test_coco_boxes_surround_their_centres(blob_dataset):
    coco = json.loads((blob_dataset.folder / "coco_train.json").read_text())
    assert len(coco["images"]) == 24
    assert {c["id"] for c in coco["categories"]} == {1, 2, 3, 4}
    whole = [a for a in coco["annotations"] if min(a["bbox"][:2]) > 0.0 and max(far_corner(a)) < 512.0]
    assert len(whole) > 100
    for a in whole:
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


@pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")  # of pycocotools itself
def test_pycocotools_reads_the_annotations_and_scores_them_as_perfect(blob_dataset, capsys):
    path = blob_dataset.folder / "coco_train.json"
    truth = COCO(str(path))
    annotations = truth.loadAnns(truth.getAnnIds())
    assert len(annotations) == len(json.loads(path.read_text())["annotations"]) > 0
    for one in annotations:
        # The mask lies in the image and in the box, to the pixel, and fills the area.
        mask = truth.annToMask(one)
        rows, columns = np.nonzero(mask)
        x, y, width, height = one["bbox"]
        assert mask.shape == (512, 512)
        if len(rows):
            assert x - 1.0 <= columns.min() and columns.max() <= x + width + 1.0
            assert y - 1.0 <= rows.min() and rows.max() <= y + height + 1.0
        # Pixels at the rim are in or out.
        assert abs(mask.sum() - one["area"]) <= 1.0 + 2.0 * (width + height)
    found = [
        {"image_id": one["image_id"], "category_id": one["category_id"], "bbox": one["bbox"], "score": 1.0}
        for one in annotations
    ]
    scores = COCOeval(truth, truth.loadRes(found), "bbox")
    scores.params.maxDets = [1, 10, 1000]
    scores.evaluate()
    scores.accumulate()
    precision = scores.eval["precision"][..., -1]  # with every detection of an image
    assert precision[precision > -1.0].min() > 0.999
