"""The paper's detector: RGB frames, channels normalised before they are averaged, classes without sizes, flown."""

import json
from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx, fixture, raises

from lunar.camera import PinholeCamera
from lunar.datafolder import find_data
from payload_emulator.errors import DatasetError, ModelError
from payload_emulator.flight.navigation.odometry.odometry import frame_features
from payload_emulator.flight.navigation.outcomes import Mode
from payload_emulator.flight.vision.detector import OnnxDetector, decode_classes
from payload_emulator.flight.vision.preprocess import Preparation, gray_levels, prepare_image
from payload_emulator.session.world.recipe import Recipe, Source, load_recipe
from payload_emulator.training.data.build import build
from payload_emulator.training.data.dataset import Dataset
from payload_emulator.training.data.feeder import AugmentParameters, TrainParameters, make_crop
from payload_emulator.training.model.export import export
from payload_emulator.training.model.train import train

MEDIANS_M = np.array([6.5e3, 12e3, 18e3])


def colour_frame(seed=0):
    rng = np.random.default_rng(seed)
    base = 90.0 + 50.0 * np.sin(np.arange(512) / 11.0)[:, None] * np.cos(np.arange(512) / 8.0)[None, :]
    gains = np.array([1.2, 0.9, 0.5])
    return np.clip(base[..., None] * gains + rng.normal(0.0, 3.0, (512, 512, 3)), 0, 255).astype(np.uint8)


def test_each_channel_is_normalised_before_the_average():
    image = colour_frame()
    paper = prepare_image(image, Preparation.normalise_first).gray
    expected = np.zeros((512, 512))
    for k in range(3):
        root = np.sqrt(image[..., k] / 255.0)
        expected += np.clip((root - root.mean()) / root.std(), -4.0, 4.0) / 3.0
    assert_allclose(paper, expected, atol=1e-4)
    assert np.abs(paper - prepare_image(image).gray).max() > 0.02
    gray = gray_levels(image)
    assert_array_equal(prepare_image(gray, Preparation.normalise_first).gray, prepare_image(gray).gray)


def test_a_gain_of_one_channel_makes_no_difference_in_the_papers_order():
    image = colour_frame().astype(np.float32) / 255.0
    dimmed = image * np.array([1.0, 1.0, 0.5], np.float32)
    paper = [prepare_image(one, Preparation.normalise_first).gray for one in (image, dimmed)]
    assert_allclose(paper[0], paper[1], atol=1e-3)


def test_a_crop_of_a_colour_frame_is_that_of_its_gray_where_channels_agree():
    gray = colour_frame()[..., 0]
    crops = []
    for picture in (gray, np.repeat(gray[..., None], 3, axis=2)):
        rng = np.random.Generator(np.random.Philox(key=[1, 2]))
        none = np.zeros(0)
        crops.append(
            make_crop(picture, np.array([0.0, -1.0, 0.2]), none, none, none, none > 0, 96, AugmentParameters(), rng)
        )
    assert_allclose(crops[0].image, crops[1].image, atol=1e-5)


def one_frame(folder, split, colour="rgb"):
    source = Source("world", split, "procedural", 1.0, (41,), altitude_km=(40.0, 45.0))
    list(build(Recipe("colour", 7, (source,), frames_per_shard=1, colour=colour), folder, 1, find_data(None)))
    return Dataset(folder)


@fixture(scope="module")
def coloured(tmp_path_factory):
    return one_frame(tmp_path_factory.mktemp("colour") / "set", "train")


def test_a_data_set_in_colour_keeps_the_channels(coloured, tmp_path):
    frame = coloured.frames()[0]
    image = coloured.image(frame)
    assert image.shape == (512, 512, 3) and image.dtype == np.uint8
    assert np.any(image[..., 0] != image[..., 2])
    assert_array_equal(coloured.gray(frame), gray_levels(image))
    # The same frame without colours holds the mean of the channels.
    plain = one_frame(tmp_path / "gray", "train", "gray")
    assert_array_equal(plain.image(plain.frames()[0]), coloured.gray(frame))


def test_an_unknown_colour_is_refused(tmp_path):
    path = tmp_path / "r.toml"
    path.write_text(
        '[dataset]\nname = "x"\nseed = 1\ncolour = "sepia"\n[[dataset.source]]\nname = "a"\nsplit = "train"\n'
        'terrain = "procedural"\nshare = 1.0\n'
    )
    with raises(DatasetError, match=r"colour: expected .*gray.*rgb.*sepia"):
        load_recipe(path)


@fixture(scope="module")
def classes_only(coloured, tmp_path_factory):
    run = tmp_path_factory.mktemp("classes")
    parameters = TrainParameters(
        minutes=0.0, steps=1, batch=2, crop_px=96, replicas=1, detail_blocks=0,
        preparation=Preparation.normalise_first,
    )  # fmt: skip
    train([coloured, one_frame(run.with_name("validation"), "val")], run, parameters)
    export(run / "checkpoint.pt", run / "m.onnx", [coloured], classes_only=True)
    return (run / "m.onnx").read_bytes()


def test_the_exported_network_gives_classes_offsets_and_no_sizes(classes_only, coloured):
    detector = OnnxDetector(classes_only)
    heat, offsets = detector.run_network(np.zeros((1, 1, 512, 512), np.float32))
    assert heat.shape == (1, 3, 128, 128) and offsets.shape == (1, 2, 128, 128)
    assert detector.preparation is Preparation.normalise_first
    craters = coloured.frames()[0].craters
    diameters = craters["diameter_m"][craters["id"] >= 0]
    first = np.median(diameters[(diameters >= 5e3) & (diameters < 10e3)])
    assert detector.class_medians_m[0] == approx(first, abs=0.1)
    low = OnnxDetector(classes_only, replace(detector.parameters, score_threshold=1e-4))
    _, found = low.examine(coloured.image(coloured.frames()[0]), np.array([0.0, -1.0, 0.2]))
    assert len(found) > 0 and found.size_class is not None and found.diameter_m is not None
    assert np.isnan(found.diameter_px).all() and np.isfinite(found.u_px).all()
    assert_array_equal(found.diameter_m, detector.class_medians_m[found.size_class])


def test_a_network_of_classes_without_medians_is_refused(classes_only):
    import onnx

    model = onnx.load_from_string(classes_only)
    metadata = {item.key: item.value for item in model.metadata_props}
    assert json.loads(metadata["class_median_diameter_m"])
    onnx.helper.set_model_props(model, metadata | {"class_median_diameter_m": "[1, 2]"})
    with raises(ModelError, match=r"three median diameters in class_median_diameter_m, found '\[1, 2\]'"):
        OnnxDetector(model.SerializeToString())


def test_of_two_classes_at_one_place_the_better_counts():
    heat = np.zeros((3, 128, 128), np.float32)
    heat[0, 40, 50], heat[1, 40, 51], heat[2, 90, 10] = 0.6, 0.8, 0.5
    found = decode_classes(heat, np.zeros((2, 128, 128), np.float32), MEDIANS_M, 0.4)
    assert found.size_class.tolist() == [1, 2] and found.score.tolist() == approx([0.8, 0.5])


def test_odometry_takes_the_class_of_a_classified_detection_and_its_prior_gives_the_size():
    heat = np.zeros((3, 128, 128), np.float32)
    heat[2, 64, 64] = 0.9
    found = decode_classes(heat, np.zeros((2, 128, 128), np.float32), MEDIANS_M, 0.4)
    camera = PinholeCamera()
    features = frame_features(found, 30e3, camera, Mode.paper)
    assert features.ground.size_class.tolist() == [2]
    sized = found.with_prior_sizes(np.array([30e3]), camera.focal_px)
    assert sized.diameter_px[0] == approx(camera.focal_px * 18e3 / 30e3)
