"""Training of the crater network: replicas on threads (one per core) or one on a GPU, checkpoints, resume, curves.

Two threads of one process, each with its own replica on half of the batch, train twice as fast on two cores as one
replica on two OpenMP threads: the network's operations are too small to be split, and waiting threads spin.
`set_environment` must have been called before torch is imported for the allocator settings to count.

Files of a run: checkpoint.pt (last state, resumable), best.pt (weights of the best validation), curves.csv, curves.png,
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
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lunar.catalogue import size_class
from payload_emulator.errors import DatasetError, ModelError
from payload_emulator.training.augment import AugmentParameters, make_crop
from payload_emulator.training.dataset import Dataset, Frame, choose_tiers
from payload_emulator.training.landmarks import Landmarks, with_landmarks
from payload_emulator.training.targets import Tier, make_targets

ENVIRONMENT = {
    "OMP_WAIT_POLICY": "PASSIVE",
    "GOMP_SPINCOUNT": "0",
    "MALLOC_MMAP_MAX_": "0",
    "MALLOC_TRIM_THRESHOLD_": "17179869184",
    "MALLOC_TOP_PAD_": "268435456",
}
"""Waiting without spinning, and an allocator that keeps its pages: each was measured at 2 to 10 times on two cores."""


EVEN_DIAMETER_PX = 28.0
EMPHASIS_LIMITS = (0.5, 4.0)
STAMPED_EMPHASIS = 0.6
"""Small craters outnumber large ones twenty to one; without a counterweight the network hardly learns the large."""


@dataclass(frozen=True, slots=True)
class TrainParameters:
    """Settings of a run.

    minutes : wall-clock budget; the learning rate falls to zero over it (0: `steps` counts instead).
    micro_batch : crops that a replica sees at once; more does not pay on a CPU, whose cache they must share.
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
    augment: AugmentParameters = field(default_factory=AugmentParameters)


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
        No training frames, or data sets of different cameras.
    """
    import cv2
    import torch

    from payload_emulator.training.model import CraterNet, ModelConfig

    train_frames = [(d, f) for d in datasets for f in d.frames("train")]
    validation = [(d, f) for d in datasets for f in d.frames("val")]
    if landmarks is not None:
        train_frames = [(d, with_landmarks(d, f, landmarks)) for d, f in train_frames]
    if not train_frames:
        raise DatasetError("training: expected frames of the split 'train', found none")
    if len({(d.width_px, d.height_px, round(d.focal_px, 3)) for d in datasets}) > 1:
        raise DatasetError("training: expected data sets of one camera, found several")
    run.mkdir(parents=True, exist_ok=True)
    cv2.setNumThreads(1)
    torch.manual_seed(parameters.seed)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    replicas = parameters.replicas or (1 if device == "cuda" else max(1, min(os.cpu_count() or 1, 8)))
    if device == "cpu":
        torch.set_num_threads(1)
    config = ModelConfig(
        parameters.pyramid_channels,
        parameters.detail_blocks,
        parameters.detail_channels,
        parameters.paper_classes,
        parameters.depth,
    )
    network = CraterNet(config).to(device, memory_format=torch.channels_last)
    average = copy.deepcopy(network).eval()
    optimiser = torch.optim.AdamW(
        _parameter_groups(network, parameters.weight_decay), lr=parameters.learning_rate, fused=True
    )
    state = _Progress()
    origin: dict[str, Any] | None = None
    checkpoint = run / "checkpoint.pt"
    if checkpoint.is_file():
        stored = torch.load(checkpoint, map_location=device, weights_only=False)
        network.load_state_dict(stored["network"])
        average.load_state_dict(stored["average"])
        optimiser.load_state_dict(stored["optimiser"])
        state = _Progress(**stored["progress"])
        report(f"resumed at step {state.step}, {state.seconds / 60:.1f} min, best F1 {state.best_f1:.3f}")
    elif start_from is not None:
        origin = _start_from(start_from, network, average)
        report(f"started from {start_from.name}")
    images = _load_images(train_frames, report)
    _write_run(run, parameters, datasets, config.to_dict(), replicas, device, origin)
    team = _Team(network, replicas, device, parameters)
    feeder = _Feeder(train_frames, images, parameters)
    shown = _Shown()
    began = time.monotonic() - state.seconds
    last_saved = last_validated = time.monotonic()

    while not _finished(state, parameters):
        rate = _learning_rate(state, parameters)
        for group in optimiser.param_groups:
            group["lr"] = rate
        terms = team.step(feeder, state.step, optimiser)
        state.step += 1
        state.seconds = time.monotonic() - began
        _update_average(
            average, network, min(parameters.average_decay, (1.0 + state.step) / (10.0 + state.step))
        )
        shown.add(terms)
        if state.step % 50 == 0:
            line = shown.line(state, rate, parameters.batch)
            report(line)
        now = time.monotonic()
        if now - last_validated > 60.0 * parameters.validate_every_minutes or _finished(state, parameters):
            last_validated = now
            figures = _validate(average, validation, parameters.validation_frames, device)
            _append_curve(run, state, shown, figures)
            report(
                f"validation at {state.seconds / 60:.1f} min: F1 {figures['f1']:.3f} (P {figures['precision']:.3f} "
                f"R {figures['recall']:.3f} loc {figures['loc_px']:.2f} px, threshold {figures['threshold']:.2f})"
            )
            if not validation or figures["f1"] >= state.best_f1:
                state.best_f1, state.best_step, state.stale = figures["f1"], state.step, 0
                _save(run / "best.pt", network, average, None, state, config.to_dict(), figures)
            else:
                state.stale += 1
            _save(checkpoint, network, average, optimiser, state, config.to_dict(), figures)
            last_saved = now
            if parameters.patience and state.stale >= parameters.patience:
                report(f"stopped early: {state.stale} validations without gain")
                break
        elif now - last_saved > 60.0:
            _save(checkpoint, network, average, optimiser, state, config.to_dict(), {})
            last_saved = now
    _save(checkpoint, network, average, optimiser, state, config.to_dict(), {})
    draw_curves(run)
    return {
        "best": {"f1": state.best_f1, "step": state.best_step},
        "steps": state.step,
        "minutes": state.seconds / 60.0,
        "images_per_s": state.step * parameters.batch / max(state.seconds, 1e-9),
        "train_frames": len(train_frames),
        "validation_frames": len(validation),
    }


@dataclass(slots=True)
class _Progress:
    step: int = 0
    seconds: float = 0.0
    best_f1: float = -1.0
    best_step: int = 0
    stale: int = 0


class _Shown:
    """Running means of the loss terms since the last line."""

    def __init__(self) -> None:
        self.names = ("total", "heat", "offset", "diameter", "sigma", "depth")
        self.sums = np.zeros(6)
        self.count = 0
        self.last = np.full(6, np.nan)
        self.clock = time.monotonic()

    def add(self, terms: NDArray[np.float64]) -> None:
        self.sums += terms
        self.count += 1

    def line(self, state: _Progress, rate: float, batch: int) -> str:
        self.last = self.sums / max(self.count, 1)
        now = time.monotonic()
        speed = self.count * batch / max(now - self.clock, 1e-9)
        self.sums, self.count, self.clock = np.zeros(6), 0, now
        parts = " ".join(f"{name} {value:.3f}" for name, value in zip(self.names, self.last, strict=True))
        return f"step {state.step} {state.seconds / 60:.1f} min {parts} rate {rate:.2e} {speed:.1f} images/s"


class _Feeder:
    """Crops by number: crop k of a run is the same whatever thread asks for it."""

    def __init__(
        self,
        frames: list[tuple[Dataset, Frame]],
        images: list[NDArray[np.uint8]],
        parameters: TrainParameters,
    ) -> None:
        self.frames = frames
        self.images = images
        self.parameters = parameters
        self.tiers = [choose_tiers(f.craters, d.width_px, d.height_px, f.complete) for d, f in frames]

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
        tier = np.where(inside & (crop.diameter_px >= 8.0), tiers, Tier.IGNORE).astype(np.int8)[near]
        emphasis = np.clip(crop.diameter_px / EVEN_DIAMETER_PX, *EMPHASIS_LIMITS)
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


_orders: dict[tuple[int, int, int], NDArray[np.int64]] = {}


def _permutation(seed: int, epoch: int, count: int) -> NDArray[np.int64]:
    key = (seed, epoch, count)
    if key not in _orders:
        if len(_orders) > 8:
            _orders.clear()
        _orders[key] = np.random.Generator(np.random.Philox(key=[seed, 2**40 + epoch])).permutation(count)
    return _orders[key]


class _Team:
    """Replicas of the network, each on its own thread with a share of every batch; gradients are averaged."""

    def __init__(self, network: Any, replicas: int, device: str, parameters: TrainParameters) -> None:
        self.network = network
        self.members = [network] + [copy.deepcopy(network) for _ in range(replicas - 1)]
        self.device = device
        self.parameters = parameters
        self.pool = ThreadPoolExecutor(replicas)

    def step(self, feeder: _Feeder, step: int, optimiser: Any) -> NDArray[np.float64]:
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

    def _work(self, member: Any, feeder: _Feeder, first: int, count: int) -> NDArray[np.float64]:
        import torch

        from payload_emulator.training.loss import LossWeights, crater_loss

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
            )
            (terms.total * (size / count)).backward()
            values = (
                terms.total.detach(),
                terms.heat,
                terms.offset,
                terms.diameter,
                terms.sigma,
                terms.depth,
            )
            sums += np.array([float(value) for value in values]) * (size / count)
        return sums


def _start_from(path: Path, network: Any, average: Any) -> dict[str, Any]:
    """Give both networks the averaged weights of a checkpoint; what it was comes back.

    A checkpoint with fewer heads gives those it has; class heatmaps begin as copies of the common one.
    """
    from payload_emulator.training.export import load_network

    other, stored = load_network(path)
    weights = other.state_dict()
    heats, mine = other.heat_channels, network.heat_channels
    for name in ("head.weight", "head.bias"):
        old, new = weights[name], network.state_dict()[name].clone().cpu()
        new[:mine] = old[:1]
        new[: min(heats, mine)] = old[: min(heats, mine)]
        shared = min(other.geometry_channels, network.geometry_channels)
        new[mine : mine + shared] = old[heats : heats + shared]
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
        state.seconds / (60.0 * parameters.minutes)
        if parameters.minutes > 0
        else state.step / max(parameters.steps, 1)
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


def _validate(
    network: Any, validation: list[tuple[Dataset, Frame]], limit: int, device: str
) -> dict[str, float]:
    """Strict figures of 5-30 km craters at the threshold of the greatest F1, over evenly chosen frames."""
    from payload_emulator.training.dataset import frame_truth
    from payload_emulator.training.evaluate import detect_with_network
    from payload_emulator.training.scoring import best_threshold, tally

    if not validation:
        return {"f1": 0.0, "precision": 0.0, "recall": 0.0, "loc_px": float("nan"), "threshold": 0.4}
    chosen = [validation[k] for k in np.unique(np.linspace(0, len(validation) - 1, limit).astype(int))]
    found = [detect_with_network(network, dataset, frame, device) for dataset, frame in chosen]
    truths = [frame_truth(dataset, frame) for dataset, frame in chosen]
    threshold, figures = best_threshold(tally(truths, found))
    return {
        "f1": figures.f1,
        "precision": figures.precision,
        "recall": figures.recall,
        "loc_px": figures.loc_px,
        "threshold": threshold,
    }


def _load_images(
    frames: list[tuple[Dataset, Frame]], report: Callable[[str], None]
) -> list[NDArray[np.uint8]]:
    began = time.monotonic()
    images = [dataset.image(frame) for dataset, frame in frames]
    report(f"{len(images)} training images loaded in {time.monotonic() - began:.1f} s")
    return images


def _save(
    path: Path,
    network: Any,
    average: Any,
    optimiser: Any,
    state: _Progress,
    config: dict[str, Any],
    figures: dict[str, float],
) -> None:
    import torch

    document = {
        "network": network.state_dict(),
        "average": average.state_dict(),
        "progress": asdict(state),
        "config": config,
        "figures": figures,
    }
    if optimiser is not None:
        document["optimiser"] = optimiser.state_dict()
    unfinished = path.with_suffix(".unfinished")
    torch.save(document, unfinished)
    unfinished.replace(path)


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
    if origin is None and path.is_file():
        origin = json.loads(path.read_text(encoding="utf-8")).get("started_from")
    document = {
        "parameters": asdict(parameters),
        "model": config,
        "datasets": [
            {"name": d.index["name"], "labels_sha256": d.digest, "data": d.index["data"]} for d in datasets
        ],
        "replicas": replicas,
        "device": device,
        "started_from": origin,
    }
    path.write_text(json.dumps(document, indent=1), encoding="utf-8")


_CURVE_COLUMNS = (
    "step",
    "minutes",
    "total",
    "heat",
    "offset",
    "diameter",
    "sigma",
    "depth",
    "f1",
    "precision",
    "recall",
    "loc_px",
    "threshold",
)


def _append_curve(run: Path, state: _Progress, shown: _Shown, figures: dict[str, float]) -> None:
    path = run / "curves.csv"
    fresh = not path.is_file()
    with path.open("a", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        if fresh:
            writer.writerow(_CURVE_COLUMNS)
        losses = [f"{value:.5f}" for value in shown.last]
        scores = [f"{figures[key]:.5f}" for key in _CURVE_COLUMNS[8:]]
        writer.writerow([state.step, f"{state.seconds / 60:.3f}", *losses, *scores])


def draw_curves(run: Path) -> None:
    """Draw curves.png from curves.csv."""
    path = run / "curves.csv"
    if not path.is_file():
        return
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    with path.open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    minutes = [float(row["minutes"]) for row in rows]
    figure, (left, right) = pyplot.subplots(1, 2, figsize=(10, 4), constrained_layout=True)
    for name in ("total", "heat", "offset", "diameter"):
        left.plot(minutes, [float(row[name]) for row in rows], label=name)
    left.set(xlabel="minutes", ylabel="training loss")
    left.legend()
    for name in ("f1", "precision", "recall"):
        right.plot(minutes, [float(row[name]) for row in rows], label=name)
    right.set(xlabel="minutes", ylabel="validation, strict, 5-30 km", ylim=(0, 1))
    right.legend()
    figure.savefig(run / "curves.png", dpi=110)
    pyplot.close(figure)
