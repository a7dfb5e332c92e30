"""Visibility of bowls whose shading is computed here from their slopes, not from the template."""

import numpy as np
import pytest

from payload_emulator.training.data.visibility import HIDDEN, VISIBLE, visibility

SIZE = 160


def shaded(diameter_px=40.0, depth_ratio=0.15, azimuth_deg=0.0, elevation_deg=20.0, noise=0.0, seed=0):
    """Lambert brightness (160, 160) of a paraboloid with a raised rim in the middle of a plain."""
    row, column = np.mgrid[0:SIZE, 0:SIZE].astype(float)
    right, down = column - 79.5, row - 79.5
    radius, reach = 0.5 * diameter_px, np.hypot(right, down)
    depth, rim = depth_ratio * diameter_px, 0.2 * depth_ratio * diameter_px
    bowl = rim - depth * (1.0 - (reach / radius) ** 2)
    height = np.where(reach < radius, bowl, rim * (radius / np.maximum(reach, 1.0)) ** 3)
    by_row, by_column = np.gradient(height)
    azimuth, elevation = np.radians(azimuth_deg), np.radians(elevation_deg)
    toward = np.array([np.sin(azimuth), -np.cos(azimuth)])  # right, down
    slope = by_column * toward[0] + by_row * toward[1]
    normal = np.sqrt(1.0 + by_row**2 + by_column**2)
    light = (np.sin(elevation) - np.cos(elevation) * slope) / normal
    light = light + noise * np.random.default_rng(seed).normal(size=light.shape)
    return np.clip(light, 0.0, None)


def seen(image, diameter_px=40.0, azimuth_deg=0.0, u=79.5, v=79.5):
    one = np.array([1.0])
    return float(visibility(image, u * one, v * one, diameter_px * one, np.radians(azimuth_deg))[0])


@pytest.mark.parametrize("azimuth_deg", [0.0, 37.0, 90.0, -135.0, 180.0])
def test_a_clear_crater_is_visible_from_whatever_side_the_sun_shines(azimuth_deg):
    image = shaded(azimuth_deg=azimuth_deg)
    assert seen(image, azimuth_deg=azimuth_deg) > 0.8 > VISIBLE
    assert seen(image, azimuth_deg=azimuth_deg + 180.0) == 0.0  # a hill
    assert seen(image, azimuth_deg=azimuth_deg + 90.0) < HIDDEN


def test_visibility_falls_with_depth_with_clutter_and_with_size():
    by_depth = [seen(shaded(depth_ratio=ratio, noise=0.02)) for ratio in (0.12, 0.03, 0.01, 0.003)]
    assert by_depth == sorted(by_depth, reverse=True) and by_depth[-1] < HIDDEN < VISIBLE < by_depth[0]
    by_clutter = [seen(shaded(noise=noise)) for noise in (0.1, 0.3, 1.0)]
    assert by_clutter == sorted(by_clutter, reverse=True) and by_clutter[-1] < 0.5 * by_clutter[0]
    by_size = [seen(shaded(diameter_px=size), size) for size in (30.0, 12.0, 6.0)]
    assert by_size[0] > by_size[1] > by_size[2]
    assert by_size[2] < 6.0 / 16.0


def test_a_plain_has_no_visible_crater():
    assert seen(np.full((SIZE, SIZE), 100, np.uint8)) < 1e-6


def test_bits_and_gain_do_not_matter():
    image = shaded()
    bytes_ = np.rint(200.0 * image / image.max()).astype(np.uint8)
    assert seen(bytes_) == pytest.approx(seen(image), abs=0.02)


def test_a_catalogued_centre_may_be_wrong_by_a_seventh_of_the_radius():
    image = shaded()
    assert seen(image, u=79.5 + 0.15 * 20.0) == pytest.approx(seen(image), abs=0.03)
    assert seen(image, u=79.5 + 30.0) < 0.3


def test_of_a_crater_mostly_outside_the_image_nothing_is_known():
    assert np.isnan(seen(shaded(), u=-15.0))
    assert visibility(shaded(), np.zeros(0), np.zeros(0), np.zeros(0), 0.0).shape == (0,)
