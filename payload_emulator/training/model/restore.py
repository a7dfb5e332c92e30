"""Conversion of an exported ONNX network into a trainable one, with recomputed normalisation statistics.

The export folds every batch normalisation into the preceding convolution. A folded network cannot be trained further
directly, because its normalisation would start with a mean of zero and a variance of one. `network_from_onnx` loads the
folded weights, and `count_statistics` recomputes the statistics of each normalisation without changing the outputs.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from pickle import UnpicklingError
from struct import error as StructError
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from google.protobuf.message import DecodeError
from torch import Tensor, nn

from payload_emulator.errors import ModelError
from payload_emulator.training.model.model import CraterNet, parse_config

if TYPE_CHECKING:
    from payload_emulator.training.data.feeder import Feeder

_PREFIX = "network."
_CROPS = 64
_UNREADABLE = (
    OSError, RuntimeError, ValueError, TypeError, LookupError, AttributeError, EOFError, AssertionError,
    UnpicklingError, StructError, DecodeError,
)  # fmt: skip
"""Errors of torch and onnx for octets and values of another kind."""


@contextmanager
def reading(path: Path, what: str = "a checkpoint of a training run") -> Iterator[None]:
    """Turn errors of reading a foreign file into a `ModelError`."""
    try:
        yield
    except FileNotFoundError:
        raise ModelError(f"{path}: expected {what}, found no file") from None
    except _UNREADABLE as error:
        raise ModelError(f"{path}: expected {what}, found: {str(error)[:120]}") from error


def read_checkpoint(path: Path, device: str = "cpu") -> dict[str, Any]:
    """Return the document of a checkpoint, read as tensors and plain values only; `ModelError` where it is none."""
    with reading(path):
        stored = torch.load(path, map_location=device, weights_only=True)
        if not isinstance(stored, dict) or not {"config", "network", "average", "progress"} <= stored.keys():
            raise ValueError("other parts")
    return stored


def network_from_onnx(path: Path) -> tuple[CraterNet, dict[str, Any]]:
    """Return the network of an exported ONNX file, and its training progress and configuration as in a checkpoint.

    Raises
    ------
    ModelError
        If the file is not an export of this project's network.
    """
    import onnx
    from onnx import numpy_helper

    with reading(path, "an exported network"):
        model = onnx.load(str(path))
        metadata = {item.key: item.value for item in model.metadata_props}
        config = json.loads(metadata["model_config"])
        stored = {
            item.name.removeprefix(_PREFIX): torch.from_numpy(np.array(numpy_helper.to_array(item)))
            for item in model.graph.initializer
            if item.name.startswith(_PREFIX)
        }
        maps = int(stored["head.bias"].shape[0])
        heats = maps - (5 if config.get("depth") else 4)
        network = CraterNet(parse_config(config | {"paper_classes": heats == 4}))
        _fill(network, stored)
        progress = {
            "step": int(metadata.get("training_steps", 0)),
            "seconds": 60.0 * float(metadata.get("training_minutes", 0.0)),
        }
    return network.eval(), {"progress": progress, "config": config}


def enlarging(network: CraterNet, factor: int) -> CraterNet:
    """Return a network of the same weights that enlarges images by a factor; diameters are in original pixels."""
    larger = CraterNet(replace(network.config, enlarge=factor))
    state = {name: value.clone() for name, value in network.state_dict().items()}
    first = network.heat_channels + 2
    state["head.bias"][first : first + 2] -= math.log(factor / network.config.enlarge)
    larger.load_state_dict(state)
    larger.eval()
    return larger


def count_statistics(network: CraterNet, feeder: Feeder, average: CraterNet, crops: int = _CROPS) -> None:
    """Compute the normalisation statistics from the first crops of a run; evaluation outputs do not change."""
    layers = [layer for layer in network.modules() if isinstance(layer, nn.BatchNorm2d)]
    sums = {layer: torch.zeros(3, layer.num_features, dtype=torch.float64) for layer in layers}

    def count(layer: nn.Module, inputs: tuple[Tensor, ...]) -> None:
        assert isinstance(layer, nn.BatchNorm2d)
        x = inputs[0].detach().to("cpu", torch.float64)
        sums[layer] += torch.stack([torch.ones_like(x), x, x * x]).sum(dim=(1, 3, 4))

    hooks = [layer.register_forward_pre_hook(count) for layer in layers]
    was_training, device = network.training, next(network.parameters()).device
    network.eval()
    with torch.no_grad():
        for first in range(crops):
            image = torch.from_numpy(feeder.batch(first, 1)["image"]).to(device)
            network(image.contiguous(memory_format=torch.channels_last))
        for hook in hooks:
            hook.remove()
        for layer in layers:
            number, total, squares = sums[layer]
            mean = (total / number).to(device, torch.float32)
            variance = (squares / number - (total / number) ** 2).clamp(min=0.0).to(device, torch.float32)
            assert layer.running_mean is not None and layer.running_var is not None
            scale = layer.weight / torch.sqrt(layer.running_var + layer.eps)
            shift = layer.bias - scale * layer.running_mean
            layer.weight.copy_(scale * torch.sqrt(variance + layer.eps))
            layer.bias.copy_(shift + scale * mean)
            layer.running_mean.copy_(mean)
            layer.running_var.copy_(variance)
    network.train(was_training)
    average.load_state_dict(network.state_dict())


def _fill(network: CraterNet, stored: dict[str, Tensor]) -> None:
    """Load the values of folded convolutions into the layers of a network."""
    state = network.state_dict()
    for name, layer in network.named_modules():
        if isinstance(layer, nn.Conv2d):
            state[f"{name}.weight"] = stored[f"{name}.weight"]
            if layer.bias is not None:
                state[f"{name}.bias"] = stored[f"{name}.bias"]
        elif isinstance(layer, nn.BatchNorm2d):
            before, number = name.rsplit(".", 1)
            state[f"{name}.weight"] = torch.ones(layer.num_features)
            state[f"{name}.bias"] = stored[f"{before}.{int(number) - 1}.weight_bias"]
            state[f"{name}.running_mean"] = torch.zeros(layer.num_features)
            state[f"{name}.running_var"] = torch.full((layer.num_features,), 1.0 - layer.eps)
    network.load_state_dict(state)
