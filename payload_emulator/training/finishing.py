"""The index and the COCO files of a finished data set."""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lunar.catalogue import size_class
from payload_emulator.training.dataset import (
    CATEGORIES,
    SCHEMA_VERSION,
    Frame,
    choose_tiers,
    in_picture,
    load_shard,
    shard_frames,
    write_whole,
)
from payload_emulator.training.recipe import SPLITS, Recipe
from payload_emulator.training.targets import Tier


def write_index(
    folder: Path, recipe: Recipe, frames: int, shards: dict[str, str], data_names: Sequence[str]
) -> None:
    """Write the COCO files and, last, dataset.json with the hashes of them and of the shards."""
    files = {
        f"coco_{split}.json": _write_coco(
            folder / f"coco_{split}.json", folder, recipe, sorted(shards), split
        )
        for split in SPLITS
    }
    index = {
        "schema_version": SCHEMA_VERSION,
        "name": recipe.name,
        "recipe": recipe.to_dict(),
        "recipe_sha256": recipe.digest,
        "camera": {"width_px": recipe.width_px, "height_px": recipe.height_px, "fov_deg": recipe.fov_deg},
        "frames": frames,
        "data": list(data_names),
        "shards": shards,
        "files": files,
    }
    index["sha256"] = index_digest(index)
    write_whole(folder / "dataset.json", json.dumps(index, indent=1, sort_keys=True).encode())


def index_digest(index: dict[str, Any]) -> str:
    """Hash of an index's content but for the hash itself."""
    content = {key: value for key, value in index.items() if key != "sha256"}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _write_coco(path: Path, folder: Path, recipe: Recipe, shards: Sequence[str], split: str) -> str:
    """Write the annotations of a split piece by piece, as a month of orbit has millions; SHA-256 comes back."""
    digest = hashlib.sha256()
    unfinished = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with unfinished.open("wb") as out:
            for text in _coco_text(folder, recipe, shards, split):
                octets = text.encode()
                digest.update(octets)
                out.write(octets)
        unfinished.replace(path)
    except OSError:
        unfinished.unlink(missing_ok=True)
        raise
    return digest.hexdigest()


def _coco_text(folder: Path, recipe: Recipe, shards: Sequence[str], split: str) -> Iterator[str]:
    """The COCO object of a split as pieces of JSON."""

    def frames() -> Iterator[Frame]:
        for name in shards:
            for frame in shard_frames(load_shard(folder / "shards" / f"{name}.npz")):
                if frame.split == split:
                    yield frame

    head = {
        "info": {"description": recipe.name, "version": str(SCHEMA_VERSION)},
        "categories": [
            {"id": number, "name": name, "supercategory": "crater"} for number, name in CATEGORIES
        ],
    }
    yield json.dumps(head)[:-1] + ', "images": ['
    for n, frame in enumerate(frames()):
        yield (", " if n else "") + json.dumps(
            {
                "id": frame.number,
                "file_name": f"images/{frame.number:06d}.png",
                "width": recipe.width_px,
                "height": recipe.height_px,
            }
        )
    yield '], "annotations": ['
    count = 0
    for frame in frames():
        for annotation in _annotations(frame, recipe.width_px, recipe.height_px):
            yield (", " if count else "") + json.dumps({"id": count + 1} | annotation)
            count += 1
    yield "]}"


def _annotations(frame: Frame, width_px: int, height_px: int) -> Iterator[dict[str, Any]]:
    """COCO annotations of a frame's craters; boxes surround the rim's ellipse, from the corner of the first pixel.

    An ellipse is given as centre u, v, half-axes, angle of the major one from +u toward +v in degrees.
    """
    craters = frame.craters
    classes = size_class(craters["diameter_m"].astype(np.float64))
    tiers, _ = choose_tiers(craters, width_px, height_px, frame.complete)
    for k in np.flatnonzero(in_picture(craters, width_px, height_px) & (classes >= 0)):
        u, v, d = (float(craters[name][k]) for name in ("u_px", "v_px", "diameter_px"))
        a, b = 0.5 * float(craters["major_px"][k]), 0.5 * float(craters["minor_px"][k])
        angle = float(craters["angle_rad"][k])
        half_width = math.hypot(a * math.cos(angle), b * math.sin(angle))
        half_height = math.hypot(a * math.sin(angle), b * math.cos(angle))
        box = (u - half_width + 0.5, v - half_height + 0.5, 2.0 * half_width, 2.0 * half_height)
        yield {
            "image_id": frame.number,
            "category_id": int(classes[k]),
            "bbox": [round(value, 2) for value in box],
            "area": round(math.pi * a * b, 1),
            "iscrowd": 0,
            "centre": [round(u, 3), round(v, 3)],
            "diameter": round(d, 3),
            "ellipse": [
                round(u, 3),
                round(v, 3),
                round(a, 3),
                round(b, 3),
                round(math.degrees(angle), 2),
            ],
            "visible": round(float(craters["visible"][k]), 3),
            "crater_id": int(craters["id"][k]),
            "depth_ratio": round(float(np.nan_to_num(craters["depth_ratio"][k])), 4),
            "ignore": int(tiers[k] != Tier.LABEL),
        }
