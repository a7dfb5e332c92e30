"""Figures of a detector on a data set: Table II and more, strict and ignore-aware, with the data source named."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from payload_emulator.errors import DatasetError
from payload_emulator.flight.detections import Detections
from payload_emulator.flight.detector import DetectorParameters, OnnxDetector, decode, drop_duplicates
from payload_emulator.flight.preprocess import prepare_image, sun_up_turns, turn_back
from payload_emulator.training.dataset import Dataset, Frame, diameter_on_ground_m, frame_truth
from payload_emulator.training.scoring import (
    DEGRADATION_EDGES,
    PAPER_TABLE_2,
    FrameDetections,
    FrameTruth,
    MatchRule,
    Tally,
    bootstrap_f1,
    tally,
)

SCORE_FLOOR = 0.10  # detections are kept down to this for curves; figures are given at the threshold
_CURVE_THRESHOLDS = tuple(round(0.10 + 0.05 * k, 2) for k in range(17))
_DIAMETER_EDGES_PX = (10.0, 16.0, 24.0, 32.0, 48.0, 96.0, 400.0)


def detect_with_network(network: Any, dataset: Dataset, frame: Frame, device: str = "cpu") -> FrameDetections:
    """Detections of a torch network (in evaluation mode) in one frame, prepared as on board."""
    import torch

    gray = prepare_image(dataset.image(frame)).gray
    turns = sun_up_turns(frame.sun_camera)
    with torch.no_grad():
        image = torch.from_numpy(np.ascontiguousarray(np.rot90(gray, turns)))[None, None].to(device)
        heat, geometry = network(image.contiguous(memory_format=torch.channels_last))
    found = decode(
        torch.sigmoid(heat)[0, 0].cpu().contiguous().numpy(),
        geometry[0].cpu().contiguous().numpy(),
        SCORE_FLOOR,
    )
    found = drop_duplicates(found.select(np.argsort(-found.score, kind="stable")), DetectorParameters())
    u_px, v_px = turn_back(found.u_px, found.v_px, turns, *gray.shape)
    return _on_ground(dataset, frame, Detections(u_px, v_px, found.diameter_px, found.score, found.sigma_px))


def detect_with_model(detector: OnnxDetector, dataset: Dataset, frame: Frame) -> FrameDetections:
    """Detections of the flight detector in one frame."""
    return _on_ground(dataset, frame, detector.detect(dataset.image(frame), frame.sun_camera))


def open_for_evaluation(model_octets: bytes) -> OnnxDetector:
    """The flight detector, kept down to `SCORE_FLOOR` so that curves can be drawn."""
    return OnnxDetector(model_octets, DetectorParameters(score_threshold=SCORE_FLOOR, max_detections=400))


def evaluate(
    model_octets: bytes,
    dataset: Dataset,
    split: str = "test",
    source: str = "",
    threshold: float | None = None,
    progress: Callable[[Sequence[Frame]], Any] = iter,
) -> dict[str, Any]:
    """Figures of a model on a split of a data set; `threshold` None takes the model's own (fixed on validation).

    Raises
    ------
    DatasetError
        The split is empty.
    """
    frames = dataset.frames(split, source)
    if not frames:
        where = f"split {split!r}" + (f", source {source!r}" if source else "")
        raise DatasetError(f"{dataset.folder}: expected frames of {where}, found none")
    detector = open_for_evaluation(model_octets)
    if threshold is None:
        threshold = float(detector.metadata.get("score_threshold", "0.4"))
    navigation = float(detector.metadata.get("navigation_threshold", str(threshold)))
    found = [detect_with_model(detector, dataset, frame) for frame in progress(frames)]
    truths = [frame_truth(dataset, frame) for frame in frames]
    figures = score(truths, found, threshold, navigation)
    return {
        "model_sha256": detector.sha256,
        "dataset": dataset.index["name"],
        "dataset_sha256": dataset.digest,
        "split": split,
        "source": source,
        "sources": sorted({frame.source for frame in frames}),
        "rung": evidence_rung(frames),
        "data": dataset.index["data"],
        "frames": len(frames),
        **figures,
    }


def evidence_rung(frames: Sequence[Frame]) -> str:
    """Which step of the ladder of evidence the frames stand on."""
    kinds = {frame.complete for frame in frames}
    split = {frame.split for frame in frames}
    held = "held out" if split <= {"test", "val"} else "trained on"
    if kinds == {True}:
        return f"2 (procedural Moon, {held})"
    if kinds == {False}:
        return f"3 (real terrain, {held})"
    return f"2 and 3 mixed ({held})"


def score(
    truths: Sequence[FrameTruth],
    found: Sequence[FrameDetections],
    threshold: float,
    navigation_threshold: float,
) -> dict[str, Any]:
    """All figures of detections against truths."""
    radius_rule = MatchRule(radii=0.5)
    strict = tally(truths, found)
    fair = tally(truths, found, ignore_aware=True)
    strict_radius = tally(truths, found, rule=radius_rule)
    per_class = []
    for k in range(3):
        per = tally(truths, found, classes=(k,)).figures(threshold).to_dict()
        per_radius = tally(truths, found, classes=(k,), rule=radius_rule).figures(threshold)
        per |= {
            "size_class": k,
            "precision_half_radius": per_radius.precision,
            "recall_half_radius": per_radius.recall,
            "paper": PAPER_TABLE_2[k],
        }
        per_class.append(per)
    all_sizes = tally(truths, found, low_m=3_000.0, high_m=30_000.0, ignore_aware=True)
    return {
        "threshold": threshold,
        "per_class": per_class,
        "micro": _with_interval(strict, threshold),
        "micro_half_radius": strict_radius.figures(threshold).to_dict(),
        "ignore_aware": _with_interval(fair, threshold),
        "ignore_aware_half_radius": tally(truths, found, ignore_aware=True, rule=radius_rule)
        .figures(threshold)
        .to_dict(),
        "ignore_aware_3_to_30_km": all_sizes.figures(threshold).to_dict(),
        "navigation": {
            "threshold": navigation_threshold,
            "strict": strict.figures(navigation_threshold).to_dict(),
            "ignore_aware": fair.figures(navigation_threshold).to_dict(),
        },
        "recall_by_degradation": _recall_by(
            strict, strict.crater_depth_ratio, DEGRADATION_EDGES, threshold, "depth_ratio"
        ),
        "recall_by_diameter_px": _recall_by(
            fair, fair.crater_diameter_px, _DIAMETER_EDGES_PX, threshold, "diameter_px"
        ),
        "bias_px_by_sun_octant": _bias_by_octant(strict, threshold),
        "sigma_calibration": _calibration(fair, threshold),
        "precision_recall": [
            {
                "threshold": t,
                **{
                    k: v for k, v in strict.figures(t).to_dict().items() if k in ("precision", "recall", "f1")
                },
            }
            for t in _CURVE_THRESHOLDS
        ],
        "unique_craters": int(np.unique(strict.crater_id).size),
        "blocks": int(np.unique(strict.crater_block).size),
    }


def format_figures(figures: dict[str, Any]) -> str:
    """The figures as a short table beside the paper's."""
    lines = [
        f"{figures['frames']} frames of {', '.join(figures['sources'])}; evidence rung {figures['rung']}; "
        f"threshold {figures['threshold']:.2f} (fixed on validation)",
        f"{'':24}{'P':>7}{'R':>7}{'F1':>7}{'loc px':>8}{'median':>8}   paper P / R / loc",
    ]
    names = ("class 0 (5-10 km)", "class 1 (10-15 km)", "class 2 (15-30 km)")
    for name, row in zip(names, figures["per_class"], strict=True):
        paper = row["paper"]
        lines.append(
            _row(name, row) + f"   {paper['precision']:.2f} / {paper['recall']:.2f} / {paper['loc_px']:.2f}"
        )
    lines.append(_row("5-30 km strict", figures["micro"]) + f"   F1 {_interval(figures['micro'])}")
    lines.append(
        _row("5-30 km ignore-aware", figures["ignore_aware"]) + f"   F1 {_interval(figures['ignore_aware'])}"
    )
    lines.append(_row("3-30 km ignore-aware", figures["ignore_aware_3_to_30_km"]))
    lines.append(_row("5-30 km within 0.5 R", figures["micro_half_radius"]))
    lines.append(
        _row(f"navigation ({figures['navigation']['threshold']:.2f})", figures["navigation"]["strict"])
    )
    recalls = ", ".join(
        f"{item['low']:g}-{item['high']:g}: {item['recall']:.2f} ({item['expected']})"
        for item in figures["recall_by_degradation"]
    )
    lines.append(f"recall by depth/diameter (craters): {recalls}")
    return "\n".join(lines)


def _row(name: str, row: dict[str, float]) -> str:
    values = (row["precision"], row["recall"], row["f1"])
    return (
        f"{name:24}"
        + "".join(f"{v:7.3f}" for v in values)
        + f"{row['loc_px']:8.2f}{row['loc_median_px']:8.2f}"
    )


def _interval(row: dict[str, Any]) -> str:
    low, high = row["f1_interval_95"]
    return f"[{low:.2f}, {high:.2f}]"


def _with_interval(tallied: Tally, threshold: float) -> dict[str, Any]:
    return {**tallied.figures(threshold).to_dict(), "f1_interval_95": list(bootstrap_f1(tallied, threshold))}


def _recall_by(
    tallied: Tally, values: NDArray[np.float64], edges: tuple[float, ...], threshold: float, name: str
) -> list[dict[str, Any]]:
    with np.errstate(invalid="ignore"):
        found = tallied.crater_score >= threshold
    rows = []
    for low, high in itertools.pairwise(edges):
        chosen = (values >= low) & (values < high) if low > edges[0] else values < high
        count = int(chosen.sum())
        rows.append(
            {
                "by": name,
                "low": low,
                "high": high,
                "expected": count,
                "recall": float(found[chosen].mean()) if count else float("nan"),
            }
        )
    return rows


def _bias_by_octant(tallied: Tally, threshold: float) -> list[dict[str, Any]]:
    right = (tallied.score >= threshold) & (tallied.outcome == 1)
    rows = []
    for octant in range(8):
        chosen = right & (tallied.detection_octant == octant)
        count = int(chosen.sum())
        rows.append(
            {
                "octant": octant,
                "sun_azimuth_image_deg": [45 * octant, 45 * (octant + 1)],
                "pairs": count,
                "du_px": float(np.mean(tallied.error_u[chosen])) if count else float("nan"),
                "dv_px": float(np.mean(tallied.error_v[chosen])) if count else float("nan"),
                "standard_error_px": float(np.std(tallied.error_u[chosen]) / np.sqrt(count))
                if count
                else float("nan"),
            }
        )
    return rows


def _calibration(tallied: Tally, threshold: float) -> dict[str, float]:
    """How the errors compare with the predicted sigma: 1 and 0.683 would be perfect for a Gaussian."""
    right = (tallied.score >= threshold) & (tallied.outcome == 1)
    scaled = np.concatenate(
        [tallied.error_u[right] / tallied.sigma_px[right], tallied.error_v[right] / tallied.sigma_px[right]]
    )
    if scaled.size == 0:
        return {"rms": float("nan"), "inside_one_sigma": float("nan"), "inside_three_sigma": float("nan")}
    return {
        "rms": float(np.sqrt(np.mean(scaled**2))),
        "median_ratio": float(np.median(np.abs(scaled)) / 0.6745),
        "inside_one_sigma": float(np.mean(np.abs(scaled) < 1.0)),
        "inside_three_sigma": float(np.mean(np.abs(scaled) < 3.0)),
    }


def _on_ground(dataset: Dataset, frame: Frame, found: Detections) -> FrameDetections:
    return FrameDetections(
        found.u_px,
        found.v_px,
        found.diameter_px,
        diameter_on_ground_m(dataset, frame, found.u_px, found.v_px, found.diameter_px),
        found.score,
        found.sigma_px,
    )
