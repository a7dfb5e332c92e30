"""Fit of a network's calibration on validation frames: scores by size, the pull of the Sun, and position errors.

Real terrain is used where there is any, as for the thresholds. Registration of the terrain (a displacement of the
catalogue from the drawn ground, metres east and north in each cell of 15 by 10 degrees) is estimated with the pull of
the Sun and removed from the errors, since it is not the detector's.

Which part of an error lasts is seen where one crater is in several frames under one Sun (`views` of a recipe): the
scatter about the crater's own mean is new in every frame, the rest lasts.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from lunar.arrays import BoolArray, FloatArray, IntArray
from payload_emulator.errors import DatasetError, ModelError
from payload_emulator.flight.vision.calibration import (
    CALIBRATION_KEY,
    REFERENCE_DIAMETER_PX,
    Calibration,
    ScoreModel,
    SigmaModel,
    SunModel,
    format_calibration,
    logit,
    sigma_features,
    sun_directions,
    with_metadata,
)
from payload_emulator.flight.vision.detections import Detections
from payload_emulator.flight.vision.detector import DetectorParameters, OnnxDetector
from payload_emulator.training.data.dataset import Dataset, Frame, frame_truth
from payload_emulator.training.data.truth import FrameTruth
from payload_emulator.training.evaluate.evaluate import (
    EVERY_DETECTION,
    SCORE_FLOOR,
    detect_with_model,
    refuse_other_camera,
)
from payload_emulator.training.evaluate.scoring import (
    FrameDetections,
    MatchRule,
    best_threshold,
    match,
    tally,
    threshold_for_precision,
)
from payload_emulator.training.model.calibrate import NAVIGATION_PRECISION

ON_BOARD_PRECISION = 0.85
"""Share of the detections of 3 to 30 km used on board that are catalogued craters, over the validation frames."""

DEFAULT_PARTS = ("score", "sigma")
"""The pull of the Sun is left out: on validation frames it is below 0.1 px at 20 px, with opposite signs on real and on
procedural terrain."""

_KNOTS_PX = (10.0, 14.0, 20.0, 32.0, 48.0, 80.0)
_SCORED_M = (3_000.0, 30_000.0)
_LEAST_DIAMETER_M = 2_500.0  # what real terrain resolves
_LEAST_ROWS = 200
_RIGHT_PROBABILITY = 0.4
_SAME_SIZE = 0.4  # of ln diameter: a pair that differs more is of two craters
_CELL_DEG = (15.0, 10.0)
_OUTLIER_SIGMAS = 3.5
FRESH_FACTOR = 1.6
"""Factor on the fitted sigma of fresh errors. The error of a crater also drifts with the direction of view while it
crosses the image, alike for neighbouring craters, which the filter takes for new information. Chosen of 1, 1.6 and 2.2
as the least with a NIS of 0.8 to 1.2 and no more refused fixes over validation windows (`docs/detector.md`)."""

_FRESH_OUTLIER_SIGMAS = 6.0
"""Beyond, an error new in a frame is left out of the fit. Its distribution has long tails that the filter meets: a
detection that jumps refuses a whole fix if the stated sigma is that of the quiet ones."""
_ROUNDS = 6
_RIDGE = 1e-3
_THRESHOLDS = ("score_threshold", "f1_threshold", "navigation_threshold")
_RAW_THRESHOLDS = "network_thresholds"


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """Detections with the crater that each is, arrays (n,): error (n, 2) px, features of sigma (n, 6), and more.

    `directions` (n, 2, 3) are those of `sun_directions`; `place` numbers cells of ground, `crater` numbers craters
    under one Sun.
    """

    error_px: FloatArray
    features: FloatArray
    directions: FloatArray
    ground_m_per_px: FloatArray
    place: IntArray
    crater: IntArray

    def select(self, which: BoolArray) -> Pairs:
        return Pairs(*(getattr(self, one.name)[which] for one in fields(self)))


def plain_model(model_octets: bytes) -> bytes:
    """The model without a calibration, with the thresholds that belong to the network's own scores."""
    metadata = dict(OnnxDetector(model_octets).metadata)
    metadata.pop(CALIBRATION_KEY, None)
    metadata |= json.loads(metadata.pop(_RAW_THRESHOLDS, "{}"))
    return with_metadata(model_octets, metadata)


def fit_calibration(
    model_octets: bytes,
    datasets: Sequence[Dataset],
    parts: Sequence[str] = DEFAULT_PARTS,
    precision: float = ON_BOARD_PRECISION,
    progress: Callable[[Sequence[Any]], Iterable[Any]] = iter,
) -> tuple[bytes, dict[str, Any]]:
    """The model with the named parts of a calibration, and what was fitted with its evidence.

    Raises
    ------
    DatasetError
        There are no validation frames of the detector's camera, or too few craters were found in them.
    ModelError
        The network gives classes and no sizes.
    """
    plain = plain_model(model_octets)
    detector = OnnxDetector(
        plain, DetectorParameters(score_threshold=SCORE_FLOOR, max_detections=EVERY_DETECTION)
    )
    if detector.class_medians_m is not None:
        raise ModelError("detector network: expected one that gives sizes, found one that gives classes only")
    frames = _validation_frames(datasets)
    for dataset in datasets:
        refuse_other_camera(detector, dataset)
    truths = [frame_truth(d, f) for d, f in frames]
    found = [detect_with_model(detector, d, f) for d, f in progress(frames)]
    score = fit_score(truths, found)
    pairs = _pairs(frames, truths, found, score)
    sun, residual_px, evidence = fit_sun(pairs)
    sigma, sigma_evidence = fit_sigma(replace(pairs, error_px=residual_px))
    calibration = Calibration(
        score if "score" in parts else None,
        sigma if "sigma" in parts else None,
        sun if "sun" in parts else None,
    )
    thresholds = {name: float(detector.metadata.get(name, "0.4")) for name in _THRESHOLDS}
    metadata = dict(detector.metadata)
    if calibration.score is not None:
        metadata[_RAW_THRESHOLDS] = json.dumps({name: metadata.get(name, "0.4") for name in _THRESHOLDS})
        thresholds = _thresholds(truths, found, score, precision)
        metadata |= {name: str(value) for name, value in thresholds.items()}
    notes = {
        "frames": len(frames),
        "pairs": int(pairs.place.size),
        "labels_sha256": [dataset.digest for dataset in datasets],
    }
    if parts:
        metadata[CALIBRATION_KEY] = format_calibration(calibration, plain, notes)
    document = {
        **notes,
        "parts": list(parts),
        "thresholds": thresholds,
        "score_threshold_by_diameter_px": _raw_thresholds(score, thresholds["score_threshold"])
        if calibration.score is not None
        else [],
        "sun": {"coefficients_px": list(sun.coefficients), **evidence},
        "sigma": {"fresh": list(sigma.fresh), "total": list(sigma.total), **sigma_evidence},
    }
    return with_metadata(plain, metadata), document


def _validation_frames(datasets: Sequence[Dataset]) -> list[tuple[Dataset, Frame]]:
    every = [(d, f) for d in datasets for f in d.frames("val")]
    if not every:
        names = ", ".join(str(d.folder) for d in datasets)
        raise DatasetError(f"{names}: expected frames of split 'val', found none")
    real = [(d, f) for d, f in every if not f.complete]
    return real or every


def fit_score(truths: Sequence[FrameTruth], found: Sequence[FrameDetections]) -> ScoreModel:
    """Probability that a detection of 3 to 30 km is a catalogued crater, by maximum likelihood (Newton's method)."""
    score, diameter, outcome = [], [], []
    for truth, part in zip(truths, found, strict=True):
        alone = tally([truth], [part], low_m=_SCORED_M[0], high_m=_SCORED_M[1])
        chosen = (part.diameter_m >= _SCORED_M[0]) & (part.diameter_m <= _SCORED_M[1])
        score.append(alone.score)
        outcome.append(alone.outcome == 1)
        diameter.append(part.diameter_px[chosen])
    raw, right = np.concatenate(score), np.concatenate(outcome).astype(float)
    size = np.log(np.maximum(np.concatenate(diameter), 1e-3))
    if right.size < _LEAST_ROWS or not 0.0 < right.mean() < 1.0:
        raise DatasetError(
            f"calibration: expected at least {_LEAST_ROWS} detections, right ones and wrong ones, found {right.size} "
            f"of which {int(right.sum())} are right"
        )
    knots = np.log(_KNOTS_PX)
    basis = np.stack([np.interp(size, knots, row) for row in np.eye(knots.size)], axis=1)
    design = np.concatenate([basis, logit(raw)[:, None]], axis=1)
    weight = np.concatenate([np.zeros(knots.size), [1.0]])
    for _ in range(25):
        probability = 1.0 / (1.0 + np.exp(-design @ weight))
        slope = design.T @ (right - probability)
        curvature = (design * (probability * (1.0 - probability))[:, None]).T @ design
        step = np.linalg.solve(curvature + _RIDGE * np.eye(weight.size), slope)
        weight = weight + step
        if np.abs(step).max() < 1e-8:
            break
    return ScoreModel(tuple(float(x) for x in knots), tuple(float(x) for x in weight[:-1]), float(weight[-1]))


def _raw_thresholds(score: ScoreModel, probability: float) -> list[dict[str, float]]:
    """The network's own score at which the probability is reached, by diameter."""
    wanted = float(logit(np.array(probability)))
    return [
        {
            "diameter_px": float(np.exp(size)),
            "score": float(1.0 / (1.0 + np.exp(-(wanted - offset) / score.slope))),
        }
        for size, offset in zip(score.log_diameter_px, score.offset, strict=True)
    ]


def _thresholds(
    truths: Sequence[FrameTruth], found: Sequence[FrameDetections], score: ScoreModel, precision: float
) -> dict[str, float]:
    """Thresholds of the calibrated score: on board, of the greatest F1, and of the precision for navigation."""
    calibrated = []
    for part in found:
        moved = replace(part, score=score.probability(part.score, part.diameter_px))
        calibrated.append(_ordered(moved, np.argsort(-moved.score, kind="stable")))
    on_board = threshold_for_precision(
        tally(truths, calibrated, low_m=_SCORED_M[0], high_m=_SCORED_M[1]), precision
    )
    tallied = tally(truths, calibrated)
    balanced, _ = best_threshold(tallied)
    navigation = max(on_board, threshold_for_precision(tallied, NAVIGATION_PRECISION))
    return dict(
        zip(_THRESHOLDS, (round(value, 3) for value in (on_board, balanced, navigation)), strict=True)
    )


def _ordered(part: FrameDetections, order: IntArray) -> FrameDetections:
    columns = (getattr(part, one.name) for one in fields(part))
    ordered: list[Any] = [None if values is None else values[order] for values in columns]
    return FrameDetections(*ordered)


def _pairs(
    frames: Sequence[tuple[Dataset, Frame]],
    truths: Sequence[FrameTruth],
    found: Sequence[FrameDetections],
    score: ScoreModel,
) -> Pairs:
    """Detections that are a catalogued crater of 2.5 km and more, of the same size within half its radius."""
    columns: list[list[Any]] = [[] for _ in range(5)]
    keys: list[tuple[Any, ...]] = []
    for (dataset, frame), truth, part in zip(frames, truths, found, strict=True):
        good = np.flatnonzero(score.probability(part.score, part.diameter_px) >= _RIGHT_PROBABILITY)
        listed = np.flatnonzero(
            (truth.diameter_m >= _LEAST_DIAMETER_M)
            & (np.abs(truth.u_px - 0.5 * (truth.width_px - 1)) < 0.5 * truth.width_px)
            & (np.abs(truth.v_px - 0.5 * (truth.height_px - 1)) < 0.5 * truth.height_px)
        )
        hit = match(
            part.u_px[good],
            part.v_px[good],
            truth.u_px[listed],
            truth.v_px[listed],
            truth.diameter_px[listed],
            MatchRule(radii=0.5),
        )
        d, c = good[hit >= 0], listed[hit[hit >= 0]]
        same = np.abs(np.log(part.diameter_px[d] / truth.diameter_px[c])) < _SAME_SIZE
        d, c = d[same], c[same]
        seen = Detections(
            part.u_px[d],
            part.v_px[d],
            part.diameter_px[d],
            part.score[d],
            part.sigma_px[d],
            None if part.depth_ratio is None else part.depth_ratio[d],
        )
        above_m = frame.values["altitude_m"] - frame.values["ground_m"]
        columns[0].append(np.stack([part.u_px[d] - truth.u_px[c], part.v_px[d] - truth.v_px[c]], axis=1))
        columns[1].append(sigma_features(seen, frame.sun_camera, truth.width_px, truth.height_px))
        columns[2].append(sun_directions(seen.diameter_px, frame.sun_camera))
        columns[3].append(np.full(d.size, above_m / dataset.focal_px))
        columns[4].append(np.full(d.size, _place(frame), dtype=np.int64))
        sun = frame.camera_from_mcmf.T @ frame.sun_camera
        light = (frame.source, *(int(value) for value in np.rint(1e7 * sun)))
        keys += [(light, int(number)) for number in truth.ids[c]]
    numbers: dict[tuple[Any, ...], int] = {}
    crater = np.array([numbers.setdefault(key, len(numbers)) for key in keys], dtype=np.int64)
    if crater.size < _LEAST_ROWS:
        raise DatasetError(
            f"calibration: expected at least {_LEAST_ROWS} detections of catalogued craters, found {crater.size}"
        )
    _, place = np.unique(np.concatenate(columns[4]), return_inverse=True)
    error_px, features, directions, ground_m_per_px = (np.concatenate(column) for column in columns[:4])
    return Pairs(error_px, features, directions, ground_m_per_px, place.astype(np.int64), crater)


def _place(frame: Frame) -> int:
    """Number of the cell of ground below a frame."""
    return int(frame.values["longitude_deg"] // _CELL_DEG[0]) * 100 + int(
        (frame.values["latitude_deg"] + 90.0) // _CELL_DEG[1]
    )


def fit_sun(pairs: Pairs) -> tuple[SunModel, FloatArray, dict[str, Any]]:
    """The pull of the Sun with the registration of each cell, errors without both (n, 2), and standard errors.

    Weighted least squares; pairs beyond 3.5 sigma are left out.
    """
    cells = int(pairs.place.max()) + 1
    step_px = 1.0 / pairs.ground_m_per_px
    ground = np.zeros((pairs.place.size, 2, 2 * cells))
    row = np.arange(pairs.place.size)
    ground[row, 0, 2 * pairs.place] = step_px  # a detection east of the catalogue's place
    ground[row, 1, 2 * pairs.place + 1] = step_px  # south of it
    design = np.concatenate([pairs.directions, ground], axis=2)
    count = pairs.directions.shape[2]
    weight = 1.0 / np.maximum(np.exp(pairs.features[:, 2]), 0.3)
    keep = np.ones(row.size, dtype=bool)
    for _ in range(_ROUNDS):
        left = (design[keep] * weight[keep, None, None]).reshape(-1, design.shape[2])
        right = (pairs.error_px[keep] * weight[keep, None]).reshape(-1)
        solution = np.linalg.lstsq(left, right, rcond=None)[0]
        residual = pairs.error_px - design @ solution
        keep = np.hypot(*(residual * weight[:, None]).T) < _OUTLIER_SIGMAS
    spread = np.linalg.pinv(left.T @ left) * np.mean((right - left @ solution) ** 2)
    sigma = np.sqrt(np.diag(spread))
    of_cell = np.bincount(pairs.place[keep], minlength=cells)
    evidence = {
        "standard_errors_px": [float(value) for value in sigma[:count]],
        "registration": [
            {
                "pairs": int(of_cell[k]),
                "east_m": float(solution[count + 2 * k]),
                "north_m": float(-solution[count + 2 * k + 1]),
                "standard_error_m": float(sigma[count + 2 * k]),
            }
            for k in range(cells)
        ],
    }
    return SunModel(tuple(float(value) for value in solution[:count])), residual, evidence


def fit_sigma(pairs: Pairs) -> tuple[SigmaModel, dict[str, Any]]:
    """Standard deviations by their features, in all and new in every frame.

    Raises
    ------
    DatasetError
        Too few craters are in several frames under one Sun.
    """
    total, kept = _log_linear(pairs.features, 0.5 * (pairs.error_px**2).sum(axis=1))
    inner = pairs.select(kept)
    _, crater = np.unique(inner.crater, return_inverse=True)
    times = np.bincount(crater)
    mean = np.stack([np.bincount(crater, weights=axis) for axis in inner.error_px.T], axis=1) / times[:, None]
    again = times[crater] > 1
    if np.count_nonzero(again) < _LEAST_ROWS:
        raise DatasetError(
            f"calibration: expected at least {_LEAST_ROWS} detections of craters in several frames under one Sun, "
            f"found {np.count_nonzero(again)}: add a data set with views, such as the recipe detector-passes"
        )
    scatter = (inner.error_px - mean[crater])[again] * np.sqrt(times / np.maximum(times - 1.0, 1.0))[crater][
        again, None
    ]
    fresh, kept_again = _log_linear(
        inner.features[again], 0.5 * (scatter**2).sum(axis=1), _FRESH_OUTLIER_SIGMAS
    )
    fresh[0] += np.log(FRESH_FACTOR)
    low, high = np.percentile(inner.features, (1.0, 99.0), axis=0)
    model = SigmaModel(*(tuple(float(x) for x in part) for part in (fresh, total, low, high)))
    variance, of_frame = model.variances_px2(inner.features)
    return model, {
        "detections": int(again.sum()),
        "mean_square_over_variance": float((0.5 * (inner.error_px**2).sum(axis=1) / variance).mean()),
        "outlier_share": float(1.0 - kept.mean()),
        "outlier_share_fresh": float(1.0 - kept_again.mean()),
        "by_diameter_px": [
            {
                "diameter_px": float(np.exp(size) * REFERENCE_DIAMETER_PX),
                "sigma_px": float(np.sqrt(variance[part].mean())),
                "fresh_px": float(np.sqrt(of_frame[part].mean())),
                "persistence": float(1.0 - of_frame[part].mean() / variance[part].mean()),
                "pairs": int(part.sum()),
            }
            for size, part in _by_size(inner.features[:, 1])
        ],
    }


def _by_size(log_size: FloatArray) -> list[tuple[float, BoolArray]]:
    edges = np.quantile(log_size, np.linspace(0.0, 1.0, 7))
    parts = [(log_size >= a) & (log_size <= b) for a, b in itertools.pairwise(edges)]
    return [(float(np.median(log_size[part])), part) for part in parts if part.any()]


def _log_linear(
    features: FloatArray, mean_square: FloatArray, outlier_sigmas: float = _OUTLIER_SIGMAS
) -> tuple[FloatArray, BoolArray]:
    """Coefficients of ln sigma for mean squares (n,) of two axes, and which rows are no outliers.

    Maximum likelihood of normal errors by Newton's method; rows beyond `outlier_sigmas` are left out and the fit
    repeated.
    """
    keep = np.ones(mean_square.size, dtype=bool)
    middle, width = features.mean(axis=0), np.maximum(features.std(axis=0), 1e-9)
    scaled = np.where(features.std(axis=0) > 1e-9, (features - middle) / width, 0.0)
    scaled[:, 0] = 1.0
    weight = np.zeros(features.shape[1])
    weight[0] = 0.5 * np.log(max(float(np.median(mean_square)), 1e-6))
    for _ in range(_ROUNDS):
        for _ in range(30):
            ratio = mean_square[keep] * np.exp(-2.0 * scaled[keep] @ weight)
            slope = scaled[keep].T @ (ratio - 1.0)
            curvature = (scaled[keep] * (2.0 * np.maximum(ratio, 0.05))[:, None]).T @ scaled[keep]
            step = np.linalg.solve(curvature + _RIDGE * np.eye(weight.size), slope)
            weight = weight + np.clip(step, -0.5, 0.5)
            if np.abs(step).max() < 1e-7:
                break
        ratio = mean_square * np.exp(-2.0 * scaled @ weight)
        keep = 2.0 * ratio < outlier_sigmas**2
    coefficients = np.where(features.std(axis=0) > 1e-9, weight / width, 0.0)
    coefficients[0] = weight[0] - float((coefficients[1:] * middle[1:]).sum())
    return coefficients, keep


def format_calibration_figures(document: dict[str, Any]) -> str:
    """What was fitted, in lines."""
    thresholds, sun, sigma = document["thresholds"], document["sun"], document["sigma"]
    limits = ", ".join(
        f"{row['score']:.2f} at {row['diameter_px']:.0f} px"
        for row in document["score_threshold_by_diameter_px"]
    )
    pulls = ", ".join(
        f"{name} {value:+.3f} ± {error:.3f}"
        for name, value, error in zip(
            ("toward", "toward per 20 px", "across"),
            sun["coefficients_px"],
            sun["standard_errors_px"],
            strict=True,
        )
    )
    lines = [
        f"{document['frames']} validation frames, {document['pairs']} detections of catalogued craters; parts "
        f"{', '.join(document['parts']) or 'none'}",
        f"threshold on board {thresholds['score_threshold']:.2f}, balanced {thresholds['f1_threshold']:.2f}, "
        f"navigation {thresholds['navigation_threshold']:.2f}; score of the network on board: "
        f"{limits or 'the same for all sizes'}",
        f"pull of the Sun px: {pulls}",
        f"sigma: mean square error over variance {sigma['mean_square_over_variance']:.2f}, "
        f"{100 * sigma['outlier_share']:.1f} % outliers",
    ]
    lines += [
        f"  {row['diameter_px']:5.1f} px: sigma {row['sigma_px']:.2f} px, new in every frame {row['fresh_px']:.2f} px, "
        f"lasting share {row['persistence']:.2f} ({row['pairs']} pairs)"
        for row in sigma["by_diameter_px"]
    ]
    lines += [
        f"  registration {row['east_m']:+.0f} m east, {row['north_m']:+.0f} m north ± {row['standard_error_m']:.0f} m "
        f"({row['pairs']} pairs)"
        for row in sun["registration"]
    ]
    return "\n".join(lines)
