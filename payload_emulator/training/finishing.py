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
    files = _write_coco(folder, recipe, sorted(shards))
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


def _write_coco(folder: Path, recipe: Recipe, shards: Sequence[str]) -> dict[str, str]:
    """Write the annotations of all splits in one reading of the shards; SHA-256 of each file comes back.

    Piece by piece, as a month of orbit has millions of annotations.
    """
    writers = {split: _CocoFile(folder / f"coco_{split}.json", recipe) for split in SPLITS}
    try:
        for name in shards:
            for frame in shard_frames(load_shard(folder / "shards" / f"{name}.npz")):
                writers[frame.split].add(frame)
        return {writer.path.name: writer.finish() for writer in writers.values()}
    finally:
        for writer in writers.values():
            writer.abandon()


class _CocoFile:
    """A COCO object that grows beside its place: annotations as they come, then the images."""

    def __init__(self, path: Path, recipe: Recipe) -> None:
        self.path = path
        self._size = recipe.width_px, recipe.height_px
        self._unfinished = path.with_name(f".{path.name}.{os.getpid()}")
        self._out = self._unfinished.open("wb")
        self._digest = hashlib.sha256()
        self._images: list[int] = []
        self._count = 0
        categories = [{"id": number, "name": name, "supercategory": "crater"} for number, name in CATEGORIES]
        head = {
            "info": {"description": recipe.name, "version": str(SCHEMA_VERSION)},
            "categories": categories,
        }
        self._write(json.dumps(head)[:-1] + ', "annotations": [')

    def add(self, frame: Frame) -> None:
        self._images.append(frame.number)
        for annotation in _annotations(frame, *self._size):
            self._count += 1
            self._write((", " if self._count > 1 else "") + json.dumps({"id": self._count} | annotation))

    def finish(self) -> str:
        images = [
            {
                "id": number,
                "file_name": f"images/{number:06d}.png",
                "width": self._size[0],
                "height": self._size[1],
            }
            for number in self._images
        ]
        self._write(f'], "images": {json.dumps(images)}}}')
        self._out.close()
        self._unfinished.replace(self.path)
        return self._digest.hexdigest()

    def abandon(self) -> None:
        self._out.close()
        self._unfinished.unlink(missing_ok=True)

    def _write(self, text: str) -> None:
        octets = text.encode()
        self._digest.update(octets)
        self._out.write(octets)


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
