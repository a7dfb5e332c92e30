"""The detector's score, on a crater field whose detections are made by hand."""

import numpy as np
import pytest

from ground_service.processing.recall import expected_craters, match_detections, score_detections
from ground_service.processing.samples import DetectionSamples
from lunar.camera import PinholeCamera
from lunar.catalogue import CraterCatalogue, make_catalogue
from lunar.frames import mcmf_from_spherical

ALTITUDE_M = 30_000.0
CAMERA = PinholeCamera()
POSITION = mcmf_from_spherical(np.array([0.0]), np.array([0.0]), np.array([ALTITUDE_M]))


def field(complete: bool = True, rim_height_m: float = 0.0) -> CraterCatalogue:
    """Four craters of 6, 12, 20 and 4 km around latitude 0, longitude 0, and one on the far side."""
    latitude = np.radians([0.0, 0.6, -0.6, 0.3, 0.0])
    longitude = np.radians([0.0, 0.6, 0.6, -0.7, 180.0])
    diameter = [6e3, 12e3, 20e3, 4e3, 8e3]
    return make_catalogue(
        latitude, longitude, diameter, source="test", rim_height_m=np.full(5, rim_height_m), complete=complete
    )


def detections(
    u: list[float], v: list[float], d: list[float], classes: list[int], usable: bool = True
) -> DetectionSamples:
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


def test_craters_project_where_the_picture_shows_them() -> None:
    """East is right, south is down; the crater below is at the centre and as wide as f D / h."""
    expected = expected_craters(field(), CAMERA, POSITION)
    assert expected.index.tolist() == [0, 1, 2, 3]
    assert expected.u_px[0] == pytest.approx(255.5, abs=1e-9)
    assert expected.diameter_px[0] == pytest.approx(CAMERA.focal_px * 6e3 / ALTITUDE_M, rel=1e-9)
    assert expected.u_px[1] > 255.5 > expected.v_px[1]
    assert expected.u_px[2] > 255.5
    assert expected.v_px[2] > 255.5


def test_rim_height_moves_a_crater_in_the_image() -> None:
    """A rim 3 km up is a tenth nearer to a camera at 30 km, so it stands a tenth further from the centre."""
    low = expected_craters(field(), CAMERA, POSITION)
    high = expected_craters(field(rim_height_m=3_000.0), CAMERA, POSITION)
    ratio = (high.u_px[1] - 255.5) / (low.u_px[1] - 255.5)
    assert ratio == pytest.approx(1.0 / 0.9, rel=0.01)


def test_a_perfect_detector_scores_one() -> None:
    expected = expected_craters(field(), CAMERA, POSITION)
    found = detections(
        (expected.u_px + 0.3).tolist(),
        (expected.v_px - 0.4).tolist(),
        expected.diameter_px.tolist(),
        [0, 1, 2, 3],
    )
    score = score_detections(found, expected, match_detections(found, expected), np.array([ALTITUDE_M]))
    assert score.micro is not None
    assert (score.micro.expected, score.micro.detected_true, score.micro.false_alarms) == (3, 3, 0)
    assert score.micro.localisation_px == pytest.approx(0.5)
    assert score.residuals is not None
    np.testing.assert_allclose(score.residuals.du_px, 0.3)


def test_one_detection_serves_one_crater_and_the_second_is_a_false_alarm() -> None:
    expected = expected_craters(field(), CAMERA, POSITION)
    u, v, d = (float(a[1]) for a in (expected.u_px, expected.v_px, expected.diameter_px))
    found = detections([u, u + 2.0], [v, v], [d, d], [1, 1])
    score = score_detections(found, expected, match_detections(found, expected), np.array([ALTITUDE_M]))
    middle = score.per_class[1]
    assert (middle.detected_true, middle.false_alarms, middle.precision, middle.recall) == (1, 1, 0.5, 1.0)
    assert middle.localisation_px == 0.0


@pytest.mark.parametrize(
    ("offset_px", "width", "hit"),
    [(9.9, 1.0, True), (10.1, 1.0, False), (0.0, 2.1, False), (0.0, 0.45, False), (0.0, 1.9, True)],
)
def test_the_limits_of_a_match(offset_px: float, width: float, hit: bool) -> None:
    """The 20 km crater is some 98 px wide: half a radius is 24 px, so the paper's 10 px decide."""
    expected = expected_craters(field(), CAMERA, POSITION)
    found = detections(
        [float(expected.u_px[2]) - offset_px],
        [float(expected.v_px[2])],
        [float(expected.diameter_px[2]) * width],
        [2],
    )
    assert bool(match_detections(found, expected).crater_of_detection[0] >= 0) is hit


def test_small_craters_count_neither_for_nor_against() -> None:
    expected = expected_craters(field(), CAMERA, POSITION)
    found = detections(
        [float(expected.u_px[3]), 3.0],
        [float(expected.v_px[3]), 3.0],
        [float(expected.diameter_px[3]), 15.0],
        [3, 3],
    )
    score = score_detections(found, expected, match_detections(found, expected), np.array([ALTITUDE_M]))
    assert score.micro is not None
    assert (score.micro.expected, score.micro.false_alarms) == (3, 0)


@pytest.mark.parametrize(("usable", "complete"), [(False, True), (True, False)])
def test_unfit_images_and_incomplete_regions_are_left_out(usable: bool, complete: bool) -> None:
    expected = expected_craters(field(complete), CAMERA, POSITION)
    found = detections([3.0], [3.0], [30.0], [1], usable)
    score = score_detections(found, expected, match_detections(found, expected), np.array([ALTITUDE_M]))
    assert score.micro is not None
    assert (score.micro.expected, score.micro.false_alarms) == (0, 0)
    assert np.isnan(score.micro.recall)


def test_no_craters_and_no_frames_are_no_error() -> None:
    empty = field().select(np.zeros(0, dtype=np.int64))
    expected = expected_craters(empty, CAMERA, POSITION)
    found = detections([10.0], [10.0], [30.0], [1])
    score = score_detections(found, expected, match_detections(found, expected), np.array([ALTITUDE_M]))
    assert score.micro is not None
    assert score.micro.false_alarms == 1
    nothing = expected_craters(field(), CAMERA, np.zeros((0, 3)))
    assert len(nothing.index) == 0
