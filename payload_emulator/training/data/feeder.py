"""Settings of a training run and the crops it is fed: crop k of a run is the same whatever thread asks for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lunar.arrays import IntArray, OctetArray
from lunar.catalogue import size_class
from payload_emulator.flight.vision.preprocess import Preparation
from payload_emulator.training.data.augment import AugmentParameters, make_crop
from payload_emulator.training.data.dataset import LABEL_MINIMUM_DIAMETER_PX, Dataset, Frame, choose_tiers
from payload_emulator.training.data.targets import Tier, make_targets

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
    backbone, stride_px, enlarge : as in `model.ModelConfig`. Lengths in pixels that suit the network's first layer are
        shorter in the image by the enlargement.
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
    patience: int = 0
    seed: int = 1
    replicas: int = 0
    paper_classes: bool = True
    depth: bool = True
    pyramid_channels: int = 48
    detail_blocks: int = 1
    detail_channels: int = 24
    backbone: str = "small"
    stride_px: int = 4
    enlarge: int = 1
    preparation: Preparation = Preparation.gray_first
    augment: AugmentParameters = field(default_factory=AugmentParameters)


class Feeder:
    """Crops by number: crop k of a run is the same whatever thread asks for it."""

    def __init__(
        self,
        frames: Sequence[tuple[Dataset, Frame]],
        images: list[OctetArray],
        parameters: TrainParameters,
    ) -> None:
        self.frames = frames
        self.images = images
        self.parameters = parameters
        least_px = LABEL_MINIMUM_DIAMETER_PX / parameters.enlarge
        self.tiers = [
            choose_tiers(f.craters, d.width_px, d.height_px, f.complete, least_px) for d, f in frames
        ]

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
        tier = np.where(
            inside & (crop.diameter_px >= LEAST_CROP_DIAMETER_PX / p.enlarge), tiers, Tier.IGNORE
        ).astype(np.int8)[near]
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
            p.stride_px // p.enlarge,
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
