"""Training of the crater network: replicas on threads (one per core) or one on a GPU, checkpoints, resume, curves.

Two threads of one process, each with its own replica on half of the batch, train twice as fast on two cores as one
replica on two OpenMP threads: the network's operations are too small to be split, and waiting threads spin.
`set_environment` must have been called before torch is imported for the allocator settings to count.

Files of a run: checkpoint.pt (last state, resumable), best.pt (weights of the best validation), curves.csv,
run.json (settings and provenance).
"""

from __future__ import annotations

import copy
import csv
import hashlib
import json
import math
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lunar.arrays import FloatArray, OctetArray
from payload_emulator.errors import DatasetError, ModelError
from payload_emulator.flight.vision.detector import STRIDE_PX
from payload_emulator.flight.vision.preprocess import Preparation
from payload_emulator.training.data.dataset import Dataset, Frame
from payload_emulator.training.data.feeder import Feeder, TrainParameters
from payload_emulator.training.data.landmarks import Landmarks, with_landmarks

if TYPE_CHECKING:
    from payload_emulator.training.model.model import ModelConfig

ENVIRONMENT = {
    "OMP_WAIT_POLICY": "PASSIVE",
    "GOMP_SPINCOUNT": "0",
    "MALLOC_MMAP_MAX_": "0",
    "MALLOC_TRIM_THRESHOLD_": "17179869184",
    "MALLOC_TOP_PAD_": "268435456",
}
"""Waiting without spinning, and an allocator that keeps its pages: each was measured at 2 to 10 times on two cores."""


def set_environment() -> dict[str, str]:
    """Environment in which training should run: the current one with `ENVIRONMENT` filled in where not set."""
    return {**ENVIRONMENT, **os.environ}


def train(
    datasets: Sequence[Dataset],
    run: Path,
    parameters: TrainParameters,
    *,
    start_from: Path | None = None,
    landmarks: Landmarks | None = None,
    report: Callable[[str], None] = lambda line: None,
) -> dict[str, Any]:
    """Train (or resume) a run; the best validation figures come back.

    `start_from` gives the first weights, `landmarks` further labels that no catalogue lists.

    Raises
    ------
    DatasetError
        No training or no validation frames, or data sets of different cameras.
    """
    import cv2
    import torch

    from payload_emulator.training.model.model import CraterNet
    from payload_emulator.training.model.restore import count_statistics

    frames = [(d, f) for d in datasets for f in d.frames("train")]
    if landmarks is not None:
        frames = [(d, with_landmarks(d, f, landmarks)) for d, f in frames]
    validation = [(d, f) for d in datasets for f in d.frames("val")]
    _check_datasets(datasets, frames, validation, parameters)
    run.mkdir(parents=True, exist_ok=True)
    cv2.setNumThreads(1)
    torch.manual_seed(parameters.seed)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    replicas = parameters.replicas or (1 if device == "cuda" else max(1, min(os.cpu_count() or 1, 8)))
    if device == "cpu":
        torch.set_num_threads(1)
    config = _model_config(parameters)
    network = CraterNet(config).to(device, memory_format=torch.channels_last)
    average = copy.deepcopy(network).eval()
    optimiser = torch.optim.AdamW(
        _parameter_groups(network, parameters.weight_decay), lr=parameters.learning_rate, fused=True
    )
    files = _RunFiles(run, network, average, optimiser, config.to_dict())
    state = _Progress()
    origin: dict[str, Any] | None = None
    if files.checkpoint.is_file():
        state = files.resume(device)
        report(f"resumed at step {state.step}, {state.seconds / 60:.1f} min, best F1 {state.best_f1:.3f}")
    elif start_from is not None:
        origin = _start_from(start_from, network, average)
        report(f"started from {start_from.name}")
    images = _load_images(frames, report, parameters.preparation is Preparation.normalise_first)
    _write_run(run, parameters, datasets, config.to_dict(), replicas, device, origin)
    feeder = Feeder(frames, images, parameters)
    if origin is not None and start_from is not None and start_from.suffix == ".onnx":
        count_statistics(network, feeder, average)
    team = _Team(network, replicas, device, parameters)
    _optimise(
        team, feeder, files, state, lambda: _validate(average, validation, parameters.validation_frames, device),
        report=report,
    )  # fmt: skip
    files.save(state, {})
    return {
        "best": {"f1": state.best_f1, "step": state.best_step},
        "steps": state.step,
        "minutes": state.seconds / 60.0,
        "images_per_s": state.step * parameters.batch / max(state.seconds, 1e-9),
        "train_frames": len(frames),
        "validation_frames": len(validation),
    }


def _check_datasets(
    datasets: Sequence[Dataset],
    frames: Sequence[tuple[Dataset, Frame]],
    validation: Sequence[tuple[Dataset, Frame]],
    parameters: TrainParameters,
) -> None:
    for split, present in (("train", frames), ("val", validation)):
        if not present:
            raise DatasetError(f"training: expected frames of the split '{split}', found none")
    if len({(d.width_px, d.height_px, round(d.focal_px, 3)) for d in datasets}) > 1:
        raise DatasetError("training: expected data sets of one camera, found several")
    in_colour = parameters.preparation is Preparation.normalise_first
    if in_colour and not all(d.index["recipe"].get("colour") == "rgb" for d in datasets):
        raise DatasetError('training: expected data sets in colour (colour = "rgb") to normalise before averaging')


def _model_config(parameters: TrainParameters) -> ModelConfig:
    from payload_emulator.training.model.model import ModelConfig

    return ModelConfig(
        parameters.pyramid_channels,
        parameters.detail_blocks,
        parameters.detail_channels,
        parameters.paper_classes,
        parameters.depth,
        parameters.enlarge,
        str(parameters.preparation),
    )


def _optimise(
    team: _Team,
    feeder: Feeder,
    files: _RunFiles,
    state: _Progress,
    validate: Callable[[], dict[str, float]],
    *,
    report: Callable[[str], None],
) -> None:
    """Take steps until the budget is spent; validate and save at intervals."""
    parameters = team.parameters
    shown = _Shown()
    began = time.monotonic() - state.seconds
    last_saved = last_validated = time.monotonic()
    while not _finished(state, parameters):
        rate = _learning_rate(state, parameters)
        for group in files.optimiser.param_groups:
            group["lr"] = rate
        terms = team.step(feeder, state.step, files.optimiser)
        state.step += 1
        state.seconds = time.monotonic() - began
        decay = min(parameters.average_decay, (1.0 + state.step) / (10.0 + state.step))
        _update_average(files.average, files.network, decay)
        shown.add(terms)
        if state.step % 50 == 0:
            report(shown.line(state, rate, parameters.batch))
        now = time.monotonic()
        if now - last_validated > 60.0 * parameters.validate_every_minutes or _finished(state, parameters):
            last_validated = last_saved = now
            figures = validate()
            _append_curve(files.run, state.step, state.seconds / 60.0, shown.last, figures)
            report(
                f"validation at {state.seconds / 60:.1f} min: F1 {figures['f1']:.3f} (P {figures['precision']:.3f} "
                f"R {figures['recall']:.3f} loc {figures['loc_px']:.2f} px, threshold {figures['threshold']:.2f})"
            )
            if figures["f1"] >= state.best_f1:
                state.best_f1, state.best_step = figures["f1"], state.step
                files.write(files.run / "best.pt", state, figures, {})
            files.save(state, figures)
        elif now - last_saved > 60.0:
            files.save(state, {})
            last_saved = now


@dataclass(frozen=True, slots=True, eq=False)
class _RunFiles:
    """Saved files of a run: network, running average of its weights and optimiser, in the files of its folder."""

    run: Path
    network: Any
    average: Any
    optimiser: Any
    config: dict[str, Any]

    @property
    def checkpoint(self) -> Path:
        return self.run / "checkpoint.pt"

    def resume(self, device: str) -> _Progress:
        """Give networks and optimiser the state of the checkpoint; return its progress."""
        from payload_emulator.training.model.restore import read_checkpoint, reading

        stored = read_checkpoint(self.checkpoint, device)
        with reading(self.checkpoint):
            for name in ("network", "average", "optimiser"):
                getattr(self, name).load_state_dict(stored[name])
            return _Progress(*(stored["progress"][one.name] for one in fields(_Progress)))

    def save(self, state: _Progress, figures: dict[str, float]) -> None:
        """Write the checkpoint, from which a run can be resumed."""
        self.write(self.checkpoint, state, figures, {"optimiser": self.optimiser.state_dict()})

    def write(self, path: Path, state: _Progress, figures: dict[str, float], more: dict[str, Any]) -> None:
        import torch

        document = {
            "network": self.network.state_dict(),
            "average": self.average.state_dict(),
            "progress": asdict(state),
            "config": self.config,
            "figures": figures,
        }
        unfinished = path.with_suffix(".unfinished")
        torch.save(document | more, unfinished)
        unfinished.replace(path)


@dataclass(slots=True)
class _Progress:
    step: int = 0
    seconds: float = 0.0
    best_f1: float = -1.0
    best_step: int = 0


class _Shown:
    """Running means of the loss terms since the last line."""

    def __init__(self) -> None:
        self.sums = np.zeros(6)
        self.count = 0
        self.last = np.full(6, np.nan)
        self.clock = time.monotonic()

    def add(self, terms: FloatArray) -> None:
        self.sums += terms
        self.count += 1

    def line(self, state: _Progress, rate: float, batch: int) -> str:
        self.last = self.sums / max(self.count, 1)
        now = time.monotonic()
        speed = self.count * batch / max(now - self.clock, 1e-9)
        self.sums, self.count, self.clock = np.zeros(6), 0, now
        parts = " ".join(f"{name} {value:.3f}" for name, value in zip(_LOSSES, self.last, strict=True))
        return f"step {state.step} {state.seconds / 60:.1f} min {parts} rate {rate:.2e} {speed:.1f} images/s"


_LOSSES = ("total", "heat", "offset", "diameter", "sigma", "depth")
_SCORES = ("f1", "precision", "recall", "loc_px", "threshold")


def _append_curve(run: Path, step: int, minutes: float, losses: FloatArray, figures: dict[str, float]) -> None:
    """Add a line to curves.csv: losses since the last one, figures of the validation."""
    with (run / "curves.csv").open("a", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        if stream.tell() == 0:
            writer.writerow(["step", "minutes", *_LOSSES, *_SCORES])
        values = [*losses, *(figures[key] for key in _SCORES)]
        writer.writerow([step, f"{minutes:.3f}", *(f"{value:.5f}" for value in values)])


class _Team:
    """Replicas of the network, each on its own thread with a share of every batch; gradients are averaged."""

    def __init__(self, network: Any, replicas: int, device: str, parameters: TrainParameters) -> None:
        self.network = network
        self.members = [network] + [copy.deepcopy(network) for _ in range(replicas - 1)]
        self.device = device
        self.parameters = parameters
        self.pool = ThreadPoolExecutor(replicas)

    def step(self, feeder: Feeder, step: int, optimiser: Any) -> FloatArray:
        """One optimiser step over the step's batch; the mean loss terms come back."""
        import torch

        p = self.parameters
        share = max(1, p.batch // len(self.members))
        first = step * p.batch
        jobs = [
            self.pool.submit(self._work, member, feeder, first + k * share, share)
            for k, member in enumerate(self.members)
        ]
        terms = np.mean([job.result() for job in jobs], axis=0)
        with torch.no_grad():
            others = [list(member.parameters()) for member in self.members[1:]]
            for k, value in enumerate(self.network.parameters()):
                for other in others:
                    value.grad += other[k].grad
                value.grad /= len(self.members)
            torch.nn.utils.clip_grad_norm_(self.network.parameters(), 5.0)
            optimiser.step()
            optimiser.zero_grad(set_to_none=False)
            for member in self.members[1:]:
                for mine, lead in zip(member.parameters(), self.network.parameters(), strict=True):
                    mine.copy_(lead)
                    if mine.grad is not None:
                        mine.grad.zero_()
                for held, lead in zip(member.buffers(), self.network.buffers(), strict=True):
                    if held.dtype.is_floating_point:
                        lead.copy_(0.5 * (held + lead))
                        held.copy_(lead)
        return np.asarray(terms)

    def _work(self, member: Any, feeder: Feeder, first: int, count: int) -> FloatArray:
        import torch

        from payload_emulator.training.model.model import LossWeights, crater_loss

        p = self.parameters
        micro = count if self.device == "cuda" else min(p.micro_batch, count)
        sums = np.zeros(6)
        for start in range(0, count, micro):
            size = min(micro, count - start)
            arrays = feeder.batch(first + start, size)
            tensors = {key: torch.from_numpy(value).to(self.device) for key, value in arrays.items()}
            image = tensors["image"].contiguous(memory_format=torch.channels_last)
            heat, geometry = member(image)
            terms = crater_loss(
                heat,
                geometry,
                tensors["heat"],
                tensors["weight"],
                tensors["negative"],
                tensors["geometry"],
                tensors["regressed"],
                tensors["incomplete"],
                LossWeights(),
                STRIDE_PX // p.enlarge,
            )
            (terms.total * (size / count)).backward()
            values = (terms.total.detach(), terms.heat, terms.offset, terms.diameter, terms.sigma, terms.depth)
            sums += np.array([float(value) for value in values]) * (size / count)
        return sums


def _start_from(path: Path, network: Any, average: Any) -> dict[str, Any]:
    """Give both networks the averaged weights of a checkpoint or an exported network; what it was comes back.

    One with fewer heads gives those it has; class heatmaps begin as copies of the common one.
    """
    from payload_emulator.training.model.export import load_network
    from payload_emulator.training.model.restore import network_from_onnx

    other, stored = network_from_onnx(path) if path.suffix == ".onnx" else load_network(path)
    weights = other.state_dict()
    heats, mine = other.heat_channels, network.heat_channels
    for name in ("head.weight", "head.bias"):
        old, new = weights[name], network.state_dict()[name].clone().cpu()
        new[:mine] = old[:1]
        new[: min(heats, mine)] = old[: min(heats, mine)]
        shared = min(other.geometry_channels, network.geometry_channels)
        new[mine : mine + shared] = old[heats : heats + shared]
        if name == "head.bias":
            # Diameters and errors are in pixels of the image, which the network sees enlarged.
            new[mine + 2 : mine + 4] -= math.log(network.config.enlarge / other.config.enlarge)
        weights[name] = new
    try:
        network.load_state_dict(weights)
    except RuntimeError as error:
        raise ModelError(f"{path}: expected a network of {network.config}, found {other.config}") from error
    average.load_state_dict(network.state_dict())
    return {
        "checkpoint": path.name,
        "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
        "steps": stored["progress"]["step"],
        "minutes": stored["progress"]["seconds"] / 60.0,
    }


def _parameter_groups(network: Any, weight_decay: float) -> list[dict[str, Any]]:
    """Weights decay; biases and normalisation do not."""
    decayed = [value for value in network.parameters() if value.ndim > 1]
    free = [value for value in network.parameters() if value.ndim <= 1]
    return [{"params": decayed, "weight_decay": weight_decay}, {"params": free, "weight_decay": 0.0}]


def _learning_rate(state: _Progress, parameters: TrainParameters) -> float:
    """Linear warm-up, then a cosine to zero over the budget."""
    done = (
        state.seconds / (60.0 * parameters.minutes) if parameters.minutes > 0 else state.step / max(parameters.steps, 1)
    )
    warm = min(1.0, (state.step + 1) / max(parameters.warm_up_steps, 1))
    return parameters.learning_rate * warm * max(0.5 * (1.0 + math.cos(math.pi * min(done, 1.0))), 2e-3)


def _finished(state: _Progress, parameters: TrainParameters) -> bool:
    if parameters.minutes > 0:
        return state.seconds >= 60.0 * parameters.minutes
    return state.step >= parameters.steps


def _update_average(average: Any, network: Any, decay: float) -> None:
    import torch

    with torch.no_grad():
        for held, value in zip(average.parameters(), network.parameters(), strict=True):
            held.lerp_(value, 1.0 - decay)
        for held, value in zip(average.buffers(), network.buffers(), strict=True):
            held.copy_(value)


def _validate(network: Any, validation: list[tuple[Dataset, Frame]], limit: int, device: str) -> dict[str, float]:
    """Strict figures of 5-30 km craters at the threshold of the greatest F1, over evenly chosen frames."""
    from payload_emulator.training.data.dataset import frame_truth
    from payload_emulator.training.evaluate.evaluate import detect_with_network
    from payload_emulator.training.evaluate.scoring import best_threshold, tally

    chosen = [validation[k] for k in np.unique(np.linspace(0, len(validation) - 1, limit).astype(int))]
    found = [detect_with_network(network, dataset, frame, device) for dataset, frame in chosen]
    truths = [frame_truth(dataset, frame) for dataset, frame in chosen]
    threshold, figures = best_threshold(tally(truths, found))
    names = ("f1", "precision", "recall", "loc_px")
    return {name: getattr(figures, name) for name in names} | {"threshold": threshold}


def _load_images(
    frames: Sequence[tuple[Dataset, Frame]], report: Callable[[str], None], in_colour: bool
) -> list[OctetArray]:
    began = time.monotonic()
    images = [dataset.image(frame) if in_colour else dataset.gray(frame) for dataset, frame in frames]
    report(f"{len(images)} training images loaded in {time.monotonic() - began:.1f} s")
    return images


def _write_run(
    run: Path,
    parameters: TrainParameters,
    datasets: Sequence[Dataset],
    config: dict[str, Any],
    replicas: int,
    device: str,
    origin: dict[str, Any] | None,
) -> None:
    path = run / "run.json"
    if path.is_file():
        before = json.loads(path.read_text(encoding="utf-8"))
        origin = before.get("started_from") if origin is None else origin
    document = {
        "parameters": asdict(parameters),
        "model": config,
        "datasets": [{"name": d.index["name"], "labels_sha256": d.digest, "data": d.index["data"]} for d in datasets],
        "replicas": replicas,
        "device": device,
        "started_from": origin,
    }
    path.write_text(json.dumps(document, indent=1), encoding="utf-8")
