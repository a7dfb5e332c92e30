"""Projection into a tilted, distorted camera over high terrain, against a projection written out here."""

import math

import numpy as np
import pytest

from ground_service.evaluation.detection.fixes import Pairs, snapshot_positions, wrong_fixes
from ground_service.evaluation.detection.recall import expected_craters
from ground_service.evaluation.detection.viewing import Viewing
from lunar.catalogue import make_catalogue
from lunar.frames import quaternion_from_matrix
from lunar.lens import BrownCamera

RADIUS_M = 1_737_400.0
ALTITUDE_M = 30_000.0
K1, P1 = -0.02, 1e-3
TILT_RAD = math.radians(15.0)
RIM_HEIGHT_M = 5_000.0
POSITION = np.array([[RADIUS_M + ALTITUDE_M, 0.0, 0.0]])  # above latitude 0, longitude 0
CAMERA = BrownCamera(512, 512, 2.0 * math.pi / 3.0, k1=K1, p1=P1)
FOCAL_PX = 256.0 / math.tan(math.radians(60.0))


def pixel(latitude_deg: float, longitude_deg: float, height_m: float) -> tuple[float, float]:
    """Pixel of a place, seen from above (0, 0) by a camera that leans 15 degrees from nadir to the north."""
    latitude, longitude = math.radians(latitude_deg), math.radians(longitude_deg)
    radius = RADIUS_M + height_m
    up = radius * math.cos(latitude) * math.cos(longitude) - (RADIUS_M + ALTITUDE_M)
    east = radius * math.cos(latitude) * math.sin(longitude)
    north = radius * math.sin(latitude)
    along = -up * math.cos(TILT_RAD) + north * math.sin(TILT_RAD)  # boresight
    down = -north * math.cos(TILT_RAD) - up * math.sin(TILT_RAD)  # image v
    x, y = east / along, down / along
    square = x * x + y * y
    radial = 1.0 + K1 * square
    u = x * radial + 2.0 * P1 * x * y
    v = y * radial + P1 * (square + 2.0 * y * y)
    return 255.5 + FOCAL_PX * u, 255.5 + FOCAL_PX * v


PLACES_DEG = [(0.0, 0.1), (0.5, -0.4), (1.0, 0.6), (-0.2, 0.3)]


def catalogue():
    places = np.radians(np.array(PLACES_DEG))
    return make_catalogue(
        places[:, 0], places[:, 1], np.full(4, 8e3), source="made", rim_height_m=np.full(4, RIM_HEIGHT_M)
    )


def test_a_tilted_distorted_camera_sees_craters_on_high_ground_where_they_are() -> None:
    viewing = Viewing(CAMERA, TILT_RAD)
    expected = expected_craters(catalogue(), CAMERA, POSITION, viewing.pointed(POSITION))
    assert expected.index.tolist() == [0, 1, 2, 3]
    for row in range(4):
        u, v = pixel(*PLACES_DEG[row], RIM_HEIGHT_M)
        assert (expected.u_px[row], expected.v_px[row]) == pytest.approx((u, v), abs=1e-6)


def test_a_camera_that_leans_far_sees_craters_beyond_a_nadir_footprint() -> None:
    """2.5 degrees north of the track is 76 km, past the corner of a nadir image from 30 km (73 km)."""
    far = make_catalogue(
        np.radians([3.0]), np.radians([0.0]), np.array([9e3]), source="made", rim_height_m=np.zeros(1)
    )
    narrow = BrownCamera(512, 512, math.radians(60.0))
    assert len(expected_craters(far, narrow, POSITION).index) == 0
    leaning = Viewing(narrow, math.radians(65.0)).pointed(POSITION)
    assert expected_craters(far, narrow, POSITION, leaning).index.tolist() == [0]


def test_a_telemetered_attitude_wins_over_the_declared_pointing() -> None:
    tilted = Viewing(CAMERA, TILT_RAD).pointed(POSITION)
    mcmf_from_icrf = np.array([[[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]])
    q = quaternion_from_matrix(tilted @ mcmf_from_icrf)
    viewing = Viewing(CAMERA, attitude_utc_ns=np.array([1_000]), q_wxyz=q)
    told = viewing.camera_from_mcmf(np.array([1_000]), POSITION, mcmf_from_icrf)
    np.testing.assert_allclose(told, tilted, atol=1e-12)
    other = viewing.camera_from_mcmf(np.array([1_001]), POSITION, mcmf_from_icrf)
    np.testing.assert_allclose(other, Viewing(CAMERA).pointed(POSITION), atol=1e-12)
    assert viewing.known(np.array([999, 1_000, 1_001])).tolist() == [False, True, False]


def test_a_frame_without_reference_expects_nothing() -> None:
    lost = np.full((1, 3), np.nan)
    assert (
        len(expected_craters(catalogue(), CAMERA, lost, Viewing(CAMERA, TILT_RAD).pointed(lost)).index) == 0
    )


@pytest.mark.parametrize("telemetered", [True, False])
def test_a_snapshot_of_a_tilted_distorted_camera_finds_its_place(telemetered: bool) -> None:
    craters = catalogue()
    pairs = Pairs(
        np.zeros(4, dtype=np.int64),
        np.zeros(4, dtype=np.int64),
        np.array([pixel(*place, RIM_HEIGHT_M) for place in PLACES_DEG]),
        np.full(4, 40.0),
        craters.position_mcmf_m,
    )
    viewing = Viewing(CAMERA, TILT_RAD)
    attitude = viewing.pointed(POSITION) if telemetered else None
    start = POSITION + np.array([[800.0, -500.0, 300.0]])
    found = snapshot_positions(pairs, CAMERA, np.zeros(1, dtype=np.int64), start, viewing.pointed, attitude)
    np.testing.assert_allclose(found, POSITION, atol=0.01)
    times = np.zeros(1, dtype=np.int64)
    assert wrong_fixes(pairs, CAMERA, times, POSITION, viewing.pointed(POSITION)) == 0
    assert wrong_fixes(pairs, CAMERA, times, POSITION) == 1
