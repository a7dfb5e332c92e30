import math

import numpy as np
import pytest

from payload_emulator.errors import PayloadError
from payload_emulator.sim.sensor import COLOUR, SensorModel, auto_exposure, expose, expose_deep, random_sensor

PLAIN = {
    "psf_sigma_px": 0.0,
    "vignetting": 0.0,
    "gain_mismatch": 0.0,
    "stray": 0.0,
    "hot_pixels": 0.0,
    "dark_e": 0.0,
    "offset": 0.0,
}


def field(value, size=128):
    return np.full((size, size), value, np.float32)


def test_noise_is_that_of_the_electrons_counted():
    sensor = SensorModel(exposure=1.0, full_well_e=10_000.0, read_noise_e=20.0, bits=16, **PLAIN)
    image = expose_deep(field(0.4), sensor, np.random.default_rng(1))[..., 1] / 65535.0 * 10_000.0
    assert image.mean() == pytest.approx(4000.0, rel=0.002)
    # 16,384 samples: the deviation is good to 0.6 %.
    assert image.std() == pytest.approx(math.sqrt(4000.0 + 400.0), rel=0.03)


def test_light_beyond_full_scale_saturates():
    sensor = SensorModel(exposure=1.0, read_noise_e=0.1, full_well_e=1e9, **PLAIN)
    image = expose(field(3.0), sensor, np.random.default_rng(1))
    assert image[..., 1].min() == 255


def test_auto_exposure_ignores_shadow():
    scene = field(0.0)
    scene[:, :20] = 0.02
    assert auto_exposure(scene, SensorModel(exposure_target=0.8)) * 0.02 == pytest.approx(0.8, rel=1e-6)


def test_a_black_scene_stays_black():
    image = expose(field(0.0), SensorModel(), np.random.default_rng(1))
    assert image.mean() < 6.0


def test_the_same_generator_gives_the_same_bits():
    scene = np.random.default_rng(5).random((64, 64)).astype(np.float32)
    first = expose(scene, SensorModel(), np.random.default_rng(9))
    second = expose(scene, SensorModel(), np.random.default_rng(9))
    np.testing.assert_array_equal(first, second)
    assert first.dtype == np.uint8 and first.shape == (64, 64, 3)


def test_the_scene_is_left_as_it_was():
    scene = field(0.3)
    expose(scene, SensorModel(), np.random.default_rng(0))
    np.testing.assert_array_equal(scene, field(0.3))


def test_blur_keeps_light_and_spreads_a_point_as_a_gaussian():
    scene = field(0.0)
    scene[64, 64] = 0.5
    sensor = SensorModel(
        exposure=1.0, read_noise_e=1e-3, full_well_e=1e12, bits=16, **(PLAIN | {"psf_sigma_px": 1.2})
    )
    image = expose_deep(scene, sensor, np.random.default_rng(0))[..., 1] / 65535.0
    assert image.sum() == pytest.approx(0.5, rel=0.01)
    rows = np.arange(128) - 64
    # Integrating over pixels adds a twelfth of a pixel squared.
    assert (image.sum(axis=1) * rows**2).sum() / image.sum() == pytest.approx(1.2**2 + 1.0 / 12.0, rel=0.03)


def test_sunlit_ground_is_slightly_red():
    image = expose(field(0.5), SensorModel(exposure=1.0, **PLAIN), np.random.default_rng(2)).mean(axis=(0, 1))
    assert image[0] / image[1] == pytest.approx(COLOUR[0], abs=0.01)
    assert image[2] / image[1] == pytest.approx(COLOUR[2], abs=0.01)


@pytest.mark.parametrize(("bits", "steps"), [(12, 4096), (8, 256)])
def test_depth_limits_the_number_of_levels(bits, steps):
    scene = np.linspace(0.0, 1.0, 128 * 128, dtype=np.float32).reshape(128, 128)
    image = expose_deep(scene, SensorModel(exposure=1.0, bits=bits, **PLAIN), np.random.default_rng(3))
    assert np.unique(image).size <= steps


def test_an_odd_depth_is_refused():
    with pytest.raises(PayloadError, match="8, 12 or 16 bits, found 10"):
        SensorModel(bits=10)


def test_random_sensors_differ_but_are_reproducible():
    first, second = random_sensor(np.random.default_rng(1)), random_sensor(np.random.default_rng(1))
    assert first == second
    assert first != random_sensor(np.random.default_rng(2))
