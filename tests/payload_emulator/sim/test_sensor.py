"""The sensor and its lens against OpenCV; the fast renderer against closed forms and the ray-marching oracle."""

from dataclasses import replace
from math import cos, degrees, pi, radians, sin, sqrt, tan

import numpy as np
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from pytest import approx, fixture, mark, raises

from lunar.camera import BrownCamera, PinholeCamera, intersect_sphere, nadir_camera_from_mcmf, pointed_camera_from_mcmf
from lunar.catalogue import make_catalogue
from lunar.constants import MOON_RADIUS_M
from lunar.errors import LensError
from lunar.frames import axis_rotation, mcmf_from_spherical
from payload_emulator.errors import PayloadError, TerrainError
from payload_emulator.sim.detector import SimulatedDetector
from payload_emulator.sim.render import raymarch, renderer
from payload_emulator.sim.render.labels import project_craters
from payload_emulator.sim.render.light import sun_angles, sun_direction_mcmf
from payload_emulator.sim.render.photometry import LAWS, TABLE_SIZE, Photometry
from payload_emulator.sim.render.renderer import pixel_shifts
from payload_emulator.sim.render.sensor import COLOUR, SensorModel, auto_exposure, random_sensor, take_picture
from tests.lazy import Lazy

cv2 = Lazy("cv2")

ERRORS = ("psf_sigma_px", "vignetting", "gain_mismatch", "stray", "hot_pixels", "dark_e", "offset")
PLAIN = dict.fromkeys(ERRORS, 0.0)


def field(value):
    return np.full((128, 128), value, np.float32)


def shot(scene, sensor, seed=0):
    return take_picture(scene, sensor, default_rng(seed))


def test_noise_is_that_of_the_electrons_counted():
    image = green(field(0.4), quiet(full_well_e=10_000.0, read_noise_e=20.0)) * 10_000.0
    assert image.mean() == approx(4000.0, rel=0.002)
    # 16,384 samples: the deviation is good to 0.6 %.
    assert image.std() == approx(sqrt(4000.0 + 400.0), rel=0.03)


def test_light_beyond_full_scale_saturates_shadow_is_not_exposed_for_and_black_stays_black():
    assert green(field(3.0), quiet()).min() == 1.0
    scene = field(0.0)
    scene[:, :20] = 0.02
    assert auto_exposure(scene, SensorModel(exposure_target=0.8)) * 0.02 == approx(0.8, rel=1e-6)
    assert shot(field(0.0), SensorModel(), 1).mean() < 6.0


def test_the_same_generator_gives_the_same_bits_blur_keeps_light_and_ground_is_slightly_red():
    scene = default_rng(5).random((64, 64)).astype(np.float32)
    assert_array_equal(shot(scene, SensorModel(), 9), shot(scene, SensorModel(), 9))
    scene = field(0.0)
    scene[64, 64] = 0.5
    image = green(scene, quiet(psf_sigma_px=1.2))
    assert image.sum() == approx(0.5, rel=0.01)
    rows = np.arange(128) - 64
    # Integrating over pixels adds a twelfth of a pixel squared.
    assert (image.sum(axis=1) * rows**2).sum() / image.sum() == approx(1.2**2 + 1.0 / 12.0, rel=0.03)
    image = shot(field(0.5), SensorModel(exposure=1.0, **PLAIN), 2).mean(axis=(0, 1))
    assert image[[0, 2]] / image[1] == approx([COLOUR[0], COLOUR[2]], abs=0.01)


@mark.parametrize("bits, steps, kind", [(8, 256, "uint8"), (12, 4096, "uint16"), (16, 65536, "uint16")])
def test_depth_limits_the_number_of_levels_and_the_scene_is_left_as_it_was(bits, steps, kind):
    scene = np.linspace(0.0, 1.0, 128 * 128, dtype=np.float32).reshape(128, 128)
    before = scene.copy()
    image = shot(scene, SensorModel(exposure=1.0, bits=bits, **PLAIN), 3)
    assert steps / 8 < np.unique(image).size <= steps
    assert image.dtype == kind and image.shape == (128, 128, 3)
    assert_array_equal(scene, before)


def test_random_sensors_differ_but_are_reproducible():
    first, again, other = (random_sensor(default_rng(seed)) for seed in (1, 1, 2))
    assert first == again != other


def quiet(**options):
    """A sensor that shows one thing at a time, without noise that matters, in 16 bits."""
    return SensorModel(**{**PLAIN, "exposure": 1.0, "read_noise_e": 1e-3, "full_well_e": 1e12, "bits": 16, **options})


def green(scene, sensor):
    return shot(scene, sensor)[..., 1] / 65535.0


def test_exposure_is_the_share_of_full_scale_and_gain_brightens_and_makes_noisier():
    assert green(field(0.2), quiet(exposure=2.5)).mean() == approx(0.5, abs=1e-3)
    assert green(field(0.1), quiet(gain=4.0)).mean() == approx(0.4, abs=1e-3)
    # At the same output level four times the gain is a quarter of the electrons: noise doubles.
    deviations = [
        green(field(0.4 / gain), quiet(gain=gain, full_well_e=10_000.0, read_noise_e=0.0)).std() for gain in (1.0, 4.0)
    ]
    assert deviations[1] / deviations[0] == approx(2.0, rel=0.05)


def test_vignetting_takes_its_share_smear_follows_columns_and_stray_light_goes_everywhere():
    image = green(field(0.8), quiet(vignetting=0.4))
    assert image[64, 64] == approx(0.8, rel=1e-3)
    assert image[0, 0] == approx(0.8 * 0.6, rel=1e-3)
    assert image[64, 0] == approx(0.8 * 0.8, rel=1e-2)
    scene = field(0.0)
    scene[10:74, 30] = 0.5
    smeared = green(scene, quiet(smear=0.1))
    # Half of the column is lit: its mean is a quarter.
    assert smeared[100, 30] == approx(0.025, abs=1e-3)
    assert smeared[100, 31] == approx(0.0, abs=1e-3)
    assert green(field(0.5), quiet(stray=0.1)).mean() == approx(0.55, abs=1e-3)


def test_hot_and_uneven_pixels_are_the_same_in_every_frame_and_dark_signal_lifts_a_black_picture():
    sensor = quiet(hot_pixels=1e-3)
    first = shot(field(0.1), sensor, 1)[..., 1] == 65535
    assert_array_equal(first, shot(field(0.1), sensor, 2)[..., 1] == 65535)
    # A thousandth of 16,384; two may fall on one place.
    assert 14 <= first.sum() <= 16
    sensor = quiet(full_well_e=1000.0, dark_e=50.0, offset=0.1, read_noise_e=0.0)
    assert green(field(0.0), sensor).mean() == approx(0.15, abs=2e-3)
    flat = green(field(0.5), quiet(gain_mismatch=0.02))
    assert flat.std() / flat.mean() == approx(0.02, rel=0.05)
    assert_allclose(flat, green(field(0.5), quiet(gain_mismatch=0.02)), atol=1e-4)


@mark.parametrize(
    "options, message",
    [
        ({"bits": 10}, "8, 12 or 16 bits, found 10"),
        ({"gain": 0.0}, "gain from 0.001 to 1000, found 0"),
        ({"vignetting": 1.5}, "vignetting from 0 to 1"),
        ({"full_well_e": -1.0}, "full_well_e from 1 to inf"),
        ({"gamma": float("nan")}, "gamma from"),
    ],
)
def test_impossible_sensors_are_refused_by_name(options, message):
    with raises(PayloadError, match=message):
        SensorModel(**options)


@mark.parametrize("latitude_deg", [-60.0, 0.0, 45.0])
@mark.parametrize("azimuth_deg", [-170.0, -45.0, 0.0, 90.0])
def test_sun_direction_and_angles_are_inverse(latitude_deg, azimuth_deg):
    place = radians(latitude_deg), radians(300.0)
    sun = sun_direction_mcmf(radians(12.0), radians(azimuth_deg), *place)
    assert norm(sun) == approx(1.0, abs=1e-12)
    elevation, azimuth = sun_angles(sun, *place)
    assert degrees(elevation) == approx(12.0, abs=1e-9)
    assert degrees(azimuth) == approx(azimuth_deg, abs=1e-9)


def test_a_sun_in_the_north_points_along_the_moons_axis_at_the_equator():
    assert_allclose(sun_direction_mcmf(0.0, 0.0, 0.0, 1.0), [0.0, 0.0, 1.0], atol=1e-12)


BARREL = {"k1": -0.02, "k2": 1.0e-3, "k3": 1.0e-4, "p1": 1.0e-3, "p2": -5.0e-4}
PLACE = radians(10.2), radians(20.3)


def test_points_land_where_opencv_projects_them():
    camera = BrownCamera(**BARREL)
    points = default_rng(0).normal((0.0, 0.0, 2.0), 1.0, (500, 3))
    points = points[points[:, 2] > 1.0]
    matrix = np.array([[camera.focal_px, 0.0, 255.5], [0.0, camera.focal_px, 255.5], [0.0, 0.0, 1.0]])
    coefficients = np.array([camera.k1, camera.k2, camera.p1, camera.p2, camera.k3])
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, coefficients)
    # Both are double precision.
    assert_allclose(camera.project(points), expected[:, 0], atol=1e-9)


def test_the_ray_of_a_pixel_comes_back_to_it_and_is_that_of_the_pinhole_without_distortion():
    camera = BrownCamera(**BARREL)
    uv = default_rng(1).uniform(-0.5, 511.5, (400, 2))
    assert_allclose(camera.project(camera.rays(uv)), uv, atol=1e-7)
    uv = default_rng(2).uniform(-0.5, 511.5, (50, 2))
    assert_allclose(BrownCamera().rays(uv), PinholeCamera().rays(uv), atol=1e-12)


def test_what_lies_beyond_the_fold_of_the_lens_is_not_seen_and_a_fold_in_the_picture_refused():
    # d/dr (r - 0.01 r^3) = 0 at r = 5.77: a point at r = 9 would come back to r = 1.71, in the picture.
    camera = BrownCamera(k1=-0.01)
    assert np.isnan(camera.project(np.array([9.0, 0.0, 1.0]))).all()
    assert np.isfinite(camera.project(np.array([5.7, 0.0, 1.0]))).all()
    with raises(LensError, match="folds the image"):
        BrownCamera(k1=-0.2)


def test_shifts_of_a_barrel_lens_point_outward():
    shift_u, shift_v = pixel_shifts(BrownCamera(k1=-0.02))
    assert shift_u[255, 511] > 5.0 and shift_u[255, 0] < -5.0 and shift_v[0, 255] < -5.0
    assert abs(shift_u[255, 255]) < 1e-3


def test_both_renderers_see_through_the_same_lens(procedural):
    camera = BrownCamera(**BARREL)
    position = mcmf_from_spherical(*PLACE, 25e3)
    rotation = pointed_camera_from_mcmf(position, radians(2.0), 0.5)
    view = position, rotation, sun_direction_mcmf(radians(9.0), 0.5, *PLACE)
    fast, slow = renderer.render(procedural, camera, *view), raymarch.render(procedural, camera, *view, every=8)
    pinhole = renderer.render(procedural, PinholeCamera(), *view)
    assert np.median(np.abs(fast.range_m[::8, ::8] - slow.range_m)) < 2.0
    # The lens shows: ranges of the undistorted picture differ by kilometres at the edge.
    assert np.percentile(np.abs(fast.range_m - pinhole.range_m), 90) > 500.0
    lit = (fast.lit[::8, ::8] > 0.95) & (slow.lit > 0.95)
    assert sqrt(np.mean((fast.radiance[::8, ::8] - slow.radiance)[lit] ** 2)) <= 0.03 * slow.radiance[lit].mean()


def test_pictures_through_a_lens_without_distortion_are_those_of_the_pinhole(procedural):
    position = mcmf_from_spherical(*PLACE, 25e3)
    view = position, nadir_camera_from_mcmf(position), sun_direction_mcmf(radians(9.0), 0.5, *PLACE)
    straight, bent = (renderer.render(procedural, camera(), *view) for camera in (PinholeCamera, BrownCamera))
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
    assert bent.u_px[0] - 255.5 == approx(offset * (1.0 - 0.02 * radius**2), rel=1e-9)
    assert bent.diameter_px[0] < straight.diameter_px[0]


def test_yaw_turns_image_up_clockwise_and_tilt_leans_toward_it():
    position = mcmf_from_spherical(0.3, 1.0, 20e3)
    north = nadir_camera_from_mcmf(position)
    eastward = pointed_camera_from_mcmf(position, 0.0, pi / 2.0)
    # Image up is -y: it was north, now it is the nadir camera's +x, east.
    assert_allclose(-eastward[1], north[0], atol=1e-12)
    assert pointed_camera_from_mcmf(position, 0.1, pi / 2.0)[2] @ north[0] == approx(sin(0.1), abs=1e-12)


@fixture
def smooth(formula_terrain):
    return formula_terrain(lambda latitude, longitude: 0.0 * latitude)


def entry(table, phase_deg):
    return table[:, round((cos(radians(phase_deg)) + 1.0) * TABLE_SIZE / 2)]


@mark.parametrize("law", LAWS)
def test_every_law_gives_the_albedo_when_sun_and_camera_stand_overhead(law):
    seeliger, lambert, multiple = entry(Photometry(law).tables(), 0.0)
    h_one = 3.0 / (1.0 + 2.0 * sqrt(1.0 - 0.21))
    assert 0.5 * seeliger + lambert + 0.5 * multiple * h_one**2 == approx(1.0, abs=2e-3)


def test_lunar_lambert_shares_follow_mcewen():
    # McEwen 1996 (LPSC 27, 841): L(30 deg) = 1 - 0.57 + 0.2178 - 0.03942 = 0.60838.
    seeliger, lambert, _ = entry(Photometry("lunar-lambert", phase_slope_per_rad=0.0).tables(), 30.0)
    assert seeliger / 2.0 == approx(0.608, abs=0.004)
    assert lambert == approx(0.392, abs=0.004)


@mark.parametrize("law", [law for law in LAWS if law != "matt"])
def test_brightness_falls_with_phase(law):
    table = Photometry(law).tables()
    assert np.all(np.diff([float(entry(table, phase)[:2].sum()) for phase in (5, 30, 60, 90, 110)]) < 0.0)


def test_a_matt_surface_is_as_bright_at_any_phase():
    assert_array_equal(Photometry("matt").tables()[1], 1.0)


@mark.parametrize("law", LAWS)
def test_a_law_over_lambert_is_what_the_renderers_make_of_it(smooth, law):
    """Of a smooth sphere, whose cosines are known everywhere, at the pixel below the camera."""

    place, elevation = (0.2, 1.0), radians(25.0)
    position = mcmf_from_spherical(*place, 30e3)
    rotation = pointed_camera_from_mcmf(position, 0.0, 0.0)
    sun = sun_direction_mcmf(elevation, 1.0, *place)
    camera = PinholeCamera(33, 33)
    one, matt = (renderer.render(smooth, camera, position, rotation, sun, Photometry(name)) for name in (law, "matt"))
    ratio = Photometry(law).over_lambert(np.float32(sin(elevation)), np.float32(1.0), sin(elevation))
    assert one.radiance[16, 16] / matt.radiance[16, 16] == approx(float(ratio), rel=2e-3)


@mark.parametrize("law", LAWS)
def test_a_law_over_lambert_is_bounded_on_ground_in_profile(law):
    grid = np.linspace(-1.0, 1.0, 21, dtype=np.float32)
    ratio = Photometry(law).over_lambert(grid[:, None, None], grid[None, :, None], grid[None, None, :])
    # Lommel-Seeliger over Lambert is 2 / (mu0 + mu), with mu no less than 0.02; Hapke's surge and bounces treble it.
    assert np.isfinite(ratio).all() and ratio.min() >= 0.0 and ratio.max() <= 300.0


def test_an_unknown_law_is_refused_by_name():
    with raises(PayloadError, match="lunar-lambert, lambert, hapke, matt, found 'phong'"):
        Photometry("phong")


@mark.parametrize("law", LAWS)
def test_both_renderers_shade_a_smooth_sphere_alike_by_every_law(smooth, law):

    place = 0.2, 1.0
    position = mcmf_from_spherical(*place, 30e3)
    view = (position, pointed_camera_from_mcmf(position, 0.05, 0.4), sun_direction_mcmf(0.3, 1.0, *place))
    fast = renderer.render(smooth, PinholeCamera(), *view, Photometry(law))
    slow = raymarch.render(smooth, PinholeCamera(), *view, Photometry(law), every=32)
    # Tables are read linearly by both; slopes differ in the last digits of single precision.
    assert_allclose(fast.radiance[::32, ::32], slow.radiance, rtol=5e-3)


def test_laws_differ_where_they_should(smooth):
    """A Lambert surface does not know where it is seen from; the Moon is brighter looking down-Sun."""

    position = mcmf_from_spherical(0.0, 1.0, 30e3)
    view = (position, pointed_camera_from_mcmf(position), sun_direction_mcmf(0.5, 0.0, 0.0, 1.0))
    asymmetry = {}
    for law in LAWS:
        slope = 0.0 if law == "lambert" else 0.7
        picture = renderer.render(smooth, PinholeCamera(), *view, Photometry(law, slope)).radiance
        # The Sun stands in the north: the bottom of the picture is seen looking away from it.
        asymmetry[law] = picture[500, 256] / picture[11, 256]
    assert asymmetry["lambert"] == approx(1.0, abs=0.12)
    assert asymmetry["lunar-lambert"] > 1.5 and asymmetry["hapke"] > 1.5


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
    latitude = np.arcsin(points[:, 2] / norm(points, axis=1))
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


# latitude, longitude, altitude in m, elevation and azimuth of the Sun, tilt in degrees, yaw
POSES = """10.5 20.5 15e3 40 100 0 0
10.5 20.5 22e3 4 -150 2 1
9.5 21 31e3 9 35 -2 4
10 20 46e3 14 -20 1 2.5"""


@mark.slow
def test_fast_and_marched_pictures_agree(procedural):
    both_dark = any_dark = 0
    errors = []
    for row in POSES.splitlines():
        latitude, longitude, altitude, elevation, azimuth, tilt, yaw = map(float, row.split())
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
    return default_rng(4)


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
    assert np.corrcoef((first - uv).reshape(-1), (second - uv).reshape(-1))[0, 1] == approx(0.64, abs=0.02)
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
