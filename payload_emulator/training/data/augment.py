"""Training crops: Sun-up, randomly placed, scaled, turned a little and mirrored, with tone, blur and noise varied.

Everything is drawn from the generator passed in. Coordinates follow the pixels (centres at integers).
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lunar.arrays import BoolArray, FloatArray, OctetArray
from payload_emulator.flight.vision.preprocess import normalise, sun_up_turns, turn_forward

_NOISE_SIZE = 1400
_TONES = 4096


@dataclass(frozen=True, slots=True)
class AugmentParameters:
    """Ranges of what is varied; all intervals are uniform unless said otherwise."""

    scale: tuple[float, float] = (0.75, 1.35)  # logarithmic
    turn_deg: float = 12.0
    gamma: tuple[float, float] = (0.7, 1.4)  # logarithmic, on the square root of brightness
    unsharp: tuple[float, float] = (-0.6, 0.8)  # negative blurs
    noise: float = 0.02  # greatest deviation added, fraction of full scale
    shade: float = 0.25  # greatest slope of a brightness gradient across the crop


@dataclass(frozen=True, slots=True, eq=False)
class Crop:
    """Network input (S, S) and where the frame's craters fell, arrays (n,)."""

    image: NDArray[np.float32]
    u_px: FloatArray
    v_px: FloatArray
    diameter_px: FloatArray


def make_crop(
    gray: OctetArray,
    sun_camera: FloatArray,
    u_px: FloatArray,
    v_px: FloatArray,
    diameter_px: FloatArray,
    labelled: BoolArray,
    size_px: int,
    parameters: AugmentParameters,
    rng: np.random.Generator,
) -> Crop:
    """One training crop of a frame, gray (H, W) or RGB (H, W, 3).

    The channels of an RGB frame are normalised, then averaged. Half of the crops are drawn about a labelled crater,
    large ones more often.
    """
    import cv2

    turns = sun_up_turns(sun_camera)
    height, width = gray.shape[:2]
    turned = np.rot90(gray, turns)
    u, v = turn_forward(np.asarray(u_px, float), np.asarray(v_px, float), turns, height, width)
    rows, columns = turned.shape[:2]

    scale = math.exp(rng.uniform(math.log(parameters.scale[0]), math.log(parameters.scale[1])))
    scale = max(scale, size_px / min(rows, columns))
    angle = math.radians(rng.uniform(-parameters.turn_deg, parameters.turn_deg))
    mirror = -1.0 if rng.random() < 0.5 else 1.0
    half = 0.5 * size_px / scale
    low_u, high_u = half - 0.5, columns - 0.5 - half
    low_v, high_v = half - 0.5, rows - 0.5 - half
    centre_u, centre_v = rng.uniform(low_u, max(high_u, low_u)), rng.uniform(low_v, max(high_v, low_v))
    candidates = np.flatnonzero(labelled)
    if candidates.size and rng.random() < 0.5:
        share = np.asarray(diameter_px, float)[candidates]
        chosen = int(rng.choice(candidates, p=share / share.sum()))
        centre_u = float(np.clip(u[chosen] + rng.uniform(-0.8, 0.8) * half, low_u, max(high_u, low_u)))
        centre_v = float(np.clip(v[chosen] + rng.uniform(-0.8, 0.8) * half, low_v, max(high_v, low_v)))
    cos, sin = scale * math.cos(angle), scale * math.sin(angle)
    matrix = np.array([[mirror * cos, mirror * sin], [-sin, cos]])
    shift = 0.5 * (size_px - 1) - matrix @ np.array([centre_u, centre_v])
    warp = np.concatenate([matrix, shift[:, None]], axis=1)
    picture = cv2.warpAffine(
        np.ascontiguousarray(turned),
        warp,
        (size_px, size_px),
        flags=cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REFLECT_101,
    ).astype(np.float32)
    moved = matrix @ np.stack([u, v]) + shift[:, None]
    if picture.ndim == 2:
        image = normalise(_vary_tone(picture * np.float32(1.0 / 255.0), parameters, rng))
    else:
        # One tone for all channels: the draws begin at the same state for each.
        state = rng.bit_generator.state
        image = np.zeros(picture.shape[:2], np.float32)
        for plane in np.moveaxis(picture, -1, 0):
            rng.bit_generator.state = state
            image += normalise(_vary_tone(plane * np.float32(1.0 / 255.0), parameters, rng)) / np.float32(3.0)
    return Crop(image, moved[0], moved[1], scale * np.asarray(diameter_px, float))


def _vary_tone(
    picture: NDArray[np.float32], parameters: AugmentParameters, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Square root of brightness with sharpness, gradient, noise and tone curve changed."""
    import cv2

    amount = rng.uniform(*parameters.unsharp)
    if rng.random() < 0.6:
        smooth = cv2.GaussianBlur(picture, (0, 0), float(rng.uniform(0.7, 1.6)))
        picture = picture + np.float32(amount) * (picture - smooth)
    size = picture.shape[0]
    ramp = np.linspace(-0.5, 0.5, size, dtype=np.float32)
    slope = rng.uniform(-parameters.shade, parameters.shade, 2).astype(np.float32)
    picture = picture * (1.0 + slope[0] * ramp[None, :] + slope[1] * ramp[:, None])
    if rng.random() < 0.7:
        deviation = parameters.noise * rng.random() ** 2
        top, left = (int(k) for k in rng.integers(0, _NOISE_SIZE - size, 2))
        picture = picture + np.float32(deviation) * _noise()[top : top + size, left : left + size]
    gamma = math.exp(rng.uniform(math.log(parameters.gamma[0]), math.log(parameters.gamma[1])))
    table = (np.arange(_TONES) / (_TONES - 1.0)) ** (0.5 * gamma)
    tones = np.clip(picture * np.float32(_TONES - 1), 0, _TONES - 1).astype(np.int16)
    return np.asarray(table.astype(np.float32)[tones])


@functools.cache
def _noise() -> NDArray[np.float32]:
    """One large picture of unit noise; crops take a window of it, which is ten times quicker than drawing again."""
    return np.random.Generator(np.random.PCG64(5)).standard_normal(
        (_NOISE_SIZE, _NOISE_SIZE), dtype=np.float32
    )
