"""Study of a second observation of the same ground under a different Sun direction.

Frames of a data set that show the same ground are paired. Detections of the second frame are projected onto the mean
ground surface and from there into the first frame. A crater detected in both frames has the mean of both scores. A
crater detected in only one of two frames that both show its position has half of its score. Elsewhere scores are
unchanged. Positions are those of the first frame. The result is compared with the first frame alone, over the frames
with a partner. Thresholds and the choice between the two ways follow from the validation split alone; the test split is
scored in a separate step, for the chosen way only.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lunar.arrays import BoolArray, FloatArray
from payload_emulator.errors import DatasetError
from payload_emulator.training.data.dataset import Dataset, Frame, diameter_on_ground_m, ground_points
from payload_emulator.training.data.truth import FrameTruth
from payload_emulator.training.evaluate.evaluate import Scored
from payload_emulator.training.evaluate.scoring import FrameDetections, best_threshold, tally


@dataclass(frozen=True, slots=True)
class PairRule:
    """Which frames are a pair and which detections one crater.

    overlap : least share of the first frame's ground that the second shows; suns_apart_deg : least difference of the
        Suns' azimuths on the ground; reach : of the diameter, relief displaces a detection that far; size_ratio.
    """

    overlap: float = 0.6
    suns_apart_deg: float = 60.0
    reach: float = 0.35
    size_ratio: float = 1.6


WAYS = {"one_sun": "the first frame alone", "two_suns": "both frames"}


def study_two_suns(validation: Scored, rule: PairRule = PairRule()) -> dict[str, Any]:
    """Return the figures of single frames and of pairs over the validation frames with a partner, and the better way.

    Raises
    ------
    DatasetError
        No frame of the validation split has a partner.
    """
    truths, *found = _paired(validation, rule, "val")
    result: dict[str, Any] = {
        "validation_frames": len(truths),
        "of_validation_frames": len(validation.frames),
    }
    for name, detections in zip(WAYS, found, strict=True):
        threshold, _ = best_threshold(tally(truths, detections))
        result[name] = _figures(truths, detections, threshold)
    return result | {"chosen": max(WAYS, key=lambda name: float(result[name]["strict"]["f1"]))}


def score_chosen_way(test: Scored, study: Mapping[str, Any], rule: PairRule = PairRule()) -> dict[str, Any]:
    """Return the figures of the way that `study_two_suns` chose, over the test frames with a partner.

    Raises
    ------
    DatasetError
        No frame of the test split has a partner.
    """
    chosen = str(study["chosen"])
    truths, *found = _paired(test, rule, "test")
    return {"test_frames": len(truths), "of_test_frames": len(test.frames), "way": chosen} | _figures(
        truths, found[list(WAYS).index(chosen)], study[chosen]["threshold"]
    )


def _figures(
    truths: Sequence[FrameTruth], found: Sequence[FrameDetections], threshold: float
) -> dict[str, Any]:
    return {
        "threshold": threshold,
        "strict": tally(truths, found).figures(threshold).to_dict(),
        "ignore_aware": tally(truths, found, ignore_aware=True).figures(threshold).to_dict(),
    }


def _paired(
    scored: Scored, rule: PairRule, split: str
) -> tuple[list[FrameTruth], list[FrameDetections], list[FrameDetections]]:
    """Truths, single and fused detections of the frames with a partner, of real terrain where there is any."""
    partner = _partners(scored.frames, rule)
    first = [k for k, other in enumerate(partner) if other >= 0]
    if not first:
        raise DatasetError(
            f"two Suns: expected frames of the split {split!r} that show {100 * rule.overlap:.0f} % of each "
            f"other's ground under Suns {rule.suns_apart_deg:g} degrees apart, found none"
        )
    real = [k for k in first if not scored.frames[k][1].complete]
    first = real or first
    fused = [
        fuse(*scored.frames[k], scored.found[k], *scored.frames[partner[k]], scored.found[partner[k]], rule)
        for k in first
    ]
    return [scored.truths[k] for k in first], [scored.found[k] for k in first], fused


def _partners(frames: Sequence[tuple[Dataset, Frame]], rule: PairRule) -> list[int]:
    """For each frame the one that shows most of its ground under another Sun, -1 where none shows enough."""
    ground = [_ground_grid(dataset, frame) for dataset, frame in frames]
    azimuth = np.array([frame.values["sun_azimuth_deg"] for _, frame in frames])
    chosen = []
    for k, (_, frame) in enumerate(frames):
        apart = np.abs((azimuth - azimuth[k] + 180.0) % 360.0 - 180.0) >= rule.suns_apart_deg
        best, share = -1, rule.overlap
        for j in np.flatnonzero(apart).tolist():
            other = frames[j][1]
            near = np.linalg.norm(other.position_mcmf_m - frame.position_mcmf_m) < 300_000.0
            if other.source != frame.source or not near:
                continue
            seen = float(_in_view(*frames[j], ground[k])[1].mean())
            if seen >= share:
                best, share = j, seen
        chosen.append(best)
    return chosen


def fuse(
    dataset: Dataset,
    frame: Frame,
    found: FrameDetections,
    other_dataset: Dataset,
    other_frame: Frame,
    other: FrameDetections,
    rule: PairRule = PairRule(),
) -> FrameDetections:
    """Detections of a frame with what another frame of the same ground says, best first."""
    points = ground_points(other_dataset, other_frame, other.u_px, other.v_px)
    uv, inside = _in_view(dataset, frame, points)
    theirs = np.flatnonzero(inside)
    depth = ((points[theirs] - frame.position_mcmf_m) @ frame.camera_from_mcmf.T)[:, 2]
    size = dataset.focal_px * other.diameter_m[theirs] / depth
    _, shared = _in_view(other_dataset, other_frame, ground_points(dataset, frame, found.u_px, found.v_px))
    score = np.where(shared, 0.5 * found.score, found.score)
    free = np.ones(theirs.size, bool)
    for k in range(found.score.size):
        distance = np.hypot(uv[theirs, 0] - found.u_px[k], uv[theirs, 1] - found.v_px[k])
        same = free & (distance < rule.reach * found.diameter_px[k])
        same &= np.abs(np.log(size / found.diameter_px[k])) < math.log(rule.size_ratio)
        if same.any():
            best = int(np.argmin(np.where(same, distance, np.inf)))
            free[best] = False
            score[k] = 0.5 * (found.score[k] + other.score[theirs[best]])
    added = theirs[free]
    u, v, d = uv[added, 0], uv[added, 1], size[free]
    columns = (
        np.concatenate([found.u_px, u]),
        np.concatenate([found.v_px, v]),
        np.concatenate([found.diameter_px, d]),
        np.concatenate([found.diameter_m, diameter_on_ground_m(dataset, frame, u, v, d)]),
        np.concatenate([score, 0.5 * other.score[added]]),
        np.concatenate([found.sigma_px, other.sigma_px[added]]),
    )
    order = np.argsort(-columns[4], kind="stable")
    return FrameDetections(*(column[order] for column in columns))


def _ground_grid(dataset: Dataset, frame: Frame, side: int = 7) -> FloatArray:
    u, v = np.meshgrid(
        np.linspace(0, dataset.width_px - 1, side), np.linspace(0, dataset.height_px - 1, side)
    )
    return ground_points(dataset, frame, u.ravel(), v.ravel())


def _in_view(dataset: Dataset, frame: Frame, points: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Pixels (n, 2) of points (n, 3) in a frame, and which lie in its picture."""
    camera = dataset.camera
    uv = np.asarray(camera.project((points - frame.position_mcmf_m) @ frame.camera_from_mcmf.T))
    with np.errstate(invalid="ignore"):
        return uv, np.asarray(camera.contains(uv))


def format_two_suns(study: Mapping[str, Any], test: Mapping[str, Any] | None = None) -> str:
    """Return both ways on the validation split, the chosen one, and its test figures where given."""
    lines = [
        f"two Suns: {study['validation_frames']} of {study['of_validation_frames']} validation frames share most of "
        "their ground with another frame under a different Sun direction",
        *(_line(title, study[name]) for name, title in WAYS.items()),
        f"chosen on the validation split: {WAYS[study['chosen']]}",
    ]
    if test is not None:
        lines.append(_line(f"chosen, test, {test['test_frames']} frames", test))
    return "\n".join(lines)


def _line(title: str, row: Mapping[str, Any]) -> str:
    return (
        f"{title:38}{row['threshold']:10.2f}{row['strict']['precision']:7.3f}{row['strict']['recall']:7.3f}"
        f"{row['strict']['f1']:7.3f}{row['ignore_aware']['f1']:9.3f}"
    )
