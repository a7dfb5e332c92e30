"""The camera against OpenCV, rays and facts computed by hand; the study of the field of view."""

import math
from math import cos, radians, sin

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy import isnan, pi
from numpy.linalg import norm
from numpy.random import default_rng
from pytest import approx, mark, raises
from scipy.special import pdtrc

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
from lunar.catalogue import make_catalogue, paper_density_catalogue
from lunar.constants import MOON_RADIUS_M
from lunar.errors import LunarError
from lunar.fov_study import PAPER_FOV_DEG, study_field_of_view
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
    assert f"{ground_arc_m(radians(60), 30e3) / 1e3:.1f}" == "53.4"


def test_projection_is_that_of_opencv_about_the_middle_and_to_half_the_field_of_view():
    points = default_rng(1).uniform([-50e3, -50e3, 10e3], [50e3, 50e3, 60e3], (100, 3))
    f, (cx, cy) = CAMERA.focal_px, CAMERA.centre_px
    theirs, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.array([[f, 0, cx], [0, f, cy], [0, 0, 1]]), None)
    assert np.allclose(CAMERA.project(points), theirs[:, 0], atol=1e-9)
    assert CAMERA.centre_px == (255.5, 255.5)
    assert math.degrees(math.acos(CAMERA.rays(np.array([511.5, 255.5]))[2])) == approx(60.0, abs=1e-12)


@given(latitudes, longitudes, altitudes_m)
def test_the_nadir_camera_looks_down_with_north_up_and_east_right(latitude, longitude, altitude_m):
    position = mcmf_from_spherical(latitude, longitude, altitude_m)
    rotation = nadir_camera_from_mcmf(position)
    assert np.allclose(rotation[2], -position / norm(position), atol=1e-12)
    east, north = enu_from_mcmf(latitude, longitude)[:2]
    ground = mcmf_from_spherical(latitude, longitude)
    right, up = project_mcmf(CAMERA, rotation, position, ground + 1000.0 * np.stack([east, north])) - 255.5
    assert right[0] > 0.1 and up[1] < -0.1 and max(abs(right[1]), abs(up[0])) < 1e-6


@given(latitudes, longitudes, altitudes_m, st.floats(-0.5, 511.5), st.floats(-0.5, 511.5), st.floats(-5000, 5000))
def test_what_a_pixel_sees_projects_back_into_it(latitude, longitude, altitude_m, u, v, height_m):
    position = mcmf_from_spherical(latitude, longitude, altitude_m)
    rotation = nadir_camera_from_mcmf(position)
    point = ground_point_sphere(CAMERA, rotation, position, np.array([u, v]), height_m)
    if isnan(point).any():  # the corners of the image look past the limb from high up
        assert math.hypot(u - 255.5, v - 255.5) > 255.0
        return
    assert norm(point) == approx(MOON_RADIUS_M + height_m, abs=1e-6)
    # 1e-6 px is a tenth of a millimetre on the ground.
    assert np.allclose(project_mcmf(CAMERA, rotation, position, point), [u, v], atol=1e-6)


def test_points_behind_the_camera_and_rays_past_the_limb_are_nan():
    assert isnan(CAMERA.project([0.0, 0.0, -1.0])).all()
    position = mcmf_from_spherical(0.0, 0.0, 30e3)
    level = np.cross(position / norm(position), [0, 0, 1.0])
    assert isnan(intersect_sphere(position, np.stack([level, position / norm(position)]))).all()


@given(latitudes, longitudes, altitudes_m, st.floats(0.0, 1.2))
def test_the_range_to_the_sphere_is_that_of_the_cosine_rule(latitude, longitude, altitude_m, off_nadir):
    distance = MOON_RADIUS_M + altitude_m
    expected = distance * cos(off_nadir) - math.sqrt(MOON_RADIUS_M**2 - (distance * sin(off_nadir)) ** 2)
    rotation = enu_from_mcmf(latitude, longitude)
    direction = sin(off_nadir) * rotation[0] - cos(off_nadir) * rotation[2]
    found = intersect_sphere(mcmf_from_spherical(latitude, longitude, altitude_m), direction)
    assert found == approx(expected, abs=1e-5)


def test_the_way_out_of_a_sphere_is_found_and_only_what_stands_high_is_seen_over_the_horizon():
    ways = intersect_sphere(np.array([0.0, 0.0, 500.0]), np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]), 1000.0)
    assert ways == approx([500.0, 1500.0])
    position = mcmf_from_spherical(0.0, 0.0, 30e3)
    arc = horizon_arc_m(30e3) / MOON_RADIUS_M
    # Length of the tangent sqrt(2 R h + h^2) = 324.25 km, and R atan(324.25 / 1737.4) = 320.57 km.
    assert arc * 1737.4 == approx(320.57, abs=0.01)
    places = mcmf_from_spherical([0.0, 0.0, 0.0], [0.99 * arc, 1.01 * arc, 1.01 * arc], [0.0, 0.0, 500.0])
    assert above_horizon(position, places).tolist() == [True, False, True]


@mark.parametrize("shape", [(), (0,), (1,), (2, 3)])
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


UNIFORM = paper_density_catalogue(1, uniform=True)


def random_positions(n, seed, low_m=14e3, high_m=48e3):
    rng = default_rng(seed)
    latitude, longitude = np.arcsin(rng.uniform(-1, 1, n)), rng.uniform(-pi, pi, n)
    return mcmf_from_spherical(latitude, longitude, rng.uniform(low_m, high_m, n))


def test_counts_in_the_footprint_are_those_of_projecting_every_crater():
    positions = random_positions(25, 4)
    study = study_field_of_view(positions, UNIFORM)
    ground = mcmf_from_spherical(UNIFORM.latitude_rad, UNIFORM.longitude_rad)
    for fov_deg in (60.0, 120.0, 150.0):
        camera = PinholeCamera(fov_rad=radians(fov_deg))
        seen = []
        for position in positions:
            uv = project_mcmf(camera, nadir_camera_from_mcmf(position), position, ground)
            seen.append(np.count_nonzero(camera.contains(uv) & above_horizon(position, ground)))
        at = list(study.fov_deg).index(fov_deg)
        for n in (1, 3, 5):
            assert study.probability_at_least[n][at] == np.mean(np.array(seen) >= n)


def test_uniform_craters_follow_poisson_in_the_true_footprint():
    altitude_m, fov_deg = 20e3, 90.0
    study = study_field_of_view(random_positions(20_000, 5, altitude_m, altitude_m), UNIFORM, (fov_deg,))
    # Ground area of the image: each pixel's solid angle times range^2 over the cosine of incidence.
    camera = PinholeCamera(200, 200, radians(fov_deg))
    position = mcmf_from_spherical(0.0, 0.0, altitude_m)
    v, u = np.mgrid[0:200, 0:200]
    rays = camera.rays(np.stack([u, v], -1)) @ nadir_camera_from_mcmf(position)
    range_m = intersect_sphere(position, rays)
    normal = (position + range_m[..., None] * rays) / MOON_RADIUS_M
    solid = (rays @ -position / norm(position)) ** 3 / camera.focal_px**2
    area_m2 = np.sum(range_m**2 * solid / np.abs(np.sum(normal * rays, -1)))
    expected = len(UNIFORM) / (4 * pi * MOON_RADIUS_M**2) * area_m2
    for n in (1, 3, 5):
        chance = pdtrc(n - 1, expected)
        # 20,000 overlapping positions over a catalogue of 79,387: three standard errors are 0.02 at most.
        assert study.probability_at_least[n][0] == approx(chance, abs=0.02)


def test_probabilities_grow_with_the_field_of_view_and_none_is_selected_where_none_suffices():
    study = study_field_of_view(random_positions(500, 6), paper_density_catalogue(2))
    assert study.fov_deg.tolist() == list(PAPER_FOV_DEG)
    for values in study.probability_at_least.values():
        assert np.all(np.diff(values) >= 0.0)
    assert np.all(study.probability_at_least[1] >= study.probability_at_least[3])
    enough = study.probability_at_least[3] > 0.9
    assert study.selected_fov_deg == study.fov_deg[np.argmax(enough)]
    assert study.selected_every_altitude_deg >= study.selected_fov_deg
    study = study_field_of_view(random_positions(200, 7), UNIFORM, (10.0, 20.0))
    assert math.isnan(study.selected_fov_deg)


def test_positions_over_regions_that_the_catalogue_leaves_out_do_not_count():
    west = UNIFORM.longitude_rad > pi
    half = UNIFORM.select(west)
    study = study_field_of_view(random_positions(2000, 8), half)
    assert study.positions == 2000
    # 100 km of grace around the edge of half the Moon: 6 % more than half.
    assert 950 < study.positions_covered < 1150
    flagged = make_catalogue(
        UNIFORM.latitude_rad, UNIFORM.longitude_rad, UNIFORM.diameter_m, source="flagged", complete=west
    )
    assert 900 < study_field_of_view(random_positions(2000, 8), flagged).positions_covered < 1100


def test_craters_are_found_over_the_meridian_and_the_pole_and_nothing_to_study_is_refused():
    catalogue = make_catalogue(
        np.radians([0.0, 0.0, 89.9, 89.9, 0.2]), np.radians([359.9, 0.1, 10.0, 190.0, 0.0]), [6e3] * 5,
        source="five",
    )  # fmt: skip
    study = study_field_of_view(mcmf_from_spherical(np.radians([0.0, 90.0]), np.radians([0.0, 0.0]), 30e3), catalogue)
    assert np.count_nonzero(np.isfinite(np.tan(np.radians(study.required_fov_deg / 2)))[0]) >= 3
    assert study.required_fov_deg[0][2] < 30.0 and study.required_fov_deg[1][1] < 30.0
    with raises(LunarError, match="expected craters of 5-30 km under the orbit"):
        study_field_of_view(random_positions(5, 9), UNIFORM.select([]))
    with raises(LunarError, match=r"expected fields of view in 0\.\.180 deg"):
        study_field_of_view(random_positions(5, 9), UNIFORM, (190.0,))
