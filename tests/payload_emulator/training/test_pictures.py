"""Labelled image sets: what is read, what is refused, and how detections are scored against boxes."""

import json

import numpy as np
from numpy.testing import assert_array_equal
from pytest import approx, fixture, mark, raises

from payload_emulator.errors import DatasetError
from payload_emulator.flight.models import load_shipped_model
from payload_emulator.flight.vision.detections import Detections
from payload_emulator.flight.vision.preprocess import prepare_image, quality_reason
from payload_emulator.session.world.external import read_picture
from payload_emulator.training.data.pictures import LabelledPicture, load_pictures
from payload_emulator.training.evaluate.evaluate import open_for_evaluation
from payload_emulator.training.evaluate.pictures import (
    Criterion,
    PictureSetOptions,
    evaluate_pictures,
    format_picture_figures,
    tally_pictures,
)
from tests.payload_emulator.bowls import BOWL_CENTRES, bowl_image

SQUARE = [10, 20, 30, 20, 30, 40, 10, 40]


BOXED = {"id": 1, "image_id": 1, "bbox": [10, 20, 20, 20]}


def write_set(folder, images=({"id": 1, "file_name": "a.png"},), annotations=(BOXED,), categories=()):
    import cv2

    folder.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(folder / "a.png"), np.full((64, 96), 99, np.uint8))
    document = {"images": images, "annotations": annotations, "categories": categories}
    (folder / "labels.json").write_text(json.dumps(document))
    return folder


def label(**keys):
    return [{"id": 1, "image_id": 1} | keys]


def test_a_box_has_its_centre_between_pixel_centres(tmp_path):
    (picture,) = load_pictures(write_set(tmp_path, annotations=label(bbox=[10, 20, 20, 5])))
    assert (picture.u_px[0], picture.v_px[0], picture.diameter_px[0]) == (19.5, 22.0, 10.0)
    assert (picture.width_px, picture.height_px) == (96, 64)
    assert np.isnan(picture.sun_azimuth_deg) and not picture.crowd[0]


def test_a_polygon_counts_by_its_area(tmp_path):
    # A square of 20 px and, apart from it, one of 10 px: four fifths of the area pull the centre.
    second = [60, 20, 70, 20, 70, 30, 60, 30]
    (picture,) = load_pictures(write_set(tmp_path, annotations=label(segmentation=[SQUARE, second])))
    assert picture.u_px[0] == approx(0.8 * 20 + 0.2 * 65 - 0.5)
    assert picture.v_px[0] == approx(0.8 * 30 + 0.2 * 25 - 0.5)
    assert picture.diameter_px[0] == approx(np.sqrt(4 * 500 / np.pi))
    assert picture.box_px[0].tolist() == [10, 20, 60, 20]


def test_a_polygon_in_the_other_sense_is_the_same(tmp_path):
    back = [value for k in range(3, -1, -1) for value in SQUARE[2 * k : 2 * k + 2]]
    (picture,) = load_pictures(write_set(tmp_path, annotations=label(segmentation=[back])))
    assert (picture.u_px[0], picture.v_px[0]) == approx((19.5, 29.5))


def test_what_an_image_states_of_sun_and_scale_is_read(tmp_path):
    image = {"id": 1, "file_name": "a.png", "width": 96, "height": 64, "sun_azimuth_deg": 30, "pixel_m": 2.5}
    (picture,) = load_pictures(write_set(tmp_path, images=[image]))
    assert (picture.sun_azimuth_deg, picture.pixel_m) == (30.0, 2.5)


def test_several_files_at_any_depth_are_one_set(tmp_path):
    write_set(tmp_path / "train")
    write_set(tmp_path / "deep/valid")
    (tmp_path / "other.json").write_text("[1]")
    assert len(load_pictures(tmp_path)) == 2


BROKEN = """
annotations [{"image_id": 1, "bbox": [1, 2, 3]}] -> annotations[0].bbox: expected 4 numbers, found [1, 2, 3]
annotations [{"image_id": 1, "bbox": [1, 2, 0, 4]}] -> annotations[0].bbox: expected [x, y, width, height]
annotations [{"image_id": 1, "bbox": [1, 2, NaN, 4]}] -> annotations[0].bbox: expected 4 numbers
annotations [{"image_id": 9, "bbox": [1, 2, 3, 4]}] -> annotations[0].image_id: expected the id of an image, found 9
annotations [{"id": 1}] -> annotations[0].image_id: expected a value, found none
annotations [{"image_id": 1}] -> expected a box (bbox) or polygons (segmentation), found neither
annotations [{"image_id": 1, "segmentation": {"counts": "x"}}] -> found a run-length mask
annotations [{"image_id": 1, "segmentation": [[1, 2, 3, 4]]}] -> segmentation[0]: expected at least three pairs
annotations [{"image_id": 1, "segmentation": [[1, 1, 2, 2, 3, 3]]}] -> segmentation[0]: expected a polygon with an area
annotations {} -> annotations: expected a list of objects
images [{"id": 1}] -> images[0].file_name: expected a value, found none
images [{"id": 1, "file_name": "none.png"}] -> images[0].file_name: expected an image file
images [{"id": 1, "file_name": "labels.json"}] -> expected a file with one of .png
images [{"id": 1, "file_name": "a.png"}, {"id": 1, "file_name": "a.png"}] -> images[1].id: expected an image with a\
 number of its own, found 1 twice (also images[0])
images [{"id": 1, "file_name": "a.png", "width": 95, "height": 64}] -> images[0]: expected the size of a.png, 96 x 64\
 pixels, found 95 x 64
images [{"id": 1, "file_name": "a.png", "sun_azimuth_deg": "east"}] -> images[0].sun_azimuth_deg: expected a number,\
 found 'east'
images [{"id": 1, "file_name": "a.png", "pixel_m": 0}] -> images[0].pixel_m: expected a number above zero, found 0
"""


@mark.parametrize("change, words", [line.split(" -> ") for line in BROKEN.strip().splitlines()])
def test_a_broken_set_is_refused_by_place(tmp_path, change, words):
    part, _, items = change.partition(" ")
    with raises(DatasetError) as refusal:
        load_pictures(write_set(tmp_path, **{part: json.loads(items)}))
    assert words in str(refusal.value) and str(tmp_path) in str(refusal.value)
    assert "\n" not in str(refusal.value)


CRATER, BOULDER = {"id": 0, "name": "crater"}, {"id": 2, "name": "boulder", "supercategory": "rocks"}
BOXES = [[10, 20, 20, 20], [40, 30, 12, 12], [60, 10, 30, 30], [5, 5, 8, 8]]


def write_labels(folder, boxes=BOXES, change=lambda document: None):
    """A set of one image of 96 x 64 pixels with a label for each box."""
    document = {
        "images": [{"id": 0, "file_name": "a.png"}],
        "annotations": [{"id": k, "image_id": 0, "category_id": 0, "bbox": box} for k, box in enumerate(boxes)],
        "categories": [dict(CRATER), dict(BOULDER)],
    }
    change(document)
    return write_set(folder, **document)


def test_labels_of_other_categories_are_no_craters_and_are_counted(tmp_path):
    def mixed(document):
        for item in document["annotations"][1:]:
            item["category_id"] = 2

    (picture,) = load_pictures(write_labels(tmp_path, change=mixed))
    assert picture.box_px.tolist() == [BOXES[0]] and picture.left_out == ("boulder",) * 3
    (picture,) = load_pictures(tmp_path, category="Boulder")
    assert picture.box_px.tolist() == BOXES[1:] and picture.left_out == ("crater",)
    with raises(DatasetError, match="expected the category 'rim', found crater, boulder"):
        load_pictures(tmp_path, category="rim")


def test_a_supercategory_says_crater_too_and_a_set_without_craters_is_refused(tmp_path):
    def renamed(document):
        document["categories"][0] |= {"name": "fresh", "supercategory": "Craters"}

    (picture,) = load_pictures(write_labels(tmp_path / "a", change=renamed))
    assert len(picture.u_px) == 4
    with raises(DatasetError, match="expected a category that says crater, or --category, found boulder"):
        load_pictures(write_labels(tmp_path / "b", change=lambda d: d["categories"].pop(0)))


def test_a_label_that_is_listed_twice_counts_once(tmp_path):
    (picture,) = load_pictures(write_labels(tmp_path, BOXES * 2))
    assert picture.box_px.tolist() == BOXES and picture.repeated == 4
    (picture,) = load_pictures(write_labels(tmp_path, BOXES + [[x + 0.3, y, w, h - 0.3] for x, y, w, h in BOXES[:3]]))
    assert picture.box_px.tolist() == BOXES and picture.repeated == 3


@mark.parametrize(
    "change, message",
    [
        (lambda d: [a.update(bbox=[*a["bbox"][:2], *np.add(a["bbox"][:2], a["bbox"][2:]).tolist()])
                    for a in d["annotations"]], r"2 of 4 beyond its edge, such as \[40.*: \[x1, y1, x2, y2\]\?"),
        (lambda d: [a.update(bbox=(np.array(a["bbox"]) / [96, 64, 96, 64]).tolist()) for a in d["annotations"]],
         r"none over 0\.\d+: coordinates from 0 to 1"),
        (lambda d: d["annotations"].extend({"image_id": 0, "category_id": 0, "bbox": [k, k, 9, 9]} for k in range(20))
                   or [a.update(bbox=[v / 2 for v in a["bbox"]]) for a in d["annotations"]],
         "images of 96 x 64, found none over 45: per cent, or labels of images of another size"),
        (lambda d: d["annotations"][0].update(iscrowd="1"), r"tions\[0\].iscrowd: expected 0 or 1, found '1'"),
        (lambda d: d["annotations"][0].update(segmentation=[[35, 10, 45, 10, 45, 20, 35, 20]]),
         r"tions\[0\]: expected a box about the polygons, \[35.0, 10.0, 10.0, 10.0\], found \[10, 20, 20, 20\]"),
        (lambda d: d["images"].append({"id": 5, "file_name": "a.png"}), "each image once, found .*a.png 2 times"),
        (lambda d: d["annotations"][0].update(bbox=[300, 20, 20, 20]), "1 of 4 beyond its edge"),
        (lambda d: d["annotations"][1].update(id=0), r"tions\[1\].id: .* found 0 twice \(also annotations\[0\]\)"),
        (lambda d: d["categories"][1].update(id=0), "expected a category with a number of its own, found 0 twice"),
        (lambda d: d["images"][0].update(id=1.7), r"images\[0\].id: expected a whole number or a text, found 1.7"),
        (lambda d: d["annotations"][0].update(category_id=7), "expected the id of a category, found 7"),
        (lambda d: d["annotations"][0].pop("category_id"), "category_id: expected a value, found none"),
    ],
)  # fmt: skip
def test_a_set_with_another_order_scale_or_identity_is_refused(tmp_path, change, message):
    assert len(load_pictures(write_labels(tmp_path))[0].u_px) == 4
    with raises(DatasetError, match=message):
        load_pictures(write_labels(tmp_path, change=change))


TURNED = "012 345, 210 543, 543 210, 345 012, 03 14 25, 30 41 52, 52 41 30, 25 14 03"


@mark.parametrize("orientation, seen", [*enumerate(TURNED.split(", "), 1)])
def test_a_picture_is_turned_as_its_exif_data_state(tmp_path, orientation, seen):
    from PIL import Image

    exif = Image.Exif()
    exif[0x0112] = orientation
    values = 40 * np.arange(6, dtype=np.uint8).reshape(2, 3)
    Image.fromarray(values).save(tmp_path / "a.png", exif=exif)
    rows = read_picture(tmp_path / "a.png")[0] // 40
    assert " ".join("".join(map(str, row)) for row in rows) == seen


@mark.parametrize(
    "kind, bad, count, remark",
    [
        ("float32", np.nan, 1, "without data (black)"), ("float32", np.nan, 128, "without data (black)"),
        ("int32", -32768, 128, "without data (black)"), ("float32", -3.4e38, 1, "without data (black)"),
        ("float32", 6_000.0, 1, "hot (cut)"), ("float32", np.inf, 1, "without data (black)"),
        ("uint16", 65_535, 1, "hot (cut)"), ("float32", 1e20, 128, "without data (black)"),
    ],
)  # fmt: skip
def test_one_bad_pixel_costs_that_pixel(tmp_path, kind, bad, count, remark):
    import cv2
    from PIL import Image

    values = (100 + np.arange(4096) % 150).reshape(64, 64).astype(kind)

    def write():
        if kind == "int32":
            Image.fromarray(values).save(tmp_path / "a.tif")
        else:
            cv2.imwrite(str(tmp_path / "a.tif"), values)

    write()
    whole, none = read_picture(tmp_path / "a.tif")
    assert none == ""
    values.flat[:count] = bad
    write()
    found, words = read_picture(tmp_path / "a.tif")
    assert words == f"{count} {remark} of 4096 pixels"
    assert_array_equal(found[2:], whole[2:])


@mark.parametrize("kind, value", [("uint8", 255), ("uint16", 65_535), ("float32", -1.0)])
def test_pixels_of_the_value_that_a_tiff_file_states_are_black(tmp_path, kind, value):
    from PIL import Image

    pixels = np.full((4, 4), 3 if kind == "float32" else 200).astype(kind)
    Image.fromarray(pixels).save(tmp_path / "a.tif")
    whole, _ = read_picture(tmp_path / "a.tif")
    pixels[0] = value
    Image.fromarray(pixels).save(tmp_path / "a.tif", tiffinfo={42113: f"{value}"})
    found, words = read_picture(tmp_path / "a.tif")
    assert words == "4 without data (black) of 16 pixels" and not found[0].any()
    assert_array_equal(found[1:], whole[1:])


def test_values_below_zero_are_black(tmp_path):
    np.save(tmp_path / "a.npy", np.array([[-0.5, 0.25]]))
    assert read_picture(tmp_path / "a.npy")[0].tolist() == [[0.0, 0.25]]


def test_a_picture_that_is_not_searched_says_why():
    night = np.zeros((64, 64), np.uint8)
    for image, words in (
        (night, "0.00% of the pixels over 4.0% of full scale, expected over 0.2%"),
        (night + np.uint8(255), "100.00% of the pixels over 99.6% of full scale, expected up to 60%"),
        (night + np.uint8(90), "deviation 0.0000 of full scale, expected over 0.004"),
        (np.full((64, 64), np.nan), "4096 of 4096 pixels hold no number"),
    ):
        assert quality_reason(image, prepare_image(image).quality) == words


def test_what_is_no_set_is_refused(tmp_path):
    (tmp_path / "text").mkdir()
    (tmp_path / "text/x.json").write_text("{")
    (tmp_path / "empty").mkdir()
    for name, words in (
        ("empty", "expected a COCO file .* found none"),
        ("none", "no such folder"),
        ("text", "x.json: expected JSON"),
    ):
        with raises(DatasetError, match=words):
            load_pictures(tmp_path / name)


def test_arrays_are_read_as_images(tmp_path):
    np.save(tmp_path / "a.npy", np.array([[0.0, 5.0], [10.0, 2.5]]))
    assert read_picture(tmp_path / "a.npy")[0].tolist() == [[0.0, 0.5], [1.0, 0.25]]
    np.save(tmp_path / "b.npy", np.array([[0, 200]], np.uint8))
    assert read_picture(tmp_path / "b.npy")[0].tolist() == [[0, 200]]


@mark.parametrize(
    "values", [np.array([1.0]), np.array([["x"]]), np.array([[-1]]), np.zeros((9, 2, 7)), np.array([[None]])]
)
def test_arrays_that_are_no_images_are_refused(tmp_path, values):
    np.save(tmp_path / "a.npy", values, allow_pickle=True)
    with raises(DatasetError, match="expected an image"):
        read_picture(tmp_path / "a.npy")


def picture(boxes, crowd=()):
    box = np.array(boxes, float).reshape(-1, 4)
    return LabelledPicture(
        None, 200, 100, box[:, 0] + 0.5 * box[:, 2] - 0.5, box[:, 1] + 0.5 * box[:, 3] - 0.5,
        np.sqrt(box[:, 2] * box[:, 3]), box, np.isin(np.arange(len(box)), crowd),
    )  # fmt: skip


def detections(rows):
    u, v, diameter, score = np.array(rows, float).reshape(-1, 4).T
    return Detections(u, v, diameter, score, np.ones(u.size))


def figures(boxes, rows, criterion=Criterion.centre, limits=(8.0, 150.0), crowd=()):
    tallied = tally_pictures([picture(boxes, crowd)], [detections(rows)], criterion, [limits], np.array([np.nan]))
    at = tallied.figures(0.5)
    return at.detected_true, at.false_alarms, at.expected


BOX = [10, 20, 20, 20]  # centre 19.5, 29.5


HIT, FALSE = (1, 0, 1), (0, 1, 1)


@mark.parametrize(
    "u, size, score, strict, centre",
    [
        (19.5, 20, 0.9, HIT, HIT),
        # Nine pixels off: squares overlap by 11 of 29 columns (.38), the centre is within 10 px.
        (28.5, 20, 0.9, FALSE, HIT),
        (30.5, 20, 0.9, FALSE, FALSE),
        # Half the area of the box is .5 of the union, less is not.
        (19.5, 14.4, 0.9, HIT, HIT),
        (19.5, 14.0, 0.9, FALSE, HIT),
        (19.5, 20, 0.4, (0, 0, 1), (0, 0, 1)),
    ],
)
def test_strict_wants_half_the_union_and_centre_the_radius(u, size, score, strict, centre):
    row = (u, 29.5, size, score)
    assert (figures([BOX], [row], Criterion.strict), figures([BOX], [row])) == (strict, centre)


def test_a_label_is_taken_once_by_the_best():
    assert figures([BOX], [(19.5, 29.5, 20, 0.9), (20.5, 29.5, 20, 0.8)]) == (1, 1, 1)


def test_labels_outside_the_range_are_neither_expected_nor_false():
    rows = [(19.5, 29.5, 20, 0.9), (100.5, 50.5, 20, 0.8), (150.5, 50.5, 60, 0.7)]
    # The first takes a label of 20 px, which is below the range; the others take none, and only the last is in it.
    assert figures([BOX], rows, limits=(32.0, 150.0)) == (0, 1, 0)


def test_a_label_in_the_range_goes_before_a_nearer_one_outside():
    small, large = [14, 24, 12, 12], [4, 14, 40, 40]
    assert figures([small, large], [(19.5, 29.5, 40, 0.9)], limits=(32, 150)) == (1, 0, 1)


def test_a_box_cut_at_the_edge_is_compared_with_the_part_inside():
    # A crater of 40 px whose centre is at the left edge shows its right half.
    assert figures([[0, 30, 20, 40]], [(-0.5, 49.5, 40, 0.9)], Criterion.strict) == (1, 0, 1)


def test_detections_in_a_crowd_are_not_counted():
    rows = [(20, 30, 20, 0.9), (100, 50, 20, 0.8)]
    assert figures([[0, 0, 60, 60]], rows, crowd=(0,)) == (0, 1, 0)


def write_bowls(folder, azimuths, *, stated):
    import cv2

    images, annotations = [], []
    for k, azimuth in enumerate(azimuths):
        cv2.imwrite(str(folder / f"{k}.png"), bowl_image(sun_azimuth_deg=azimuth))
        images.append({"id": k, "file_name": f"{k}.png"} | ({"sun_azimuth_deg": azimuth} if stated else {}))
        annotations += [
            {"id": 9 * k + n, "image_id": k, "bbox": [u - 19.5, v - 19.5, 40, 40]}
            for n, (u, v) in enumerate(BOWL_CENTRES)
        ]
    document = {"images": images, "annotations": annotations, "categories": []}
    (folder / "labels.json").write_text(json.dumps(document))


@fixture(scope="module")
def detector():
    return open_for_evaluation(load_shipped_model())


def test_a_set_without_its_sun_is_searched_with_the_sun_that_is_found(tmp_path, detector):
    write_bowls(tmp_path, [180.0, 260.0], stated=False)
    found = evaluate_pictures(detector, tmp_path, 0.44)
    assert (found["rung"], found["images"], found["craters"]) == (5, 2, 8)
    assert found["level"] == "5 (as declared)"
    assert found["sun"]["headline"] == "found" and found["sun"]["not_found"] == 0
    assert set(found["by_sun"]) == {"found", "upright"}
    assert found["micro"] == found["by_sun"]["found"]["strict"]
    assert found["centre"]["recall"] == 1.0
    assert found["by_sun"]["upright"]["strict"]["f1"] < found["strict"]["f1"]
    assert found["per_class"] is None and found["pixel_m"] is None
    assert "Sun azimuth undetermined in 0 of 2 images" in format_picture_figures(found)


def test_a_set_with_its_sun_tells_both(tmp_path, detector):
    write_bowls(tmp_path, [180.0, 260.0], stated=True)
    options = PictureSetOptions(pixel_m=200.0, range_px=(16.0, 64.0))
    found = evaluate_pictures(detector, tmp_path, 0.44, options)
    assert set(found["by_sun"]) == {"given", "found", "upright"}
    assert found["sun"]["compared"] == 2 and found["sun"]["right_share"] == 1.0
    assert found["sun"]["median_error_deg"] < 8.0
    # 40 px of 200 m are craters of 8 km.
    assert [row["expected"] for row in found["per_class"]] == [8, 0, 0]
    assert found["per_class"][0]["recall"] == found["strict"]["recall"]
    low, high = found["centre"]["f1_interval_95"]
    assert low <= found["centre"]["f1"] <= high


def test_the_altitude_gives_the_scale(tmp_path, detector):
    write_bowls(tmp_path, [0.0], stated=True)
    found = evaluate_pictures(detector, tmp_path, 0.44, PictureSetOptions(altitude_km=30.0))
    # The focal length is 256 / tan 60 degrees = 147.8 px.
    assert found["pixel_m"] == [approx(30_000.0 / 147.80, rel=1e-4)]


def test_a_set_without_craters_is_refused(tmp_path, detector):
    with raises(DatasetError, match="expected craters, found 1 images without any"):
        evaluate_pictures(detector, write_set(tmp_path, annotations=[]), 0.44)
