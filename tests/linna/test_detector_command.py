"""`linna detector` and `linna dataset` from the outside: keys of their JSON, words of their refusals."""

import hashlib
import json
from pathlib import Path

import numpy as np
from numpy.random import default_rng
from pytest import fixture, mark

import linna
from linna.cli import run
from tests.payload_emulator.bowls import BOWL_CENTRES, bowl_image


def speckled(shape=(512, 512), dtype=np.uint8):
    return (default_rng(2).integers(30, 220, shape) * (np.iinfo(dtype).max // 255)).astype(dtype)


@fixture
def write_image(tmp_path):
    import cv2

    def write(name, image):
        path = tmp_path / name
        assert cv2.imwrite(str(path), image)
        return path

    return write


def test_info_tells_the_hash_and_the_thresholds(typed):
    figures = typed("detector info --json")
    assert len(figures["sha256"]) == 64
    assert 0.1 <= float(figures["score_threshold"]) <= float(figures["navigation_threshold"])
    assert figures["shipped"]["craters"]["sha256"] == figures["sha256"]
    for network in figures["shipped"].values():
        octets = Path(linna.__file__).parents[1].joinpath(network["file"]).read_bytes()
        assert hashlib.sha256(octets).hexdigest() == network["sha256"] and "altitudes" in network["purpose"]


@mark.parametrize(
    "name, image",
    [
        ("a.png", speckled()), ("b.tiff", speckled(dtype=np.uint16)), ("c.png", speckled((300, 700, 3))),
        ("d.png", speckled((64, 48))),
    ],
)  # fmt: skip
def test_detect_takes_any_size_and_depth(write_image, typed, name, image):
    path = write_image(name, image)
    (item,) = typed(f"detector detect {path} --altitude-km 30 --threshold 0.05 --json")["images"]
    assert item["file"] == str(path)
    assert item["quality"] == "ok"
    for detection in item["detections"]:
        assert set(detection) >= {"u_px", "v_px", "diameter_px", "score", "class", "depth_ratio"}
        assert detection["state"] in ("fresh", "worn", "degraded")
        assert -1 <= detection["class"] <= 3


def test_twelve_bits_in_a_file_of_sixteen_are_no_dark_picture(write_image, typed):
    image = speckled().astype(np.uint16) * 16
    (item,) = typed(f"detector detect {write_image('raw.tiff', image)} --json")["images"]
    assert item["quality"] == "ok"


def test_a_picture_that_is_not_searched_is_a_verdict_with_its_reason(write_image, typed):
    image = np.full((512, 512), 0.5, np.float32)
    image[3, 4] = np.nan
    (item,) = typed(f"detector detect {write_image('nan.tiff', image)} --json", 1)["images"]
    assert item["quality"] == "uniform" and item["detections"] == []
    assert item["reason"].startswith("deviation 0.00")
    assert item["pixels"] == "1 without data (black) of 262144 pixels"


def test_detect_finds_the_sun_that_is_not_given_and_says_so_in_one_line(write_image, capsys):
    path = write_image("a.png", bowl_image(sun_azimuth_deg=180.0))
    assert run(["detector", "detect", str(path), "--json"]) == 0
    out, err = capsys.readouterr()
    (item,) = json.loads(out)["images"]
    assert item["sun"]["source"] == "found"
    assert abs(item["sun"]["azimuth_deg"] - 180.0) < 8.0
    assert len(item["detections"]) >= 4
    (line,) = err.strip().splitlines()
    assert line.startswith(f"{path}: Sun azimuth not given; found 1") and "confidence" in line
    assert run(["detector", "detect", str(path), "--sun-azimuth-deg", "180", "--two-scales", "--json"]) == 0
    out, err = capsys.readouterr()
    (item,) = json.loads(out)["images"]
    assert item["sun"] == {"source": "given", "azimuth_deg": 180.0, "confidence": None}
    assert err == ""


def test_a_picture_without_craters_leaves_the_sun_unknown(write_image, capsys):
    noise = default_rng(3).integers(90, 110, (300, 400)).astype(np.uint8)
    assert run(["detector", "detect", str(write_image("a.png", noise)), "--json"]) == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["images"][0]["sun"]["source"] == "unknown"
    assert "not given and not found" in err


def write_labelled(tmp_path, write_image):
    write_image("a.png", bowl_image())
    boxes = [{"id": k, "image_id": 1, "bbox": [u - 19.5, v - 19.5, 40, 40]} for k, (u, v) in enumerate(BOWL_CENTRES)]
    document = {"images": [{"id": 1, "file_name": "a.png"}], "annotations": boxes, "categories": []}
    (tmp_path / "labels.json").write_text(json.dumps(document))


def test_a_labelled_set_of_anyone_is_evaluated(tmp_path, write_image, typed):
    write_labelled(tmp_path, write_image)
    figures = typed(f"detector evaluate --coco {tmp_path} --pixel-m 200 --json")
    assert figures["rung"] == 5 and figures["images"] == 1 and figures["craters"] == 4
    assert set(figures["micro"]) >= {"precision", "recall", "f1", "loc_px", "f1_interval_95"}
    assert figures["per_class"][0]["expected"] == 4
    text = typed(f"detector evaluate --coco {tmp_path} --two-scales")
    assert "evidence level 5" in text and "two scales" in text


UNFIT = """
--report r.html -> --report: expected together with --dataset
--paper-classes -> --paper-classes: expected together with --dataset
--pixel-m 0 -> --pixel-m: expected a number above 0, found '0'
--fov-deg 0 -> --fov-deg: expected a number above 0 and below 180
--range-px 9 8 -> --range-px: expected two diameters in rising order, found 9 8
 -> expected a COCO file
"""


@mark.parametrize("extra, words", [line.split(" -> ") for line in UNFIT.splitlines()[1:]])
def test_what_does_not_fit_a_labelled_set_is_refused(tmp_path, typed, extra, words):
    assert words in typed(f"detector evaluate --coco {tmp_path} {extra}", 2)


def test_options_of_labelled_sets_are_refused_with_data_sets(tmp_path, typed):
    assert "--two-scales: expected together with --coco" in typed(
        f"detector evaluate --dataset {tmp_path} --two-scales", 2
    )


@mark.parametrize(
    "extra, words",
    [
        ("--altitude-km -3", "--altitude-km: expected a number above 0, found '-3'"),
        ("--fov-deg 180", "--fov-deg: expected a number above 0 and below 180, found '180'"),
    ],
)
def test_a_camera_that_cannot_be_is_refused(write_image, typed, extra, words):
    assert words in typed(f"detector detect {write_image('a.png', speckled())} {extra}", 2)


def test_a_black_picture_is_a_verdict_not_an_error(write_image, typed):
    (item,) = typed(f"detector detect {write_image('black.png', np.zeros((512, 512), np.uint8))} --json", 1)["images"]
    assert item["quality"] == "dark" and item["detections"] == []
    assert item["reason"] == "0.00% of the pixels over 4.0% of full scale, expected over 0.2%"


def test_what_is_no_image_is_refused_in_one_line(tmp_path, typed):
    path = tmp_path / "x.png"
    path.write_text("no image")
    assert str(path) in typed(f"detector detect {path}", 2)


def test_what_is_no_model_is_refused_in_one_line(write_image, tmp_path, typed):
    (tmp_path / "m.onnx").write_bytes(b"no model")
    image = write_image("a.png", speckled())
    assert "expected an ONNX model" in typed(f"detector detect {image} --model {tmp_path}/m.onnx", 2)
    assert "none.onnx" in typed(f"detector info --model {tmp_path}/none.onnx", 2)


@mark.parametrize(
    "command",
    ["dataset stats", "dataset check", "detector evaluate --dataset", "detector calibrate --out m.onnx --dataset"],
)
def test_a_folder_without_a_data_set_is_refused_and_no_file_left(command, tmp_path, typed, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert "expected a data set" in typed(f"{command} {tmp_path}", 2)
    assert list(tmp_path.iterdir()) == []


def test_detect_lists_the_craters_and_draws_them(write_image, typed, tmp_path):
    import cv2

    path, picture = write_image("a.png", speckled()), tmp_path / "found.png"
    heading, _, *rows = typed(f"detector detect {path} --threshold 0.05 --picture {picture}").splitlines()
    diameters = [float(row.split()[2]) for row in rows]
    assert heading == f"{path}: ok, {len(rows)} craters" and diameters == sorted(diameters, reverse=True)
    drawn = cv2.imread(str(picture))
    assert (drawn[..., 0] != drawn[..., 2]).sum() > 10 * len(rows) > 0
    assert "expected one image, found 2" in typed(f"detector detect {path} {path} --picture {picture}", 2)


def test_bench_reports_latency_memory_and_size(typed):
    figures = typed("detector bench --frames 5 --json")
    assert {"median_ms", "p99_ms", "peak_rss_mb", "model_bytes"} <= set(figures)
    assert figures["model_bytes"] <= 6_000_000
