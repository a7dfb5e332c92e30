"""The distorting lens: against OpenCV's projection, and the same in both renderers and the labels."""

import math

import cv2
import numpy as np
import pytest

from lunar.camera import PinholeCamera, nadir_camera_from_mcmf
from lunar.catalogue import make_catalogue
from lunar.errors import LensError
from lunar.frames import mcmf_from_spherical
from lunar.lens import BrownCamera, pointed_camera_from_mcmf
from payload_emulator.sim.render import raymarch, renderer
from payload_emulator.sim.render.labels import project_craters
from payload_emulator.sim.render.light import sun_direction_mcmf
from payload_emulator.sim.render.renderer import pixel_shifts

BARREL = {"k1": -0.02, "k2": 1.0e-3, "k3": 1.0e-4, "p1": 1.0e-3, "p2": -5.0e-4}
PLACE = math.radians(10.2), math.radians(20.3)


def test_points_land_where_opencv_projects_them():
    camera = BrownCamera(**BARREL)
    points = np.random.default_rng(0).normal((0.0, 0.0, 2.0), 1.0, (500, 3))
    points = points[points[:, 2] > 1.0]
    matrix = np.array([[camera.focal_px, 0.0, 255.5], [0.0, camera.focal_px, 255.5], [0.0, 0.0, 1.0]])
    coefficients = np.array([camera.k1, camera.k2, camera.p1, camera.p2, camera.k3])
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, coefficients)
    # Both are double precision.
    np.testing.assert_allclose(camera.project(points), expected[:, 0], atol=1e-9)


def test_a_pixels_ray_comes_back_to_the_pixel():
    camera = BrownCamera(**BARREL)
    uv = np.random.default_rng(1).uniform(-0.5, 511.5, (400, 2))
    np.testing.assert_allclose(camera.project(camera.rays(uv)), uv, atol=1e-7)


def test_a_lens_without_distortion_is_the_pinhole():
    uv = np.random.default_rng(2).uniform(-0.5, 511.5, (50, 2))
    np.testing.assert_allclose(BrownCamera().rays(uv), PinholeCamera().rays(uv), atol=1e-12)


def test_what_lies_beyond_the_fold_of_the_lens_is_not_folded_back_into_the_picture():
    # d/dr (r - 0.01 r^3) = 0 at r = 5.77: a point at r = 9 would come back to r = 1.71, in the picture.
    camera = BrownCamera(k1=-0.01)
    assert np.isnan(camera.project(np.array([9.0, 0.0, 1.0]))).all()
    assert np.isfinite(camera.project(np.array([5.7, 0.0, 1.0]))).all()


def test_a_lens_that_folds_the_picture_is_refused():
    with pytest.raises(LensError, match="folds the image"):
        BrownCamera(k1=-0.2)


def test_shifts_of_a_barrel_lens_point_outward():
    shift_u, shift_v = pixel_shifts(BrownCamera(k1=-0.02))
    assert shift_u[255, 511] > 5.0 and shift_u[255, 0] < -5.0
    assert shift_v[0, 255] < -5.0
    assert abs(shift_u[255, 255]) < 1e-3


def test_both_renderers_see_through_the_same_lens(procedural):
    camera = BrownCamera(**BARREL)
    position = mcmf_from_spherical(*PLACE, 25e3)
    rotation = pointed_camera_from_mcmf(position, math.radians(2.0), 0.5)
    toward = sun_direction_mcmf(math.radians(9.0), 0.5, *PLACE)
    fast = renderer.render(procedural, camera, position, rotation, toward)
    slow = raymarch.render(procedural, camera, position, rotation, toward, every=8)
    pinhole = renderer.render(procedural, PinholeCamera(), position, rotation, toward)
    difference = np.abs(fast.range_m[::8, ::8] - slow.range_m)
    assert np.median(difference) < 2.0
    # The lens shows: ranges of the undistorted picture differ by kilometres at the edge.
    assert np.percentile(np.abs(fast.range_m - pinhole.range_m), 90) > 500.0
    lit = (fast.lit[::8, ::8] > 0.95) & (slow.lit > 0.95)
    error = (fast.radiance[::8, ::8] - slow.radiance)[lit]
    assert math.sqrt(np.mean(error**2)) <= 0.03 * slow.radiance[lit].mean()


def test_pictures_through_a_lens_without_distortion_are_those_of_the_pinhole(procedural):
    position = mcmf_from_spherical(*PLACE, 25e3)
    rotation = nadir_camera_from_mcmf(position)
    toward = sun_direction_mcmf(math.radians(9.0), 0.5, *PLACE)
    straight = renderer.render(procedural, PinholeCamera(), position, rotation, toward)
    bent = renderer.render(procedural, BrownCamera(), position, rotation, toward)
    # Two searches for the same hit: a thousandth of a pixel; crests may be passed on either side.
    assert np.percentile(np.abs(straight.range_m - bent.range_m), 99) < 1.0
    assert np.mean(np.abs(straight.radiance - bent.radiance) > 1e-3) < 1e-3


def test_labels_go_through_the_lens():
    position = mcmf_from_spherical(0.0, 1.0, 20e3)
    rotation = nadir_camera_from_mcmf(position)
    catalogue = make_catalogue([0.0], [1.0 + 24e3 / 1_737_400.0], [5000.0], source="t", rim_height_m=[0.0])
    straight = project_craters(catalogue, PinholeCamera(), position, rotation)
    bent = project_craters(catalogue, BrownCamera(k1=-0.02), position, rotation)
    offset = straight.u_px[0] - 255.5
    radius = offset / PinholeCamera().focal_px
    assert bent.u_px[0] - 255.5 == pytest.approx(offset * (1.0 - 0.02 * radius**2), rel=1e-9)
    assert bent.diameter_px[0] < straight.diameter_px[0]


def test_yaw_turns_image_up_clockwise_and_tilt_leans_toward_it():
    position = mcmf_from_spherical(0.3, 1.0, 20e3)
    north = nadir_camera_from_mcmf(position)
    eastward = pointed_camera_from_mcmf(position, 0.0, math.pi / 2.0)
    # Image up is -y: it was north, now it is the nadir camera's +x, east.
    np.testing.assert_allclose(-eastward[1], north[0], atol=1e-12)
    leaning = pointed_camera_from_mcmf(position, 0.1, math.pi / 2.0)
    east_part = leaning[2] @ north[0]
    assert east_part == pytest.approx(math.sin(0.1), abs=1e-12)
