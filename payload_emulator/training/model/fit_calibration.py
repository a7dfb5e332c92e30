"""Fit of a network's calibration on validation frames: standard deviations of the centres.

Real terrain is used where there is any, as for the thresholds. Detections that are probably craters, by their score
and size, are paired with the catalogue. Registration of the terrain (a displacement of the
catalogue from the drawn ground, metres east and north in each cell of 15 by 10 degrees) is estimated with the pull of
the Sun and removed from the errors, since it is not the detector's.

Which part of an error lasts is seen where one crater is in several frames under one Sun (`views` of a recipe): the
scatter about the crater's own mean is new in every frame, the rest lasts.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from lunar.arrays import BoolArray, FloatArray, IntArray
from payload_emulator.errors import DatasetError, ModelError
from payload_emulator.flight.vision import calibration
from payload_emulator.flight.vision.detections import Detections
from payload_emulator.flight.vision.detector import DetectorParameters, OnnxDetector
from payload_emulator.training.data.dataset import Dataset, Frame, FrameTruth, frame_truth
from payload_emulator.training.evaluate import evaluate
from payload_emulator.training.evaluate.scoring import FrameDetections, MatchRule, match, tally

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
_LARGEST_PULLED_PX = 60.0


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


@dataclass(frozen=True, slots=True)
class ScoreModel:
    """Logit of the probability: an offset, linear between knots of ln diameter_px, plus slope times logit of score."""

    log_diameter_px: tuple[float, ...]
    offset: tuple[float, ...]
    slope: float

    def probability(self, score: FloatArray, diameter_px: FloatArray) -> FloatArray:
        """Probabilities (n,) of scores and diameters (n,)."""
        size = np.log(np.maximum(diameter_px, 1e-3))
        offset = np.interp(size, self.log_diameter_px, self.offset)
        return np.asarray(1.0 / (1.0 + np.exp(-(offset + self.slope * logit(score)))))


def logit(probability: FloatArray) -> FloatArray:
    """Logarithm of the odds."""
    inside = np.clip(probability, 1e-6, 1.0 - 1e-6)
    return np.asarray(np.log(inside / (1.0 - inside)))


def sun_directions(diameter_px: FloatArray, sun_in_camera: FloatArray) -> FloatArray:
    """Displacements (n, 2, 3) in the image, right and down, of one unit of each coefficient of the pull of the Sun.

    The first is toward the Sun, the second too but in proportion to the diameter (20 px: 1), the third across, to the
    right of who looks toward the Sun, times the sine of twice the angle by which the Sun is to the right of the top of
    the turned image.
    """
    azimuth = float(np.arctan2(sun_in_camera[0], -sun_in_camera[1]))
    tilt = azimuth - 0.5 * np.pi * np.rint(azimuth / (0.5 * np.pi))
    toward = np.array([np.sin(azimuth), -np.cos(azimuth)])
    across = np.array([np.cos(azimuth), np.sin(azimuth)])
    size = np.minimum(diameter_px, _LARGEST_PULLED_PX) / calibration.REFERENCE_DIAMETER_PX
    one = np.ones_like(size)
    return np.stack(
        [one[:, None] * toward, size[:, None] * toward, one[:, None] * np.sin(2.0 * tilt) * across], axis=-1
    )


def plain_model(model_octets: bytes) -> bytes:
    """The model without a calibration."""
    metadata = dict(OnnxDetector(model_octets).metadata)
    metadata.pop(calibration.CALIBRATION_KEY, None)
    return calibration.with_metadata(model_octets, metadata)


def fit_calibration(
    model_octets: bytes, datasets: Sequence[Dataset], progress: Callable[[Sequence[Any]], Iterable[Any]] = iter
) -> tuple[bytes, dict[str, Any]]:
    """The model with its calibration, and what was fitted with its evidence.

    Raises
    ------
    DatasetError
        There are no validation frames of the detector's camera, or too few craters were found in them.
    ModelError
        The network gives classes and no sizes.
    """
    plain = plain_model(model_octets)
    detector = OnnxDetector(
        plain, DetectorParameters(score_threshold=evaluate.SCORE_FLOOR, max_detections=evaluate.EVERY_DETECTION)
    )
    if detector.class_medians_m is not None:
        raise ModelError("detector network: expected one that gives sizes, found one that gives classes only")
    frames = _validation_frames(datasets)
    for dataset in datasets:
        evaluate.refuse_other_camera(detector, dataset)
    truths = [frame_truth(d, f) for d, f in frames]
    found = [evaluate.detect_with_model(detector, d, f) for d, f in progress(frames)]
    pairs = _pairs(frames, truths, found, fit_score(truths, found))
    residual_px, evidence = fit_sun(pairs)
    sigma, sigma_evidence = fit_sigma(replace(pairs, error_px=residual_px))
    notes = {
        "frames": len(frames),
        "pairs": int(pairs.place.size),
        "labels_sha256": [dataset.digest for dataset in datasets],
    }
    metadata = dict(detector.metadata) | {
        calibration.CALIBRATION_KEY: calibration.format_calibration(sigma, plain, notes)
    }
    document = {
        **notes,
        "sun": evidence,
        "sigma": {"fresh": list(sigma.fresh), "total": list(sigma.total), **sigma_evidence},
    }
    return calibration.with_metadata(plain, metadata), document


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
        columns[1].append(calibration.sigma_features(seen, frame.sun_camera, truth.width_px, truth.height_px))
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


def fit_sun(pairs: Pairs) -> tuple[FloatArray, dict[str, Any]]:
    """Errors (n, 2) without the pull of the Sun and the registration of each cell, and both with standard errors.

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
        "coefficients_px": [float(value) for value in solution[:count]],
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
    return residual, evidence


def fit_sigma(pairs: Pairs) -> tuple[calibration.SigmaModel, dict[str, Any]]:
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
    fresh, kept_again = _log_linear(inner.features[again], 0.5 * (scatter**2).sum(axis=1), _FRESH_OUTLIER_SIGMAS)
    fresh[0] += np.log(FRESH_FACTOR)
    low, high = np.percentile(inner.features, (1.0, 99.0), axis=0)
    model = calibration.SigmaModel(*(tuple(float(x) for x in part) for part in (fresh, total, low, high)))
    variance, of_frame = model.variances_px2(inner.features)
    return model, {
        "detections": int(again.sum()),
        "mean_square_over_variance": float((0.5 * (inner.error_px**2).sum(axis=1) / variance).mean()),
        "outlier_share": float(1.0 - kept.mean()),
        "outlier_share_fresh": float(1.0 - kept_again.mean()),
        "by_diameter_px": [
            {
                "diameter_px": float(np.exp(size) * calibration.REFERENCE_DIAMETER_PX),
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
    """Format the fitted values as lines."""
    sun, sigma = document["sun"], document["sigma"]
    pulls = ", ".join(
        f"{name} {value:+.3f} ± {error:.3f}"
        for name, value, error in zip(
            ("toward", "toward per 20 px", "across"), sun["coefficients_px"], sun["standard_errors_px"], strict=True
        )
    )
    lines = [
        f"{document['frames']} validation frames, {document['pairs']} detections of catalogued craters",
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
