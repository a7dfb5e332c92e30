"""Settings of a training run and the crops it is fed: crop k of a run is the same whatever thread asks for it.

Everything is drawn from the generator passed in. Coordinates follow the pixels (centres at integers).
"""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lunar.arrays import BoolArray, FloatArray, IntArray, OctetArray
from lunar.catalogue import size_class
from payload_emulator.flight.vision.detector import STRIDE_PX
from payload_emulator.flight.vision.preprocess import Preparation, normalise, sun_up_turns, turn_forward
from payload_emulator.training.data.dataset import LABEL_MINIMUM_DIAMETER_PX, Dataset, Frame, choose_tiers
from payload_emulator.training.data.targets import Tier, make_targets

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
    return np.random.Generator(np.random.PCG64(5)).standard_normal((_NOISE_SIZE, _NOISE_SIZE), dtype=np.float32)


LEAST_CROP_DIAMETER_PX = 8.0
"""A labelled crater that a crop shows smaller than this is ignored there."""

EVEN_DIAMETER_PX = 28.0
LEAST_EMPHASIS, MOST_EMPHASIS = 0.5, 4.0
"""Limits of the factor by which a label counts for its diameter, 1 at 28 px. Small craters outnumber large ones twenty
to one; without a counterweight the network hardly learns the large."""

STAMPED_EMPHASIS = 0.6
"""Small craters that are stamped on real terrain outnumber those of the list."""


@dataclass(frozen=True, slots=True)
class TrainParameters:
    """Settings of a run.

    minutes : wall-clock budget; the learning rate falls to zero over it (0: `steps` counts instead).
    micro_batch : crops that a replica sees at once; more does not pay on a CPU, whose cache they must share.
    preparation : how RGB frames become gray; the paper's order needs a data set in colour.
    enlarge : as in `model.ModelConfig`. Lengths in pixels that suit the network's first layer are shorter in the image
        by the enlargement.
    """

    minutes: float = 15.0
    steps: int = 0
    batch: int = 8
    micro_batch: int = 2
    crop_px: int = 384
    learning_rate: float = 2.5e-3
    weight_decay: float = 1e-2
    warm_up_steps: int = 100
    average_decay: float = 0.998
    validate_every_minutes: float = 4.0
    validation_frames: int = 120
    seed: int = 1
    replicas: int = 0
    paper_classes: bool = True
    depth: bool = True
    pyramid_channels: int = 48
    detail_blocks: int = 1
    detail_channels: int = 24
    enlarge: int = 1
    preparation: Preparation = Preparation.gray_first
    augment: AugmentParameters = field(default_factory=AugmentParameters)


class Feeder:
    """Crops by number: crop k of a run is the same whatever thread asks for it."""

    def __init__(
        self, frames: Sequence[tuple[Dataset, Frame]], images: list[OctetArray], parameters: TrainParameters
    ) -> None:
        self.frames = frames
        self.images = images
        self.parameters = parameters
        least_px = LABEL_MINIMUM_DIAMETER_PX / parameters.enlarge
        self.tiers = [choose_tiers(f.craters, d.width_px, d.height_px, f.complete, least_px) for d, f in frames]

    def batch(self, first: int, count: int) -> dict[str, NDArray[Any]]:
        """Arrays of `count` crops from crop number `first` on."""
        parts = [self._crop(first + k) for k in range(count)]
        return {key: np.stack([part[key] for part in parts]) for key in parts[0]}

    def _crop(self, number: int) -> dict[str, Any]:
        p = self.parameters
        rng = np.random.Generator(np.random.Philox(key=[p.seed, number]))
        epoch, place = divmod(number, len(self.frames))
        order = _permutation(p.seed, epoch, len(self.frames))
        _, frame = self.frames[order[place]]
        tiers, weights = self.tiers[order[place]]
        craters = frame.craters
        crop = make_crop(
            self.images[order[place]],
            frame.sun_camera,
            craters["u_px"],
            craters["v_px"],
            craters["diameter_px"],
            tiers == Tier.LABEL,
            p.crop_px,
            p.augment,
            rng,
        )
        margin = 0.5 * crop.diameter_px
        near = (
            (crop.u_px > -margin)
            & (crop.u_px < p.crop_px + margin)
            & (crop.v_px > -margin)
            & (crop.v_px < p.crop_px + margin)
        )
        inside = (crop.u_px > 1) & (crop.u_px < p.crop_px - 2) & (crop.v_px > 1) & (crop.v_px < p.crop_px - 2)
        tier = np.where(inside & (crop.diameter_px >= LEAST_CROP_DIAMETER_PX / p.enlarge), tiers, Tier.IGNORE).astype(
            np.int8
        )[near]
        emphasis = np.clip(p.enlarge * crop.diameter_px / EVEN_DIAMETER_PX, LEAST_EMPHASIS, MOST_EMPHASIS)
        weights = weights * np.where(craters["id"] < 0, STAMPED_EMPHASIS, 1.0) * emphasis
        targets = make_targets(
            p.crop_px,
            p.crop_px,
            crop.u_px[near],
            crop.v_px[near],
            crop.diameter_px[near],
            tier,
            weights[near],
            size_class(craters["diameter_m"].astype(np.float64))[near] if p.paper_classes else None,
            np.nan_to_num(craters["depth_ratio"].astype(np.float64))[near],
            STRIDE_PX // p.enlarge,
        )
        return {
            "image": crop.image[None],
            "heat": targets.heat,
            "weight": targets.weight,
            "negative": targets.negative,
            "geometry": targets.geometry,
            "regressed": targets.regressed,
            "incomplete": np.array(not frame.complete),
        }


_orders: dict[tuple[int, int, int], IntArray] = {}


def _permutation(seed: int, epoch: int, count: int) -> IntArray:
    key = (seed, epoch, count)
    if key not in _orders:
        if len(_orders) > 8:
            _orders.clear()
        _orders[key] = np.random.Generator(np.random.Philox(key=[seed, 2**40 + epoch])).permutation(count)
    return _orders[key]
