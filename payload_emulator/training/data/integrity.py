"""Integrity check of a data set on disk: every file exists, is unchanged and can be read."""

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from payload_emulator.errors import DatasetError
from payload_emulator.session.world.recipe import PAPER_SHARES, SPLITS
from payload_emulator.training.data.dataset import Dataset, ShardLabels, count_instances, load_shard, read_gray
from payload_emulator.training.data.finishing import index_digest
from reports.published import FRAMES as PAPER_FRAMES
from reports.published import LABELS as PAPER_INSTANCES


def check(folder: Path) -> list[str]:
    """Return the missing or damaged files of a data set, one line each; empty if the data set is intact.

    Files are compared with their recorded hashes. In older data sets without hashes of images and metadata, the images
    must be readable and the metadata files must exist.

    Raises
    ------
    DatasetError
        If the data set does not exist or is unfinished.
    """
    try:
        index: dict[str, Any] = json.loads((folder / "dataset.json").read_text(encoding="utf-8"))
    except FileNotFoundError:
        found = "an unfinished one" if (folder / "recipe.json").is_file() else "none"
        raise DatasetError(f"{folder}: expected a data set (dataset.json), found {found}") from None
    except (OSError, ValueError) as error:
        return [f"{folder / 'dataset.json'}: expected a JSON object, found: {error}; build again to replace it"]
    return list(_problems(folder, index))


def _problems(folder: Path, index: dict[str, Any]) -> Iterator[str]:
    if "sha256" in index and index["sha256"] != index_digest(index):
        yield f"{folder / 'dataset.json'}: expected content of SHA-256 {index['sha256']}, found other; build again"
    for name, expected in sorted(index.get("files", {}).items()):
        yield from _against(folder / name, expected, "build again to replace it")
    frames = 0
    for name, expected in sorted(index["shards"].items()):
        path = folder / "shards" / f"{name}.npz"
        damage = list(_against(path, expected, "delete it and build again to replace its frames"))
        yield from damage
        if damage and not path.is_file():
            continue
        try:
            labels = load_shard(path)
        except DatasetError as error:
            if not damage:
                yield str(error)
            continue
        frames += labels.first.size - 1
        yield from _frames(folder, index, name, labels)
    if frames != index["frames"] and not any(
        not (folder / "shards" / f"{name}.npz").is_file() for name in index["shards"]
    ):
        yield f"{folder}: expected {index['frames']} frames, found the labels of {frames}"


def _frames(folder: Path, index: dict[str, Any], shard: str, labels: ShardLabels) -> Iterator[str]:
    cure = f"delete shards/{shard}.npz and build again to replace it"
    size = int(index["camera"]["height_px"]), int(index["camera"]["width_px"])
    for k, number in enumerate(labels.frames["number"].astype(int)):
        image = folder / "images" / f"{number:06d}.png"
        metadata = folder / "metadata" / f"{number:06d}.json"
        if labels.image_sha256:
            yield from _against(image, labels.image_sha256[k], cure)
        else:
            yield from _picture(image, size)
        if labels.metadata_sha256:
            yield from _against(metadata, labels.metadata_sha256[k], cure)
        elif not metadata.is_file():
            yield f"{metadata}: expected frame metadata, found no file"


def _against(path: Path, expected: str, cure: str) -> Iterator[str]:
    try:
        found = hashlib.sha256(path.read_bytes()).hexdigest()
    except FileNotFoundError:
        yield f"{path}: expected a file of SHA-256 {expected}, found none; {cure}"
        return
    except OSError as error:
        yield f"{path}: {error.strerror}"
        return
    if found != expected:
        yield f"{path}: expected SHA-256 {expected}, found {found}; {cure}"


def _picture(path: Path, size: tuple[int, int]) -> Iterator[str]:
    try:
        image = read_gray(path)
    except DatasetError as error:
        yield str(error)
        return
    if image.shape != size:
        yield (f"{path}: expected {size[1]} x {size[0]} pixels, found {image.shape[1]} x {image.shape[0]} pixels")


def summarise(folder: Path) -> dict[str, Any]:
    """Counts of a data set and of the paper's; instances are of the three classes, per frame too."""
    dataset = Dataset(folder)
    frames = dataset.frames()
    splits = {split: dataset.frames(split) for split in SPLITS}
    return {
        **_counts(len(frames), count_instances(frames, dataset.width_px, dataset.height_px)),
        "split": {split: len(found) for split, found in splits.items()},
        "instances_by_split": {
            split: count_instances(found, dataset.width_px, dataset.height_px) for split, found in splits.items()
        },
        "sources": {name: sum(f.source == name for f in frames) for name in sorted({f.source for f in frames})},
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
