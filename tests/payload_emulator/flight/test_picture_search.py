"""Search of single pictures: the Sun that nobody stated, the small craters of the enlarged picture."""

import numpy as np
from pytest import approx, fixture, mark

from payload_emulator.flight.models import load_shipped_model
from payload_emulator.flight.vision.detections import Detections
from payload_emulator.flight.vision.detector import MANY_DETECTIONS, DetectorParameters, OnnxDetector, drop_duplicates
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
from payload_emulator.flight.vision.preprocess import ImageQuality, prepare_image
from tests.payload_emulator.bowls import BOWL_CENTRES, bowl_image


@fixture(scope="module")
def detector():
    return OnnxDetector(load_shipped_model())


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
    straight = detector.examine_any_size(image, sun_at_azimuth(200.0))[1]
    assert straight.v_px.tolist() == given.detections.v_px.tolist()


def test_craters_of_two_opposite_suns_leave_it_undetermined(detector):
    both = np.hstack([bowl_image(sun_azimuth_deg=azimuth) for azimuth in (0.0, 180.0)])
    sun = find_sun(detector, prepare_image(both).gray)
    assert not sun.determined and 0.5 <= sun.confidence < 0.95


def test_a_slope_is_no_evidence_of_a_crater():
    plane = np.mgrid[0:40, 0:40][0].astype(np.float32)
    _, evidence = _walls(plane, Detections(*np.array([[20.0], [20.0], [16.0], [0.9], [1.0]])))
    assert evidence.tolist() == [0.0]


def test_nothing_to_be_seen_gives_no_sun(detector):
    noise = np.random.default_rng(3).integers(90, 110, (300, 400)).astype(np.uint8)
    outcome = search_picture(detector, noise)
    assert outcome.quality is ImageQuality.OK
    assert outcome.sun is None


def test_a_dark_picture_is_a_verdict(detector):
    outcome = search_picture(detector, np.zeros((64, 64), np.uint8))
    assert outcome.quality is ImageQuality.DARK
    assert len(outcome.detections) == 0 and outcome.sun is None


def test_craters_of_eight_pixels_are_found_at_two_scales(detector):
    centres = [(60.0 + 90.0 * i, 60.0 + 90.0 * j) for i in range(5) for j in range(5)]
    image = bowl_image(centres, radius=4.0)

    def found_share(outcome):
        found = outcome.detections
        return np.mean([(np.hypot(found.u_px - u, found.v_px - v) < 2.5).any() for u, v in centres])

    one = search_picture(detector, image, sun_at_azimuth(0.0))
    two = search_picture(detector, image, sun_at_azimuth(0.0), two_scales=True)
    assert found_share(two) > 0.9
    assert found_share(one) < 0.3
    near = two.detections.select(two.detections.score > 0.44)
    assert np.median(near.diameter_px) == approx(8.0, rel=0.25)


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


@mark.parametrize(
    ("shape", "count"), [((512, 512), 4), ((351, 640), 4), ((200, 300), 2), ((100, 90), 1), ((2000, 3000), 4)]
)
def test_evidence_comes_from_up_to_four_squares(shape, count):
    squares = _squares(np.zeros(shape, np.float32))
    assert len(squares) == count
    assert all(square.shape == (min(256, shape[0]), min(256, shape[1])) for square in squares)


def random_detections(count, seed, side):
    rng = np.random.default_rng(seed)
    diameter = np.exp(rng.normal(3.0, 0.8, count))
    diameter[:: max(1, count // 7)] = np.nan
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
    by_neighbours = drop_duplicates(found, DetectorParameters())
    assert by_neighbours.u_px.tolist() == each_with_each.u_px.tolist()


def test_memory_does_not_grow_with_the_square_of_the_detections():
    # Each with each would take 200,000 squared: 320 GB for one table of distances.
    found = random_detections(200_000, 1, 40_000.0)
    assert 0 < len(drop_duplicates(found, DetectorParameters())) <= len(found)
