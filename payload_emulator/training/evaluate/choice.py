"""Which of several networks flies: that with the greatest F1 on the validation split; nothing else is looked at."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from payload_emulator.errors import DatasetError
from payload_emulator.training.data.dataset import Dataset
from payload_emulator.training.evaluate.evaluate import open_for_evaluation, run
from payload_emulator.training.evaluate.scoring import best_threshold, bootstrap_f1, tally


def choose(
    models: Mapping[str, bytes],
    datasets: Sequence[Dataset],
    progress: Callable[[Sequence[Any]], Iterable[Any]] = iter,
) -> dict[str, Any]:
    """Strict figures of each model on the validation frames, on real terrain where there are any, and the best one.

    Each at the threshold of its own greatest F1, so that none gains by a threshold fixed on these very frames.

    Raises
    ------
    DatasetError
        There are no validation frames, or they are of another camera than a detector's.
    """
    rows: dict[str, dict[str, Any]] = {}
    for name, octets in models.items():
        detector = open_for_evaluation(octets)
        scored = run(detector, datasets, "val", progress=progress)
        real = [k for k, (_, frame) in enumerate(scored.frames) if not frame.complete]
        chosen = real or list(range(len(scored.frames)))
        tallied = tally([scored.truths[k] for k in chosen], [scored.found[k] for k in chosen])
        threshold, figures = best_threshold(tallied)
        rows[name] = {
            "sha256": detector.sha256,
            "frames": len(chosen),
            "threshold": threshold,
            **figures.to_dict(),
            "f1_interval_95": list(bootstrap_f1(tallied, threshold)),
        }
    if not rows:
        raise DatasetError("choice of a network: expected at least one model, found none")
    return {"models": rows, "chosen": max(rows, key=lambda name: float(rows[name]["f1"]))}


def format_choice(document: Mapping[str, Any]) -> str:
    """A line for each model, and which it is."""
    lines = [
        f"{name}: F1 {row['f1']:.3f} [{row['f1_interval_95'][0]:.2f}, {row['f1_interval_95'][1]:.2f}] (P "
        f"{row['precision']:.3f} R {row['recall']:.3f} loc {row['loc_px']:.2f} px at {row['threshold']:.2f}, "
        f"{row['frames']} validation frames)"
        for name, row in document["models"].items()
    ]
    return "\n".join([*lines, f"chosen: {document['chosen']}"])
