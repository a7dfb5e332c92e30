"""The flight detector with the shipped network: coordinates, bad input, bad models."""

import hashlib
import json

import numpy as np
from pytest import approx, fixture, mark, raises

from payload_emulator.errors import ModelError
from payload_emulator.flight.models import load_shipped_model
from payload_emulator.flight.vision.detections import Detections, states
from payload_emulator.flight.vision.detector import (
    DetectorParameters,
    OnnxDetector,
    _tile_starts,
    decode,
    decode_classes,
    drop_duplicates,
    remove_parallax,
)
from payload_emulator.flight.vision.preprocess import ImageQuality
from tests.lazy import Lazy
from tests.payload_emulator.bowls import BOWL_CENTRES as CENTRES
from tests.payload_emulator.bowls import bowl_image

onnx = Lazy("onnx")


@fixture(scope="module")
def detector():
    return OnnxDetector(load_shipped_model())


@mark.parametrize("azimuth", [0.0, 90.0, 180.0, 270.0])
def test_fresh_bowls_are_found_where_they_are_whatever_the_sun(detector, azimuth):
    angle = np.radians(azimuth)
    found = detector.detect(
        bowl_image(CENTRES, sun_azimuth_deg=azimuth), np.array([np.sin(angle), -np.cos(angle), 0.25])
    )
    for u, v in CENTRES:
        distance = np.hypot(found.u_px - u, found.v_px - v)
        best = int(np.argmin(distance))
        # Four pixels: a fifth of the radius, well inside the matching rule; the network never saw such bowls.
        assert distance[best] < 4.0
        # A diameter within a quarter keeps a crater in its class or the next.
        assert found.diameter_px[best] == approx(40.0, rel=0.25)


def test_turning_the_frame_with_the_sun_turns_the_detections(detector):
    image = bowl_image(CENTRES)
    reference = detector.detect(image, np.array([0.0, -1.0, 0.25]))
    turned = detector.detect(np.rot90(image), np.array([-1.0, 0.0, 0.25]))
    assert len(reference) == len(turned) > 0
    # The same pixels reach the network, so only the change of coordinates remains.
    assert turned.u_px == approx(reference.v_px, abs=1e-9)
    assert turned.v_px == approx(511.0 - reference.u_px, abs=1e-9)


@mark.parametrize(
    ("image", "verdict"),
    [
        (np.zeros((512, 512, 3), np.uint8), ImageQuality.DARK),
        (np.zeros((511, 512, 3), np.uint8), ImageQuality.INVALID),
        (np.zeros((512, 512, 7), np.uint8), ImageQuality.INVALID),
        (np.full((512, 512), "x"), ImageQuality.INVALID),
        (np.full((512, 512), -1, np.int16), ImageQuality.INVALID),
    ],
)
def test_a_bad_frame_is_a_verdict_and_no_detections(detector, image, verdict):
    quality, found = detector.examine(image)
    assert quality is verdict and len(found) == 0


def test_images_of_any_size_are_searched_in_tiles(detector):
    large = np.full((900, 1300), 60, np.uint8)
    tile = bowl_image(CENTRES)
    large[300:812, 700:1212] = tile
    quality, found = detector.examine_any_size(large, np.array([0.0, -1.0, 0.2]))
    assert quality is ImageQuality.OK
    for u, v in CENTRES:
        assert np.hypot(found.u_px - u - 700, found.v_px - v - 300).min() < 4.0
    small_quality, small = detector.examine_any_size(tile[:200, :300])
    assert small_quality is ImageQuality.OK
    assert (small.u_px < 300).all() and (small.v_px < 200).all()


def test_tiles_cover_every_pixel_and_overlap_by_half_a_tile():
    for length in (1, 511, 512, 513, 768, 769, 1300, 4000):
        starts = _tile_starts(length)
        assert starts[0] == 0
        assert starts[-1] == max(length - 512, 0)
        assert (np.diff(starts) <= 256).all()


def test_the_same_frame_gives_the_same_octets(detector):
    image = bowl_image(CENTRES)
    first, second = detector.detect(image), detector.detect(image)
    assert first.u_px.tobytes() == second.u_px.tobytes()
    assert first.score.tobytes() == second.score.tobytes()


def test_detections_come_best_first_and_no_more_than_asked_for():
    detector = OnnxDetector(load_shipped_model(), DetectorParameters(score_threshold=0.05, max_detections=3))
    found = detector.detect(bowl_image(CENTRES))
    assert len(found) == 3
    assert (np.diff(found.score) <= 0).all()


def test_the_shipped_network_is_small_and_tells_what_it_is(detector):
    assert len(detector.model_octets) <= 6_000_000
    assert detector.model_hash == int(hashlib.sha256(detector.model_octets).hexdigest()[:8], 16)
    assert 0.1 <= detector.score_threshold <= 0.9
    for key in ("input", "outputs", "navigation_threshold", "data", "validation", "git_revision", "training_seed"):
        assert detector.metadata[key]
    tested = json.loads(detector.metadata["test_figures"])
    assert set(tested) == {"real-strip", "real-block", "procedural-world"}


def test_a_network_of_another_hash_is_refused():
    with raises(ModelError, match="expected SHA-256 00"):
        OnnxDetector(load_shipped_model(), expected_sha256="00" * 32)


def test_octets_that_are_no_network_are_refused():
    with raises(ModelError, match="expected an ONNX model"):
        OnnxDetector(b"not a network")
    with raises(ModelError, match="expected an ONNX model"):
        OnnxDetector(load_shipped_model()[:100_000])


def test_a_network_with_other_inputs_is_refused():
    tensor = onnx.TensorProto.FLOAT
    graph = onnx.helper.make_graph(
        [onnx.helper.make_node("Identity", ["x"], ["y"])],
        "other",
        [onnx.helper.make_tensor_value_info("x", tensor, [1, 3])],
        [onnx.helper.make_tensor_value_info("y", tensor, [1, 3])],
    )
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 18)], ir_version=10)
    with raises(ModelError, match="expected input image"):
        OnnxDetector(model.SerializeToString())


def maps(*count):
    return np.zeros((*count, 128, 128), np.float32)


def test_a_flat_heatmap_gives_no_detections():
    found = decode(maps(), maps(4), 0.1)
    assert len(found) == 0


def detections(u, v, diameter=40.0, ratio=None):
    n = len(u)
    return Detections(
        np.array(u, float), np.array(v, float), np.full(n, diameter), np.full(n, 0.9), np.ones(n),
        None if ratio is None else np.array(ratio, float)
    )  # fmt: skip


def test_parallax_is_taken_out_radially_and_in_proportion_to_the_depth():
    # A bowl 0.2 * 40 px deep whose middle is seen a tenth of its depth below the rim, f = 148 px: 0.1 * 8 / 148 of
    # the distance from the middle of the picture.
    found = detections([255.5, 455.5, 255.5], [255.5, 255.5, 55.5], ratio=[0.2, 0.2, 0.1])
    moved = remove_parallax(found, 0.1 / 148.0, 512, 512)
    assert moved.u_px == approx([255.5, 455.5 + 200 * 0.1 * 8 / 148, 255.5])
    assert moved.v_px == approx([255.5, 255.5, 55.5 - 200 * 0.1 * 4 / 148])
    assert remove_parallax(found, 0.0, 512, 512) is found


def test_a_network_that_tells_depth_gives_each_crater_a_state():
    heat = maps()
    geometry = maps(5)
    for column, tenfold in ((20, 1.6), (60, 0.8), (100, 0.3)):
        heat[50, column] = 0.9
        geometry[4, 49:52, column - 1 : column + 2] = tenfold
    found = decode(heat, geometry, 0.5)
    assert found.depth_ratio == approx([0.16, 0.08, 0.03], abs=1e-6)
    assert states(found) == ["fresh", "worn", "degraded"]
    assert states(found.select(np.array([2]))) == ["degraded"]
    assert states(detections([1], [1])) == [""]


def test_craters_on_the_very_edge_of_the_heatmap_are_decoded():
    heat = maps()
    heat[0, 0] = heat[127, 127] = 0.9
    found = decode(heat, maps(4), 0.5)
    assert sorted(zip(found.u_px, found.v_px, strict=True)) == [(1.5, 1.5), (509.5, 509.5)]


def test_a_weaker_repetition_is_dropped_and_a_nested_crater_kept():
    columns = ([100, 104, 102], [100, 101, 100], [40, 44, 12], [0.9, 0.8, 0.7], [1, 1, 1])
    found = Detections(*(np.array(column, float) for column in columns))
    kept = drop_duplicates(found, DetectorParameters())
    assert kept.diameter_px.tolist() == [40, 12]


def test_what_a_dropped_repetition_would_have_dropped_stays():
    # The second repeats the first and goes; the third repeats only the second, so it is a crater of its own.
    found = detections([100, 108, 116], [100, 100, 100], diameter=30.0)
    assert drop_duplicates(found, DetectorParameters()).u_px.tolist() == [100, 116]


def test_the_first_map_of_offsets_points_right_and_the_second_down():
    heat = maps()
    heat[50, 20] = 0.9
    geometry = maps(4)
    geometry[0], geometry[1] = 0.25, -0.5
    found = decode(heat, geometry, 0.5)
    # Cells of 4 px whose first has its centre at 1.5 px.
    assert found.u_px.tolist() == [4 * 20.25 + 1.5]
    assert found.v_px.tolist() == [4 * 49.5 + 1.5]


def test_classes_give_median_diameters_and_the_best_class_of_a_place_counts():
    heat = maps(3)
    heat[0, 50, 20], heat[1, 50, 21], heat[2, 80, 80], heat[0, 80, 90] = 0.9, 0.8, 0.7, 0.6
    medians_m = np.array([6e3, 12e3, 20e3])
    found = decode_classes(heat, maps(2), medians_m, 0.5)
    assert found.size_class.tolist() == [0, 2, 0]
    assert found.diameter_m.tolist() == [6e3, 20e3, 6e3]
    assert found.u_px.tolist() == [4 * column + 1.5 for column in (20, 80, 90)]
    assert found.v_px.tolist() == [4 * row + 1.5 for row in (50, 80, 80)]
