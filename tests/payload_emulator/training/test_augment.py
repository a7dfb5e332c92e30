"""A crop shows its craters where it says they are."""

import numpy as np
import pytest

from payload_emulator.training.data.feeder import AugmentParameters, make_crop

QUIET = AugmentParameters(noise=0.0, shade=0.0, unsharp=(0.0, 0.0))


def spot_image(u, v):
    row, column = np.mgrid[0:512, 0:512]
    image = np.zeros((512, 512))
    for x, y in zip(u, v, strict=True):
        image += 255 * np.exp(-((column - x) ** 2 + (row - y) ** 2) / (2 * 3.0**2))
    return np.clip(image, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("sun", [(0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (-1.0, 0.1, 0.0)])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_spot_lands_where_the_label_says(sun, seed):
    u, v = np.array([250.0, 330.0]), np.array([200.0, 280.0])
    crop = make_crop(
        spot_image(u, v),
        np.array(sun),
        u,
        v,
        np.full(2, 20.0),
        np.array([True, True]),
        384,
        QUIET,
        np.random.default_rng(seed),
    )
    for x, y in zip(crop.u_px, crop.v_px, strict=True):
        if not (12 < x < 371 and 12 < y < 371):
            continue
        i, j = round(float(y)), round(float(x))
        window = crop.image[i - 8 : i + 9, j - 8 : j + 9].astype(float)
        weight = np.clip(window - np.median(crop.image), 0, None)
        rows, columns = np.mgrid[i - 8 : i + 9, j - 8 : j + 9]
        # Half a pixel: rounding to 8 bits and clipping of the spot's core shift its centroid by less.
        assert (columns * weight).sum() / weight.sum() == pytest.approx(x, abs=0.5)
        assert (rows * weight).sum() / weight.sum() == pytest.approx(y, abs=0.5)


def test_the_sun_is_at_the_top_of_every_crop():
    row, _ = np.mgrid[0:512, 0:512]
    bright_right = np.rot90((255 * (1 - row / 511)).astype(np.uint8), 3).copy()
    assert bright_right[:, -1].mean() > bright_right[:, 0].mean()
    crop = make_crop(
        bright_right,
        np.array([1.0, 0.0, 0.0]),
        np.zeros(0),
        np.zeros(0),
        np.zeros(0),
        np.zeros(0, bool),
        384,
        QUIET,
        np.random.default_rng(3),
    )
    assert crop.image[:40].mean() > crop.image[-40:].mean() + 0.5


def test_one_seed_gives_one_crop():
    image = spot_image([100, 300], [100, 300])
    arguments = (
        image,
        np.array([0.0, -1.0, 0.0]),
        np.array([100.0]),
        np.array([100.0]),
        np.array([20.0]),
        np.array([True]),
        256,
        AugmentParameters(),
    )
    first = make_crop(*arguments, np.random.default_rng(9))
    second = make_crop(*arguments, np.random.default_rng(9))
    assert np.array_equal(first.image, second.image)
    assert np.array_equal(first.u_px, second.u_px)
