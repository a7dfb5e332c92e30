"""Data sets on disk: frames as gray PNG, one labels file per shard, COCO and metadata as JSON for exchange.

Layout of the folder::

    dataset.json            recipe, camera, counts, data sources, hashes of the shards
    images/000123.png       8 or 16 bits, the mean of the colour channels or RGB, as the camera saw it (not turned)
    metadata/000123.json    pose, corner coordinates, Sun vector
    shards/0006.npz         labels and poses of the frames of one shard; written last, so that its presence means "done"
    coco_train.json ...     COCO annotations by split

Every catalogued crater in view of 2 km and more is listed, whatever its state; what is a label and what is ignored is
decided when training (`choose_tiers`), and scoring has its own rules.
"""

import hashlib
import io
import json
import math
import os
import zipfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lunar.arrays import BoolArray, FloatArray, IntArray, OctetArray
from lunar.boxes import Box, inside_box
from lunar.camera import PinholeCamera, intersect_sphere
from lunar.catalogue import size_class
from lunar.constants import MOON_RADIUS_M
from payload_emulator.errors import DatasetError
from payload_emulator.flight.vision.preprocess import gray_levels
from payload_emulator.training.data.targets import Tier


@dataclass(frozen=True, slots=True, eq=False)
class FrameTruth:
    """Catalogued craters in view of one frame, arrays (n,); `block` names the independent piece of ground."""

    u_px: FloatArray
    v_px: FloatArray
    diameter_px: FloatArray
    diameter_m: FloatArray
    depth_ratio: FloatArray
    ids: IntArray
    width_px: int
    height_px: int
    sun_azimuth_image_rad: float
    block: int


SCHEMA_VERSION = 1
CATEGORIES = ((0, "5-10 km"), (1, "10-15 km"), (2, "15-30 km"), (3, "3-5 km"))

# Label tier: what a network can fairly be asked to find.
LABEL_MINIMUM_DIAMETER_PX = 10.0
LABEL_MINIMUM_DIAMETER_M = 2_500.0  # the real terrain resolves nothing smaller
LABEL_MINIMUM_DEPTH_RATIO = 0.02
LABEL_LEAST_WEIGHT = 0.5  # at that depth: less, and worn craters are found too seldom
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
ELLIPSE_COLUMNS = ("major_px", "minor_px", "angle_rad", "visible")
"""Axes of the rim's ellipse, angle of the major one from +u toward +v, share of the rim within the picture.

Data sets made before these were kept are read as if rims were round and whole.
"""

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
    crater columns (n,) in frame order with `first` (f + 1,) marking where each frame's craters begin; where frames of
    one shard belong to several splits, the split of each; SHA-256 of each frame's image and metadata file."""

    source: str
    split: str
    complete: bool
    frames: dict[str, NDArray[Any]]
    sun_camera: FloatArray
    camera_from_mcmf: FloatArray
    position_mcmf_m: FloatArray
    craters: dict[str, NDArray[Any]]
    first: IntArray
    frame_split: tuple[str, ...] = ()
    image_sha256: tuple[str, ...] = ()
    metadata_sha256: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One frame of a data set with its labels; crater columns as `CRATER_COLUMNS` and `ELLIPSE_COLUMNS`."""

    number: int
    source: str
    split: str
    complete: bool
    values: dict[str, float]
    sun_camera: FloatArray
    camera_from_mcmf: FloatArray
    position_mcmf_m: FloatArray
    craters: dict[str, NDArray[Any]]

    @property
    def sun_azimuth_rad(self) -> float:
        """Azimuth of the Sun in the image, clockwise from its top."""
        return float(np.arctan2(self.sun_camera[0], -self.sun_camera[1]))


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
            found = "an unfinished one: build it again to go on" if (folder / "recipe.json").is_file() else "none"
            raise DatasetError(f"{folder}: expected a data set (dataset.json), found {found}") from None
        except (OSError, ValueError) as error:
            raise DatasetError(f"{index}: expected a JSON object, found: {error}") from error
        if self.index.get("schema_version") != SCHEMA_VERSION:
            raise DatasetError(
                f"{index}: schema_version: expected {SCHEMA_VERSION}, found {self.index.get('schema_version')!r}"
            )
        self._scored_boxes = {
            source["name"]: [Box(**box) for box in source["boxes"]]
            for source in self.index["recipe"]["sources"]
            if source.get("footprint") == "centre"
        }
        self._frames: list[Frame] = []
        for name in sorted(self.index["shards"]):
            self._frames.extend(shard_frames(load_shard(folder / "shards" / f"{name}.npz")))
        self._frames.sort(key=lambda frame: frame.number)

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
    def camera(self) -> PinholeCamera:
        return PinholeCamera(self.width_px, self.height_px, math.radians(self.index["camera"]["fov_deg"]))

    @property
    def digest(self) -> str:
        """Hash over the labels of all shards."""
        shards = self.index["shards"]
        return hashlib.sha256("".join(shards[name] for name in sorted(shards)).encode()).hexdigest()

    def frames(self, split: str = "", source: str = "") -> list[Frame]:
        """Frames of a split and a source; every one where not named."""
        return [f for f in self._frames if (not split or f.split == split) and (not source or f.source == source)]

    def is_scored(self, frame: Frame, latitude_deg: FloatArray, longitude_deg: FloatArray) -> BoolArray:
        """Return whether places count in the scores of a frame: all, or only the middle in a box."""
        boxes = self._scored_boxes.get(frame.source)
        if boxes is None:
            return np.ones(np.shape(latitude_deg), dtype=bool)
        within = [inside_box(box, latitude_deg, longitude_deg, 0.0) for box in boxes]
        return np.asarray(np.any(within, axis=0), dtype=bool)

    def image(self, frame: Frame) -> OctetArray:
        """Image of a frame, gray (H, W) or RGB (H, W, 3) as the set keeps it, the upper 8 bits where it has 16."""
        path = self.folder / "images" / f"{frame.number:06d}.png"
        return read_rgb(path) if self.index["recipe"].get("colour") == "rgb" else read_gray(path)

    def gray(self, frame: Frame) -> OctetArray:
        """Gray image (H, W) of a frame."""
        image = self.image(frame)
        return image if image.ndim == 2 else gray_levels(image)


def choose_tiers(
    craters: dict[str, NDArray[Any]],
    width_px: int,
    height_px: int,
    complete: bool,
    least_px: float = LABEL_MINIMUM_DIAMETER_PX,
) -> tuple[NDArray[np.int8], FloatArray]:
    """Tier and weight of the craters of a frame, (n,) each, by what can be seen of them.

    `complete` (procedural terrain) says that the terrain shows craters of any size; real terrain does so only for those
    stamped on it (negative id) and for what its rasters resolve. `least_px` is the least diameter of a label.
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
        & (craters["diameter_px"] >= least_px)
        & (craters["diameter_px"] <= LABEL_MAXIMUM_DIAMETER_PX)
        & resolved
        & (craters["depth_ratio"] >= LABEL_MINIMUM_DEPTH_RATIO)
        & (craters["lit"] >= LABEL_MINIMUM_LIT)
        & ~craters["hidden"].astype(bool)
    )
    span = FULL_WEIGHT_DEPTH_RATIO - LABEL_MINIMUM_DEPTH_RATIO
    grown = (craters["depth_ratio"] - LABEL_MINIMUM_DEPTH_RATIO) / span
    weight = np.clip(LABEL_LEAST_WEIGHT + (1.0 - LABEL_LEAST_WEIGHT) * grown, LABEL_LEAST_WEIGHT, 1.0)
    return np.where(label, Tier.LABEL, Tier.IGNORE).astype(np.int8), np.nan_to_num(weight, nan=LABEL_LEAST_WEIGHT)


def frame_truth(dataset: Dataset, frame: Frame) -> FrameTruth:
    """The frame's catalogued craters as scoring wants them, on the ground that is scored."""
    listed = (frame.craters["id"] >= 0) & dataset.is_scored(
        frame, frame.craters["latitude_deg"], frame.craters["longitude_deg"]
    )
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
        sun_azimuth_image_rad=frame.sun_azimuth_rad,
        block=int(frame.values["block"]),
    )


def diameter_on_ground_m(
    dataset: Dataset, frame: Frame, u_px: FloatArray, v_px: FloatArray, diameter_px: FloatArray
) -> FloatArray:
    """Diameters that a payload knowing its altitude above the mean ground gives to detections of the frame."""
    camera = dataset.camera
    rays = camera.rays(np.stack([u_px, v_px], axis=-1))
    heading = rays @ frame.camera_from_mcmf
    ground = MOON_RADIUS_M + frame.values["ground_m"]
    reach = intersect_sphere(frame.position_mcmf_m, heading, ground)
    return np.asarray(diameter_px * reach * rays[..., 2] / camera.focal_px)


def ground_points(dataset: Dataset, frame: Frame, u_px: FloatArray, v_px: FloatArray) -> FloatArray:
    """Points (n, 3) of the mean ground that pixels of a frame look at, MCMF m; NaN where a ray misses the Moon."""
    heading = dataset.camera.rays(np.stack([u_px, v_px], axis=-1)) @ frame.camera_from_mcmf
    reach = intersect_sphere(frame.position_mcmf_m, heading, MOON_RADIUS_M + frame.values["ground_m"])
    return np.asarray(frame.position_mcmf_m + reach[:, None] * heading)


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
    for key in ("frame_split", "image_sha256", "metadata_sha256"):
        if getattr(labels, key):
            arrays[key] = np.array(getattr(labels, key))
    np.savez(buffer, **arrays)
    return write_whole(folder / "shards" / f"{name}.npz", buffer.getvalue())


def load_shard(path: Path) -> ShardLabels:
    try:
        # Opened here: numpy leaves a damaged file open.
        with path.open("rb") as stream, np.load(stream) as stored:
            craters = {key: stored[f"crater_{key}"] for key in CRATER_COLUMNS}
            count = craters["id"].size
            before = {"major_px": craters["diameter_px"], "minor_px": craters["diameter_px"]}
            before |= {"angle_rad": np.zeros(count, np.float32), "visible": np.ones(count, np.float32)}
            for key in ELLIPSE_COLUMNS:
                craters[key] = stored[f"crater_{key}"] if f"crater_{key}" in stored else before[key]
            texts = {
                key: tuple(str(value) for value in stored[key]) if key in stored else ()
                for key in ("frame_split", "image_sha256", "metadata_sha256")
            }
            return ShardLabels(
                source=str(stored["source"]),
                split=str(stored["split"]),
                complete=bool(stored["complete"]),
                frames={key: stored[f"frame_{key}"] for key in FRAME_COLUMNS},
                sun_camera=stored["sun_camera"],
                camera_from_mcmf=stored["camera_from_mcmf"],
                position_mcmf_m=stored["position_mcmf_m"],
                craters=craters,
                first=stored["first"],
                **texts,
            )
    except FileNotFoundError:
        raise DatasetError(f"{path}: expected the labels of a shard, found no file") from None
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise DatasetError(f"{path}: expected the labels of a shard, found: {error}") from error


def shard_frames(labels: ShardLabels) -> Iterator[Frame]:
    """The frames of a shard, in order."""
    for k in range(labels.first.size - 1):
        span = slice(int(labels.first[k]), int(labels.first[k + 1]))
        yield Frame(
            number=int(labels.frames["number"][k]),
            source=labels.source,
            split=labels.frame_split[k] if labels.frame_split else labels.split,
            complete=labels.complete,
            values={key: float(labels.frames[key][k]) for key in FRAME_COLUMNS},
            sun_camera=labels.sun_camera[k],
            camera_from_mcmf=labels.camera_from_mcmf[k],
            position_mcmf_m=labels.position_mcmf_m[k],
            craters={key: values[span] for key, values in labels.craters.items()},
        )


def count_instances(frames: Iterable[Frame], width_px: int, height_px: int) -> list[int]:
    """Craters of the paper's three classes with their centre in the frame."""
    counts = np.zeros(3, np.int64)
    for frame in frames:
        craters = frame.craters
        inside = in_picture(craters, width_px, height_px)
        classes = size_class(craters["diameter_m"].astype(np.float64))[inside]
        counts += np.array([np.count_nonzero(classes == k) for k in range(3)])
    return [int(count) for count in counts]


def read_gray(path: Path) -> OctetArray:
    """A gray PNG (H, W) in 8 bits."""
    import cv2

    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise DatasetError(f"{path}: expected a gray PNG image, found none that can be read")
    return np.asarray(image, dtype=np.uint8)


def read_rgb(path: Path) -> OctetArray:
    """An RGB PNG (H, W, 3) in 8 bits."""
    import cv2

    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise DatasetError(f"{path}: expected an RGB PNG image, found none that can be read")
    return np.ascontiguousarray(image[..., ::-1], dtype=np.uint8)


def write_picture(path: Path, image: NDArray[Any]) -> str:
    """Write a PNG of 8 or 16 bits, gray (H, W) or blue-green-red (H, W, 3), in one move; its SHA-256 comes back."""
    import cv2

    # Noise repeats nothing: looking for runs alone is quicker and packs a frame 15 % smaller than looking for matches.
    settings = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]
    done, octets = cv2.imencode(".png", image, settings)
    if not done:
        raise DatasetError(f"{path}: expected an image of 8 or 16 bits, found {image.dtype} {image.shape}")
    return write_whole(path, octets.tobytes())


def write_frame(path: Path, image: NDArray[Any]) -> str:
    """Write a frame, gray (H, W) or RGB (H, W, 3); its SHA-256 comes back."""
    return write_picture(path, image if image.ndim == 2 else np.ascontiguousarray(image[..., ::-1]))


def write_json(path: Path, document: dict[str, Any]) -> str:
    """Write a JSON object in one move; its SHA-256 comes back."""
    return write_whole(path, json.dumps(document, indent=1).encode())


def write_whole(path: Path, octets: bytes) -> str:
    """Write a file whole or not at all; its SHA-256 comes back."""
    unfinished = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        unfinished.write_bytes(octets)
        unfinished.replace(path)
    except OSError:
        unfinished.unlink(missing_ok=True)
        raise
    return hashlib.sha256(octets).hexdigest()


def in_picture(craters: dict[str, NDArray[Any]], width_px: int, height_px: int) -> BoolArray:
    """Return which craters have their centre in the picture."""
    inside: BoolArray = (
        (craters["u_px"] >= -0.5)
        & (craters["u_px"] <= width_px - 0.5)
        & (craters["v_px"] >= -0.5)
        & (craters["v_px"] <= height_px - 0.5)
    )
    return inside
