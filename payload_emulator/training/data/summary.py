"""Summary of a data set: frames by split and source, and crater instances by class, compared with the paper's."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from payload_emulator.session.recipe import PAPER_SHARES, SPLITS
from payload_emulator.training.data.dataset import Dataset, count_instances
from reports.published import FRAMES as PAPER_FRAMES
from reports.published import LABELS as PAPER_INSTANCES


def summarise(folder: Path) -> dict[str, Any]:
    """Counts of a data set and of the paper's; instances are of the three classes, per frame too."""
    dataset = Dataset(folder)
    frames = dataset.frames()
    splits = {split: dataset.frames(split) for split in SPLITS}
    return {
        **_counts(len(frames), count_instances(frames, dataset.width_px, dataset.height_px)),
        "split": {split: len(found) for split, found in splits.items()},
        "instances_by_split": {
            split: count_instances(found, dataset.width_px, dataset.height_px)
            for split, found in splits.items()
        },
        "sources": {
            name: sum(f.source == name for f in frames) for name in sorted({f.source for f in frames})
        },
        "paper": _counts(PAPER_FRAMES, list(PAPER_INSTANCES.values())) | {"split_shares": list(PAPER_SHARES)},
        "labels_sha256": dataset.digest,
        "data": dataset.index["data"],
    }


def _counts(frames: int, instances: list[int]) -> dict[str, Any]:
    total = max(sum(instances), 1)
    return {
        "frames": frames,
        "instances": instances,
        "shares": [count / total for count in instances],
        "instances_per_frame": [count / max(frames, 1) for count in instances],
    }
