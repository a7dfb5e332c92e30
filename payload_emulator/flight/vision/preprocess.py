"""Camera frame to network input: one gray plane, normalised, turned Sun-up, with a verdict on its quality.

The network was trained on images whose Sun lies within 45 degrees of the top edge. The Sun direction in the camera
frame is known on board, so a frame is turned by quarter turns, which lose nothing. Pixel centres are integers.
"""

import enum
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lunar.arrays import FloatArray, OctetArray

# Fractions of full scale. A frame on the night side holds read noise and an offset of at most a few counts of 255.
_DARK_LEVEL = 0.04
_DARK_SHARE = 0.002  # fewer lit pixels than this (about a 23 px square of 512 x 512) hold no crater worth a match
_SATURATED_LEVEL = 0.996
_SATURATED_SHARE = 0.6  # the rest of the frame would still hold fewer craters than a fix needs
_UNIFORM_DEVIATION = 0.004  # of the square root of full scale: one count of 8 bits at mid scale
_CLIP = 4.0  # standard deviations: shadows and sunlit walls stay inside, hot pixels do not


class ImageQuality(enum.IntEnum):
    """Verdict on a frame; everything but OK yields no detections."""

    OK = 0
    DARK = 1
    SATURATED = 2
    UNIFORM = 3
    INVALID = 4


class Preparation(enum.StrEnum):
    """Order of the two steps that make the network's input of a colour frame (the paper, section IV-B)."""

    gray_first = "gray-then-normalise"
    normalise_first = "normalise-then-gray"


@dataclass(frozen=True, slots=True, eq=False)
class PreparedImage:
    """Network input, float32 (H, W), zero mean and unit deviation; `quality` other than OK leaves it all zero."""

    gray: NDArray[np.float32]
    quality: ImageQuality


def prepare_image(image: NDArray[np.generic], preparation: Preparation = Preparation.gray_first) -> PreparedImage:
    """Normalised gray plane of a frame of (H, W) or (H, W, 1|3|4), unsigned integer or float in 0..1.

    The square root of the mean of the colour channels is taken (shot noise becomes even, shadows open), then mean and
    standard deviation of the frame are removed, so that exposure and gain do not matter. The paper's order normalises
    every channel by itself and averages the results; a gray frame gives the same in either order.
    """
    image = np.asarray(image)
    colours_ok = image.ndim == 2 or (image.ndim == 3 and image.shape[2] in (1, 3, 4))
    if not colours_ok or image.size == 0 or image.dtype.kind not in "uf":
        return PreparedImage(np.zeros(_plane_shape(image), np.float32), ImageQuality.INVALID)
    by_channel = preparation is Preparation.normalise_first and image.ndim == 3 and image.shape[2] >= 3
    if image.dtype == np.uint8 and not by_channel:
        return _prepare_bytes(image)
    gray = _square_root_gray(image)
    if gray is None:
        return PreparedImage(np.zeros(_plane_shape(image), np.float32), ImageQuality.INVALID)
    quality = _verdict(
        float(np.mean(gray > np.float32(np.sqrt(_SATURATED_LEVEL)))),
        float(np.mean(gray > np.float32(np.sqrt(_DARK_LEVEL)))),
        float(gray.std(dtype=np.float64)),
    )
    if quality is not ImageQuality.OK:
        return PreparedImage(np.zeros(gray.shape, np.float32), quality)
    return PreparedImage(_mean_of_channels(image) if by_channel else normalise(gray), ImageQuality.OK)


def quality_reason(image: NDArray[np.generic], quality: ImageQuality) -> str:
    """Return why a frame has a quality, "" for a good one."""
    if quality is ImageQuality.OK:
        return ""
    gray = _square_root_gray(image) if image.size and image.dtype.kind in "uf" else None
    if gray is None:
        bad = np.count_nonzero(~np.isfinite(image)) if image.dtype.kind == "f" else image.size
        return f"{bad} of {image.size} pixels hold no number" if bad else f"shape {image.shape} of {image.dtype}"
    if quality is ImageQuality.UNIFORM:
        return f"deviation {gray.std(dtype=np.float64):.4f} of full scale, expected over {_UNIFORM_DEVIATION}"
    level = _DARK_LEVEL if quality is ImageQuality.DARK else _SATURATED_LEVEL
    share = float(np.mean(gray > np.float32(np.sqrt(level))))
    limit = f"over {_DARK_SHARE:.1%}" if quality is ImageQuality.DARK else f"up to {_SATURATED_SHARE:.0%}"
    return f"{share:.2%} of the pixels over {level:.1%} of full scale, expected {limit}"


def normalise(square_root_gray: NDArray[np.float32]) -> NDArray[np.float32]:
    """Plane with the frame's mean and standard deviation removed, clipped at four deviations."""
    mean = float(square_root_gray.mean(dtype=np.float64))
    deviation = max(float(square_root_gray.std(dtype=np.float64)), 1e-6)
    scaled: NDArray[np.float32] = (square_root_gray - np.float32(mean)) * np.float32(1.0 / deviation)
    return np.clip(scaled, -_CLIP, _CLIP, out=scaled)


def gray_levels(image: OctetArray) -> OctetArray:
    """Mean of the colour channels of an 8-bit frame (H, W, 3), rounded: what a data set stores."""
    total = image[..., 0].astype(np.uint16) + image[..., 1] + image[..., 2]
    return ((total + 1) // 3).astype(np.uint8)


def sun_up_turns(sun_in_camera: FloatArray | None) -> int:
    """Quarter turns (counter-clockwise, as `numpy.rot90`) that bring the Sun nearest the top of the image.

    `sun_in_camera` is the direction to the Sun, (3,), camera frame (x right, y down, z boresight). None or NaN: 0.
    """
    if sun_in_camera is None:
        return 0
    right, down = float(sun_in_camera[0]), float(sun_in_camera[1])
    if not np.isfinite(right + down) or right == down == 0.0:
        return 0
    # rot90 carries a direction at angle a (counter-clockwise from up, as seen) to a + 90 degrees per turn.
    angle = np.arctan2(-right, -down)
    return int(-np.rint(angle / (np.pi / 2.0))) % 4


def turn_back(
    u_px: FloatArray, v_px: FloatArray, turns: int, height_px: int, width_px: int
) -> tuple[FloatArray, FloatArray]:
    """Coordinates in the original frame (height, width) of points found in `numpy.rot90(frame, turns)`."""
    turns %= 4
    if turns == 1:
        return (width_px - 1.0) - v_px, u_px
    if turns == 2:
        return (width_px - 1.0) - u_px, (height_px - 1.0) - v_px
    return (v_px, (height_px - 1.0) - u_px) if turns == 3 else (u_px, v_px)


def turn_forward(
    u_px: FloatArray, v_px: FloatArray, turns: int, height_px: int, width_px: int
) -> tuple[FloatArray, FloatArray]:
    """Coordinates in `numpy.rot90(frame, turns)` of points of the original frame (height, width)."""
    turns %= 4
    if turns == 1:
        return v_px, (width_px - 1.0) - u_px
    if turns == 2:
        return (width_px - 1.0) - u_px, (height_px - 1.0) - v_px
    return ((height_px - 1.0) - v_px, u_px) if turns == 3 else (u_px, v_px)


def _plane_shape(image: NDArray[np.generic]) -> tuple[int, int]:
    return (int(image.shape[0]), int(image.shape[1])) if image.ndim >= 2 else (0, 0)


def _prepare_bytes(image: NDArray[np.generic]) -> PreparedImage:
    """`prepare_image` of an 8-bit frame: it has at most 766 different levels, so their counts tell all that is needed.

    Half the time of the general way, and the same values up to rounding in the last place.
    """
    colours = 3 if image.ndim == 3 and image.shape[2] >= 3 else 1
    planes = [image] if image.ndim == 2 else [image[..., k] for k in range(colours)]
    total = planes[0].astype(np.uint16)
    for plane in planes[1:]:
        total += plane.astype(np.uint8)
    share = np.bincount(total.reshape(-1), minlength=255 * colours + 1) / total.size
    level = np.arange(255 * colours + 1) / (255.0 * colours)
    root = np.sqrt(level)
    mean = float(share @ root)
    deviation = float(np.sqrt(max(float(share @ (root - mean) ** 2), 0.0)))
    quality = _verdict(float(share[level > _SATURATED_LEVEL].sum()), float(share[level > _DARK_LEVEL].sum()), deviation)
    if quality is not ImageQuality.OK:
        return PreparedImage(np.zeros(total.shape, np.float32), quality)
    table = np.clip((root - mean) / max(deviation, 1e-6), -_CLIP, _CLIP).astype(np.float32)
    return PreparedImage(np.take(table, total), ImageQuality.OK)


def _mean_of_channels(image: NDArray[np.generic]) -> NDArray[np.float32]:
    """Mean of the normalised channels."""
    total = np.zeros(image.shape[:2], np.float32)
    for k in range(3):
        plane = _square_root_gray(image[..., k])
        assert plane is not None  # finite, as the mean of the channels is
        total += normalise(plane)
    return total * np.float32(1.0 / 3.0)


def _square_root_gray(image: NDArray[np.generic]) -> NDArray[np.float32] | None:
    """Square root of the channel mean as a fraction of full scale; None where a value is not a number."""
    colours = 1 if image.ndim == 2 else min(image.shape[2], 3)
    colours = 3 if colours == 3 else 1
    planes = [image] if image.ndim == 2 else [image[..., k] for k in range(colours)]
    full_scale = float(np.iinfo(np.dtype(image.dtype).str).max) if image.dtype.kind == "u" else 1.0
    mean = np.zeros(_plane_shape(image), np.float32)
    for plane in planes:
        mean += plane.astype(np.float32)
    mean *= np.float32(1.0 / (colours * full_scale))
    if not np.isfinite(mean).all():
        return None
    return np.sqrt(np.clip(mean, 0.0, 1.0, out=mean), out=mean)


def _verdict(saturated_share: float, lit_share: float, deviation: float) -> ImageQuality:
    if saturated_share > _SATURATED_SHARE:
        return ImageQuality.SATURATED
    if lit_share < _DARK_SHARE:
        return ImageQuality.DARK
    if deviation < _UNIFORM_DEVIATION:
        return ImageQuality.UNIFORM
    return ImageQuality.OK
