import math

import numpy as np
import pytest

from payload_emulator.errors import PayloadError
from payload_emulator.sim.render.sensor import COLOUR, SensorModel, auto_exposure, random_sensor, take_picture

ERRORS = ("psf_sigma_px", "vignetting", "gain_mismatch", "stray", "hot_pixels", "dark_e", "offset")
PLAIN = dict.fromkeys(ERRORS, 0.0)


def field(value):
    return np.full((128, 128), value, np.float32)


def shot(scene, sensor, seed=0):
    return take_picture(scene, sensor, np.random.default_rng(seed))


def test_noise_is_that_of_the_electrons_counted():
    sensor = SensorModel(exposure=1.0, full_well_e=10_000.0, read_noise_e=20.0, bits=16, **PLAIN)
    image = shot(field(0.4), sensor, 1)[..., 1] / 65535.0 * 10_000.0
    assert image.mean() == pytest.approx(4000.0, rel=0.002)
    # 16,384 samples: the deviation is good to 0.6 %.
    assert image.std() == pytest.approx(math.sqrt(4000.0 + 400.0), rel=0.03)


def test_light_beyond_full_scale_saturates():
    sensor = SensorModel(exposure=1.0, read_noise_e=0.1, full_well_e=1e9, **PLAIN)
    image = shot(field(3.0), sensor, 1)
    assert image[..., 1].min() == 255


def test_auto_exposure_ignores_shadow():
    scene = field(0.0)
    scene[:, :20] = 0.02
    assert auto_exposure(scene, SensorModel(exposure_target=0.8)) * 0.02 == pytest.approx(0.8, rel=1e-6)


def test_a_black_scene_stays_black():
    image = shot(field(0.0), SensorModel(), 1)
    assert image.mean() < 6.0


def test_the_same_generator_gives_the_same_bits():
    scene = np.random.default_rng(5).random((64, 64)).astype(np.float32)
    np.testing.assert_array_equal(shot(scene, SensorModel(), 9), shot(scene, SensorModel(), 9))


def test_blur_keeps_light_and_spreads_a_point_as_a_gaussian():
    scene = field(0.0)
    scene[64, 64] = 0.5
    sensor = SensorModel(
        exposure=1.0, read_noise_e=1e-3, full_well_e=1e12, bits=16, **(PLAIN | {"psf_sigma_px": 1.2})
    )
    image = shot(scene, sensor)[..., 1] / 65535.0
    assert image.sum() == pytest.approx(0.5, rel=0.01)
    rows = np.arange(128) - 64
    # Integrating over pixels adds a twelfth of a pixel squared.
    assert (image.sum(axis=1) * rows**2).sum() / image.sum() == pytest.approx(1.2**2 + 1.0 / 12.0, rel=0.03)


def test_sunlit_ground_is_slightly_red():
    image = shot(field(0.5), SensorModel(exposure=1.0, **PLAIN), 2).mean(axis=(0, 1))
    assert image[0] / image[1] == pytest.approx(COLOUR[0], abs=0.01)
    assert image[2] / image[1] == pytest.approx(COLOUR[2], abs=0.01)


@pytest.mark.parametrize(
    ("bits", "steps", "kind"), [(8, 256, "uint8"), (12, 4096, "uint16"), (16, 65536, "uint16")]
)
def test_depth_limits_the_number_of_levels_and_the_scene_is_left_as_it_was(bits, steps, kind):
    scene = np.linspace(0.0, 1.0, 128 * 128, dtype=np.float32).reshape(128, 128)
    before = scene.copy()
    image = shot(scene, SensorModel(exposure=1.0, bits=bits, **PLAIN), 3)
    assert steps / 8 < np.unique(image).size <= steps
    assert image.dtype == kind and image.shape == (128, 128, 3)
    np.testing.assert_array_equal(scene, before)


def test_random_sensors_differ_but_are_reproducible():
    first, second = random_sensor(np.random.default_rng(1)), random_sensor(np.random.default_rng(1))
    assert first == second
    assert first != random_sensor(np.random.default_rng(2))


def quiet(**options):
    """A sensor that shows one thing at a time, without noise that matters, in 16 bits."""
    return SensorModel(
        **{**PLAIN, "exposure": 1.0, "read_noise_e": 1e-3, "full_well_e": 1e12, "bits": 16, **options}
    )


def green(scene, sensor):
    return shot(scene, sensor)[..., 1] / 65535.0


def test_exposure_is_the_share_of_full_scale_per_unit_of_radiance():
    assert green(field(0.2), quiet(exposure=2.5)).mean() == pytest.approx(0.5, abs=1e-3)


def test_gain_brightens_and_makes_noisier():
    bright = green(field(0.1), quiet(exposure=1.0, gain=4.0))
    assert bright.mean() == pytest.approx(0.4, abs=1e-3)
    # At the same output level four times the gain is a quarter of the electrons: noise doubles.
    deviations = [
        green(field(0.4 / gain), quiet(gain=gain, full_well_e=10_000.0, read_noise_e=0.0)).std()
        for gain in (1.0, 4.0)
    ]
    assert deviations[1] / deviations[0] == pytest.approx(2.0, rel=0.05)


def test_vignetting_takes_its_share_at_the_corners_and_half_of_it_at_the_sides():
    image = green(field(0.8), quiet(vignetting=0.4))
    assert image[64, 64] == pytest.approx(0.8, rel=1e-3)
    assert image[0, 0] == pytest.approx(0.8 * 0.6, rel=1e-3)
    assert image[64, 0] == pytest.approx(0.8 * 0.8, rel=1e-2)


def test_smear_follows_columns_and_stray_light_goes_everywhere():
    scene = field(0.0)
    scene[10:74, 30] = 0.5
    smeared = green(scene, quiet(smear=0.1))
    # Half of the column is lit: its mean is a quarter.
    assert smeared[100, 30] == pytest.approx(0.025, abs=1e-3)
    assert smeared[100, 31] == pytest.approx(0.0, abs=1e-3)
    assert green(field(0.5), quiet(stray=0.1)).mean() == pytest.approx(0.55, abs=1e-3)


def test_hot_pixels_are_the_same_ones_in_every_frame():
    sensor = quiet(hot_pixels=1e-3)
    first = shot(field(0.1), sensor, 1)[..., 1] == 65535
    second = shot(field(0.1), sensor, 2)[..., 1] == 65535
    np.testing.assert_array_equal(first, second)
    # A thousandth of 16,384; two may fall on one place.
    assert 14 <= first.sum() <= 16


def test_dark_signal_and_offset_lift_a_black_picture():
    sensor = quiet(full_well_e=1000.0, dark_e=50.0, offset=0.1, read_noise_e=0.0)
    assert green(field(0.0), sensor).mean() == pytest.approx(0.15, abs=2e-3)


def test_pixels_respond_unevenly_and_always_alike():
    flat = green(field(0.5), quiet(gain_mismatch=0.02))
    assert flat.std() / flat.mean() == pytest.approx(0.02, rel=0.05)
    np.testing.assert_allclose(flat, green(field(0.5), quiet(gain_mismatch=0.02)), atol=1e-4)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"bits": 10}, "8, 12 or 16 bits, found 10"),
        ({"gain": 0.0}, "gain from 0.001 to 1000, found 0"),
        ({"vignetting": 1.5}, "vignetting from 0 to 1"),
        ({"full_well_e": -1.0}, "full_well_e from 1 to inf"),
        ({"gamma": float("nan")}, "gamma from"),
    ],
)
def test_impossible_sensors_are_refused_by_name(options, message):
    with pytest.raises(PayloadError, match=message):
        SensorModel(**options)
