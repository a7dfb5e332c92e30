"""The crater network: MobileNetV3 backbone, depthwise feature pyramid, CenterNet heads at stride 4; its loss.

Input (B, 1, H, W), H and W multiples of 32, as `flight.vision.preprocess` makes it. Outputs at (H/4, W/4), finer where
the network enlarges the image first: heatmap logits (B, 1 or 4, h, w): any crater, then the three classes of the paper;
geometry (B, 4 or 5, h, w): offset to the centre in cells (right, down), ln(diameter / 16 px), ln(one-sigma centre error
/ 1 px), and if asked for ten times the depth/diameter, by which a crater is fresh or degraded.

References
----------
A. Howard et al., "Searching for MobileNetV3", 2019, tables 1 and 2. X. Zhou et al., "Objects as Points", 2019.
"""

import copy
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor, nn

from payload_emulator.errors import ModelError
from payload_emulator.flight.vision.detector import STRIDE_PX

# kernel, expanded channels, output channels, squeeze-excite, hard-swish (else ReLU), stride
_SMALL = (
    (3, 16, 16, True, False, 2),
    (3, 72, 24, False, False, 2),
    (3, 88, 24, False, False, 1),
    (5, 96, 40, True, True, 2),
    (5, 240, 40, True, True, 1),
    (5, 240, 40, True, True, 1),
    (5, 120, 48, True, True, 1),
    (5, 144, 48, True, True, 1),
    (5, 288, 96, True, True, 2),
    (5, 576, 96, True, True, 1),
    (5, 576, 96, True, True, 1),
)
_TAPS = (0, 2, 7, 10)  # the last blocks at strides 4, 8, 16 and 32
_STEM_CHANNELS = 16
_PRIOR_LOGIT = -4.0  # about one cell in fifty before training: keeps the first focal losses finite
_INITIAL_LOG_SIGMA = 0.3
_INITIAL_TENFOLD_DEPTH = 0.8  # depth/diameter 0.08, the middle of the catalogue


@dataclass(frozen=True, slots=True)
class ModelConfig:
    """Shape of the network. `detail_blocks` adds blocks at stride 4, where small craters live.

    preparation : how a colour frame becomes the network's input, a `flight.vision.preprocess.Preparation`.
    enlarge : factor by which the network first enlarges the image, for craters of few pixels (high altitudes).
    """

    pyramid_channels: int = 64
    detail_blocks: int = 1
    detail_channels: int = 24
    paper_classes: bool = False
    depth: bool = False
    enlarge: int = 1
    preparation: str = "gray-then-normalise"

    def __post_init__(self) -> None:
        if self.enlarge < 1 or STRIDE_PX % self.enlarge:
            raise ModelError(f"enlarge: expected a divisor of the stride {STRIDE_PX}, found {self.enlarge}")

    @property
    def cell_px(self) -> int:
        """Size of an output cell in pixels of the image."""
        return STRIDE_PX // self.enlarge

    def to_dict(self) -> dict[str, int | bool | str]:
        return asdict(self)


def parse_config(document: Mapping[str, Any]) -> ModelConfig:
    """Return the shape that a checkpoint or an exported network states; older ones also name backbone and stride.

    Raises
    ------
    ModelError
        Another backbone than the small one, or another stride than 4.
    """
    older = {"backbone": "small", "stride_px": STRIDE_PX}
    for key, expected in older.items():
        if document.get(key, expected) != expected:
            raise ModelError(f"model_config: expected {key} {expected}, found {document[key]!r}")
    return ModelConfig(**{key: value for key, value in document.items() if key not in older})


class CraterNet(nn.Module):
    """Heatmap logits and geometry of a normalised gray image."""

    def __init__(self, config: ModelConfig | None = None) -> None:
        super().__init__()
        self.config = config or ModelConfig()
        self.stem = _conv_norm(1, _STEM_CHANNELS, 3, stride=2, activation=nn.Hardswish())
        blocks: list[nn.Module] = []
        tapped: list[int] = []
        channels = _STEM_CHANNELS
        for index, (kernel, expanded, out, squeeze, swish, stride) in enumerate(_SMALL):
            blocks.append(_InvertedResidual(channels, expanded, out, kernel, stride, squeeze, swish))
            channels = out
            if index in _TAPS:
                tapped.append(out)
        self.blocks = nn.ModuleList(blocks)
        detail = self.config.detail_channels
        self.detail = nn.Sequential(
            *(
                _InvertedResidual(tapped[0] if i == 0 else detail, 2 * detail, detail, 3, 1, False, False)
                for i in range(self.config.detail_blocks)
            )
        )
        if self.config.detail_blocks:
            tapped[0] = detail
        width = self.config.pyramid_channels
        self.lateral = nn.ModuleList(nn.Conv2d(c, width, 1) for c in tapped)
        self.smooth = nn.ModuleList(_separable(width, width) for _ in tapped[:-1])
        self.trunk = _separable(width, width)
        self.head = nn.Conv2d(width, self.heat_channels + self.geometry_channels, 1)
        _initialise(self)
        assert self.head.bias is not None
        self.head.bias.data[: self.heat_channels] = _PRIOR_LOGIT
        self.head.bias.data[self.heat_channels + 3] = _INITIAL_LOG_SIGMA
        if self.config.depth:
            self.head.bias.data[self.heat_channels + 4] = _INITIAL_TENFOLD_DEPTH

    @property
    def heat_channels(self) -> int:
        return 4 if self.config.paper_classes else 1

    @property
    def geometry_channels(self) -> int:
        return 5 if self.config.depth else 4

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        out = self.maps(image)
        return out[:, : self.heat_channels], out[:, self.heat_channels :]

    def maps(self, image: Tensor) -> Tensor:
        """Heatmap logits and geometry as one stack of maps."""
        features: list[Tensor] = []
        if self.config.enlarge > 1:
            image = nn.functional.interpolate(
                image, scale_factor=float(self.config.enlarge), mode="bilinear", align_corners=False
            )
        x = self.stem(image)
        for index, block in enumerate(self.blocks):
            x = block(x)
            if index in _TAPS:
                features.append(x)
        features[0] = self.detail(features[0])
        merged = self.lateral[-1](features[-1])
        for level in range(len(features) - 2, -1, -1):
            merged = nn.functional.interpolate(merged, scale_factor=2.0, mode="nearest")
            merged = self.smooth[level](self.lateral[level](features[level]) + merged)
        out = self.head(self.trunk(merged))
        if out.requires_grad:  # a gradient of another memory layout makes the backward pass several times slower
            out.register_hook(lambda gradient: gradient.contiguous(memory_format=torch.channels_last))
        return out


class ExportedCraterNet(nn.Module):
    """The network as flight runs it: probabilities, and geometry with the corrections of `calibrate.calibrate`.

    `heat_channels` 1 leaves the paper's class heatmaps out; `classes_only` leaves all but these and the offsets out.
    Corrections are part of the last layer's biases, and what
    is left out is not computed.
    """

    def __init__(
        self,
        network: CraterNet,
        geometry_shift: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0),
        heat_channels: int = 1,
        *,
        classes_only: bool = False,
    ) -> None:
        super().__init__()
        self.network = copy.deepcopy(network)
        self.heat_channels = heat_channels
        whole = network.head
        assert whole.bias is not None
        first = network.heat_channels
        kept = [*range(heat_channels), *range(first, first + network.geometry_channels)]
        if classes_only:
            heat_channels = self.heat_channels = network.heat_channels - 1
            kept = [*range(1, first), first, first + 1]
        head = nn.Conv2d(whole.in_channels, len(kept), 1)
        assert head.bias is not None
        with torch.no_grad():
            head.weight.copy_(whole.weight[kept])
            head.bias.copy_(whole.bias[kept])
            geometry_channels = len(kept) - heat_channels
            head.bias[heat_channels : heat_channels + 4] += torch.tensor(geometry_shift)[:geometry_channels]
        self.network.head = head

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        out = self.network.maps(image)
        return torch.sigmoid(out[:, : self.heat_channels]), out[:, self.heat_channels :]


class _SqueezeExcite(nn.Module):
    def __init__(self, channels: int) -> None:
        super().__init__()
        reduced = max(8, (channels // 4 + 4) // 8 * 8)
        self.reduce = nn.Conv2d(channels, reduced, 1)
        self.expand = nn.Conv2d(reduced, channels, 1)

    def forward(self, x: Tensor) -> Tensor:
        pooled = x.mean((2, 3), keepdim=True)
        gate = nn.functional.hardsigmoid(self.expand(nn.functional.relu(self.reduce(pooled))))
        return x * gate


class _InvertedResidual(nn.Module):
    def __init__(
        self, channels: int, expanded: int, out: int, kernel: int, stride: int, squeeze: bool, swish: bool
    ) -> None:
        super().__init__()
        self.residual = stride == 1 and channels == out
        layers: list[nn.Module] = []
        if expanded != channels:
            layers.append(_conv_norm(channels, expanded, 1, activation=_activation(swish)))
        layers.append(
            _conv_norm(expanded, expanded, kernel, stride=stride, groups=expanded, activation=_activation(swish))
        )
        if squeeze:
            layers.append(_SqueezeExcite(expanded))
        layers.append(_conv_norm(expanded, out, 1, activation=None))
        self.body = nn.Sequential(*layers)

    def forward(self, x: Tensor) -> Tensor:
        y: Tensor = self.body(x)
        return x + y if self.residual else y


def _activation(swish: bool) -> nn.Module:
    return nn.Hardswish() if swish else nn.ReLU()


def _conv_norm(
    channels: int, out: int, kernel: int, stride: int = 1, groups: int = 1, activation: nn.Module | None = None
) -> nn.Sequential:
    layers: list[nn.Module] = [
        nn.Conv2d(channels, out, kernel, stride, kernel // 2, groups=groups, bias=False),
        nn.BatchNorm2d(out, momentum=0.02),
    ]
    if activation is not None:
        layers.append(activation)
    return nn.Sequential(*layers)


def _separable(channels: int, out: int) -> nn.Sequential:
    depthwise = nn.Conv2d(channels, channels, 3, padding=1, groups=channels, bias=False)
    return nn.Sequential(depthwise, _conv_norm(channels, out, 1, activation=nn.ReLU()))


def _initialise(network: CraterNet) -> None:
    for module in network.modules():
        if isinstance(module, nn.Conv2d):
            fan_out = module.kernel_size[0] * module.kernel_size[1] * module.out_channels / module.groups
            nn.init.normal_(module.weight, 0.0, math.sqrt(2.0 / fan_out))
            if module.bias is not None:
                nn.init.zeros_(module.bias)
    nn.init.normal_(network.head.weight, 0.0, 0.01)


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
