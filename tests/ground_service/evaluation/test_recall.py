"""The detector's score, on a crater field whose detections are made by hand."""

from dataclasses import replace
from operator import attrgetter

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx, fixture, mark

from ground_service.evaluation.recall import ExpectedCraters, expected_craters, match_detections, score_detections
from ground_service.telemetry.samples import DetectionSamples
from lunar.camera import PinholeCamera
from lunar.catalogue import make_catalogue
from lunar.frames import mcmf_from_spherical

ALTITUDE_M = 30_000.0
CAMERA = PinholeCamera()
POSITION = mcmf_from_spherical(np.array([0.0]), np.array([0.0]), np.array([ALTITUDE_M]))


def field(complete=True, rim_height_m=0.0):
    """Four craters of 6, 12, 20 and 4 km around latitude 0, longitude 0, and one on the far side."""
    latitude = np.radians([0.0, 0.6, -0.6, 0.3, 0.0])
    longitude = np.radians([0.0, 0.6, 0.6, -0.7, 180.0])
    diameter = [6e3, 12e3, 20e3, 4e3, 8e3]
    return make_catalogue(
        latitude, longitude, diameter, source="test", rim_height_m=np.full(5, rim_height_m), complete=complete
    )


def detections(u, v, d, classes, usable=True):
    n = len(u)
    return DetectionSamples(
        frame_number=np.array([7]),
        utc_ns=np.array([0]),
        usable=np.array([usable]),
        quality=("ok" if usable else "dark",),
        offsets=np.array([0, n]),
        u_px=np.array(u),
        v_px=np.array(v),
        diameter_px=np.array(d),
        score=np.linspace(0.9, 0.5, n),
        size_class=np.array(classes),
    )


@fixture(scope="module")
def expected():
    return expected_craters(field(), CAMERA, POSITION)


def scored(found, expected):
    """Return the scores of the detections of one frame."""
    return score_detections(found, expected, match_detections(found, expected), np.array([ALTITUDE_M]))


def test_craters_project_where_the_picture_shows_them(expected):
    """East is right, south is down; the crater below is at the centre and as wide as f D / h."""
    assert expected.index.tolist() == [0, 1, 2, 3]
    assert expected.u_px[0] == approx(255.5, abs=1e-9)
    assert expected.diameter_px[0] == approx(CAMERA.focal_px * 6e3 / ALTITUDE_M, rel=1e-9)
    assert expected.u_px[1] > 255.5 > expected.v_px[1]
    assert min(expected.u_px[2], expected.v_px[2]) > 255.5


def test_a_crater_of_unknown_height_is_neither_missed_nor_a_false_alarm():
    known = field(rim_height_m=3_000.0)
    heights = np.where(np.arange(5) == 1, np.nan, known.rim_height_m)
    expected = expected_craters(replace(known, rim_height_m=heights), CAMERA, POSITION)
    high = expected_craters(known, CAMERA, POSITION)
    assert_array_equal(expected.u_px, high.u_px)  # at the height of the others
    for rows in [0, 1, 2], [0, 2]:
        columns = (high.u_px[rows], high.v_px[rows], high.diameter_px[rows])
        score = scored(detections(*columns, rows), expected).micro
        assert (score.expected, score.detected_true, score.false_alarms) == (2, 2, 0)


def test_a_perfect_detector_scores_one_and_a_second_detection_of_a_crater_is_a_false_alarm(expected):
    found = detections(expected.u_px + 0.3, expected.v_px - 0.4, expected.diameter_px, [0, 1, 2, 3])
    score = scored(found, expected)
    micro = score.micro
    assert (micro.expected, micro.detected_true, micro.false_alarms) == (3, 3, 0)
    assert micro.localisation_px == approx(0.5)
    assert_allclose(score.residuals.du_px, 0.3)
    twice = [1, 1]
    found = detections(expected.u_px[twice] + [0.0, 2.0], expected.v_px[twice], expected.diameter_px[twice], twice)
    middle = scored(found, expected).per_class[1]
    assert (middle.detected_true, middle.false_alarms, middle.precision, middle.recall) == (1, 1, 0.5, 1.0)
    assert middle.localisation_px == 0.0


@mark.parametrize(
    "crater, offset_px, width, hit",
    [
        (2, 9.9, 1.0, True), (2, 10.1, 1.0, False), (0, 7.3, 1.0, True), (0, 7.5, 1.0, False),
        (2, 0.0, 2.1, False), (2, 0.0, 0.45, False), (2, 0.0, 1.9, True),
    ],
)  # fmt: skip
def test_the_limits_of_a_match(expected, crater, offset_px, width, hit):
    """Half a radius is 24 px for 20 km, so that the paper's 10 px decide, and 7.4 px for 6 km."""
    u, v, d = (one[[crater]] for one in (expected.u_px, expected.v_px, expected.diameter_px))
    found = match_detections(detections(u - offset_px, v, d * width, [crater]), expected)
    assert bool(found.crater_of_detection[0] >= 0) is hit


def test_small_craters_count_neither_for_nor_against(expected):
    small = (expected.u_px[3], expected.v_px[3], expected.diameter_px[3])
    score = scored(detections(*zip(small, (3.0, 3.0, 15.0), strict=True), [3, 3]), expected)
    assert (score.micro.expected, score.micro.false_alarms) == (3, 0)


@mark.parametrize("usable, complete", [(False, True), (True, False)])
def test_unfit_images_and_incomplete_regions_are_left_out(usable, complete):
    expected = expected_craters(field(complete), CAMERA, POSITION)
    micro = scored(detections([3.0], [3.0], [30.0], [1], usable), expected).micro
    assert (micro.expected, micro.false_alarms) == (0, 0)
    assert np.isnan(micro.recall)


def test_no_craters_and_no_frames_are_no_error():
    empty = field().select(np.zeros(0, dtype=np.int64))
    expected = expected_craters(empty, CAMERA, POSITION)
    micro = scored(detections([10.0], [10.0], [30.0], [1]), expected).micro
    # Where the catalogue is complete nowhere, a detection is no false alarm: nobody knows the craters there.
    assert micro.false_alarms == 0 and np.isnan(micro.precision)
    assert len(expected_craters(field(), CAMERA, np.zeros((0, 3))).index) == 0


def three_frames():
    """Three frames of craters of 40 px each, classes 0, 1, 2 and 0; the detections are 1 px off, one is an alarm.

    Frame 0 has the craters 0 to 3, of which the last lies where the catalogue is not complete; 1 and 2 find theirs,
    the first of frame 0 is missed, and its second detection is of nothing.
    """
    u = np.array([50.0, 150.0, 250.0, 350.0, 50.0, 150.0, 250.0])
    expected = ExpectedCraters(
        offsets=np.array([0, 4, 6, 7]),
        index=np.arange(7),
        u_px=u,
        v_px=np.full(7, 100.0),
        diameter_px=np.full(7, 40.0),
        size_class=np.array([0, 1, 2, 0, 0, 1, 2]),
        complete=np.array([True, True, True, False, True, True, True]),
    )
    found = DetectionSamples(
        frame_number=np.arange(3),
        utc_ns=np.arange(3),
        usable=np.ones(3, dtype=np.bool_),
        quality=("ok",) * 3,
        offsets=np.array([0, 3, 5, 7]),
        u_px=np.array([151.0, 250.0, 450.0, 50.0, 150.0, 250.0, 450.0]),
        v_px=np.array([100.0, 102.0, 100.0, 103.0, 100.0, 104.0, 100.0]),
        diameter_px=np.full(7, 40.0),
        score=np.array([0.9, 0.8, 0.35, 0.7, 0.6, 0.95, 0.31]),
        size_class=np.array([1, 2, 1, 0, 1, 2, 3]),
    )
    return found, expected, match_detections(found, expected)


def test_scores_are_given_by_class_and_by_bins_of_altitude_and_of_the_sun():
    found, expected, matches = three_frames()
    assert matches.crater_of_detection.tolist() == [1, 2, -1, 4, 5, 6, -1]
    assert matches.detection_of_crater.tolist() == [-1, 0, 1, -1, 3, 4, 5]
    score = score_detections(
        found,
        expected,
        matches,
        np.array([25e3, 25.5e3, 31e3]),
        np.array([4.0, 7.0, 8.0]),
        np.array([10.0, 20.0, 30.0]),
    )
    # Errors of 1, 2, 3, 0 and 4 px; the crater of the incomplete region is not expected.
    counted = attrgetter("size_class", "label", "expected", "detected_true", "false_alarms")
    assert score.micro.localisation_px == approx(2.0)
    assert list(map(counted, (score.micro, *score.per_class))) == [
        (-1, "5–30 km", 6, 5, 1),
        (0, "5–10 km", 2, 1, 0),
        (1, "10–15 km", 2, 2, 1),
        (2, "15–30 km", 2, 2, 0),
    ]
    binned = attrgetter("low", "high", "expected", "precision", "recall", "localisation_px")
    assert list(map(binned, score.by_altitude_km)) == [
        (20.0, 30.0, 5, approx(0.8), approx(0.8), approx(1.5)),
        (30.0, 40.0, 1, 1.0, 1.0, 4.0),
    ]
    assert [binned(one)[:5] for one in score.by_sun_elevation_deg] == [
        (0.0, 5.0, 3, approx(2 / 3), approx(2 / 3)),
        (5.0, 10.0, 3, 1.0, 1.0),
    ]
    residuals = {
        "u_px": [150.0, 250.0, 50.0, 150.0, 250.0],
        "v_px": [100.0] * 5,
        "du_px": [1.0, 0.0, 0.0, 0.0, 0.0],
        "dv_px": [0.0, 2.0, 3.0, 0.0, 4.0],
        "sun_azimuth_deg": [10.0, 10.0, 20.0, 20.0, 30.0],
        "diameter_px": [40.0] * 5,
    }
    assert {name: getattr(score.residuals, name).tolist() for name in residuals} == residuals
    assert "into a nadir camera; a detection is true within 0.5 radii and 10 px of the centre" in score.method


def test_curves_and_calibration_follow_the_scores():
    """True at 0.9, 0.8, 0.7, 0.6 and 0.95, an alarm at 0.35; the detection of class 3 counts nowhere."""
    found, expected, matches = three_frames()
    score = score_detections(found, expected, matches, np.full(3, 25e3))
    assert [one.label for one in score.curves] == ["5–10 km", "10–15 km", "15–30 km", "5–30 km"]
    every = score.curves[3]
    assert every.threshold.tolist() == [0.35, 0.6, 0.7, 0.8, 0.9, 0.95]
    assert_allclose(every.precision, [5 / 6, 1.0, 1.0, 1.0, 1.0, 1.0])
    assert_allclose(every.recall, np.array([5, 5, 4, 3, 2, 1]) / 6)
    assert score.curves[1].threshold.tolist() == [0.35, 0.6, 0.9]
    assert_allclose(score.curves[1].precision, [2 / 3, 1.0, 1.0])
    assert_allclose(score.curves[1].recall, [1.0, 1.0, 0.5])
    assert [(one.mean_score, one.fraction_true, one.count) for one in score.calibration] == [
        (0.35, 0.0, 1),
        (0.6, 1.0, 1),
        (0.7, 1.0, 1),
        (0.8, 1.0, 1),
        (approx(0.925), 1.0, 2),
    ]
    assert score.by_sun_elevation_deg == ()
    assert score.residuals.sun_azimuth_deg is None


def test_alarms_count_where_most_of_the_view_is_complete():
    """Two craters of a frame, one of them in an incomplete region: half is not most."""
    found, expected, _ = three_frames()
    for complete, alarms in ([True, True, False, False], 0), ([True, True, True, False], 1):
        part = replace(expected, complete=np.array([*complete, True, True, True]))
        score = score_detections(found, part, match_detections(found, part), np.full(3, 25e3))
        assert score.micro.false_alarms == alarms


def test_the_closest_pair_in_radii_is_matched_first():
    """A detection 4 px from a crater of 40 px (0.2 radii) and 3 px from one of 20 px (0.3) belongs to the former."""
    two = ExpectedCraters(
        offsets=np.array([0, 2]),
        index=np.arange(2),
        u_px=np.array([50.0, 57.0]),
        v_px=np.zeros(2),
        diameter_px=np.array([40.0, 20.0]),
        size_class=np.zeros(2, dtype=np.int64),
        complete=np.ones(2, dtype=np.bool_),
    )
    found = detections([54.0], [0.0], [28.0], [0])
    assert match_detections(found, two).detection_of_crater.tolist() == [0, -1]
    # With a second detection on the latter both have their own.
    both = detections([54.0, 57.0], [0.0, 0.0], [28.0, 20.0], [0, 0])
    assert match_detections(both, two).crater_of_detection.tolist() == [0, 1]


def test_craters_of_many_frames_are_those_of_each_frame_alone():
    """More frames than are projected together: every one sees what it sees alone, and lost ones see nothing."""
    longitude = np.radians(np.linspace(-0.5, 0.5, 501))
    position = mcmf_from_spherical(np.zeros(501), longitude, np.full(501, ALTITUDE_M))
    position[7] = np.nan
    every = expected_craters(field(), CAMERA, position)
    for frame in 0, 250, 500:
        alone = expected_craters(field(), CAMERA, position[[frame]])
        rows = slice(every.offsets[frame], every.offsets[frame + 1])
        for name in "index", "u_px", "v_px", "diameter_px", "size_class", "complete":
            assert_array_equal(getattr(every, name)[rows], getattr(alone, name))
    assert every.offsets[7] == every.offsets[8] and len(every.offsets) == 502
    assert every.offsets[-1] == len(every.index)


def test_classes_and_completeness_are_those_of_the_catalogue():
    mixed = replace(field(), complete=np.array([True, False, True, True, True]))
    expected = expected_craters(mixed, CAMERA, POSITION)
    assert expected.size_class.tolist()[:3] == [0, 1, 2] and expected.size_class[3] not in (0, 1, 2)
    assert expected.complete.tolist() == [True, False, True, True]
