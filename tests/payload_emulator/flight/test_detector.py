"""The flight detector with the shipped network: coordinates, bad input, single pictures, preparation."""

import hashlib
import json

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy import cos, hypot, nan, pi, sin
from numpy.random import default_rng
from pytest import approx, fixture, mark, raises

from payload_emulator.errors import ModelError
from payload_emulator.flight.models import load_shipped_model
from payload_emulator.flight.vision.detections import Detections, states
from payload_emulator.flight.vision.detector import (
    MANY_DETECTIONS,
    DetectorParameters,
    OnnxDetector,
    _tile_starts,
    decode,
    decode_classes,
    drop_duplicates,
    remove_parallax,
)
from payload_emulator.flight.vision.picture_search import (
    SMALL_CRATERS_PX,
    _merge,
    _squares,
    _walls,
    enlarge,
    find_sun,
    search_picture,
    sun_at_azimuth,
)
from payload_emulator.flight.vision.preprocess import (
    ImageQuality,
    gray_levels,
    prepare_image,
    sun_up_turns,
    turn_back,
    turn_forward,
)
from tests.lazy import Lazy
from tests.payload_emulator.bowls import BOWL_CENTRES, bowl_image
from tests.payload_emulator.bowls import BOWL_CENTRES as CENTRES

onnx = Lazy("onnx")


@fixture(scope="module")
def detector():
    return OnnxDetector(load_shipped_model())


@mark.parametrize("azimuth", [0.0, 90.0, 180.0, 270.0])
def test_fresh_bowls_are_found_where_they_are_whatever_the_sun(detector, azimuth):
    angle = np.radians(azimuth)
    found = detector.detect(bowl_image(CENTRES, sun_azimuth_deg=azimuth), np.array([sin(angle), -cos(angle), 0.25]))
    for u, v in CENTRES:
        distance = hypot(found.u_px - u, found.v_px - v)
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


BAD = """DARK 512,512,3 uint8 0
INVALID 511,512,3 uint8 0
INVALID 512,512,7 uint8 0
INVALID 512,512 U1 0
INVALID 512,512 int16 -1"""
UNSEARCHABLE = """DARK 512,512,3 uint8 0
DARK 512,512,3 uint8 4
SATURATED 512,512,3 uint8 255
SATURATED 512,512 uint16 65535
UNIFORM 512,512,3 uint8 120
INVALID 512,512 float32 nan
INVALID 512,512,2 uint8 0
INVALID 0,0 uint8 0
INVALID 512 uint8 0
INVALID 512,512 complex64 0
INVALID 2,2,2,2 uint8 0"""


def verdict_of(row):
    """Return the verdict of a row, and an image of its shape and type with one value."""
    verdict, shape, kind, value = row.split()
    return ImageQuality[verdict], np.full([*map(int, shape.split(","))], float(value)).astype(kind)


@mark.parametrize("row", BAD.splitlines())
def test_a_bad_frame_is_a_verdict_and_no_detections(detector, row):
    verdict, image = verdict_of(row)
    quality, found = detector.examine(image)
    assert quality is verdict and len(found) == 0


def test_images_of_any_size_are_searched_in_tiles(detector):
    large = np.full((900, 1300), 60, np.uint8)
    tile = bowl_image(CENTRES)
    large[300:812, 700:1212] = tile
    quality, found = detector.examine_any_size(large, np.array([0.0, -1.0, 0.2]))
    assert quality is ImageQuality.OK
    for u, v in CENTRES:
        assert hypot(found.u_px - u - 700, found.v_px - v - 300).min() < 4.0
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
    assert set(json.loads(detector.metadata["test_figures"])) == {"real-strip", "real-block", "procedural-world"}


def test_a_network_of_another_hash_and_octets_that_are_none_are_refused():
    with raises(ModelError, match="expected SHA-256 00"):
        OnnxDetector(load_shipped_model(), expected_sha256="00" * 32)
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
    assert len(decode(maps(), maps(4), 0.1)) == 0


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


def test_a_weaker_repetition_is_dropped_and_a_nested_crater_and_what_it_repeats_stay():
    columns = ([100, 104, 102], [100, 101, 100], [40, 44, 12], [0.9, 0.8, 0.7], [1, 1, 1])
    found = Detections(*(np.array(column, float) for column in columns))
    assert drop_duplicates(found, DetectorParameters()).diameter_px.tolist() == [40, 12]
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


def off_deg(found, true):
    return abs((found - true + 180.0) % 360.0 - 180.0)


@mark.parametrize("azimuth", [0.0, 30.0, 90.0, 130.0, 180.0, 250.0, 270.0, 330.0])
def test_the_azimuth_of_the_sun_is_found_from_the_craters(detector, azimuth):
    sun = find_sun(detector, prepare_image(bowl_image(sun_azimuth_deg=azimuth)).gray)
    # Bowls have no ejecta and no neighbours, so a few degrees is what their walls can tell.
    assert off_deg(sun.azimuth_deg, azimuth) < 8.0
    assert sun.craters >= len(BOWL_CENTRES)
    assert sun.determined and sun.confidence > 0.99
    assert int(np.argmax(sun.evidence)) in (int(azimuth // 90), int(-(-azimuth // 90)) % 4)


def test_a_picture_without_its_sun_gives_what_the_picture_with_it_gives(detector):
    image = bowl_image(sun_azimuth_deg=200.0)
    given = search_picture(detector, image, sun_at_azimuth(200.0))
    found = search_picture(detector, image)
    assert given.sun is None and found.sun is not None
    assert found.detections.u_px.tolist() == given.detections.u_px.tolist()
    assert found.detections.score.tolist() == given.detections.score.tolist()
    assert len(found.detections) >= len(BOWL_CENTRES)
    assert detector.examine_any_size(image, sun_at_azimuth(200.0))[1].v_px.tolist() == given.detections.v_px.tolist()


def test_craters_of_two_opposite_suns_leave_it_undetermined(detector):
    both = np.hstack([bowl_image(sun_azimuth_deg=azimuth) for azimuth in (0.0, 180.0)])
    sun = find_sun(detector, prepare_image(both).gray)
    assert not sun.determined and 0.5 <= sun.confidence < 0.95


def test_a_slope_is_no_evidence_of_a_crater():
    plane = np.mgrid[0:40, 0:40][0].astype(np.float32)
    _, evidence = _walls(plane, Detections(*np.array([[20.0], [20.0], [16.0], [0.9], [1.0]])))
    assert evidence.tolist() == [0.0]


def test_nothing_to_be_seen_gives_no_sun_and_a_dark_picture_is_a_verdict(detector):
    outcome = search_picture(detector, default_rng(3).integers(90, 110, (300, 400)).astype(np.uint8))
    assert outcome.quality is ImageQuality.OK
    assert outcome.sun is None
    outcome = search_picture(detector, np.zeros((64, 64), np.uint8))
    assert outcome.quality is ImageQuality.DARK
    assert len(outcome.detections) == 0 and outcome.sun is None


def test_craters_of_eight_pixels_are_found_at_two_scales(detector):
    centres = [(60.0 + 90.0 * i, 60.0 + 90.0 * j) for i in range(5) for j in range(5)]
    image = bowl_image(centres, radius=4.0)

    def found_share(outcome):
        found = outcome.detections
        return np.mean([(hypot(found.u_px - u, found.v_px - v) < 2.5).any() for u, v in centres])

    one = search_picture(detector, image, sun_at_azimuth(0.0))
    two = search_picture(detector, image, sun_at_azimuth(0.0), two_scales=True)
    assert found_share(two) > 0.9
    assert found_share(one) < 0.3
    assert np.median(two.detections.select(two.detections.score > 0.44).diameter_px) == approx(8.0, rel=0.25)


def test_what_one_scale_finds_two_scales_find(detector):
    def found(*rows):
        u, diameter, score = np.array(rows).T
        return Detections(u, np.full(u.size, 100.0), diameter, score, np.ones(u.size))

    coarse = found((100.0, 60.0, 0.9), (200.0, 30.0, 0.5))
    fine = found((300.0, 20.0, 0.8), (101.0, 44.0, 0.6), (400.0, 2.0 * SMALL_CRATERS_PX, 0.4))
    assert _merge(coarse, fine, detector).u_px.tolist() == [100.0, 300.0, 200.0]


def test_enlarging_puts_pixel_x_at_two_x_and_a_half():
    row, column = np.mgrid[0:20, 0:30].astype(np.float32)
    larger = enlarge(2.0 * column + 3.0 * row)
    assert larger.shape == (40, 60)
    down, right = np.mgrid[0:40, 0:60]
    expected = 2.0 * (right - 0.5) / 2.0 + 3.0 * (down - 0.5) / 2.0
    # A cubic kernel is exact on a plane, away from the edges that it repeats.
    assert larger[4:-4, 4:-4] == approx(expected[4:-4, 4:-4], abs=1e-4)


@mark.parametrize("row", ["512 512 4", "351 640 4", "200 300 2", "100 90 1", "2000 3000 4"])
def test_evidence_comes_from_up_to_four_squares(row):
    *shape, count = map(int, row.split())
    squares = _squares(np.zeros(shape, np.float32))
    assert len(squares) == count
    assert all(square.shape == (min(256, shape[0]), min(256, shape[1])) for square in squares)


def random_detections(count, seed, side):
    rng = default_rng(seed)
    diameter = np.exp(rng.normal(3.0, 0.8, count))
    diameter[:: max(1, count // 7)] = nan
    return Detections(
        rng.uniform(0, side, count), rng.uniform(0, side, count), diameter, np.sort(rng.uniform(0, 1, count))[::-1],
        np.ones(count)
    )  # fmt: skip


@mark.parametrize("seed", range(5))
def test_many_detections_lose_the_same_duplicates_as_few(monkeypatch, seed):
    found = random_detections(MANY_DETECTIONS - 1, seed, 300.0)
    each_with_each = drop_duplicates(found, DetectorParameters())
    assert len(each_with_each) < len(found)
    monkeypatch.setattr("payload_emulator.flight.vision.detector.MANY_DETECTIONS", 0)
    assert drop_duplicates(found, DetectorParameters()).u_px.tolist() == each_with_each.u_px.tolist()


def test_memory_does_not_grow_with_the_square_of_the_detections():
    # Each with each would take 200,000 squared: 320 GB for one table of distances.
    found = random_detections(200_000, 1, 40_000.0)
    assert 0 < len(drop_duplicates(found, DetectorParameters())) <= len(found)


def texture(shape=(512, 512, 3), dtype=np.uint8):
    rng = default_rng(0)
    smooth = 100 + 60 * sin(np.arange(shape[1]) / 9.0)[None, :] * cos(np.arange(shape[0]) / 7.0)[:, None]
    image = smooth + rng.normal(0, 4, shape[:2])
    if len(shape) == 3:
        image = np.repeat(image[..., None], shape[2], axis=2)
    full = np.iinfo(dtype).max / 255.0
    return np.clip(image * full, 0, np.iinfo(dtype).max).astype(dtype)


def test_a_good_frame_has_zero_mean_and_unit_deviation_whatever_its_depth_and_colour():
    prepared = prepare_image(texture())
    assert prepared.quality is ImageQuality.OK
    # Clipping at four deviations moves both by far less than a hundredth.
    assert float(prepared.gray.mean()) == approx(0.0, abs=0.01)
    assert float(prepared.gray.std()) == approx(1.0, abs=0.01)
    reference = prepare_image(texture()).gray
    for other in (
        texture(shape=(512, 512)),
        texture(dtype=np.uint16),
        texture(shape=(512, 512, 1)),
        texture().astype(np.float32) / 255.0,
    ):
        # One count of 255 at mid scale, in deviations of this scene.
        assert np.abs(prepare_image(other).gray - reference).max() < 0.06


@mark.parametrize("shape", [(512, 512), (512, 512, 3), (300, 200, 4), (64, 64, 1)])
def test_eight_bits_go_a_quicker_way_to_the_same_values(shape):
    image = default_rng(1).integers(0, 256, shape, dtype=np.uint8)
    colours = image if image.ndim == 2 else image[..., : 3 if shape[2] >= 3 else 1].mean(axis=2)
    # Rounding of 32-bit numbers up to 4 and the order of sums.
    assert prepare_image(image).gray == approx(prepare_image(colours / 255.0).gray, abs=5e-6)


def test_half_the_exposure_gives_the_same_input():
    bright = texture(dtype=np.uint16)
    reference = prepare_image(bright).gray
    assert np.abs(prepare_image(bright // 2).gray - reference).max() < 1e-3


@mark.parametrize("row", UNSEARCHABLE.splitlines())
def test_a_frame_that_cannot_be_searched_is_a_verdict(row):
    verdict, image = verdict_of(row)
    assert prepare_image(image).quality is verdict


def test_gray_levels_round_to_the_nearest_count_and_one_that_is_no_number_is_invalid():
    image = texture(shape=(64, 64)).astype(np.float32) / 255.0
    image[3, 5] = np.inf
    assert prepare_image(image).quality is ImageQuality.INVALID
    image = np.array([[[1, 1, 2], [255, 255, 255], [0, 0, 1]]], np.uint8)
    assert gray_levels(image).tolist() == [[1, 255, 0]]


@given(st.floats(0.0, 2.0 * pi))
def test_after_the_turns_the_sun_is_within_45_degrees_of_the_top(azimuth):
    sun = np.array([sin(azimuth), -cos(azimuth), 0.3])
    turns = sun_up_turns(sun)
    # Follow a point from the middle toward the Sun.
    u, v = turn_forward(np.array([255.5 + 100 * sun[0]]), np.array([255.5 + 100 * sun[1]]), turns, 512, 512)
    assert 255.5 - v[0] >= 100 * cos(pi / 4) - 1e-6
    assert abs(u[0] - 255.5) <= 100 * sin(pi / 4) + 1e-6


@mark.parametrize("turns", [0, 1, 2, 3])
def test_turned_coordinates_point_at_the_same_pixel_and_come_back(turns):
    image = np.arange(6 * 9).reshape(6, 9)
    turned = np.rot90(image, turns)
    for row in range(6):
        for column in range(9):
            u, v = turn_forward(np.array([float(column)]), np.array([float(row)]), turns, 6, 9)
            assert turned[int(v[0]), int(u[0])] == image[row, column]
            back_u, back_v = turn_back(u, v, turns, 6, 9)
            assert (back_u[0], back_v[0]) == (column, row)


@mark.parametrize("sun", [None, np.array([nan, nan, nan]), np.array([0.0, 0.0, 1.0])])
def test_without_a_sun_direction_the_frame_stays_as_it_is(sun):
    assert sun_up_turns(sun) == 0
