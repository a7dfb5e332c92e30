"""Preparation of frames: verdicts, invariance to exposure, and quarter turns that bring the Sun to the top."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from pytest import approx, mark

from payload_emulator.flight.vision.preprocess import (
    ImageQuality,
    gray_levels,
    prepare_image,
    sun_up_turns,
    turn_back,
    turn_forward,
)


def texture(shape=(512, 512, 3), dtype=np.uint8):
    rng = np.random.default_rng(0)
    smooth = 100 + 60 * np.sin(np.arange(shape[1]) / 9.0)[None, :] * np.cos(np.arange(shape[0]) / 7.0)[:, None]
    image = smooth + rng.normal(0, 4, shape[:2])
    if len(shape) == 3:
        image = np.repeat(image[..., None], shape[2], axis=2)
    full = np.iinfo(dtype).max / 255.0
    return np.clip(image * full, 0, np.iinfo(dtype).max).astype(dtype)


def test_a_good_frame_comes_out_with_zero_mean_and_unit_deviation():
    prepared = prepare_image(texture())
    assert prepared.quality is ImageQuality.OK
    # Clipping at four deviations moves both by far less than a hundredth.
    assert float(prepared.gray.mean()) == approx(0.0, abs=0.01)
    assert float(prepared.gray.std()) == approx(1.0, abs=0.01)


def test_depth_and_colour_of_the_same_scene_make_no_difference():
    reference = prepare_image(texture()).gray
    for other in (
        texture(shape=(512, 512)),
        texture(dtype=np.uint16),
        texture(shape=(512, 512, 1)),
        texture().astype(np.float32) / 255.0,
    ):
        # One count of 255 at mid scale, in deviations of this scene.
        assert np.abs(prepare_image(other).gray - reference).max() < 0.06


@mark.parametrize("shape", [(512, 512), (512, 512, 3), (300, 200, 4), (64, 64, 1)])
def test_eight_bits_go_a_quicker_way_to_the_same_values(shape):
    image = np.random.default_rng(1).integers(0, 256, shape, dtype=np.uint8)
    colours = image if image.ndim == 2 else image[..., : 3 if shape[2] >= 3 else 1].mean(axis=2)
    # Rounding of 32-bit numbers up to 4 and the order of sums.
    assert prepare_image(image).gray == approx(prepare_image(colours / 255.0).gray, abs=5e-6)


def test_half_the_exposure_gives_the_same_input():
    bright = texture(dtype=np.uint16)
    reference = prepare_image(bright).gray
    assert np.abs(prepare_image(bright // 2).gray - reference).max() < 1e-3


@mark.parametrize(
    ("image", "verdict"),
    [
        (np.zeros((512, 512, 3), np.uint8), ImageQuality.DARK),
        (np.full((512, 512, 3), 4, np.uint8), ImageQuality.DARK),
        (np.full((512, 512, 3), 255, np.uint8), ImageQuality.SATURATED),
        (np.full((512, 512), 65535, np.uint16), ImageQuality.SATURATED),
        (np.full((512, 512, 3), 120, np.uint8), ImageQuality.UNIFORM),
        (np.full((512, 512), np.nan, np.float32), ImageQuality.INVALID),
        (np.zeros((512, 512, 2), np.uint8), ImageQuality.INVALID),
        (np.zeros((0, 0), np.uint8), ImageQuality.INVALID),
        (np.zeros(512, np.uint8), ImageQuality.INVALID),
        (np.zeros((512, 512), np.complex64), ImageQuality.INVALID),
        (np.zeros((2, 2, 2, 2), np.uint8), ImageQuality.INVALID),
    ],
)
def test_a_frame_that_cannot_be_searched_is_a_verdict(image, verdict):
    assert prepare_image(image).quality is verdict


def test_one_pixel_that_is_no_number_makes_a_float_frame_invalid():
    image = texture(shape=(64, 64)).astype(np.float32) / 255.0
    image[3, 5] = np.inf
    assert prepare_image(image).quality is ImageQuality.INVALID


def test_gray_levels_round_to_the_nearest_count():
    image = np.array([[[1, 1, 2], [255, 255, 255], [0, 0, 1]]], np.uint8)
    assert gray_levels(image).tolist() == [[1, 255, 0]]


@given(st.floats(0.0, 2.0 * np.pi))
def test_after_the_turns_the_sun_is_within_45_degrees_of_the_top(azimuth):
    sun = np.array([np.sin(azimuth), -np.cos(azimuth), 0.3])
    turns = sun_up_turns(sun)
    # Follow a point from the middle toward the Sun.
    u, v = turn_forward(np.array([255.5 + 100 * sun[0]]), np.array([255.5 + 100 * sun[1]]), turns, 512, 512)
    assert 255.5 - v[0] >= 100 * np.cos(np.pi / 4) - 1e-6
    assert abs(u[0] - 255.5) <= 100 * np.sin(np.pi / 4) + 1e-6


@mark.parametrize("turns", [0, 1, 2, 3])
def test_turned_coordinates_point_at_the_same_pixel_and_come_back(turns):
    image = np.arange(6 * 9).reshape(6, 9)
    turned = np.rot90(image, turns)
    for row in range(6):
        for column in range(9):
            u, v = turn_forward(np.array([float(column)]), np.array([float(row)]), turns, 6, 9)
            assert turned[int(v[0]), int(u[0])] == image[row, column]
            back_u, back_v = turn_back(u, v, turns, 6, 9)
            assert (back_u[0], back_v[0]) == (column, row)


@mark.parametrize("sun", [None, np.array([np.nan, np.nan, np.nan]), np.array([0.0, 0.0, 1.0])])
def test_without_a_sun_direction_the_frame_stays_as_it_is(sun):
    assert sun_up_turns(sun) == 0
