"""Data sets on disk: frames as gray PNG, one labels file per shard, COCO and metadata as JSON for exchange.

Layout of the folder::

    dataset.json            recipe, camera, counts, data sources, hashes of the shards
    images/000123.png       8-bit gray, the mean of the sensor's colour channels, as the camera saw it (not turned)
    metadata/000123.json    pose, corner coordinates, Sun vector
    shards/0006.npz         labels and poses of the frames of one shard; written last, so that its presence means "done"
    coco_train.json ...     COCO annotations by split

Every catalogued crater in view of 2 km and more is listed, whatever its state; what is a label and what is ignored is
decided when training (`choose_tiers`), and scoring has its own rules.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lunar.catalogue import size_class
from payload_emulator.errors import DatasetError
from payload_emulator.training.recipe import SPLITS, Recipe
from payload_emulator.training.scoring import FrameTruth
from payload_emulator.training.targets import Tier

SCHEMA_VERSION = 1
CATEGORIES = ((0, "5-10 km"), (1, "10-15 km"), (2, "15-30 km"), (3, "3-5 km"))

# Label tier: what a network can fairly be asked to find.
LABEL_MINIMUM_DIAMETER_PX = 10.0
LABEL_MINIMUM_DIAMETER_M = 2_500.0  # the real terrain resolves nothing smaller
LABEL_MINIMUM_DEPTH_RATIO = 0.025
FULL_WEIGHT_DEPTH_RATIO = 0.06
LABEL_MINIMUM_LIT = 0.06
LABEL_MAXIMUM_DIAMETER_PX = 380.0

CRATER_COLUMNS = (
    "id",
    "u_px",
    "v_px",
    "diameter_px",
    "diameter_m",
    "depth_ratio",
    "lit",
    "hidden",
    "latitude_deg",
    "longitude_deg",
)
FRAME_COLUMNS = (
    "number",
    "latitude_deg",
    "longitude_deg",
    "altitude_m",
    "ground_m",
    "sun_elevation_deg",
    "sun_azimuth_deg",
    "block",
)


@dataclass(frozen=True, slots=True, eq=False)
class ShardLabels:
    """Labels of one shard: frame columns (f,), sun_camera (f, 3), camera_from_mcmf (f, 3, 3), position_mcmf_m (f, 3),
    crater columns (n,) in frame order with `first` (f + 1,) marking where each frame's craters begin."""

    source: str
    split: str
    complete: bool
    frames: dict[str, NDArray[Any]]
    sun_camera: NDArray[np.float64]
    camera_from_mcmf: NDArray[np.float64]
    position_mcmf_m: NDArray[np.float64]
    craters: dict[str, NDArray[Any]]
    first: NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One frame of a data set with its labels; crater columns as `CRATER_COLUMNS`."""

    number: int
    source: str
    split: str
    complete: bool
    values: dict[str, float]
    sun_camera: NDArray[np.float64]
    camera_from_mcmf: NDArray[np.float64]
    position_mcmf_m: NDArray[np.float64]
    craters: dict[str, NDArray[Any]]


class Dataset:
    """A data set opened for reading.

    Raises
    ------
    DatasetError
        The folder holds no data set, an unfinished one, or one of another schema.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        index = folder / "dataset.json"
        try:
            self.index: dict[str, Any] = json.loads(index.read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise DatasetError(f"{folder}: expected a data set (dataset.json), found none") from None
        except (OSError, ValueError) as error:
            raise DatasetError(f"{index}: expected a JSON object, found: {error}") from error
        if self.index.get("schema_version") != SCHEMA_VERSION:
            raise DatasetError(
                f"{index}: schema_version: expected {SCHEMA_VERSION}, found {self.index.get('schema_version')!r}"
            )
        self._frames: list[Frame] = []
        for name in sorted(self.index["shards"]):
            self._frames.extend(shard_frames(load_shard(folder / "shards" / f"{name}.npz")))

    @property
    def width_px(self) -> int:
        return int(self.index["camera"]["width_px"])

    @property
    def height_px(self) -> int:
        return int(self.index["camera"]["height_px"])

    @property
    def focal_px(self) -> float:
        return self.width_px / 2.0 / math.tan(math.radians(self.index["camera"]["fov_deg"]) / 2.0)

    @property
    def digest(self) -> str:
        """Hash over the labels of all shards."""
        shards = self.index["shards"]
        return hashlib.sha256("".join(shards[name] for name in sorted(shards)).encode()).hexdigest()

    def frames(self, split: str = "", source: str = "") -> list[Frame]:
        """Frames of a split and a source; every one where not named."""
        return [
            f for f in self._frames if (not split or f.split == split) and (not source or f.source == source)
        ]

    def image(self, frame: Frame) -> NDArray[np.uint8]:
        """Gray image (H, W) of a frame."""
        return read_gray(self.folder / "images" / f"{frame.number:06d}.png")


def choose_tiers(
    craters: dict[str, NDArray[Any]], width_px: int, height_px: int, complete: bool
) -> tuple[NDArray[np.int8], NDArray[np.float64]]:
    """Tier and weight of the craters of a frame, (n,) each, by what can be seen of them.

    `complete` (procedural terrain) says that the terrain shows craters of any size; real terrain does so only for those
    stamped on it (negative id) and for what its rasters resolve.
    """
    resolved = complete | (craters["id"] < 0) | (craters["diameter_m"] >= LABEL_MINIMUM_DIAMETER_M)
    inside = (
        (craters["u_px"] >= 2.0)
        & (craters["u_px"] <= width_px - 3.0)
        & (craters["v_px"] >= 2.0)
        & (craters["v_px"] <= height_px - 3.0)
    )
    label = (
        inside
        & (craters["diameter_px"] >= LABEL_MINIMUM_DIAMETER_PX)
        & (craters["diameter_px"] <= LABEL_MAXIMUM_DIAMETER_PX)
        & resolved
        & (craters["depth_ratio"] >= LABEL_MINIMUM_DEPTH_RATIO)
        & (craters["lit"] >= LABEL_MINIMUM_LIT)
        & ~craters["hidden"].astype(bool)
    )
    span = FULL_WEIGHT_DEPTH_RATIO - LABEL_MINIMUM_DEPTH_RATIO
    weight = np.clip(0.3 + 0.7 * (craters["depth_ratio"] - LABEL_MINIMUM_DEPTH_RATIO) / span, 0.3, 1.0)
    return np.where(label, Tier.LABEL, Tier.IGNORE).astype(np.int8), np.nan_to_num(weight, nan=0.3)


def frame_truth(dataset: Dataset, frame: Frame) -> FrameTruth:
    """The frame's catalogued craters as scoring wants them."""
    listed = frame.craters["id"] >= 0
    craters = {key: values[listed] for key, values in frame.craters.items()}
    return FrameTruth(
        u_px=craters["u_px"].astype(np.float64),
        v_px=craters["v_px"].astype(np.float64),
        diameter_px=craters["diameter_px"].astype(np.float64),
        diameter_m=craters["diameter_m"].astype(np.float64),
        depth_ratio=np.nan_to_num(craters["depth_ratio"].astype(np.float64), nan=0.0),
        ids=craters["id"].astype(np.int64),
        width_px=dataset.width_px,
        height_px=dataset.height_px,
        sun_azimuth_image_rad=float(np.arctan2(frame.sun_camera[0], -frame.sun_camera[1])),
        block=int(frame.values["block"]),
    )


def diameter_on_ground_m(
    dataset: Dataset,
    frame: Frame,
    u_px: NDArray[np.float64],
    v_px: NDArray[np.float64],
    diameter_px: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Diameters that a payload knowing its altitude above the mean ground gives to detections of the frame."""
    from lunar.camera import PinholeCamera, intersect_sphere
    from lunar.constants import MOON_RADIUS_M

    camera = PinholeCamera(
        dataset.width_px, dataset.height_px, math.radians(dataset.index["camera"]["fov_deg"])
    )
    rays = camera.rays(np.stack([u_px, v_px], axis=-1))
    heading = rays @ frame.camera_from_mcmf
    ground = MOON_RADIUS_M + frame.values["ground_m"]
    reach = intersect_sphere(frame.position_mcmf_m, heading, ground)
    return np.asarray(diameter_px * reach * rays[..., 2] / camera.focal_px)


def write_shard(folder: Path, name: str, labels: ShardLabels) -> str:
    """Write the labels of a finished shard in one move; its SHA-256 comes back."""
    buffer = io.BytesIO()
    arrays: dict[str, Any] = {
        "source": np.array(labels.source),
        "split": np.array(labels.split),
        "complete": np.array(labels.complete),
        "sun_camera": labels.sun_camera,
        "camera_from_mcmf": labels.camera_from_mcmf,
        "position_mcmf_m": labels.position_mcmf_m,
        "first": labels.first,
    }
    arrays |= {f"frame_{key}": value for key, value in labels.frames.items()}
    arrays |= {f"crater_{key}": value for key, value in labels.craters.items()}
    np.savez(buffer, **arrays)
    octets = buffer.getvalue()
    _write_whole(folder / "shards" / f"{name}.npz", octets)
    return hashlib.sha256(octets).hexdigest()


def load_shard(path: Path) -> ShardLabels:
    """Labels of one shard."""
    try:
        with np.load(path) as stored:
            return ShardLabels(
                source=str(stored["source"]),
                split=str(stored["split"]),
                complete=bool(stored["complete"]),
                frames={key: stored[f"frame_{key}"] for key in FRAME_COLUMNS},
                sun_camera=stored["sun_camera"],
                camera_from_mcmf=stored["camera_from_mcmf"],
                position_mcmf_m=stored["position_mcmf_m"],
                craters={key: stored[f"crater_{key}"] for key in CRATER_COLUMNS},
                first=stored["first"],
            )
    except FileNotFoundError:
        raise DatasetError(f"{path}: expected the labels of a shard, found no file") from None
    except (OSError, ValueError, KeyError, EOFError) as error:
        raise DatasetError(f"{path}: expected the labels of a shard, found: {error}") from error


def shard_frames(labels: ShardLabels) -> Iterator[Frame]:
    """The frames of a shard, in order."""
    for k in range(labels.first.size - 1):
        span = slice(int(labels.first[k]), int(labels.first[k + 1]))
        yield Frame(
            number=int(labels.frames["number"][k]),
            source=labels.source,
            split=labels.split,
            complete=labels.complete,
            values={key: float(labels.frames[key][k]) for key in FRAME_COLUMNS},
            sun_camera=labels.sun_camera[k],
            camera_from_mcmf=labels.camera_from_mcmf[k],
            position_mcmf_m=labels.position_mcmf_m[k],
            craters={key: labels.craters[key][span] for key in CRATER_COLUMNS},
        )


def write_index(
    folder: Path, recipe: Recipe, frames: int, shards: dict[str, str], data_names: Sequence[str]
) -> None:
    """Write dataset.json and the COCO files of a finished data set."""
    index = {
        "schema_version": SCHEMA_VERSION,
        "name": recipe.name,
        "recipe": recipe.to_dict(),
        "recipe_sha256": recipe.digest,
        "camera": {"width_px": recipe.width_px, "height_px": recipe.height_px, "fov_deg": recipe.fov_deg},
        "frames": frames,
        "data": list(data_names),
        "shards": shards,
    }
    _write_whole(folder / "dataset.json", json.dumps(index, indent=1, sort_keys=True).encode())
    dataset = Dataset(folder)
    for split in SPLITS:
        found = dataset.frames(split)
        _write_whole(folder / f"coco_{split}.json", json.dumps(_coco(dataset, found)).encode())


def count_instances(frames: Iterable[Frame], width_px: int, height_px: int) -> list[int]:
    """Craters of the paper's three classes with their centre in the frame."""
    counts = np.zeros(3, np.int64)
    for frame in frames:
        craters = frame.craters
        inside = _inside(craters, width_px, height_px)
        classes = size_class(craters["diameter_m"].astype(np.float64))[inside]
        counts += np.array([np.count_nonzero(classes == k) for k in range(3)])
    return [int(count) for count in counts]


def check(folder: Path) -> list[str]:
    """What is wrong with a data set: missing or damaged files, one line each; empty when it is whole."""
    dataset = Dataset(folder)
    problems = []
    for name, expected in sorted(dataset.index["shards"].items()):
        path = folder / "shards" / f"{name}.npz"
        found = hashlib.sha256(path.read_bytes()).hexdigest()
        if found != expected:
            problems.append(f"{path}: expected SHA-256 {expected}, found {found}")
    for frame in dataset.frames():
        path = folder / "images" / f"{frame.number:06d}.png"
        try:
            image = read_gray(path)
        except DatasetError as error:
            problems.append(str(error))
            continue
        if image.shape != (dataset.height_px, dataset.width_px):
            problems.append(
                f"{path}: expected {dataset.width_px} x {dataset.height_px} pixels, "
                f"found {image.shape[1]} x {image.shape[0]}"
            )
        if not (folder / "metadata" / f"{frame.number:06d}.json").is_file():
            problems.append(
                f"{folder}/metadata/{frame.number:06d}.json: expected frame metadata, found no file"
            )
    return problems


def read_gray(path: Path) -> NDArray[np.uint8]:
    """An 8-bit gray PNG (H, W)."""
    import cv2

    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise DatasetError(f"{path}: expected an 8-bit PNG image, found none that can be read")
    return np.asarray(image, dtype=np.uint8)


def write_gray(path: Path, image: NDArray[np.uint8]) -> None:
    """Write an 8-bit gray PNG in one move."""
    import cv2

    done, octets = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not done:
        raise DatasetError(f"{path}: expected an image of 8-bit gray, found {image.dtype} {image.shape}")
    _write_whole(path, octets.tobytes())


def write_json(path: Path, document: dict[str, Any]) -> None:
    """Write a JSON object in one move."""
    _write_whole(path, json.dumps(document, indent=1).encode())


def _write_whole(path: Path, octets: bytes) -> None:
    unfinished = path.with_name(f".{path.name}.{os.getpid()}")
    unfinished.write_bytes(octets)
    unfinished.replace(path)


def _inside(craters: dict[str, NDArray[Any]], width_px: int, height_px: int) -> NDArray[np.bool_]:
    inside: NDArray[np.bool_] = (
        (craters["u_px"] >= -0.5)
        & (craters["u_px"] <= width_px - 0.5)
        & (craters["v_px"] >= -0.5)
        & (craters["v_px"] <= height_px - 0.5)
    )
    return inside


def _coco(dataset: Dataset, frames: Sequence[Frame]) -> dict[str, Any]:
    annotations: list[dict[str, Any]] = []
    for frame in frames:
        craters = frame.craters
        classes = size_class(craters["diameter_m"].astype(np.float64))
        tiers, _ = choose_tiers(craters, dataset.width_px, dataset.height_px, frame.complete)
        chosen = np.flatnonzero(_inside(craters, dataset.width_px, dataset.height_px) & (classes >= 0))
        for k in chosen:
            u, v, d = (float(craters[name][k]) for name in ("u_px", "v_px", "diameter_px"))
            annotations.append(
                {
                    "id": len(annotations) + 1,
                    "image_id": frame.number,
                    "category_id": int(classes[k]),
                    "bbox": [round(value, 2) for value in (u - d / 2 + 0.5, v - d / 2 + 0.5, d, d)],
                    "area": round(math.pi * d * d / 4, 1),
                    "iscrowd": 0,
                    "centre": [round(u, 3), round(v, 3)],
                    "diameter": round(d, 3),
                    "ellipse": [round(u, 3), round(v, 3), round(d / 2, 3), round(d / 2, 3), 0.0],
                    "crater_id": int(craters["id"][k]),
                    "depth_ratio": round(float(np.nan_to_num(craters["depth_ratio"][k])), 4),
                    "ignore": int(tiers[k] != Tier.LABEL),
                }
            )
    return {
        "info": {"description": str(dataset.index["name"]), "version": str(SCHEMA_VERSION)},
        "categories": [
            {"id": number, "name": name, "supercategory": "crater"} for number, name in CATEGORIES
        ],
        "images": [
            {
                "id": frame.number,
                "file_name": f"images/{frame.number:06d}.png",
                "width": dataset.width_px,
                "height": dataset.height_px,
            }
            for frame in frames
        ],
        "annotations": annotations,
    }
