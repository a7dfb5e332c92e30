"""Losses of the crater network: penalty-reduced focal loss on heatmaps, L1 on geometry, likelihood of the centre error.

References
----------
X. Zhou et al., "Objects as Points", 2019, equations 1 to 3 (alpha 2, beta 4).
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from payload_emulator.flight.vision.detector import STRIDE_PX


@dataclass(frozen=True, slots=True)
class LossWeights:
    """Share of each term; offsets are in cells, diameters in natural logarithms, so both are near unity."""

    offset: float = 1.0
    diameter: float = 0.7
    sigma: float = 0.1
    depth: float = 0.2
    class_heat: float = 0.25  # of the paper's class heatmaps, a variant in addition to the common one
    high_score: float = 0.85  # background above this on incompletely catalogued terrain is left alone


@dataclass(frozen=True, slots=True)
class LossTerms:
    """Total (with gradient) and the detached parts."""

    total: Tensor
    heat: Tensor
    offset: Tensor
    diameter: Tensor
    sigma: Tensor
    depth: Tensor


def crater_loss(
    heat_logit: Tensor,
    geometry: Tensor,
    target_heat: Tensor,
    target_weight: Tensor,
    negative_weight: Tensor,
    target_geometry: Tensor,
    regressed: Tensor,
    incomplete: Tensor,
    weights: LossWeights,
    stride_px: int = STRIDE_PX,
) -> LossTerms:
    """Loss of a batch; tensors as `targets.Targets` stacked; `incomplete` (B,) bool: its catalogue lacks craters."""
    probability = torch.sigmoid(heat_logit)
    log_p = torch.nn.functional.logsigmoid(heat_logit)
    log_not_p = log_p - heat_logit
    share = torch.full((heat_logit.shape[1], 1, 1), weights.class_heat, device=heat_logit.device)
    share[0] = 1.0
    centres = target_weight[:, 0].sum().clamp(min=1.0)
    positive = -(share * target_weight * (1.0 - probability) ** 2 * log_p).sum()
    unlisted = incomplete[:, None, None, None] & (probability.detach() > weights.high_score) & (target_heat < 0.05)
    negative_weight = negative_weight.masked_fill(unlisted, 0.0).masked_fill(target_weight > 0.0, 0.0)
    negative = -(share * negative_weight * (1.0 - target_heat) ** 4 * probability**2 * log_not_p).sum()
    heat = (positive + negative) / centres

    mass = regressed.sum().clamp(min=1.0)
    error = (geometry[:, :2] - target_geometry[:, :2]).abs()
    offset = (regressed[:, None] * error).sum() / mass
    diameter = (regressed * (geometry[:, 2] - target_geometry[:, 2]).abs()).sum() / mass
    # Laplace likelihood per axis: scale b = sigma / sqrt 2; the error is held fixed, only its size is learned here.
    log_b = geometry[:, 3].clamp(-4.0, 4.0) - 0.5 * float(torch.log(torch.tensor(2.0)))
    error_px = stride_px * error.detach().mean(1)
    sigma = (regressed * (error_px * torch.exp(-log_b) + log_b)).sum() / mass
    depth = torch.zeros_like(sigma)
    if geometry.shape[1] > 4:
        depth = (regressed * (geometry[:, 4] - target_geometry[:, 3]).abs()).sum() / mass
    total = heat + weights.offset * offset + weights.diameter * diameter + weights.sigma * sigma + weights.depth * depth
    return LossTerms(total, heat.detach(), offset.detach(), diameter.detach(), sigma.detach(), depth.detach())
