"""The same scenes by several renderers, detected by one network and scored against one set of labels.

What the detector finds must not hang on the renderer that its training frames came from.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from lunar.arrays import BoolArray
from payload_emulator.errors import DatasetError
from payload_emulator.training.data.dataset import Dataset, Frame, frame_truth
from payload_emulator.training.data.truth import FrameTruth
from payload_emulator.training.evaluate.evaluate import (
    detect_with_model,
    evidence_level,
    open_for_evaluation,
    refuse_other_camera,
)
from payload_emulator.training.evaluate.scoring import (
    FrameDetections,
    Tally,
    bootstrap_f1,
    bootstrap_f1_difference,
    tally,
)


def compare_renderers(
    model_octets: bytes,
    datasets: Sequence[Dataset],
    split: str = "test",
    threshold: float | None = None,
    progress: Callable[[Sequence[Any]], Any] = iter,
) -> dict[str, Any]:
    """F1 of a network on the scenes that data sets of one recipe have in common, one row per data set and terrain.

    The first data set is the reference: its labels score all, and the others' F1 less its own has a paired interval
    (the same blocks of ground are drawn for both).  `threshold` None takes the model's own, fixed on validation.

    Raises
    ------
    DatasetError
        There are fewer than two data sets, they have no scene in common, or another camera than the detector's.
    """
    if len(datasets) < 2:
        raise DatasetError(
            f"detector domain: expected the data sets of two renderers or more, found {len(datasets)}"
        )
    detector = open_for_evaluation(model_octets)
    for dataset in datasets:
        refuse_other_camera(detector, dataset)
    scenes = common_scenes(datasets, split)
    chosen = threshold
    if chosen is None:
        chosen = float(detector.metadata.get("score_threshold", "0.4"))
    jobs = [(n, k) for n in range(len(datasets)) for k in range(len(scenes))]
    found: list[list[FrameDetections]] = [[] for _ in datasets]
    for n, k in progress(jobs):
        found[n].append(detect_with_model(detector, datasets[n], scenes[k][n]))
    truths = [frame_truth(datasets[0], frames[0]) for frames in scenes]
    sources = np.array([frames[0].source for frames in scenes])
    groups = {"all": np.ones(len(scenes), bool)} | {
        str(name): sources == name for name in (np.unique(sources) if np.unique(sources).size > 1 else ())
    }
    return {
        "model_sha256": detector.sha256,
        "threshold": chosen,
        "scenes": len(scenes),
        "left_out": len(datasets[0].frames(split)) - len(scenes),
        "level": evidence_level([frames[0] for frames in scenes]),
        "data": sorted({str(name) for name in datasets[0].index["data"]}),
        "renderers": [
            {"renderer": renderer_of(dataset), "dataset_sha256": dataset.digest}
            | {name: _figures(truths, found[n], found[0], mask, chosen) for name, mask in groups.items()}
            for n, dataset in enumerate(datasets)
        ],
    }


def renderer_of(dataset: Dataset) -> str:
    """Name of the renderer that a data set was made by."""
    return str(dataset.index["recipe"].get("renderer", "fast"))


def common_scenes(datasets: Sequence[Dataset], split: str) -> list[tuple[Frame, ...]]:
    """Frames of a split that show the same place from the same camera under the same Sun in every data set.

    Raises
    ------
    DatasetError
        There are none.
    """
    others = [{frame.number: frame for frame in dataset.frames(split)} for dataset in datasets[1:]]
    scenes = []
    for frame in datasets[0].frames(split):
        twins = [frames.get(frame.number) for frames in others]
        same = [twin for twin in twins if twin is not None and _same_scene(frame, twin)]
        if len(same) == len(others):
            scenes.append((frame, *same))
    if not scenes:
        names = ", ".join(str(dataset.folder) for dataset in datasets)
        raise DatasetError(f"{names}: expected frames of the same scenes in split {split!r}, found none")
    return scenes


def _same_scene(one: Frame, other: Frame) -> bool:
    return (
        np.array_equal(one.position_mcmf_m, other.position_mcmf_m)
        and np.array_equal(one.camera_from_mcmf, other.camera_from_mcmf)
        and np.array_equal(one.sun_camera, other.sun_camera)
    )


def _figures(
    truths: Sequence[FrameTruth],
    found: Sequence[FrameDetections],
    reference: Sequence[FrameDetections],
    mask: BoolArray,
    threshold: float,
) -> dict[str, Any]:
    chosen = [int(k) for k in np.flatnonzero(mask)]

    def tallied(of: Sequence[FrameDetections], fair: bool) -> Tally:
        return tally([truths[k] for k in chosen], [of[k] for k in chosen], ignore_aware=fair)

    row: dict[str, Any] = {"scenes": len(chosen)}
    for name, fair in (("strict", False), ("ignore_aware", True)):
        own, theirs = tallied(found, fair), tallied(reference, fair)
        figures = own.figures(threshold)
        row[name] = figures.to_dict() | {
            "f1_interval_95": list(bootstrap_f1(own, threshold)),
            "f1_less_reference": figures.f1 - theirs.figures(threshold).f1,
            "f1_less_reference_interval_95": list(bootstrap_f1_difference(own, theirs, threshold)),
        }
    return row


def format_domains(figures: dict[str, Any]) -> str:
    """The figures as a short table."""
    lines = [
        f"{figures['scenes']} scenes (evidence level {figures['level']}); threshold {figures['threshold']:.2f} "
        "(fixed on validation); craters of 5-30 km; differences to the first renderer with paired 95 % intervals",
        f"{'':34}{'P':>7}{'R':>7}{'F1':>7}{'interval':>16}{'difference':>12}{'interval':>18}",
    ]
    for row in figures["renderers"]:
        for name in (key for key in row if key not in ("renderer", "dataset_sha256")):
            for rule in ("strict", "ignore_aware"):
                at = row[name][rule]
                low, high = at["f1_interval_95"]
                less, more = at["f1_less_reference_interval_95"]
                title = f"{row['renderer']}, {name}, {rule.replace('_', '-')}"
                lines.append(
                    f"{title:34}{at['precision']:7.3f}{at['recall']:7.3f}{at['f1']:7.3f}"
                    f"{f'{low:.3f}..{high:.3f}':>16}{at['f1_less_reference']:+12.3f}"
                    f"{f'{less:+.3f}..{more:+.3f}':>18}"
                )
    return "\n".join(lines)
