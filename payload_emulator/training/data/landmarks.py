"""Craters learned from flight as further labels of a training (labels of `linna landmarks`)."""

import csv
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lunar.arrays import FloatArray, IntArray
from lunar.frames import mcmf_from_spherical
from payload_emulator.errors import DatasetError
from payload_emulator.training.data.dataset import Dataset, Frame

_COLUMNS = ("latitude_deg", "longitude_deg", "height_m", "diameter_m", "sightings", "looks", "score")
_FIRST_ID = 10_000_000_000  # above every catalogue's numbers


@dataclass(frozen=True, slots=True, eq=False)
class Landmarks:
    """Places on the ground, arrays (n,): how often each was seen, in how many frames it was in view, mean score."""

    latitude_rad: FloatArray
    longitude_rad: FloatArray
    height_m: FloatArray
    diameter_m: FloatArray
    sightings: IntArray
    looks: IntArray
    score: FloatArray

    def __len__(self) -> int:
        return int(self.diameter_m.size)

    @property
    def position_mcmf_m(self) -> FloatArray:
        return np.asarray(mcmf_from_spherical(self.latitude_rad, self.longitude_rad, self.height_m))


def with_landmarks(dataset: Dataset, frame: Frame, landmarks: Landmarks) -> Frame:
    """Return the frame with the landmarks in view added to its craters."""
    camera = dataset.camera
    points = (landmarks.position_mcmf_m - frame.position_mcmf_m) @ frame.camera_from_mcmf.T
    uv = camera.project(points)
    with np.errstate(invalid="ignore"):
        index = np.flatnonzero((np.linalg.norm(points, axis=1) < 400_000.0) & camera.contains(uv))
    if index.size == 0:
        return frame
    uv, diameter_px = uv[index], camera.focal_px * landmarks.diameter_m[index] / points[index, 2]
    added = {
        "id": _FIRST_ID + index,
        "u_px": uv[:, 0],
        "v_px": uv[:, 1],
        "diameter_px": diameter_px,
        "diameter_m": landmarks.diameter_m[index],
        "depth_ratio": np.full(index.size, 0.05),  # of what the catalogue lacks: worn rather than fresh
        "lit": np.ones(index.size),
        "hidden": np.zeros(index.size),
        "latitude_deg": np.degrees(landmarks.latitude_rad[index]),
        "longitude_deg": np.degrees(landmarks.longitude_rad[index]) % 360.0,
        "major_px": diameter_px,
        "minor_px": diameter_px,
        "angle_rad": np.zeros(index.size),
        "visible": np.ones(index.size),
    }
    craters: dict[str, NDArray[Any]] = {
        key: np.concatenate([values, added[key].astype(values.dtype)]) for key, values in frame.craters.items()
    }
    return replace(frame, craters=craters)


def load_landmarks(path: Path) -> Landmarks:
    """Return the landmarks of a CSV of labels.

    Raises
    ------
    DatasetError
        The file cannot be read or is of another form.
    """
    try:
        with path.open(encoding="utf-8", newline="") as stream:
            rows = list(csv.DictReader(stream))
        column = {name: np.array([float(row[name]) for row in rows]) for name in _COLUMNS}
    except (OSError, UnicodeDecodeError, KeyError, TypeError, ValueError) as error:
        raise DatasetError(f"{path}: expected landmarks (CSV with {', '.join(_COLUMNS)}), found: {error}") from error
    return Landmarks(
        np.radians(column["latitude_deg"]),
        np.radians(column["longitude_deg"]),
        column["height_m"],
        column["diameter_m"],
        column["sightings"].astype(np.int64),
        column["looks"].astype(np.int64),
        column["score"],
    )
