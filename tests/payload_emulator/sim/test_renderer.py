"""The fast renderer against closed forms and the ray-marching oracle; the simulated detector."""

from dataclasses import replace
from math import pi, radians, sqrt, tan

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx, fixture, mark, raises

from lunar.camera import PinholeCamera, intersect_sphere, nadir_camera_from_mcmf
from lunar.constants import MOON_RADIUS_M
from lunar.frames import axis_rotation, mcmf_from_spherical
from payload_emulator.errors import TerrainError
from payload_emulator.sim.detector import SimulatedDetector
from payload_emulator.sim.render import raymarch, renderer
from payload_emulator.sim.render.light import sun_direction_mcmf
from payload_emulator.sim.render.photometry import Photometry

CAMERA = PinholeCamera()
LAMBERT = Photometry("lambert", phase_slope_per_rad=0.0)


def pose(latitude_deg, longitude_deg, altitude_m):
    position = mcmf_from_spherical(radians(latitude_deg), radians(longitude_deg), altitude_m)
    return position, nadir_camera_from_mcmf(position)


def sun(elevation_deg, azimuth_deg, latitude_deg, longitude_deg):
    angles = (elevation_deg, azimuth_deg, latitude_deg, longitude_deg)
    return sun_direction_mcmf(*(radians(angle) for angle in angles))


def rays(rotation):
    """Directions of all pixels in MCMF."""
    v, u = np.mgrid[0:512, 0:512]
    return CAMERA.rays(np.stack([u, v], axis=-1)) @ rotation


@mark.parametrize("longitude_deg", [20.0, 0.0, 359.9])
@mark.parametrize("height_m", [0.0, -3000.0, 4000.0])
def test_ranges_over_a_smooth_sphere_are_those_of_the_sphere(formula_terrain, height_m, longitude_deg):
    terrain = formula_terrain(lambda latitude, longitude: height_m + 0.0 * latitude)
    position, rotation = pose(10.0, longitude_deg, 20e3)
    tilted = axis_rotation(1, radians(3.0)) @ axis_rotation(3, 0.7) @ rotation
    picture = renderer.render(terrain, CAMERA, position, tilted, sun(30.0, 20.0, 10.0, longitude_deg))
    expected = intersect_sphere(position, rays(tilted), MOON_RADIUS_M + height_m)
    # A hundredth of a pixel (100 m on the ground) along the ray: grid points are joined by straight lines.
    assert_allclose(picture.range_m, expected, atol=2.0)


def test_a_lambert_sphere_shines_with_the_sine_of_the_local_sun(formula_terrain):
    terrain = formula_terrain(lambda latitude, longitude: 0.0 * latitude)
    position, rotation = pose(-30.0, 100.0, 30e3)
    toward = sun(20.0, 60.0, -30.0, 100.0)
    picture = renderer.render(terrain, CAMERA, position, rotation, toward, LAMBERT)
    assert picture.lit.min() == 1.0
    directions = rays(rotation)
    points = position + directions * intersect_sphere(position, directions)[..., None]
    expected = 0.12 * (points @ toward) / MOON_RADIUS_M
    # Heights near 1.7e6 m lose nothing to single precision that shows above one part in 300.
    assert_allclose(picture.radiance, expected, rtol=3e-3)


def test_the_shadow_of_a_step_ends_where_trigonometry_says(formula_terrain):
    edge_rad = radians(0.3)

    def wall(latitude, longitude):
        return np.where(latitude > edge_rad, 1500.0, 0.0) + 0.0 * longitude

    position, rotation = pose(0.0, 50.0, 30e3)
    picture = renderer.render(formula_terrain(wall), CAMERA, position, rotation, sun(10.0, 0.0, 0.0, 50.0))
    # Along the central meridian the ground south of the wall is dark for height / tan(elevation).
    column = picture.lit[:, 255]
    points = position + picture.range_m[:, 255, None] * rays(rotation)[:, 255]
    latitude = np.arcsin(points[:, 2] / np.linalg.norm(points, axis=1))
    dark = (column < 0.5) & (latitude < edge_rad - 100.0 / MOON_RADIUS_M)
    length = (edge_rad - latitude[dark].min()) * MOON_RADIUS_M
    # The crest lies below the tangent plane by the fall of the Moon over its distance from below the camera.
    fall = 0.5 * edge_rad**2 * MOON_RADIUS_M
    exact = (1500.0 - fall) / tan(radians(10.0))
    # The crest is found up to a pixel of the terrain (167 m) and a grid step (132 m) behind the edge, and the last
    # dark pixel's centre up to a pixel of the picture (203 m) before the shadow's end.
    assert exact - 502.0 <= length <= exact + 10.0


def test_yaw_by_a_quarter_turn_turns_the_picture(procedural):
    position, rotation = pose(10.0, 20.0, 25e3)
    toward = sun(12.0, 30.0, 10.0, 20.0)
    upright = renderer.render(procedural, CAMERA, position, rotation, toward)
    turned = renderer.render(procedural, CAMERA, position, axis_rotation(3, pi / 2.0) @ rotation, toward)
    difference = np.abs(np.rot90(upright.range_m, 1) - turned.range_m)
    # Same rays, other order of search: a tenth of a metre.
    assert np.percentile(difference, 99) < 1.0


POSES = [
    (10.5, 20.5, 15e3, 40.0, 100.0, 0.0, 0.0), (10.5, 20.5, 22e3, 4.0, -150.0, 2.0, 1.0),
    (9.5, 21.0, 31e3, 9.0, 35.0, -2.0, 4.0), (10.0, 20.0, 46e3, 14.0, -20.0, 1.0, 2.5)
]  # fmt: skip


@mark.slow
def test_fast_and_marched_pictures_agree(procedural):
    both_dark = any_dark = 0
    errors = []
    for latitude, longitude, altitude, elevation, azimuth, tilt, yaw in POSES:
        position, rotation = pose(latitude, longitude, altitude)
        rotation = axis_rotation(3, yaw) @ axis_rotation(1, radians(tilt)) @ rotation
        toward = sun(elevation, azimuth, latitude, longitude)
        fast = renderer.render(procedural, CAMERA, position, rotation, toward)
        slow = raymarch.render(procedural, CAMERA, position, rotation, toward, every=8)
        dark, expected = fast.lit[::8, ::8] < 0.5, slow.lit < 0.5
        both_dark += np.count_nonzero(dark & expected)
        any_dark += np.count_nonzero(dark | expected)
        lit = (fast.lit[::8, ::8] > 0.95) & (slow.lit > 0.95)
        difference = (fast.radiance[::8, ::8] - slow.radiance)[lit]
        errors.append(sqrt(np.mean(difference**2)) / slow.radiance[lit].mean())
        # Half a pixel on the ground at the picture's edge is far more than this.
        assert np.nanmedian(np.abs(fast.range_m[::8, ::8] - slow.range_m)) < 2.0
    assert any_dark > 1000
    # Low Suns are the hard case, and three of these four are low.
    assert both_dark / any_dark >= 0.96
    assert max(errors) <= 0.03


def test_a_picture_is_the_same_bits_whatever_was_rendered_before(procedural):
    position, rotation = pose(10.0, 20.0, 20e3)
    toward = sun(10.0, 0.0, 10.0, 20.0)
    first = renderer.render(procedural, CAMERA, position, rotation, toward)
    renderer.render(procedural, CAMERA, *pose(11.0, 21.0, 30e3), toward)
    again = renderer.render(procedural, CAMERA, position, rotation, toward)
    assert_array_equal(first.radiance, again.radiance)


def test_a_camera_in_the_ground_is_refused(formula_terrain):
    terrain = formula_terrain(lambda latitude, longitude: 5000.0 + 0.0 * latitude)
    with raises(TerrainError, match="above the ground"):
        renderer.render(terrain, CAMERA, *pose(0.0, 0.0, 4000.0), sun(10.0, 0.0, 0.0, 0.0))


def test_a_view_of_the_pole_is_refused_with_the_latitude(procedural):
    with raises(TerrainError, match="within 84 deg"):
        renderer.render(procedural, CAMERA, *pose(88.0, 0.0, 20e3), sun(10.0, 0.0, 88.0, 0.0))


CORNER = np.array([511.0, 511.0])
COUNT = 20_000


@fixture()
def rng():
    return np.random.default_rng(4)


def test_each_class_is_found_with_its_recall_and_no_other_size(rng):
    detector = SimulatedDetector(recall=(0.2, 0.4, 0.6, 0.8))
    for diameter_m, recall in ((7e3, 0.2), (12e3, 0.4), (20e3, 0.6), (4e3, 0.8), (2e3, 0.0), (40e3, 0.0)):
        found = detector.found(np.full(COUNT, diameter_m), rng)
        # Four standard deviations of a share of 20,000.
        assert found.size / COUNT == approx(recall, abs=4.0 * np.sqrt(0.25 / COUNT))


def test_errors_have_their_size_and_the_lasting_part_stays(rng):
    detector = SimulatedDetector(precision=1.0, sigma_px=1.5, persistence=0.64, log_diameter_sigma=0.1)
    uv, size = np.full((COUNT, 2), 100.0), np.full(COUNT, 30.0)
    lasting = rng.standard_normal((COUNT, 2))
    first, sizes = detector.detect(uv, size, CORNER, rng, lasting)
    second, _ = detector.detect(uv, size, CORNER, rng, lasting)
    assert (first - uv).std() == approx(1.5, rel=0.02)
    correlation = np.corrcoef((first - uv).reshape(-1), (second - uv).reshape(-1))[0, 1]
    assert correlation == approx(0.64, abs=0.02)
    assert np.log(sizes / size).std() == approx(0.1, rel=0.03)


def test_a_shift_moves_true_detections(rng):
    detector = SimulatedDetector(precision=1.0, sigma_px=0.0, log_diameter_sigma=0.0, bias_px=(2.0, -1.0))
    uv = np.full((5, 2), 100.0)
    assert_array_equal(detector.detect(uv, np.ones(5), CORNER, rng)[0], uv + np.array([2.0, -1.0]))
    moved, _ = detector.detect(uv, np.ones(5), CORNER, rng, bias_px=np.array([0.5, 0.5]))
    assert_array_equal(moved, uv + 0.5)


def test_false_detections_have_their_share_and_lie_in_the_image(rng):
    detector = SimulatedDetector(precision=0.8, log_diameter_sigma=0.0)
    uv, size = np.full((COUNT, 2), -50.0), np.full(COUNT, 33.0)
    places, sizes = detector.detect(uv, size, CORNER, rng)
    false = places[COUNT:]
    assert COUNT / len(places) == approx(0.8, abs=0.01)
    assert false.min() >= 0.0 and false.max() <= 511.0
    assert set(sizes[COUNT:]) == {33.0}
    blind = replace(detector, precision=0.05)
    sizes = np.concatenate([blind.detect(uv[:0], size[:0], CORNER, rng)[1] for _ in range(50)])
    assert sizes.size > 100 and sizes.min() >= 15.0 and sizes.max() <= 60.0


def test_the_declared_error_is_the_true_one_unless_stated():
    assert SimulatedDetector(sigma_px=1.2).stated_sigma_px == 1.2
    assert SimulatedDetector(sigma_px=1.2, claimed_sigma_px=0.7).stated_sigma_px == 0.7
