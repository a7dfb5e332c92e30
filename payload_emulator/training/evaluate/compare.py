"""Two networks on the same frames: figures of each, paired differences with intervals."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

from payload_emulator.training.data.dataset import Dataset
from payload_emulator.training.data.visibility import VISIBLE
from payload_emulator.training.evaluate.evaluate import Scored, evidence_level, open_for_evaluation, run
from payload_emulator.training.evaluate.metrics import score
from payload_emulator.training.evaluate.scoring import Tally, bootstrap_f1, bootstrap_f1_difference, tally

_RANGES_M = {"5_to_30_km": (5_000.0, 30_000.0), "3_to_30_km": (3_000.0, 30_000.0)}


def compare(
    models: tuple[bytes, bytes],
    datasets: Sequence[Dataset],
    split: str = "test",
    source: str = "",
    progress: Callable[[Sequence[Any]], Iterable[Any]] = iter,
) -> tuple[dict[str, Any], tuple[Scored, Scored]]:
    """Figures of a network and of a reference, each at its own on-board threshold, and their frames as scored.

    Raises
    ------
    DatasetError
        The split is empty, or the frames are of another camera than a detector's.
    """
    detectors = [open_for_evaluation(octets) for octets in models]
    one, other = (run(detector, datasets, split, source, progress=progress) for detector in detectors)
    rows = []
    for detector, scored in zip(detectors, (one, other), strict=True):
        figures = score(scored.truths, scored.found, scored.thresholds, scored.scenes)
        rows.append(
            {
                "sha256": detector.sha256,
                "threshold": scored.thresholds.on_board,
                **{f"strict_{name}": _with_interval(scored, *limits) for name, limits in _RANGES_M.items()},
                **{
                    f"visible_{name}": _with_interval(scored, *limits, VISIBLE)
                    for name, limits in _RANGES_M.items()
                },
                "bias_px": figures["bias_px"],
                "bias_px_registered": figures.get("bias_px_registered"),
                "sigma_calibration": figures["sigma_calibration"],
            }
        )
    differences = {
        f"{kind}_{name}": _difference((one, other), *limits, visible)
        for kind, visible in (("strict", 0.0), ("visible", VISIBLE))
        for name, limits in _RANGES_M.items()
    }
    return {
        "level": evidence_level([frame for _, frame in one.frames]),
        "frames": len(one.frames),
        "split": split,
        "source": source,
        "network": rows[0],
        "reference": rows[1],
        "f1_difference": differences,
    }, (one, other)


def _tallied(scored: Scored, low_m: float, high_m: float, visible_from: float = 0.0) -> Tally:
    return tally(scored.truths, scored.found, low_m=low_m, high_m=high_m, visible_from=visible_from)


def _with_interval(scored: Scored, low_m: float, high_m: float, visible_from: float = 0.0) -> dict[str, Any]:
    tallied, threshold = _tallied(scored, low_m, high_m, visible_from), scored.thresholds.on_board
    interval = list(bootstrap_f1(tallied, threshold))
    return {**tallied.figures(threshold).to_dict(), "f1_interval_95": interval}


def _difference(
    pair: tuple[Scored, Scored], low_m: float, high_m: float, visible_from: float
) -> dict[str, Any]:
    """F1 of the network less that of the reference, over the same resampled blocks of ground."""
    one, other = (_tallied(scored, low_m, high_m, visible_from) for scored in pair)
    thresholds = [scored.thresholds.on_board for scored in pair]
    low, high = bootstrap_f1_difference(one, other, thresholds[0], reference_threshold=thresholds[1])
    return {
        "value": one.figures(thresholds[0]).f1 - other.figures(thresholds[1]).f1,
        "interval_95": [low, high],
    }


def format_comparison(document: dict[str, Any]) -> str:
    """A line for each range and network, and the differences."""
    lines = [f"{document['frames']} frames of split {document['split']}, level {document['level']}"]
    for key, difference in document["f1_difference"].items():
        for name in ("reference", "network"):
            row = document[name][key]
            low, high = row["f1_interval_95"]
            lines.append(
                f"{key.replace('_', ' '):20} {name:9} P {row['precision']:.3f} R {row['recall']:.3f} "
                f"F1 {row['f1']:.3f} [{low:.2f}, {high:.2f}] median {row['loc_median_px']:.2f} px of {row['expected']}"
            )
        low, high = difference["interval_95"]
        lines.append(f"{'':20} difference of F1 {difference['value']:+.3f} [{low:+.3f}, {high:+.3f}]")
    for name in ("reference", "network"):
        row = document[name]
        bias, sigma = row["bias_px"], row["sigma_calibration"]
        alone = row["bias_px_registered"] or bias
        lines.append(
            f"{name}: longest bias by Sun octant {bias['worst_octant_px']:.2f} px (noise "
            f"{bias['worst_octant_noise_px']:.2f}), without registration "
            f"{alone['worst_octant_px']:.2f} ({alone['worst_octant_noise_px']:.2f}); "
            f"rms of error over sigma {sigma['rms']:.2f}, inside one sigma {sigma['inside_one_sigma']:.2f}"
        )
    return "\n".join(lines)
