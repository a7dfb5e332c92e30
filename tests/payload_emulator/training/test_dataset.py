"""Data sets on disk: recipes, crops, targets; an exported network made trainable again."""

import shutil
from json import dumps, loads
from pathlib import Path

import numpy as np
from numpy import array_equal
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval
from pytest import approx, fixture, mark, raises

from lunar.boxes import Box, inside_box
from lunar.catalogue import size_class
from payload_emulator.errors import DatasetError, ModelError
from payload_emulator.flight.models import load_shipped_model
from payload_emulator.flight.vision.detector import OnnxDetector, decode
from payload_emulator.session.world.recipe import Source, load_recipe, procedural_recipe
from payload_emulator.training.data import dataset as store
from payload_emulator.training.data.build import plan_shards
from payload_emulator.training.data.feeder import AugmentParameters, make_crop
from payload_emulator.training.data.finishing import clipped, ellipse_polygon, polygon_area
from payload_emulator.training.data.integrity import check, summarise
from payload_emulator.training.data.shots import allowed
from payload_emulator.training.data.targets import Tier, make_targets
from payload_emulator.training.evaluate.sheets import CLASS_COLOURS, draw_frame, draw_sheet
from payload_emulator.training.model.export import keep_blocked, onnx_model
from tests.lazy import Lazy


@fixture
def copy(blob_dataset, tmp_path):
    shutil.copytree(blob_dataset.folder, tmp_path / "set")
    return tmp_path / "set"


def test_frames_come_back_by_split(blob_dataset):
    assert [len(blob_dataset.frames(split)) for split in ("train", "val", "test")] == [24, 6, 4]
    frame = blob_dataset.frames("val")[0]
    assert blob_dataset.image(frame).shape == (512, 512)
    assert frame.craters["u_px"].shape == frame.craters["id"].shape
    assert check(blob_dataset.folder) == []


def test_every_missing_or_damaged_file_is_named(copy):
    (copy / "images/000004.png").write_bytes(b"\x89PNG broken")
    for name in ("images/000003.png", "metadata/000005.json", "coco_val.json"):
        (copy / name).unlink()
    coco = copy / "coco_train.json"
    coco.write_bytes(coco.read_bytes().replace(b"2", b"3", 1))
    problems = "\n".join(check(copy))
    for name in ("000003.png", "000004.png", "000005.json", "coco_val.json", "coco_train.json"):
        assert name in problems


@mark.parametrize("missing", [True, False])
def test_a_lost_shard_does_not_hide_the_rest(copy, missing):
    (copy / "images/000025.png").unlink()
    path = copy / "shards/00000.npz"
    if missing:
        path.unlink()
    else:
        path.write_bytes(path.read_bytes()[:-30])
    problems = check(copy)
    assert any("00000.npz" in problem and "build again" in problem for problem in problems)
    assert any("000025.png" in problem for problem in problems)


def test_a_changed_index_is_found_and_one_of_another_schema_refused(copy):
    path = copy / "dataset.json"
    index = loads(path.read_text())
    index["camera"]["fov_deg"] = 119.0
    path.write_text(dumps(index))
    assert any("dataset.json" in problem for problem in check(copy))
    index["schema_version"] = 99
    path.write_text(dumps(index))
    with raises(DatasetError, match="schema_version: expected 1, found 99"):
        store.Dataset(copy)
    path.write_text("{")
    assert any("dataset.json: expected a JSON object" in problem for problem in check(copy))


def test_an_unfinished_data_set_is_distinguished_from_none(copy):
    (copy / "dataset.json").unlink()
    with raises(DatasetError, match="found none"):
        check(copy)
    (copy / "recipe.json").write_text("{}")
    for open_it in (check, store.Dataset):
        with raises(DatasetError, match="found an unfinished one"):
            open_it(copy)


def test_rims_of_older_data_sets_are_round(copy):
    frame = store.Dataset(copy).frames()[0]
    assert_array_equal(frame.craters["major_px"], frame.craters["diameter_px"])
    assert set(frame.craters["visible"]) == {1.0}


def test_counts_are_compared_with_the_papers(blob_dataset):
    figures = summarise(blob_dataset.folder)
    assert figures["frames"] == 34 and figures["split"] == {"train": 24, "val": 6, "test": 4}
    assert [sum(k) for k in zip(*figures["instances_by_split"].values(), strict=True)] == figures["instances"]
    # The paper, section V-B.4: 51,924 frames, 72.8, 16.9 and 10.3 per cent.
    assert figures["paper"]["instances"] == [956_110, 221_860, 135_098]
    assert [round(100 * share, 1) for share in figures["paper"]["shares"]] == [72.8, 16.9, 10.3]
    assert figures["paper"]["instances_per_frame"][0] == approx(18.41, abs=0.01)


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
    with raises(DatasetError, match="expected frames of split 'night', found none"):
        draw_sheet(blob_dataset, "night")


def test_sixteen_bits_are_stored_and_read_as_eight(tmp_path):
    deep = (np.arange(64 * 64, dtype=np.uint16) * 16).reshape(64, 64)
    store.write_frame(tmp_path / "a.png", deep)
    import cv2

    assert_array_equal(cv2.imread(str(tmp_path / "a.png"), cv2.IMREAD_UNCHANGED), deep)
    # The reader keeps the upper octet, to a rounding.
    assert np.abs(store.read_gray(tmp_path / "a.png").astype(int) - (deep >> 8)).max() <= 1


def test_nothing_half_written_stays_when_the_disk_is_full(tmp_path, monkeypatch):
    def full(path, octets):
        path.touch()
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr("pathlib.Path.write_bytes", full)
    with raises(OSError, match="No space left"):
        store.write_json(tmp_path / "a.json", {})
    assert list(tmp_path.iterdir()) == []


def test_changed_labels_are_found_by_their_hash(copy):
    path = copy / "shards/00000.npz"
    labels = store.load_shard(path)
    labels.craters["u_px"][0] += 1.0
    store.write_shard(copy, "00000", labels)
    assert any("SHA-256" in problem for problem in check(copy))


def test_a_damaged_shard_is_refused(copy):
    (copy / "shards/00001.npz").write_bytes(b"PK damaged")
    with raises(DatasetError, match=r"00001\.npz"):
        store.Dataset(copy)


def far_corner(annotation):
    x, y, w, h = annotation["bbox"]
    return x + w, y + h


@mark.parametrize("split", ["train", "val", "test"])
def test_coco_has_the_fields_that_its_readers_need(blob_dataset, split):
    coco = loads((blob_dataset.folder / f"coco_{split}.json").read_text())
    assert set(coco) == {"info", "licenses", "images", "annotations", "categories"}
    images = {image["id"]: image for image in coco["images"]}
    numbers = [frame.number for frame in blob_dataset.frames(split)]
    assert [images[number + 1]["file_name"] for number in numbers] == [f"images/{n:06d}.png" for n in numbers]
    assert min(images) >= 1 and len(images) == len(numbers)
    assert all((i["width"], i["height"]) == (512, 512) for i in images.values())
    assert [a["id"] for a in coco["annotations"]] == list(range(1, len(coco["annotations"]) + 1))
    names = {c["id"]: c["name"] for c in coco["categories"]}
    assert names == {1: "5-10 km", 2: "10-15 km", 3: "15-30 km", 4: "3-5 km"}
    for a in coco["annotations"]:
        assert a["image_id"] in images and a["iscrowd"] == 0
        x, y, w, h = a["bbox"]
        assert min(x, y) >= 0.0 and w > 0.0 and h > 0.0 and max(far_corner(a)) <= 512.0 + 0.01  # rounded
        (ring,) = a["segmentation"]
        points = np.array(ring).reshape(-1, 2)
        assert len(points) >= 3 and points.min() >= 0.0 and points.max() <= 512.0
        assert_allclose([*points.min(axis=0), *np.ptp(points, axis=0)], a["bbox"], atol=0.015)
        assert 0.0 < a["area"] <= w * h
        assert names[a["category_id"]] in ("5-10 km", "10-15 km")  # blobs are 5.3 to 10.1 km wide


def test_an_ellipse_in_the_image_keeps_its_box_and_area():
    # Half-axes 20 and 10, turned by 30 degrees: half extents sqrt(300 + 25) and sqrt(100 + 75).
    rim = clipped(ellipse_polygon(100.0, 50.0, 20.0, 10.0, np.radians(30.0)), 512, 512)
    half = np.sqrt([325.0, 175.0])
    assert_allclose(rim.min(axis=0), np.array([100.0, 50.0]) - half, atol=1e-9)
    assert_allclose(rim.max(axis=0), np.array([100.0, 50.0]) + half, atol=1e-9)
    assert polygon_area(rim) == approx(np.pi * 200.0, rel=0.0065)


# centre, box, share of the area
BORDER = """0 40 0 30 10 50 .5
200 40 190 30 200 50 .5
100 0 90 0 110 10 .5
100 80 90 70 110 80 .5
200 80 190 70 200 80 .25"""


@mark.parametrize("row", BORDER.splitlines())
def test_a_crater_on_the_border_is_clipped_to_the_image(row):
    *places, share = map(float, row.split())
    centre, box = places[:2], places[2:]
    rim = clipped(ellipse_polygon(*centre, 10.0, 10.0, 0.0), 200, 80)
    assert_allclose([*rim.min(axis=0), *rim.max(axis=0)], box, atol=1e-9)
    assert polygon_area(rim) == approx(share * np.pi * 100.0, rel=0.0065)


def test_nothing_is_left_of_a_crater_outside_of_the_image():
    assert clipped(ellipse_polygon(-20.0, 5.0, 10.0, 5.0, 0.3), 200, 80).shape == (0, 2)


def test_boxes_surround_their_centres_and_the_ground_diameter_undoes_the_projection(blob_dataset):
    coco = loads((blob_dataset.folder / "coco_train.json").read_text())
    whole = [a for a in coco["annotations"] if min(a["bbox"][:2]) > 0.0 and max(far_corner(a)) < 512.0]
    assert len(whole) > 100
    for a in whole:
        x, y, w, h = a["bbox"]
        # COCO counts from the corner of the first pixel, labels from its centre; both are rounded to 0.01 px.
        assert x + w / 2 == approx(a["centre"][0] + 0.5, abs=0.02)
        assert y + h / 2 == approx(a["centre"][1] + 0.5, abs=0.02)
    frame = blob_dataset.frames("test")[0]
    c = frame.craters
    ground = store.diameter_on_ground_m(blob_dataset, frame, c["u_px"], c["v_px"], c["diameter_px"])
    # Labels of this set were made flat; the curved ground is up to 4 % farther in the corners from 30 km.
    assert ground == approx(c["diameter_m"], rel=0.05)
    middle = store.diameter_on_ground_m(blob_dataset, frame, np.array([255.5]), np.array([255.5]), np.array([25.0]))
    assert middle == approx(25.0 * 30_000.0 / 147.8017, rel=1e-6)


def craters(**changes):
    base = {
        "id": 7, "u_px": 100.0, "v_px": 100.0, "diameter_px": 30.0, "diameter_m": 6000.0, "depth_ratio": 0.12,
        "lit": 0.9, "hidden": 0,
    } | changes  # fmt: skip
    return {key: np.array([value]) for key, value in base.items()}


@mark.parametrize(
    "change, tier",
    [
        ({}, Tier.LABEL), ({"diameter_m": 1200.0, "id": -4}, Tier.LABEL),
        *(({name: value}, Tier.IGNORE) for name, value in (("depth_ratio", 0.01), ("depth_ratio", np.nan),
            ("diameter_px", 6.0), ("diameter_m", 2200.0), ("lit", 0.0), ("hidden", 1), ("u_px", -5.0))),
    ],
)  # fmt: skip
def test_what_can_be_seen_is_a_label_and_the_rest_is_ignored(change, tier):
    tiers, weights = store.choose_tiers(craters(**change), 512, 512, complete=False)
    assert tiers[0] == tier
    assert 0.3 <= weights[0] <= 1.0


def test_deeper_craters_weigh_more():
    (_, [shallow]), (_, [deep]) = (store.choose_tiers(craters(depth_ratio=d), 512, 512, False) for d in (0.03, 0.1))
    assert shallow < deep == 1.0


@mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")  # of pycocotools itself
def test_pycocotools_reads_the_annotations_and_scores_them_as_perfect(blob_dataset):
    path = blob_dataset.folder / "coco_train.json"
    truth = COCO(str(path))
    annotations = truth.loadAnns(truth.getAnnIds())
    assert len(annotations) == len(loads(path.read_text())["annotations"]) > 0
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


QUIET = AugmentParameters(noise=0.0, shade=0.0, unsharp=(0.0, 0.0))


def spot_image(u, v):
    row, column = np.mgrid[0:512, 0:512]
    image = np.zeros((512, 512))
    for x, y in zip(u, v, strict=True):
        image += 255 * np.exp(-((column - x) ** 2 + (row - y) ** 2) / (2 * 3.0**2))
    return np.clip(image, 0, 255).astype(np.uint8)


@mark.parametrize("sun", [(0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (-1.0, 0.1, 0.0)])
@mark.parametrize("seed", [0, 1, 2])
def test_a_spot_lands_where_the_label_says(sun, seed):
    u, v = np.array([250.0, 330.0]), np.array([200.0, 280.0])
    crop = make_crop(
        spot_image(u, v), np.array(sun), u, v, np.full(2, 20.0), np.array([True, True]), 384, QUIET,
        default_rng(seed),
    )  # fmt: skip
    for x, y in zip(crop.u_px, crop.v_px, strict=True):
        if not (12 < x < 371 and 12 < y < 371):
            continue
        i, j = round(float(y)), round(float(x))
        weight = np.clip(crop.image[i - 8 : i + 9, j - 8 : j + 9].astype(float) - np.median(crop.image), 0, None)
        rows, columns = np.mgrid[i - 8 : i + 9, j - 8 : j + 9]
        # Half a pixel: rounding to 8 bits and clipping of the spot's core shift its centroid by less.
        assert (columns * weight).sum() / weight.sum() == approx(x, abs=0.5)
        assert (rows * weight).sum() / weight.sum() == approx(y, abs=0.5)


def test_the_sun_is_at_the_top_of_every_crop_and_one_seed_gives_one_crop():
    row, _ = np.mgrid[0:512, 0:512]
    bright_right = np.rot90((255 * (1 - row / 511)).astype(np.uint8), 3).copy()
    assert bright_right[:, -1].mean() > bright_right[:, 0].mean()
    crop = make_crop(
        bright_right, np.array([1.0, 0.0, 0.0]), np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(0, bool), 384,
        QUIET, default_rng(3),
    )  # fmt: skip
    assert crop.image[:40].mean() > crop.image[-40:].mean() + 0.5
    image = spot_image([100, 300], [100, 300])
    arguments = (
        image, np.array([0.0, -1.0, 0.0]), np.array([100.0]), np.array([100.0]), np.array([20.0]), np.array([True]),
        256, AugmentParameters(),
    )  # fmt: skip
    first, second = (make_crop(*arguments, default_rng(9)) for _ in range(2))
    assert array_equal(first.image, second.image)
    assert array_equal(first.u_px, second.u_px)


def targets(u, v, diameter, tiers=Tier.LABEL, weight=1.0, *classes):
    u, v, diameter = (np.array(one, float) for one in (u, v, diameter))
    tiers, weight = np.broadcast_to(np.int8(tiers), u.shape), np.broadcast_to(weight, u.shape)
    return make_targets(512, 512, u, v, diameter, tiers, weight, *classes)


def perfect_maps(*places):
    t = targets(*places)
    return t, np.concatenate([t.geometry, np.zeros((1, 128, 128), np.float32)])


def test_decoding_the_targets_returns_the_craters():
    rng = default_rng(1)
    u = np.array([20.3, 100.0, 255.5, 333.9, 480.2])
    v = np.array([30.7, 200.1, 255.5, 90.4, 470.9])
    diameter = rng.uniform(12.0, 120.0, 5)
    t, geometry = perfect_maps(u, v, diameter)
    found = decode(t.heat[0], geometry, 0.99)
    order = np.argsort(found.u_px)
    # The mean over nine cells is exact where all nine point at one centre; float32 offsets leave 1e-5 px.
    assert found.u_px[order] == approx(u, abs=1e-3)
    assert found.v_px[order] == approx(v, abs=1e-3)
    assert found.diameter_px[order] == approx(diameter, rel=1e-4)


def test_an_ignored_crater_takes_only_its_own_loss_away_and_class_maps_follow_the_common_one():
    t = targets([200], [100], [60], Tier.IGNORE)
    assert t.heat.max() == 0.0 and t.weight.max() == 0.0 and t.regressed.max() == 0.0
    assert t.negative[0, 25, 50] == 0.0
    assert t.negative[0, 25, 80] == 1.0
    t = targets([200, 206], [100, 100], [60, 40], [Tier.IGNORE, Tier.LABEL], [1.0, 0.7])
    assert t.weight.max() == approx(0.7)
    t = targets([100, 300], [100, 300], [40, 60], Tier.LABEL, 1.0, np.array([0, 3], np.int8))
    assert [one.max() for one in t.heat[1:]] == [1.0, 0.0, 0.0]
    assert (t.heat[0] == 1.0).sum() == 2


def test_heat_falls_with_distance_in_units_of_the_radius_and_no_craters_give_none():
    t, _ = perfect_maps([], [], [])
    assert t.heat.max() == 0.0 and t.negative.min() == 1.0
    t, _ = perfect_maps([257.5], [257.5], [80.0])
    # sigma = 0.22 R = 2.2 cells: one sigma away exp(-1/2).
    assert t.heat[0, 64, 64] == 1.0
    assert t.heat[0, 64, 66] == approx(np.exp(-0.5 * (2 / 2.2) ** 2), rel=1e-5)


ROOT = Path(__file__).parents[3]


def write(tmp_path, text):
    path = tmp_path / "recipe.toml"
    path.write_text(text)
    return path


GOOD = """[dataset]
name = "a"
seed = 1
[[dataset.source]]
name = "x"
split = "train"
terrain = "procedural"
share = 1.0
"""


@mark.parametrize(
    "old, new, message",
    [
        ("seed = 1", "seed = 1\nsead = 2", r"unknown key 'sead' \(did you mean 'seed'\?\)"),
        ('split = "train"', 'split = "trane"', "expected one of train, val, test"),
        ('terrain = "procedural"', 'terrain = "mars"', "expected one of 'procedural', 'real'"),
        ("share = 1.0", "share = 1.0\nboxes = [[1, 2, 3]]", "west, east, south, north"),
        ('name = "a"\n', "", "dataset.name"),
        ("[dataset]", "[dataset", "expected a TOML file"),
    ],
)
def test_a_wrong_recipe_is_refused_in_one_line_that_says_where(tmp_path, old, new, message):
    with raises(DatasetError, match=message) as caught:
        load_recipe(write(tmp_path, GOOD.replace(old, new, 1)))
    assert "recipe.toml" in str(caught.value)


def test_a_plain_scenario_gives_the_procedural_recipe_of_its_seed_and_its_splits_share_no_world(tmp_path):
    assert load_recipe(write(tmp_path, "seed = 5\n")).digest == procedural_recipe(5).digest
    seeds = [seed for source in procedural_recipe().sources for seed in source.seeds]
    assert len(seeds) == len(set(seeds))


def test_the_shipped_recipe_keeps_every_test_and_validation_box_away_from_training():
    recipe = load_recipe(ROOT / "scenarios/detector-dataset.toml")
    train = [s for s in recipe.sources if s.split == "train" and s.terrain == "real"]
    held = [box for s in recipe.sources if s.split != "train" and s.terrain == "real" for box in s.boxes]
    assert held
    for source in train:
        assert set(held) <= set(source.avoid)
        assert source.buffer_km >= 60.0
    seeds = {}
    for source in recipe.sources:
        if source.terrain == "procedural":
            for seed in source.seeds:
                assert seeds.setdefault(seed, source.split) == source.split


def test_a_footprint_near_a_forbidden_box_is_refused_also_over_the_zero_meridian():
    source = Source("x", "train", "real", 1.0, avoid=(Box(285.0, 300.0, -60.0, 60.0),), buffer_km=60.0)
    world = Box(180.0, 330.0, -60.0, 60.0)
    # One degree of longitude is 30.3 km at the equator and half of that at 60 degrees.
    places = ((0.0, 284.0), (0.0, 283.1), (0.0, 282.9), (58.0, 281.5))
    found = [bool(allowed(source, world, np.array([north]), np.array([east]))) for north, east in places]
    assert found == [False, False, True, False]
    inside = inside_box(Box(350.0, 370.0, -10.0, 10.0), np.zeros(4), np.array([355.0, 5.0, 12.0, 349.0]), 0.0)
    assert inside.tolist() == [True, True, False, False]


def test_shards_hold_every_frame_once_and_each_source_its_share():
    shards = plan_shards(procedural_recipe(), 300)
    assert [n for s in shards for n in s.frame_numbers] == list(range(300))
    assert sum(s.frames for s in shards if s.source.split == "train") == 240


def test_real_terrain_may_be_taken_without_what_is_stamped_on_it(tmp_path):
    real = GOOD.replace("procedural", "real")
    sharpened, plain = (load_recipe(write(tmp_path, real + more)) for more in ("", "sharpen = false\n"))
    assert sharpened.sources[0].sharpen and not plain.sources[0].sharpen
    # What is as it always was keeps the identity that data sets carry.
    assert "sharpen" not in sharpened.to_dict()["sources"][0]
    assert plain.digest != sharpened.digest
    for text in (f"{GOOD}sharpen = false\n", f"{real}sharpen = 3\n"):
        with raises(DatasetError, match="sharpen: expected true or false"):
            load_recipe(write(tmp_path, text))


torch = Lazy("torch")
networks = Lazy("payload_emulator.training.model.model")
restoring = Lazy("payload_emulator.training.model.restore")


class Crops:
    """Stands in for the feeder: seeded images of another brightness than unit deviation."""

    def batch(self, first, count):
        rng = default_rng(first)
        return {"image": 1.7 * rng.standard_normal((count, 1, 64, 64)).astype(np.float32) + 0.4}


@fixture()
def shipped(tmp_path):
    path = tmp_path / "m.onnx"
    path.write_bytes(load_shipped_model())
    return path


def outputs(network, image):
    with torch.no_grad():
        heat, geometry = network(torch.from_numpy(image))
    return torch.sigmoid(heat).numpy(), geometry.numpy()


def test_the_restored_network_gives_what_the_exported_one_gives(shipped):
    network, document = restoring.network_from_onnx(shipped)
    image = default_rng(1).standard_normal((1, 1, 512, 512)).astype(np.float32)
    heat, geometry = outputs(network, image)
    expected = OnnxDetector(shipped.read_bytes()).run_network(image)
    # Single precision through 67 layers: the limit that the export itself holds to.
    assert_allclose(heat, expected[0], atol=2e-4)
    assert_allclose(geometry, expected[1], atol=2e-4)
    assert document["progress"]["step"] == 5095  # in the metadata of the shipped network


def test_counted_statistics_leave_outputs_and_make_training_mode_agree(shipped):
    network, _ = restoring.network_from_onnx(shipped)
    average, _ = restoring.network_from_onnx(shipped)
    image = Crops().batch(1, 16)["image"]
    before = outputs(network, image)
    restoring.count_statistics(network, Crops(), average, crops=32)
    after = outputs(network, image)
    assert_allclose(after[0], before[0], atol=2e-4)
    assert_allclose(after[1], before[1], atol=2e-3)
    assert_allclose(outputs(average, image)[0], after[0], atol=1e-6)
    first = network.stem[1]
    with torch.no_grad():
        seen = network.stem[0](torch.from_numpy(np.concatenate([Crops().batch(k, 1)["image"] for k in range(32)])))
    assert_allclose(first.running_mean.numpy(), seen.mean((0, 2, 3)).numpy(), atol=1e-4)
    assert_allclose(first.running_var.numpy(), seen.var((0, 2, 3), unbiased=False).numpy(), rtol=1e-3)


def test_what_is_no_exported_network_is_refused(tmp_path):
    (tmp_path / "text.onnx").write_text("no model")
    for name, found in (("none", ", found no file"), ("text", "")):
        with raises(ModelError, match="expected an exported network" + found):
            restoring.network_from_onnx(tmp_path / f"{name}.onnx")


def test_an_enlarging_network_gives_maps_of_half_the_stride_and_flies():
    network = networks.CraterNet(networks.ModelConfig(16, depth=True, enlarge=2)).eval()
    assert network.config.cell_px == 2
    import onnx

    model = keep_blocked(onnx_model(networks.ExportedCraterNet(network).eval()))
    detector = OnnxDetector(model.SerializeToString())
    assert onnx.checker.check_model(model) is None
    assert detector.stride_px == 2
    image = default_rng(2).standard_normal((1, 1, 512, 512)).astype(np.float32)
    heat, geometry = detector.run_network(image)
    assert heat.shape == (1, 1, 256, 256) and geometry.shape == (1, 5, 256, 256)
    assert_allclose(heat, outputs(network, image)[0], atol=2e-4)
    with raises(ModelError, match="expected a divisor of the stride 4, found 3"):
        networks.ModelConfig(enlarge=3)


def test_older_networks_name_the_only_backbone_and_stride():
    assert networks.parse_config({"enlarge": 2, "backbone": "small", "stride_px": 4}) == networks.ModelConfig(enlarge=2)
    for name, known, other in (("backbone", "small", "large"), ("stride_px", 4, 2)):
        with raises(ModelError, match=f"expected {name} {known}, found {other!r}"):
            networks.parse_config({name: other})


def test_a_peak_of_a_fine_map_lies_in_the_middle_of_its_cell():
    heat = np.zeros((256, 256), np.float32)
    heat[10, 20] = 0.9
    found = decode(heat, np.zeros((5, 256, 256), np.float32), 0.5, 2)
    # Cell 20 of two pixels covers pixels 40 and 41.
    assert (found.u_px[0], found.v_px[0]) == (approx(40.5), approx(20.5))


def test_an_enlarging_copy_sees_the_enlarged_image_and_tells_pixels_of_the_image(shipped):
    network, _ = restoring.network_from_onnx(shipped)
    image = default_rng(5).standard_normal((1, 1, 128, 128)).astype(np.float32)
    large = torch.nn.functional.interpolate(
        torch.from_numpy(image), scale_factor=2.0, mode="bilinear", align_corners=False
    ).numpy()
    heat, geometry = outputs(restoring.enlarging(network, 2), image)
    expected_heat, expected = outputs(network, large)
    assert_allclose(heat, expected_heat, atol=1e-5)
    expected[:, 2:4] -= np.log(2.0)
    assert_allclose(geometry[:, :4], expected[:, :4], atol=1e-4)
