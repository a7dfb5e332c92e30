"""Visibility of craters: how much of the brightness in and around a rim is the shading that a crater would have.

The catalogue lists many craters that hardly anyone can see in a given image: worn ones, and clear ones that lie in a
shadow, under a low contrast or among stronger relief. Visibility is computed from the image, which is terrain, Sun and
resolution in one, and from the catalogued circle; no detector takes part.

For a crater of radius R the image is sampled on circles up to 1.4 R about its centre and compared with the linear
shading of a bowl: inside the rim brightness falls toward the Sun in proportion to the distance from the centre (the
wall near the Sun is dark, the far one bright), outside the flank is bright toward the Sun and fades with the cube of
the distance. With the Sun at azimuth a, the template at radius r R and azimuth p is -r cos(p - a) inside and
0.35 cos(p - a) / r**3 outside. Visibility is the product of

- the correlation of image and template: the clutter of the surroundings lowers it;
- the amplitude of the template over the mean brightness (both of the square root of the signal), full from 0.3;
- the diameter over 16 px, full from there.

The correlation is the greatest of five places, the catalogued centre and 0.15 R to four sides, since centres in the
catalogue are wrong by that much (0.01 of the diameter for fresh small craters, 0.03 for large ones, more for worn
ones).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lunar.arrays import FloatArray

VISIBLE = 0.5
"""From here on a crater is called visible: that is half of the catalogued craters of 5 to 30 km in validation frames of
real terrain, as many as a reader saw in such frames."""

HIDDEN = 0.2
"""Below, a crater is called hidden: a detector is not expected to find it, and finds a fifth, in part by chance."""

VISIBILITY_EDGES = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 1.0)

FULL_AMPLITUDE = 0.3
FULL_DIAMETER_PX = 16.0
_FLANK = 0.35
_FLANK_POWER = 3.0
_RADII = np.linspace(0.1, 1.4, 14)
_AZIMUTHS = np.arange(24) * (np.pi / 12.0)
_SHIFTS = ((0.0, 0.0), (0.15, 0.0), (-0.15, 0.0), (0.0, 0.15), (0.0, -0.15))  # of the radius
_SAMPLED_DIAMETER_PX = 16.0  # of the reduced image: finer than one sample for each pixel shows nothing more
_LEAST_SHARE = 0.4  # of the samples inside the image
_LEAST_BRIGHTNESS = 0.02


def visibility(
    gray: NDArray[np.generic],
    u_px: FloatArray,
    v_px: FloatArray,
    diameter_px: FloatArray,
    sun_azimuth_image_rad: float,
) -> FloatArray:
    """Visibility of craters (n,) in an image, 0 to 1; NaN where less than 40 % of a crater is in the image.

    Parameters
    ----------
    gray : brightness, (H, W), unsigned integer or any float not below zero.
    u_px, v_px, diameter_px : circles of the craters, (n,).
    sun_azimuth_image_rad : direction to the Sun in the image, clockwise from its top.
    """
    u_px, v_px, diameter_px = (np.asarray(part, np.float64) for part in (u_px, v_px, diameter_px))
    if u_px.size == 0:
        return np.zeros(0)
    full_scale = float(np.iinfo(np.dtype(gray.dtype).str).max) if gray.dtype.kind == "u" else 1.0
    planes = _halved(np.asarray(gray, np.float32) / np.float32(full_scale))
    radius_px = 0.5 * diameter_px
    every = np.array(
        [
            _shading(
                planes,
                u_px + right * radius_px,
                v_px + down * radius_px,
                diameter_px,
                sun_azimuth_image_rad,
            )
            for right, down in _SHIFTS
        ]
    )  # (shifts, 2, n)
    best = np.argmax(np.nan_to_num(every[:, 0], nan=-2.0), axis=0)
    correlation, amplitude = every[best, :, np.arange(u_px.size)].T
    contrast = np.clip(amplitude / FULL_AMPLITUDE, 0.0, 1.0)
    resolved = np.clip(diameter_px / FULL_DIAMETER_PX, 0.0, 1.0)
    return np.asarray(np.maximum(correlation, 0.0) * contrast * resolved)


def _halved(plane: NDArray[np.float32]) -> list[NDArray[np.float32]]:
    """A plane and its reductions by two, by means of 2 x 2 pixels."""
    planes = [plane]
    while min(planes[-1].shape) >= 32:
        last = planes[-1]
        rows, columns = last.shape[0] // 2 * 2, last.shape[1] // 2 * 2
        planes.append(last[:rows, :columns].reshape(rows // 2, 2, columns // 2, 2).mean(axis=(1, 3)))
    return planes


def _shading(
    planes: list[NDArray[np.float32]],
    u_px: FloatArray,
    v_px: FloatArray,
    diameter_px: FloatArray,
    sun_azimuth_rad: float,
) -> FloatArray:
    """Correlation of each crater with the template, and the template's amplitude over the mean, (2, n)."""
    level = np.clip(np.log2(np.maximum(diameter_px, 1.0) / _SAMPLED_DIAMETER_PX), 0, len(planes) - 1)
    level = level.astype(np.int64)
    brightness = np.full((u_px.size, _RADII.size, _AZIMUTHS.size), np.nan)
    for step in np.unique(level):
        chosen = np.flatnonzero(level == step)
        brightness[chosen] = _sampled(
            planes[step], u_px[chosen], v_px[chosen], diameter_px[chosen], 2.0**step
        )
    inside = np.isfinite(brightness)
    root = np.sqrt(np.where(inside, brightness, 0.0))
    toward = np.cos(_AZIMUTHS - sun_azimuth_rad)
    within = _RADII[:, None] <= 1.0
    template = np.where(within, -_RADII[:, None], _FLANK * _RADII[:, None] ** -_FLANK_POWER) * toward
    weight = inside * _RADII[:, None]  # a ring's area
    total = weight.sum(axis=(1, 2))

    def mean(values: FloatArray) -> FloatArray:
        return np.asarray((weight * values).sum(axis=(1, 2)) / np.maximum(total, 1e-12))

    middle = mean(root)
    image = root - middle[:, None, None]
    shape = template - mean(np.broadcast_to(template, root.shape))[:, None, None]
    product, of_shape, of_image = mean(image * shape), mean(shape * shape), mean(image * image)
    correlation = product / np.sqrt(np.maximum(of_shape * of_image, 1e-20))
    amplitude = product / np.maximum(of_shape, 1e-12) / np.maximum(middle, _LEAST_BRIGHTNESS)
    known = total >= _LEAST_SHARE * _RADII.sum() * _AZIMUTHS.size
    return np.where(known, np.stack([correlation, amplitude]), np.nan)


def _sampled(
    plane: NDArray[np.float32], u_px: FloatArray, v_px: FloatArray, diameter_px: FloatArray, scale: float
) -> FloatArray:
    """Brightness on the circles about craters (n, radii, azimuths), bilinear; NaN outside the plane."""
    reach = 0.5 * diameter_px[:, None, None] * _RADII[:, None]
    column = (u_px[:, None, None] + reach * np.sin(_AZIMUTHS) + 0.5) / scale - 0.5
    row = (v_px[:, None, None] - reach * np.cos(_AZIMUTHS) + 0.5) / scale - 0.5
    rows, columns = plane.shape
    inside = (column >= 0.0) & (column <= columns - 1) & (row >= 0.0) & (row <= rows - 1)
    left = np.clip(np.floor(column), 0, columns - 2).astype(np.int64)
    top = np.clip(np.floor(row), 0, rows - 2).astype(np.int64)
    right, down = column - left, row - top
    upper = plane[top, left] * (1.0 - right) + plane[top, left + 1] * right
    lower = plane[top + 1, left] * (1.0 - right) + plane[top + 1, left + 1] * right
    return np.where(inside, upper * (1.0 - down) + lower * down, np.nan)
