"""The index and the COCO files of a finished data set."""

import hashlib
import json
import math
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lunar.arrays import FloatArray
from lunar.catalogue import size_class
from payload_emulator.session.world.recipe import SPLITS, Recipe
from payload_emulator.training.data import dataset
from payload_emulator.training.data.targets import Tier

FIRST_ID = 1
"""COCO readers take 0 for "no annotation" and for the background, so images, categories and annotations begin at 1."""

RIM_VERTICES = 32
"""Number of vertices of a rim polygon, plus its extreme points: the area is at most 0.6 % too small."""


def write_index(folder: Path, recipe: Recipe, frames: int, shards: dict[str, str], data_names: Sequence[str]) -> None:
    """Write the COCO files and, last, dataset.json with the hashes of them and of the shards."""
    files = _write_coco(folder, recipe, sorted(shards))
    index = {
        "schema_version": dataset.SCHEMA_VERSION,
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
    dataset.write_whole(folder / "dataset.json", json.dumps(index, indent=1, sort_keys=True).encode())


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
            for frame in dataset.shard_frames(dataset.load_shard(folder / "shards" / f"{name}.npz")):
                writers[frame.split].add(frame)
        return {writer.path.name: writer.finish() for writer in writers.values()}
    finally:
        for writer in writers.values():
            writer.abandon()


class _CocoFile:
    """COCO file written to a temporary file: annotations as they arrive, then the images."""

    def __init__(self, path: Path, recipe: Recipe) -> None:
        self.path = path
        self._size = recipe.width_px, recipe.height_px
        self._unfinished = path.with_name(f".{path.name}.{os.getpid()}")
        self._out = self._unfinished.open("wb")
        self._digest = hashlib.sha256()
        self._images: list[tuple[int, float]] = []
        self._count = 0
        categories = [
            {"id": number + FIRST_ID, "name": name, "supercategory": "crater"} for number, name in dataset.CATEGORIES
        ]
        head = {
            "info": {"description": recipe.name, "version": str(dataset.SCHEMA_VERSION)},
            "licenses": [],
            "categories": categories,
        }
        self._write(json.dumps(head)[:-1] + ', "annotations": [')

    def add(self, frame: dataset.Frame) -> None:
        self._images.append((frame.number, round(math.degrees(frame.sun_azimuth_rad) % 360.0, 3)))
        for annotation in _annotations(frame, *self._size):
            self._count += 1
            self._write((", " if self._count > 1 else "") + json.dumps({"id": self._count} | annotation))

    def finish(self) -> str:
        images = [
            {
                "id": number + FIRST_ID,
                "file_name": f"images/{number:06d}.png",
                "width": self._size[0],
                "height": self._size[1],
                "sun_azimuth_deg": azimuth,
            }
            for number, azimuth in self._images
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


def _annotations(frame: dataset.Frame, width_px: int, height_px: int) -> Iterator[dict[str, Any]]:
    """COCO annotations of a frame's craters, in pixels from the corner of the first pixel.

    Segmentation, box and area are those of the part of the rim's ellipse that lies in the image. Under `ellipse`, the
    whole ellipse is given as centre u, v (from the centre of the first pixel), half-axes, and angle of the major one
    from +u toward +v in degrees.
    """
    craters = frame.craters
    classes = size_class(craters["diameter_m"].astype(np.float64))
    tiers, _ = dataset.choose_tiers(craters, width_px, height_px, frame.complete)
    for k in np.flatnonzero(dataset.in_picture(craters, width_px, height_px) & (classes >= 0)):
        u, v, d = (float(craters[name][k]) for name in ("u_px", "v_px", "diameter_px"))
        a, b = 0.5 * float(craters["major_px"][k]), 0.5 * float(craters["minor_px"][k])
        angle = float(craters["angle_rad"][k])
        rim = clipped(ellipse_polygon(u + 0.5, v + 0.5, a, b, angle), width_px, height_px)
        low, high = rim.min(axis=0), rim.max(axis=0)
        yield {
            "image_id": frame.number + FIRST_ID,
            "category_id": int(classes[k]) + FIRST_ID,
            "bbox": [round(float(value), 2) for value in (*low, *(high - low))],
            "area": round(polygon_area(rim), 1),
            "segmentation": [[round(float(value), 2) for value in rim.ravel()]],
            "iscrowd": 0,
            "centre": [round(u, 3), round(v, 3)],
            "diameter": round(d, 3),
            "ellipse": [round(u, 3), round(v, 3), round(a, 3), round(b, 3), round(math.degrees(angle), 2)],
            "visible": round(float(craters["visible"][k]), 3),
            "crater_id": int(craters["id"][k]),
            "depth_ratio": round(float(np.nan_to_num(craters["depth_ratio"][k])), 4),
            "ignore": int(tiers[k] != Tier.LABEL),
        }


def ellipse_polygon(x: float, y: float, a: float, b: float, angle_rad: float) -> FloatArray:
    """Return a polygon (n, 2) on an ellipse, its leftmost, rightmost, topmost and lowest points among the vertices.

    Parameters
    ----------
    x, y
        Centre.
    a, b
        Half-axes, the major one first.
    angle_rad
        Angle of the major axis from +x toward +y.
    """
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    across, along = math.atan2(-b * sin, a * cos), math.atan2(b * cos, a * sin)
    extremes = np.array([across, across + math.pi, along, along + math.pi])
    around = np.concatenate([np.arange(RIM_VERTICES) * (2.0 * math.pi / RIM_VERTICES), extremes])
    t = np.unique(around % (2.0 * math.pi))
    return np.column_stack(
        [x + a * np.cos(t) * cos - b * np.sin(t) * sin, y + a * np.cos(t) * sin + b * np.sin(t) * cos]
    )


def clipped(polygon: FloatArray, width: float, height: float) -> FloatArray:
    """Return the part of a convex polygon (n, 2) in the rectangle from (0, 0) to (width, height); (0, 2) for none.

    References
    ----------
    Sutherland and Hodgman, "Reentrant polygon clipping", Communications of the ACM 17 (1974).
    """
    for axis, sign, limit in ((0, 1.0, 0.0), (0, -1.0, -width), (1, 1.0, 0.0), (1, -1.0, -height)):
        kept: list[FloatArray] = []
        inside = sign * polygon[:, axis] - limit
        for k in range(len(polygon)):
            before, here = inside[k - 1], inside[k]
            if (before < 0.0) != (here < 0.0):
                crossing = polygon[k - 1] + before / (before - here) * (polygon[k] - polygon[k - 1])
                crossing[axis] = sign * limit
                kept.append(crossing)
            if here >= 0.0:
                kept.append(polygon[k])
        polygon = np.array(kept).reshape(-1, 2)
    return polygon


def polygon_area(polygon: FloatArray) -> float:
    """Return the area of a polygon (n, 2) without crossings."""
    x, y = polygon.T
    return 0.5 * abs(float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)))
