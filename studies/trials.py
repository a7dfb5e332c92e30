"""Changes of input and output processing to improve detection on real terrain without training.

A trial changes how a frame is passed to the network or how the output is decoded. Thresholds and the choice of a trial
follow from the validation split alone. The test split is scored in a separate step, for the chosen trial only.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lunar.arrays import FloatArray
from lunar.catalogue import size_class
from payload_emulator.errors import DatasetError
from payload_emulator.flight.vision.detections import Detections
from payload_emulator.flight.vision.detector import DetectorParameters, OnnxDetector, decode, drop_duplicates
from payload_emulator.flight.vision.preprocess import prepare_image, sun_up_turns, turn_back
from payload_emulator.training.data.dataset import Dataset, Frame, diameter_on_ground_m, frame_truth
from payload_emulator.training.data.truth import FrameTruth
from payload_emulator.training.evaluate.evaluate import SCORE_FLOOR, refuse_other_camera
from payload_emulator.training.evaluate.metrics import RADIUS_RULE
from payload_emulator.training.evaluate.scoring import (
    FrameDetections,
    average_precision,
    best_threshold,
    tally,
)

Image = NDArray[np.float32]
_CLASSES = (0, 1, 2)

PER_CLASS = "a threshold for each class"


@dataclass(frozen=True, slots=True)
class Trial:
    """A way of looking at one prepared frame: gives detections in the frame's own pixels."""

    name: str
    look: Callable[[OnnxDetector, Image, FloatArray], Detections]


def run_trials(
    detector: OnnxDetector,
    datasets: Sequence[Dataset],
    trials: Sequence[Trial] | None = None,
    progress: Callable[[Sequence[Any]], Any] = iter,
) -> dict[str, Any]:
    """Return the figures of each trial on the validation split, and the trial with the greatest strict F1.

    Real frames are scored if there are any, otherwise all frames. Each trial has the threshold of its own greatest
    F1. Of equal trials the first is chosen. The test split is not read.

    Raises
    ------
    DatasetError
        The validation split is empty, or the camera of the frames is not that of the detector.
    """
    for dataset in datasets:
        refuse_other_camera(detector, dataset)
    frames = _frames(datasets, "val")
    truths = [frame_truth(d, f) for d, f in frames]
    rows = []
    for trial in TRIALS if trials is None else trials:
        found = [_look(trial, detector, d, f) for d, f in progress(frames)]
        threshold, _ = best_threshold(tally(truths, found))
        rows.append(_row(trial.name, truths, found, threshold))
        if trial is AS_FLOWN:
            limits = [best_threshold(tally(truths, found, classes=(k,)))[0] for k in _CLASSES]
            lifted = [_lifted(part, limits, threshold) for part in found]
            rows.append(_row(PER_CLASS, truths, lifted, threshold) | {"thresholds": limits})
    chosen = max(rows, key=lambda row: float(row["strict"]["f1"]))
    return {"validation_frames": len(frames), "trials": rows, "chosen": chosen["trial"]}


def score_chosen_trial(
    detector: OnnxDetector,
    datasets: Sequence[Dataset],
    study: Mapping[str, Any],
    source: str = "",
    trials: Sequence[Trial] | None = None,
    progress: Callable[[Sequence[Any]], Any] = iter,
) -> dict[str, Any]:
    """Return the figures of the chosen trial on the test split, at the threshold fixed on the validation split.

    Parameters
    ----------
    study
        Result of `run_trials`.
    source
        Only the test frames of this source.

    Raises
    ------
    DatasetError
        The test split is empty.
    """
    row = next(row for row in study["trials"] if row["trial"] == study["chosen"])
    per_class = row["trial"] == PER_CLASS
    known = {trial.name: trial for trial in (TRIALS if trials is None else trials)}
    trial = AS_FLOWN if per_class else known[row["trial"]]
    frames = _frames(datasets, "test", source)
    found = [_look(trial, detector, d, f) for d, f in progress(frames)]
    if per_class:
        found = [_lifted(part, row["thresholds"], row["threshold"]) for part in found]
    return {"test_frames": len(frames)} | _row(
        row["trial"], [frame_truth(d, f) for d, f in frames], found, row["threshold"]
    )


def _row(
    name: str, truths: Sequence[FrameTruth], found: Sequence[FrameDetections], threshold: float
) -> dict[str, Any]:
    strict, fair = tally(truths, found), tally(truths, found, ignore_aware=True)
    return {
        "trial": name,
        "threshold": threshold,
        "strict": strict.figures(threshold).to_dict(),
        "ignore_aware": fair.figures(threshold).to_dict(),
        "average_precision": average_precision(tally(truths, found, rule=RADIUS_RULE)),
    }


def _frames(datasets: Sequence[Dataset], split: str, source: str = "") -> list[tuple[Dataset, Frame]]:
    every = [(d, f) for d in datasets for f in d.frames(split, source)]
    if not every:
        where = f"split {split!r}" + (f", source {source!r}" if source else "")
        raise DatasetError(f"trials: expected frames of {where}, found none")
    real = [(d, f) for d, f in every if not f.complete]
    return real or every


def _look(trial: Trial, detector: OnnxDetector, dataset: Dataset, frame: Frame) -> FrameDetections:
    gray = prepare_image(dataset.image(frame)).gray
    found = trial.look(detector, gray, frame.sun_camera)
    found = drop_duplicates(found.select(np.argsort(-found.score, kind="stable")), DetectorParameters())
    return FrameDetections(
        found.u_px,
        found.v_px,
        found.diameter_px,
        diameter_on_ground_m(dataset, frame, found.u_px, found.v_px, found.diameter_px),
        found.score,
        found.sigma_px,
        found.depth_ratio,
    )


def _lifted(found: FrameDetections, limits: Sequence[float], threshold: float) -> FrameDetections:
    """Detections whose scores are shifted so that the threshold of their class becomes the common one."""
    own = np.asarray(size_class(found.diameter_m))
    shift = np.array([*(threshold - limit for limit in limits), 0.0])
    return replace(found, score=found.score + shift[np.where(own <= 2, own, 3)])


def _read(detector: OnnxDetector, tile: Image) -> Detections:
    heatmap, geometry = detector.run_network(np.ascontiguousarray(tile)[None, None])
    return decode(heatmap[0, 0], geometry[0], SCORE_FLOOR)


def _as_flown(detector: OnnxDetector, gray: Image, sun: FloatArray) -> Detections:
    turns = sun_up_turns(sun)
    found = _read(detector, np.rot90(gray, turns))
    u_px, v_px = turn_back(found.u_px, found.v_px, turns, *gray.shape)
    return replace(found, u_px=u_px, v_px=v_px)


def _not_turned(detector: OnnxDetector, gray: Image, sun: FloatArray) -> Detections:
    return _read(detector, gray)


def _exactly_sun_up(detector: OnnxDetector, gray: Image, sun: FloatArray) -> Detections:
    """Turned by the exact angle; what falls out of the square is lost, the corners are mirrored ground."""
    import cv2

    angle_deg = float(np.degrees(np.arctan2(sun[0], -sun[1])))
    middle = 0.5 * (gray.shape[0] - 1)
    matrix = cv2.getRotationMatrix2D((middle, middle), angle_deg, 1.0)
    turned = cv2.warpAffine(gray, matrix, gray.shape[::-1], borderMode=cv2.BORDER_REFLECT_101)
    found = _read(detector, turned)
    back = cv2.invertAffineTransform(matrix)
    u_px = back[0, 0] * found.u_px + back[0, 1] * found.v_px + back[0, 2]
    v_px = back[1, 0] * found.u_px + back[1, 1] * found.v_px + back[1, 2]
    inside = (np.abs(u_px - middle) <= middle + 0.5) & (np.abs(v_px - middle) <= middle + 0.5)
    return replace(found, u_px=u_px, v_px=v_px).select(inside)


def _sharpened(detector: OnnxDetector, gray: Image, sun: FloatArray) -> Detections:
    import cv2

    smooth = cv2.GaussianBlur(gray, (0, 0), 1.2)
    return _as_flown(detector, np.clip(gray + np.float32(0.6) * (gray - smooth), -4.0, 4.0), sun)


def _with_mirror(detector: OnnxDetector, gray: Image, sun: FloatArray) -> Detections:
    """Maps of the frame and of its mirror image averaged: twice the time."""
    turns = sun_up_turns(sun)
    tile = np.ascontiguousarray(np.rot90(gray, turns))
    heat, geometry = detector.run_network(tile[None, None])
    mirrored_heat, mirrored = detector.run_network(np.ascontiguousarray(tile[:, ::-1])[None, None])
    other = mirrored[0, :, :, ::-1].copy()
    other[0] *= -1.0
    found = decode(
        0.5 * (heat[0, 0] + mirrored_heat[0, 0, :, ::-1]), 0.5 * (geometry[0] + other), SCORE_FLOOR
    )
    u_px, v_px = turn_back(found.u_px, found.v_px, turns, *gray.shape)
    return replace(found, u_px=u_px, v_px=v_px)


def _enlarged(detector: OnnxDetector, gray: Image, sun: FloatArray) -> Detections:
    """One and a half times as large, in four overlapping tiles: four times the time."""
    import cv2

    factor, tile_px = 1.5, gray.shape[0]
    turns = sun_up_turns(sun)
    large = cv2.resize(
        np.ascontiguousarray(np.rot90(gray, turns)), None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC
    )
    last = large.shape[0] - tile_px
    parts = []
    for top in (0, last):
        for left in (0, last):
            found = _read(detector, large[top : top + tile_px, left : left + tile_px])
            parts.append(replace(found, u_px=found.u_px + left, v_px=found.v_px + top))
    every = Detections(
        *(
            np.concatenate([np.asarray(getattr(part, name)) for part in parts])
            for name in ("u_px", "v_px", "diameter_px", "score", "sigma_px")
        )
    )
    # Pixel centres are integers, so an enlarged image begins half an old pixel before the first centre.
    u_px, v_px = (every.u_px + 0.5) / factor - 0.5, (every.v_px + 0.5) / factor - 0.5
    u_px, v_px = turn_back(u_px, v_px, turns, *gray.shape)
    return Detections(u_px, v_px, every.diameter_px / factor, every.score, every.sigma_px / factor)


AS_FLOWN = Trial("as flown (quarter turns to Sun-up)", _as_flown)
TRIALS = (
    AS_FLOWN,
    Trial("not turned", _not_turned),
    Trial("turned exactly Sun-up", _exactly_sun_up),
    Trial("sharpened (unsharp mask 0.6)", _sharpened),
    Trial("averaged with its mirror image", _with_mirror),
    Trial("enlarged 1.5 times, four tiles", _enlarged),
)


def format_trials(study: Mapping[str, Any], test: Mapping[str, Any] | None = None) -> str:
    """Return the trials on the validation split as a table, the chosen one, and its test figures where given."""
    title = f"validation, {study['validation_frames']} frames"
    lines = [
        f"{title:38}{'threshold':>10}{'P':>7}{'R':>7}{'F1':>7}{'F1 ign.':>9}{'AP':>7}{'loc px':>8}",
        *(_line(row["trial"], row) for row in study["trials"]),
        f"chosen on the validation split: {study['chosen']}",
    ]
    if test is not None:
        lines.append(_line(f"chosen, test, {test['test_frames']} frames", test))
    return "\n".join(lines)


def _line(title: str, row: Mapping[str, Any]) -> str:
    strict = row["strict"]
    return (
        f"{title:38}{row['threshold']:10.2f}{strict['precision']:7.3f}{strict['recall']:7.3f}"
        f"{strict['f1']:7.3f}{row['ignore_aware']['f1']:9.3f}{row['average_precision']:7.3f}"
        f"{strict['loc_px']:8.2f}"
    )
