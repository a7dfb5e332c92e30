import math

import numpy as np
import pytest

from lunar.camera import PinholeCamera
from lunar.frames import mcmf_from_spherical
from lunar.lens import pointed_camera_from_mcmf
from payload_emulator.errors import PayloadError
from payload_emulator.sim.render import raymarch, renderer
from payload_emulator.sim.render.light import sun_direction_mcmf
from payload_emulator.sim.render.photometry import LAWS, TABLE_SIZE, Photometry


def entry(table, phase_deg):
    return table[:, round((math.cos(math.radians(phase_deg)) + 1.0) * TABLE_SIZE / 2)]


@pytest.mark.parametrize("law", LAWS)
def test_every_law_gives_the_albedo_when_sun_and_camera_stand_overhead(law):
    seeliger, lambert, multiple = entry(Photometry(law).tables(), 0.0)
    h_one = 3.0 / (1.0 + 2.0 * math.sqrt(1.0 - 0.21))
    normal = 0.5 * seeliger + lambert + 0.5 * multiple * h_one**2
    assert normal == pytest.approx(1.0, abs=2e-3)


def test_lunar_lambert_shares_follow_mcewen():
    # McEwen 1996 (LPSC 27, 841): L(30 deg) = 1 - 0.57 + 0.2178 - 0.03942 = 0.60838.
    seeliger, lambert, _ = entry(Photometry("lunar-lambert", phase_slope_per_rad=0.0).tables(), 30.0)
    assert seeliger / 2.0 == pytest.approx(0.608, abs=0.004)
    assert lambert == pytest.approx(0.392, abs=0.004)


@pytest.mark.parametrize("law", [law for law in LAWS if law != "matt"])
def test_brightness_falls_with_phase(law):
    table = Photometry(law).tables()
    whole = [float(entry(table, phase)[:2].sum()) for phase in (5, 30, 60, 90, 110)]
    assert np.all(np.diff(whole) < 0.0)


def test_a_matt_surface_is_as_bright_at_any_phase():
    np.testing.assert_array_equal(Photometry("matt").tables()[1], 1.0)


@pytest.mark.parametrize("law", LAWS)
def test_a_law_over_lambert_is_what_the_renderers_make_of_it(formula_terrain, law):
    """Of a smooth sphere, whose cosines are known everywhere, at the pixel below the camera."""
    terrain = formula_terrain(lambda latitude, longitude: 0.0 * latitude)
    place, elevation = (0.2, 1.0), math.radians(25.0)
    position = mcmf_from_spherical(*place, 30e3)
    rotation = pointed_camera_from_mcmf(position, 0.0, 0.0)
    sun = sun_direction_mcmf(elevation, 1.0, *place)
    camera = PinholeCamera(33, 33)
    one, matt = (
        renderer.render(terrain, camera, position, rotation, sun, Photometry(name)) for name in (law, "matt")
    )
    ratio = Photometry(law).over_lambert(
        np.float32(math.sin(elevation)), np.float32(1.0), math.sin(elevation)
    )
    assert one.radiance[16, 16] / matt.radiance[16, 16] == pytest.approx(float(ratio), rel=2e-3)


@pytest.mark.parametrize("law", LAWS)
def test_a_law_over_lambert_is_bounded_on_ground_in_profile(law):
    grid = np.linspace(-1.0, 1.0, 21, dtype=np.float32)
    ratio = Photometry(law).over_lambert(grid[:, None, None], grid[None, :, None], grid[None, None, :])
    # Lommel-Seeliger over Lambert is 2 / (mu0 + mu), with mu no less than 0.02; Hapke's surge and bounces treble it.
    assert np.isfinite(ratio).all() and ratio.min() >= 0.0 and ratio.max() <= 300.0


def test_an_unknown_law_is_refused_by_name():
    with pytest.raises(PayloadError, match="lunar-lambert, lambert, hapke, matt, found 'phong'"):
        Photometry("phong")


@pytest.mark.parametrize("law", LAWS)
def test_both_renderers_shade_a_smooth_sphere_alike_by_every_law(formula_terrain, law):
    terrain = formula_terrain(lambda latitude, longitude: 0.0 * latitude)
    place = 0.2, 1.0
    position = mcmf_from_spherical(*place, 30e3)
    view = (position, pointed_camera_from_mcmf(position, 0.05, 0.4), sun_direction_mcmf(0.3, 1.0, *place))
    fast = renderer.render(terrain, PinholeCamera(), *view, Photometry(law))
    slow = raymarch.render(terrain, PinholeCamera(), *view, Photometry(law), every=32)
    # Tables are read linearly by both; slopes differ in the last digits of single precision.
    np.testing.assert_allclose(fast.radiance[::32, ::32], slow.radiance, rtol=5e-3)


def test_laws_differ_where_they_should(formula_terrain):
    """A Lambert surface does not know where it is seen from; the Moon is brighter looking down-Sun."""
    terrain = formula_terrain(lambda latitude, longitude: 0.0 * latitude)
    position = mcmf_from_spherical(0.0, 1.0, 30e3)
    view = (position, pointed_camera_from_mcmf(position), sun_direction_mcmf(0.5, 0.0, 0.0, 1.0))
    asymmetry = {}
    for law in LAWS:
        slope = 0.0 if law == "lambert" else 0.7
        picture = renderer.render(terrain, PinholeCamera(), *view, Photometry(law, slope)).radiance
        # The Sun stands in the north: the bottom of the picture is seen looking away from it.
        asymmetry[law] = picture[500, 256] / picture[11, 256]
    assert asymmetry["lambert"] == pytest.approx(1.0, abs=0.12)
    assert asymmetry["lunar-lambert"] > 1.5 and asymmetry["hapke"] > 1.5
