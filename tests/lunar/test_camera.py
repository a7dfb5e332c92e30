"""The camera against OpenCV, against rays, and against the facts of the mission computed by hand."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lunar.camera import (
    PinholeCamera,
    above_horizon,
    ground_arc_m,
    ground_point_sphere,
    horizon_arc_m,
    intersect_sphere,
    nadir_camera_from_mcmf,
    project_mcmf,
)
from lunar.constants import MOON_RADIUS_M
from lunar.frames import enu_from_mcmf, mcmf_from_spherical
from tests.lazy import Lazy

cv2 = Lazy("cv2")

CAMERA = PinholeCamera()
latitudes = st.floats(-1.57, 1.57)
longitudes = st.floats(-7.0, 7.0)
altitudes_m = st.floats(10_000.0, 100_000.0)


def test_the_facts_of_the_paper_hold_to_their_printed_digits():
    assert f"{CAMERA.focal_px:.2f}" == "147.80"  # 256 / tan 60 deg
    sizes = np.array([14e3, 30e3, 48.6e3]) / CAMERA.focal_px
    assert [f"{v:.1f}" if v < 100 else f"{v:.0f}" for v in sizes] == ["94.7", "203", "329"]
    assert f"{ground_arc_m(math.radians(60), 30e3) / 1e3:.1f}" == "53.4"


def test_projection_is_that_of_opencv():
    rng = np.random.default_rng(1)
    points = rng.uniform([-50e3, -50e3, 10e3], [50e3, 50e3, 60e3], (100, 3))
    f, (cx, cy) = CAMERA.focal_px, CAMERA.centre_px
    theirs, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.array([[f, 0, cx], [0, f, cy], [0, 0, 1]]), None)
    assert np.allclose(CAMERA.project(points), theirs[:, 0], atol=1e-9)


def test_the_boresight_is_between_the_four_middle_pixels_and_the_edge_is_half_the_field_of_view():
    assert CAMERA.centre_px == (255.5, 255.5)
    edge = CAMERA.rays(np.array([511.5, 255.5]))
    assert math.degrees(math.acos(edge[2])) == pytest.approx(60.0, abs=1e-12)


@given(latitudes, longitudes, altitudes_m)
def test_the_nadir_camera_looks_down_with_north_up_and_east_right(latitude, longitude, altitude_m):
    position = mcmf_from_spherical(latitude, longitude, altitude_m)
    rotation = nadir_camera_from_mcmf(position)
    assert np.allclose(rotation[2], -position / np.linalg.norm(position), atol=1e-12)
    east, north = enu_from_mcmf(latitude, longitude)[:2]
    ground = mcmf_from_spherical(latitude, longitude)
    right, up = project_mcmf(CAMERA, rotation, position, ground + 1000.0 * np.stack([east, north])) - 255.5
    assert right[0] > 0.1 and up[1] < -0.1 and max(abs(right[1]), abs(up[0])) < 1e-6


@given(latitudes, longitudes, altitudes_m, st.floats(-0.5, 511.5), st.floats(-0.5, 511.5), st.floats(-5000, 5000))
def test_what_a_pixel_sees_projects_back_into_it(latitude, longitude, altitude_m, u, v, height_m):
    position = mcmf_from_spherical(latitude, longitude, altitude_m)
    rotation = nadir_camera_from_mcmf(position)
    point = ground_point_sphere(CAMERA, rotation, position, np.array([u, v]), height_m)
    if np.isnan(point).any():  # the corners of the image look past the limb from high up
        assert math.hypot(u - 255.5, v - 255.5) > 255.0
        return
    assert np.linalg.norm(point) == pytest.approx(MOON_RADIUS_M + height_m, abs=1e-6)
    # 1e-6 px is a tenth of a millimetre on the ground.
    assert np.allclose(project_mcmf(CAMERA, rotation, position, point), [u, v], atol=1e-6)


def test_points_behind_the_camera_and_rays_past_the_limb_are_nan():
    assert np.isnan(CAMERA.project([0.0, 0.0, -1.0])).all()
    position = mcmf_from_spherical(0.0, 0.0, 30e3)
    level = np.cross(position / np.linalg.norm(position), [0, 0, 1.0])
    assert np.isnan(intersect_sphere(position, np.stack([level, position / np.linalg.norm(position)]))).all()


@given(latitudes, longitudes, altitudes_m, st.floats(0.0, 1.2))
def test_the_range_to_the_sphere_is_that_of_the_cosine_rule(latitude, longitude, altitude_m, off_nadir):
    distance = MOON_RADIUS_M + altitude_m
    expected = distance * math.cos(off_nadir) - math.sqrt(MOON_RADIUS_M**2 - (distance * math.sin(off_nadir)) ** 2)
    rotation = enu_from_mcmf(latitude, longitude)
    direction = math.sin(off_nadir) * rotation[0] - math.cos(off_nadir) * rotation[2]
    found = intersect_sphere(mcmf_from_spherical(latitude, longitude, altitude_m), direction)
    assert found == pytest.approx(expected, abs=1e-5)


def test_from_inside_a_sphere_the_way_out_is_found():
    ways = intersect_sphere(np.array([0.0, 0.0, 500.0]), np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]), 1000.0)
    assert ways == pytest.approx([500.0, 1500.0])


def test_what_lies_behind_the_horizon_is_hidden_and_what_stands_high_is_seen_over_it():
    position = mcmf_from_spherical(0.0, 0.0, 30e3)
    arc = horizon_arc_m(30e3) / MOON_RADIUS_M
    # Length of the tangent sqrt(2 R h + h^2) = 324.25 km, and R atan(324.25 / 1737.4) = 320.57 km.
    assert arc * 1737.4 == pytest.approx(320.57, abs=0.01)
    places = mcmf_from_spherical([0.0, 0.0, 0.0], [0.99 * arc, 1.01 * arc, 1.01 * arc], [0.0, 0.0, 500.0])
    assert above_horizon(position, places).tolist() == [True, False, True]


@pytest.mark.parametrize("shape", [(), (0,), (1,), (2, 3)])
def test_leading_dimensions_are_kept(shape):
    positions = np.broadcast_to(mcmf_from_spherical(0.1, 0.2, 30e3), (*shape, 3))
    rotations = nadir_camera_from_mcmf(positions)
    uv = np.full((*shape, 2), 100.0)
    points = ground_point_sphere(CAMERA, rotations, positions, uv)
    assert points.shape == (*shape, 3)
    assert project_mcmf(CAMERA, rotations, positions, points).shape == (*shape, 2)
    assert CAMERA.contains(uv).shape == shape


def test_one_pose_serves_many_points_and_many_poses_serve_their_own():
    positions = mcmf_from_spherical(np.array([0.1, 0.2]), np.array([0.3, 0.4]), 30e3)
    rotations = nadir_camera_from_mcmf(positions)
    points = mcmf_from_spherical(np.full((2, 5), 0.15), np.linspace(0.3, 0.4, 5), 0.0)
    together = project_mcmf(CAMERA, rotations[:, None], positions[:, None], points)
    for k in range(2):
        assert np.array_equal(together[k], project_mcmf(CAMERA, rotations[k], positions[k], points[k]))


def test_the_image_reaches_half_a_pixel_past_the_outer_centres():
    inside = CAMERA.contains([[-0.5, 0], [-0.51, 0], [511.5, 511.5], [512.0, 0], [5, 5]])
    assert inside.tolist() == [True, False, True, False, True]
    assert CAMERA.contains([[5.0, 5.0]], margin_px=10).tolist() == [False]
    assert CAMERA.corners_px().tolist() == [[-0.5, -0.5], [511.5, -0.5], [511.5, 511.5], [-0.5, 511.5]]
