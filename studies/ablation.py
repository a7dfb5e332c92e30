"""Training changes to improve detection on real terrain, each compared with the same baseline recipe.

Every variant is trained from scratch on the same number of crops and, except for the variant that changes the frames,
on the same frames. The budgets are small: the figures compare variants with each other and do not show the result of a
full training. The baseline recipe is trained with every seed; the spread of its figures is the noise level, and smaller
effects are not significant. Thresholds, figures and the choice of a variant are those of the validation split. The test
split is scored in a separate step, for the chosen variant only.

Each variant has its own run folder, so an interrupted training resumes from its last checkpoint.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from payload_emulator.errors import DatasetError
from payload_emulator.training.data.augment import AugmentParameters
from payload_emulator.training.data.dataset import Dataset, Frame, frame_truth, write_json
from payload_emulator.training.data.feeder import TrainParameters
from payload_emulator.training.data.refits import RefittedRims, refitted_frame
from payload_emulator.training.data.truth import FrameTruth
from payload_emulator.training.evaluate.localisation import against_rims
from payload_emulator.training.evaluate.scoring import FrameDetections, best_threshold, tally

BASELINE = "recipe"
STRIP_DEG = (255.0, 285.0)
"""One strip of longitude, as wide as the prototype's: west of the strip that is held out."""

_CLEAR_DEPTH_RATIO = 0.06


@dataclass(frozen=True, slots=True)
class Variant:
    """The recipe with one thing changed: settings, or which frames it learns from.

    frames : "mixed" (the recipe's), "strip" (its real frames all from `STRIP_DEG`), "real" (no procedural worlds),
        "plain" (real terrain as the rasters have it, a separate data set) or "refitted" (labels on measured rims).
    """

    name: str
    title: str
    changes: Mapping[str, Any] = field(default_factory=dict)
    frames: str = "mixed"


VARIANTS = (
    Variant(BASELINE, "the recipe"),
    Variant("one-strip", "real frames of one 30-degree strip only", frames="strip"),
    Variant("real-only", "no procedural worlds", frames="real"),
    Variant("plain-terrain", "no craters and roughness stamped below the rasters", frames="plain"),
    Variant("refitted-rims", "labels on the rims fitted on the terrain", frames="refitted"),
    Variant("hard-labels", "labels weigh the same at any depth/diameter", {"soft_labels": False}),
    Variant(
        "no-tone",
        "no tone, sharpness, noise and shade in the augmentation",
        {"augment": AugmentParameters(gamma=(1.0, 1.0), unsharp=(0.0, 0.0), noise=0.0, shade=0.0)},
    ),
    Variant("stride-2", "maps of twice the resolution (stride 2)", {"stride_px": 2}),
    Variant("narrow", "feature pyramid of 24 channels", {"pyramid_channels": 24}),
    Variant("wide", "feature pyramid of 96 channels", {"pyramid_channels": 96}),
    Variant("large-backbone", "MobileNetV3-large", {"backbone": "large"}),
)


@dataclass(frozen=True, slots=True)
class AblationParameters:
    """Equal budget of every variant: steps of 8 crops, and how many frames teach and test."""

    steps: int = 600
    crop_px: int = 256
    real_frames: int = 480
    procedural_frames: int = 240
    validation_frames: int = 150
    test_frames: int = 160
    seeds: tuple[int, ...] = (1, 2)
    every_seed: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Material:
    """Data sets of the recipe; real terrain without what is stamped on it; rims measured on the terrain."""

    datasets: Sequence[Dataset]
    plain: Dataset | None = None
    rims: RefittedRims | None = None


def ablate(
    material: Material,
    folder: Path,
    variants: Sequence[Variant] = VARIANTS,
    parameters: AblationParameters = AblationParameters(),
    report: Callable[[str], None] = lambda line: None,
) -> list[dict[str, Any]]:
    """Train each variant in its own folder under `folder` and score it on the validation split; return the rows.

    The baseline runs with every seed, the others with the first unless `every_seed`. Variants without
    material are left out and logged. Finished variants are not trained again.

    Raises
    ------
    DatasetError
        The folder holds runs with another budget or other data, or there are no training or validation frames.
    """
    rows = []
    for variant in variants:
        if missing := _missing(variant, material):
            report(f"{variant.name}: left out, {missing}")
            continue
        seeds = (
            parameters.seeds if variant.name == BASELINE or parameters.every_seed else parameters.seeds[:1]
        )
        for seed in seeds:
            rows.append(_run(variant, seed, material, folder / f"{variant.name}-{seed}", parameters, report))
    return rows


def _missing(variant: Variant, material: Material) -> str:
    if variant.frames == "plain" and material.plain is None:
        return "no data set of unsharpened terrain was given"
    if variant.frames == "refitted" and material.rims is None:
        return "no table of rims was given"
    return ""


def _run(
    variant: Variant,
    seed: int,
    material: Material,
    run: Path,
    parameters: AblationParameters,
    report: Callable[[str], None],
) -> dict[str, Any]:
    from payload_emulator.training.model.export import load_network
    from payload_emulator.training.model.model import count_parameters
    from payload_emulator.training.model.train import train

    budget = _budget(variant, seed, material, parameters)
    done = run / "figures.json"
    if done.is_file():
        row: dict[str, Any] = json.loads(done.read_text(encoding="utf-8"))
        if row["budget"] != budget:
            raise DatasetError(f"{run}: expected a run of the same budget and data, found another")
        return row
    report(f"{variant.name}, seed {seed}")
    settings = replace(
        TrainParameters(
            minutes=0.0,
            steps=parameters.steps,
            crop_px=parameters.crop_px,
            replicas=1,
            seed=seed,
            paper_classes=False,
            validate_every_minutes=1e9,
            validation_frames=1,
        ),
        **variant.changes,
    )
    resumed = (run / "checkpoint.pt").is_file()
    began = time.process_time()
    train(
        material.datasets,
        run,
        settings,
        train_frames=choose_frames(variant, material, parameters),
        report=report,
    )
    seconds = time.process_time() - began
    network, _ = load_network(run / "checkpoint.pt")
    row = {
        "variant": variant.name,
        "title": variant.title,
        "seed": seed,
        "budget": budget,
        "weights": count_parameters(network),
        "cpu_ms_per_crop": None if resumed else 1e3 * seconds / (parameters.steps * settings.batch),
        **_score(network, material, parameters),
    }
    write_json(done, row)
    return row


def _budget(
    variant: Variant, seed: int, material: Material, parameters: AblationParameters
) -> dict[str, Any]:
    data = [*material.datasets, *([material.plain] if variant.frames == "plain" and material.plain else [])]
    return {
        "variant": variant.name,
        "seed": seed,
        "steps": parameters.steps,
        "crop_px": parameters.crop_px,
        "real_frames": parameters.real_frames,
        "procedural_frames": parameters.procedural_frames,
        "validation_frames": parameters.validation_frames,
        "labels_sha256": [dataset.digest for dataset in data],
    }


def choose_frames(
    variant: Variant, material: Material, parameters: AblationParameters
) -> list[tuple[Dataset, Frame]]:
    """The frames a variant learns from: as many real ones and procedural ones as every other's, but for "real"."""
    every = [(d, f) for d in material.datasets for f in d.frames("train")]
    real = [item for item in every if not item[1].complete]
    procedural = [item for item in every if item[1].complete]
    wanted_real, wanted_procedural = parameters.real_frames, parameters.procedural_frames
    match variant.frames:
        case "strip":
            west, east = STRIP_DEG
            real = [item for item in real if west <= item[1].values["longitude_deg"] < east]
        case "real":
            wanted_real, wanted_procedural = wanted_real + wanted_procedural, 0
        case "plain":
            assert material.plain is not None
            real = [(material.plain, frame) for frame in material.plain.frames("train")]
    chosen = _thin(real, wanted_real) + _thin(procedural, wanted_procedural)
    if variant.frames == "refitted":
        assert material.rims is not None
        chosen = [(d, refitted_frame(d, f, material.rims)[0]) for d, f in chosen]
    if not chosen:
        raise DatasetError(f"variant {variant.name}: expected frames of the split 'train', found none")
    return chosen


def _thin(frames: Sequence[tuple[Dataset, Frame]], count: int) -> list[tuple[Dataset, Frame]]:
    """At most `count` frames, evenly over all."""
    if not frames or count <= 0:
        return []
    return [frames[k] for k in np.unique(np.linspace(0, len(frames) - 1, count).astype(int))]


def choose_variant(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the variant with the greatest strict F1 on the validation split, the mean over its seeds.

    Of equal variants the first is chosen.

    Raises
    ------
    DatasetError
        There are no rows.
    """
    if not rows:
        raise DatasetError("choice of a variant: expected at least one trained variant, found none")
    return max(
        dict.fromkeys(str(row["variant"]) for row in rows),
        key=lambda name: float(np.mean([validation_f1(row) for row in rows if row["variant"] == name])),
    )


def validation_f1(row: Mapping[str, Any]) -> float:
    """Return the strict F1 of a row on the validation split: on real frames where there are any."""
    kind = "real" if row["validation"]["real"]["frames"] else "procedural"
    return float(row["validation"][kind]["strict"]["f1"])


def score_chosen_variant(
    material: Material,
    folder: Path,
    rows: Sequence[Mapping[str, Any]],
    parameters: AblationParameters = AblationParameters(),
) -> dict[str, Any]:
    """Return the figures of the chosen variant on the test split, for its first seed, at its validation threshold.

    Parameters
    ----------
    rows
        Result of `ablate` with the same `folder`.

    Raises
    ------
    DatasetError
        There are no rows, or no frames to test on.
    """
    from payload_emulator.training.model.export import load_network

    chosen = choose_variant(rows)
    row = next(row for row in rows if row["variant"] == chosen)
    network, _ = load_network(folder / f"{chosen}-{row['seed']}" / "checkpoint.pt")
    kinds = {
        name: _thin(_of_kind(material, "test", complete), parameters.test_frames)
        for name, complete in _KINDS.items()
    }
    if not any(kinds.values()):
        raise DatasetError(f"variant {chosen}: expected frames of the split 'test', found none")
    return {"variant": chosen, "seed": row["seed"], "threshold": row["threshold"]} | {
        name: _figures(frames, *_detect(network, frames), row["threshold"], material.rims)
        for name, frames in kinds.items()
    }


_KINDS = {"real": False, "procedural": True}
"""Kinds of terrain, and whether their catalogue is complete."""


def _of_kind(material: Material, split: str, complete: bool) -> list[tuple[Dataset, Frame]]:
    return [(d, f) for d in material.datasets for f in d.frames(split) if f.complete == complete]


def _score(network: Any, material: Material, parameters: AblationParameters) -> dict[str, Any]:
    """Return the validation figures by kind of terrain, at the threshold of real frames if there are any."""
    scored = {}
    for name, complete in _KINDS.items():
        frames = _thin(_of_kind(material, "val", complete), parameters.validation_frames)
        scored[name] = (frames, *_detect(network, frames))
    decisive = scored["real"] if scored["real"][0] else scored["procedural"]
    if not decisive[0]:
        raise DatasetError("ablation: expected frames of the split 'val', found none")
    threshold, _ = best_threshold(tally(decisive[1], decisive[2]))
    return {
        "threshold": threshold,
        "validation": {
            name: _figures(frames, truths, found, threshold, material.rims)
            for name, (frames, truths, found) in scored.items()
        },
    }


def _detect(
    network: Any, frames: Sequence[tuple[Dataset, Frame]]
) -> tuple[list[FrameTruth], list[FrameDetections]]:
    from payload_emulator.training.evaluate.evaluate import detect_with_network

    return (
        [frame_truth(d, f) for d, f in frames],
        [detect_with_network(network, d, f) for d, f in frames],
    )


def _figures(
    frames: Sequence[tuple[Dataset, Frame]],
    truths: Sequence[FrameTruth],
    found: Sequence[FrameDetections],
    threshold: float,
    rims: RefittedRims | None,
) -> dict[str, Any]:
    strict, fair = tally(truths, found), tally(truths, found, ignore_aware=True)
    with np.errstate(invalid="ignore"):
        hit = strict.crater_score >= threshold
    clear = strict.crater_depth_ratio >= _CLEAR_DEPTH_RATIO
    return {
        "frames": len(frames),
        "strict": strict.figures(threshold).to_dict(),
        "ignore_aware": fair.figures(threshold).to_dict(),
        "recall_depth_ratio_006": float(hit[clear].mean()) if clear.any() else float("nan"),
        "refitted": None if rims is None else against_rims(frames, truths, found, threshold, rims),
    }


def format_ablation(rows: Sequence[Mapping[str, Any]], test: Mapping[str, Any] | None = None) -> str:
    """Return the validation figures as a table, the spread of the baseline, the chosen variant and its test figures."""
    lines = [
        f"{'validation':16}{'seed':>5}{'weights':>9}{'ms/crop':>9}{'real F1':>9}{'aware':>7}{'R d/D>.06':>11}"
        f"{'loc px':>8}{'on rims':>9}{'proc. F1':>10}"
    ]
    for row in rows:
        speed = "" if row["cpu_ms_per_crop"] is None else f"{row['cpu_ms_per_crop']:.0f}"
        lines.append(
            f"{row['variant']:16}{row['seed']:5d}{row['weights']:9d}{speed:>9}{_columns(row['validation'])}"
        )
    lines += [f"{row['variant']}: {row['title']}" for row in rows if row["variant"] != BASELINE]
    base = [validation_f1(row) for row in rows if row["variant"] == BASELINE]
    if len(base) > 1:
        lines.append(f"validation F1 of the recipe by seed: {', '.join(f'{value:.3f}' for value in base)}")
    if rows:
        lines.append(f"chosen on the validation split: {choose_variant(rows)}")
    if test is not None:
        lines.append(f"{'chosen, test':16}{test['seed']:5d}{'':18}{_columns(test)}")
    return "\n".join(lines)


def _columns(kinds: Mapping[str, Any]) -> str:
    real, rims = kinds["real"], kinds["real"]["refitted"]
    return (
        f"{real['strict']['f1']:9.3f}{real['ignore_aware']['f1']:7.3f}{real['recall_depth_ratio_006']:11.3f}"
        f"{real['strict']['loc_median_px']:8.2f}"
        f"{'' if rims is None else format(rims['refitted']['median_px'], '.2f'):>9}"
        f"{kinds['procedural']['strict']['f1']:10.3f}"
    )
