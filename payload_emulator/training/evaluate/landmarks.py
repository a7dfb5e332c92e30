"""Uncatalogued landmarks: what the detector finds again and again at one place under different Suns, and no list holds.

The paper's plan for its false positives. A detection that no catalogued crater explains is put on the ground; places
where such detections recur in frames whose Suns differ are landmarks. They serve as labels of a second round of
training, and tell how many of the false alarms are real hollows that the catalogue lacks.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lunar.arrays import BoolArray, FloatArray, IntArray
from lunar.frames import mcmf_from_spherical, spherical_from_mcmf
from payload_emulator.errors import DatasetError
from payload_emulator.training.data.dataset import Dataset, Frame, frame_truth, ground_points
from payload_emulator.training.evaluate.scoring import FrameDetections, MatchRule, match_any, tally

_COLUMNS = ("latitude_deg", "longitude_deg", "height_m", "diameter_m", "sightings", "looks", "score")
_FIRST_ID = 10_000_000_000  # above every catalogue's numbers


@dataclass(frozen=True, slots=True)
class RecurrenceRule:
    """When detections at one place are a landmark.

    sightings : least number of frames; suns_apart_deg : two of them with Suns at least that far apart in azimuth;
    share : of all frames that look at the place; reach : of the diameter, within which detections are one place.
    """

    sightings: int = 3
    suns_apart_deg: float = 45.0
    share: float = 0.4
    reach: float = 0.3
    size_ratio: float = 1.4


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


def find_landmarks(
    frames: Sequence[tuple[Dataset, Frame]],
    found: Sequence[FrameDetections],
    threshold: float,
    rule: RecurrenceRule | None = None,
) -> Landmarks:
    """Landmarks among the detections of frames that nothing listed for them explains."""
    rule = rule or RecurrenceRule()
    ground, diameter, score, owner = [], [], [], []
    for number, ((dataset, frame), detections) in enumerate(zip(frames, found, strict=True)):
        free = np.flatnonzero(_unexplained(frame, detections) & (detections.score >= threshold))
        ground.append(ground_points(dataset, frame, detections.u_px[free], detections.v_px[free]))
        diameter.append(detections.diameter_m[free])
        score.append(detections.score[free])
        owner.append(np.full(free.size, number))
    if not ground or sum(part.shape[0] for part in ground) == 0:
        return _none()
    point, size = np.concatenate(ground), np.concatenate(diameter)
    value, seen_in = np.concatenate(score), np.concatenate(owner)
    azimuth = np.array([frame.values["sun_azimuth_deg"] for _, frame in frames])
    groups = _grouped(point, size, value, seen_in, rule)
    rows = [_row(group, point, size, value, seen_in, frames, azimuth, rule) for group in groups]
    kept = [row for row in rows if row is not None]
    if not kept:
        return _none()
    columns = [np.array(column) for column in zip(*kept, strict=True)]
    return Landmarks(*columns)


def explained_by_landmarks(
    frames: Sequence[tuple[Dataset, Frame]],
    found: Sequence[FrameDetections],
    landmarks: Landmarks,
    rule: MatchRule | None = None,
) -> list[BoolArray]:
    """For each frame, which of its detections lie on a landmark."""
    rule = rule or MatchRule()
    masks = []
    for (dataset, frame), detections in zip(frames, found, strict=True):
        uv, diameter_px, _ = _project(dataset, frame, landmarks)
        masks.append(match_any(detections.u_px, detections.v_px, uv[:, 0], uv[:, 1], diameter_px, rule))
    return masks


def with_landmarks(dataset: Dataset, frame: Frame, landmarks: Landmarks) -> Frame:
    """The frame with the landmarks in view added to its craters, as a second round of training wants them."""
    uv, diameter_px, index = _project(dataset, frame, landmarks)
    if index.size == 0:
        return frame
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
        key: np.concatenate([values, added[key].astype(values.dtype)])
        for key, values in frame.craters.items()
    }
    return replace(frame, craters=craters)


def format_landmarks(landmarks: Landmarks) -> str:
    """Landmarks as CSV, degrees and metres."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for k in range(len(landmarks)):
        writer.writerow(
            (
                f"{math.degrees(landmarks.latitude_rad[k]):.5f}",
                f"{math.degrees(landmarks.longitude_rad[k]) % 360.0:.5f}",
                f"{landmarks.height_m[k]:.0f}",
                f"{landmarks.diameter_m[k]:.0f}",
                int(landmarks.sightings[k]),
                int(landmarks.looks[k]),
                f"{landmarks.score[k]:.3f}",
            )
        )
    return buffer.getvalue()


def load_landmarks(path: Path) -> Landmarks:
    """Landmarks of a CSV that `format_landmarks` made.

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
        raise DatasetError(
            f"{path}: expected landmarks (CSV with {', '.join(_COLUMNS)}), found: {error}"
        ) from error
    return Landmarks(
        np.radians(column["latitude_deg"]),
        np.radians(column["longitude_deg"]),
        column["height_m"],
        column["diameter_m"],
        column["sightings"].astype(np.int64),
        column["looks"].astype(np.int64),
        column["score"],
    )


def hide_craters(
    frames: Sequence[tuple[Dataset, Frame]], share: float, seed: int = 0
) -> tuple[list[tuple[Dataset, Frame]], IntArray]:
    """Frames without a share of the catalogued craters, the same ones everywhere, and the ids of those hidden."""
    every = np.unique(np.concatenate([frame.craters["id"] for _, frame in frames]))
    every = every[every >= 0]
    hidden = np.sort(np.random.default_rng(seed).permutation(every)[: round(share * every.size)])
    thinned = []
    for dataset, frame in frames:
        keep = ~np.isin(frame.craters["id"], hidden)
        craters = {key: values[keep] for key, values in frame.craters.items()}
        thinned.append((dataset, replace(frame, craters=craters)))
    return thinned, hidden


def study(
    frames: Sequence[tuple[Dataset, Frame]],
    found: Sequence[FrameDetections],
    threshold: float,
    hidden_share: float = 0.0,
    rule: RecurrenceRule | None = None,
) -> tuple[Landmarks, dict[str, Any]]:
    """Landmarks of a set of frames and what they explain.

    `hidden_share` takes that share of the catalogued craters away first: how many landmarks are craters that were
    hidden tells what a landmark is worth where the truth is known.
    """
    thinned, hidden = (
        hide_craters(frames, hidden_share) if hidden_share > 0.0 else (list(frames), np.zeros(0))
    )
    landmarks = find_landmarks(thinned, found, threshold, rule)
    masks = explained_by_landmarks(thinned, found, landmarks)
    truths = [frame_truth(dataset, frame) for dataset, frame in thinned]
    before = tally(truths, found).figures(threshold)
    alarms = on_landmark = 0
    for (_, frame), detections, mask in zip(thinned, found, masks, strict=True):
        free = _unexplained(frame, detections) & (detections.score >= threshold)
        free &= (detections.diameter_m >= 5_000.0) & (detections.diameter_m <= 30_000.0)
        alarms += int(free.sum())
        on_landmark += int((free & mask).sum())
    figures: dict[str, Any] = {
        "frames": len(frames),
        "threshold": threshold,
        "landmarks": len(landmarks),
        "landmarks_5_to_30_km": int(
            np.count_nonzero((landmarks.diameter_m >= 5_000.0) & (landmarks.diameter_m <= 30_000.0))
        ),
        "strict_precision": before.precision,
        "false_alarms_off_every_crater": alarms,
        "of_these_on_landmarks": on_landmark,
        "precision_with_landmarks": (before.detected_true + on_landmark)
        / max(before.detected_true + before.false_alarms, 1),
    }
    if hidden_share > 0.0:
        figures |= _recovered(frames, hidden.astype(np.int64), landmarks)
    return landmarks, figures


def _recovered(
    frames: Sequence[tuple[Dataset, Frame]], hidden: IntArray, landmarks: Landmarks
) -> dict[str, Any]:
    """How many landmarks are hidden craters (within half a diameter, size within a half), and how many were hidden."""
    rows = {
        int(k): (a, o, d)
        for _, frame in frames
        for k, a, o, d in zip(
            *(frame.craters[name] for name in ("id", "latitude_deg", "longitude_deg", "diameter_m")),
            strict=True,
        )
        if k >= 0
    }
    known = np.array([rows[int(k)] for k in hidden if int(k) in rows]).reshape(-1, 3)
    up = np.asarray(mcmf_from_spherical(np.radians(known[:, 0]), np.radians(known[:, 1]), 0.0))
    right = 0
    for k in range(len(landmarks)):
        place = mcmf_from_spherical(landmarks.latitude_rad[k], landmarks.longitude_rad[k], 0.0)
        near = np.linalg.norm(up - np.asarray(place), axis=1) < 0.5 * landmarks.diameter_m[k]
        near &= np.abs(np.log(known[:, 2] / landmarks.diameter_m[k])) < math.log(1.5)
        right += bool(near.any())
    return {
        "hidden_craters": int(known.shape[0]),
        "landmarks_that_were_hidden": right,
        "share_that_were_hidden": right / max(len(landmarks), 1),
    }


def _unexplained(frame: Frame, found: FrameDetections) -> BoolArray:
    """Detections on nothing that is listed for the frame, catalogued or stamped."""
    craters = frame.craters
    u, v, size = (craters[key].astype(np.float64) for key in ("u_px", "v_px", "diameter_px"))
    on_any = match_any(found.u_px, found.v_px, u, v, size, MatchRule(radii=0.7))
    on_any |= match_any(found.u_px, found.v_px, u, v, size, MatchRule(pixels=4.0))
    return ~on_any


def _project(dataset: Dataset, frame: Frame, landmarks: Landmarks) -> tuple[FloatArray, FloatArray, IntArray]:
    """Places (k, 2) and diameters (k,) in pixels of the landmarks in view, and which they are."""
    camera = dataset.camera
    points = (landmarks.position_mcmf_m - frame.position_mcmf_m) @ frame.camera_from_mcmf.T
    near = np.linalg.norm(points, axis=1) < 400_000.0
    uv = camera.project(points)
    with np.errstate(invalid="ignore"):
        index = np.flatnonzero(near & camera.contains(uv))
    return uv[index], camera.focal_px * landmarks.diameter_m[index] / points[index, 2], index


def _grouped(
    point: FloatArray, size: FloatArray, score: FloatArray, owner: IntArray, rule: RecurrenceRule
) -> list[IntArray]:
    """Indices of detections at one place, at most one per frame; the best detection left gathers its own."""
    free = np.ones(size.size, bool)
    groups = []
    for first in np.argsort(-score, kind="stable"):
        if not free[first]:
            continue
        distance = np.linalg.norm(point - point[first], axis=1)
        ratio = np.abs(np.log(size / size[first]))
        near = np.flatnonzero(
            free & (distance < rule.reach * size[first]) & (ratio < math.log(rule.size_ratio))
        )
        near = near[np.argsort(distance[near], kind="stable")]
        _, one = np.unique(owner[near], return_index=True)
        free[near] = False
        groups.append(near[one])
    return groups


def _row(
    group: IntArray,
    point: FloatArray,
    size: FloatArray,
    score: FloatArray,
    owner: IntArray,
    frames: Sequence[tuple[Dataset, Frame]],
    azimuth_deg: FloatArray,
    rule: RecurrenceRule,
) -> tuple[float, ...] | None:
    """Columns of `Landmarks` for one place, None where it is none."""
    if group.size < rule.sightings:
        return None
    suns = azimuth_deg[owner[group]]
    apart = np.abs((suns[:, None] - suns[None, :] + 180.0) % 360.0 - 180.0)
    if apart.max() < rule.suns_apart_deg:
        return None
    latitude, longitude, height = spherical_from_mcmf(point[group].mean(axis=0))
    place = Landmarks(
        np.array([float(latitude)]),
        np.array([float(longitude)]),
        np.array([float(height)]),
        np.array([float(np.median(size[group]))]),
        sightings=np.array([group.size]),
        looks=np.array([0]),
        score=np.array([score[group].mean()]),
    )
    looks = sum(_project(dataset, frame, place)[2].size for dataset, frame in frames)
    if group.size < rule.share * looks:
        return None
    return (
        float(latitude),
        float(longitude),
        float(height),
        float(np.median(size[group])),
        group.size,
        looks,
        float(score[group].mean()),
    )


def _none() -> Landmarks:
    empty, count = np.empty(0), np.empty(0, np.int64)
    return Landmarks(empty, empty, empty, empty, count, count, empty)
