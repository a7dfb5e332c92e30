"""Figures of a detector on a data set: Table II and more, strict and ignore-aware, with the data source named."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lunar.frames import spherical_from_mcmf
from payload_emulator.errors import DatasetError, ModelError
from payload_emulator.flight.vision.detections import Detections
from payload_emulator.flight.vision.detector import (
    INPUT_SIZE_PX,
    DetectorParameters,
    OnnxDetector,
    decode,
    drop_duplicates,
)
from payload_emulator.flight.vision.preprocess import Preparation, prepare_image, sun_up_turns, turn_back
from payload_emulator.training.data.dataset import (
    Dataset,
    Frame,
    FrameTruth,
    diameter_on_ground_m,
    frame_truth,
    ground_points,
)
from payload_emulator.training.evaluate.metrics import Scene, Thresholds, score
from payload_emulator.training.evaluate.scoring import FrameDetections

EVERY_DETECTION = 4_000  # a frame at 150 km shows some 1,000 craters of 5 to 30 km; on board fewer are kept
SCORE_FLOOR = 0.10  # detections are kept down to this for curves; figures are given at the threshold
_CLASS_DIAMETERS_M = (7_000.0, 12_000.0, 20_000.0)  # where a network does not tell its priors


@dataclass(frozen=True, slots=True, eq=False)
class Scored:
    """Frames of a data set with truth, detections and circumstances, one each."""

    frames: list[tuple[Dataset, Frame]]
    truths: list[FrameTruth]
    found: list[FrameDetections]
    scenes: list[Scene]
    thresholds: Thresholds


def detect_with_network(network: Any, dataset: Dataset, frame: Frame, device: str = "cpu") -> FrameDetections:
    """Detections of a torch network (in evaluation mode) in one frame, prepared as on board."""
    import torch

    gray = prepare_image(dataset.image(frame), Preparation(network.config.preparation)).gray
    turns = sun_up_turns(frame.sun_camera)
    with torch.no_grad():
        image = torch.from_numpy(np.ascontiguousarray(np.rot90(gray, turns)))[None, None].to(device)
        heat, geometry = network(image.contiguous(memory_format=torch.channels_last))
    found = decode(
        torch.sigmoid(heat)[0, 0].cpu().contiguous().numpy(),
        geometry[0].cpu().contiguous().numpy(),
        SCORE_FLOOR,
        network.config.cell_px,
    )
    found = drop_duplicates(found.select(np.argsort(-found.score, kind="stable")), DetectorParameters())
    u_px, v_px = turn_back(found.u_px, found.v_px, turns, *gray.shape)
    return _on_ground(
        dataset, frame, Detections(u_px, v_px, found.diameter_px, found.score, found.sigma_px, found.depth_ratio)
    )


def detect_with_model(detector: OnnxDetector, dataset: Dataset, frame: Frame) -> FrameDetections:
    """Detections of the flight detector in one frame."""
    return _on_ground(dataset, frame, detector.detect(dataset.image(frame), frame.sun_camera))


def detect_by_class(detector: OnnxDetector, dataset: Dataset, frame: Frame) -> FrameDetections:
    """Detections of the paper's design in one frame: the class is that of the heatmap, guessed from the image alone.

    Raises
    ------
    ModelError
        The network has no class heatmaps.
    """
    prepared = prepare_image(dataset.image(frame), detector.preparation).gray
    turns = sun_up_turns(frame.sun_camera)
    heatmap, geometry = detector.run_network(np.ascontiguousarray(np.rot90(prepared, turns))[None, None])
    if heatmap.shape[1] not in (3, 4):
        raise ModelError(f"detector network: expected the paper's three class heatmaps, found {heatmap.shape[1] - 1}")
    heats = heatmap[0, -3:]
    parts = [decode(heat, geometry[0], SCORE_FLOOR, detector.stride_px) for heat in heats]
    column = {
        name: np.concatenate([getattr(part, name) for part in parts])
        for name in ("u_px", "v_px", "diameter_px", "score", "sigma_px")
    }
    classes = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    column["u_px"], column["v_px"] = turn_back(column["u_px"], column["v_px"], turns, *prepared.shape)
    medians_m = np.array(_CLASS_DIAMETERS_M) if detector.class_medians_m is None else detector.class_medians_m
    found = Detections(**column, size_class=classes, diameter_m=medians_m[classes])
    return _on_ground(dataset, frame, found.select(np.argsort(-found.score, kind="stable")))


def open_for_evaluation(model_octets: bytes) -> OnnxDetector:
    """The flight detector, kept down to `SCORE_FLOOR` so that curves can be drawn."""
    return OnnxDetector(model_octets, DetectorParameters(score_threshold=SCORE_FLOOR, max_detections=EVERY_DETECTION))


def run(
    detector: OnnxDetector,
    datasets: Sequence[Dataset],
    split: str = "test",
    source: str = "",
    threshold: float | None = None,
    progress: Callable[[Sequence[Any]], Any] = iter,
    *,
    paper_classes: bool = False,
) -> Scored:
    """Detections of a model over a split; `threshold` None takes the model's own (fixed on validation).

    Raises
    ------
    DatasetError
        The split is empty, or the frames are of another camera than the detector's.
    """
    frames = [(d, f) for d in datasets for f in d.frames(split, source)]
    names = ", ".join(str(d.folder) for d in datasets)
    if not frames:
        where = f"split {split!r}" + (f", source {source!r}" if source else "")
        raise DatasetError(f"{names}: expected frames of {where}, found none")
    for dataset in datasets:
        refuse_other_camera(detector, dataset)
    own = float(detector.metadata.get("score_threshold", "0.4"))
    if paper_classes:
        own = float(detector.metadata.get("paper_threshold", str(own)))
    thresholds = Thresholds(
        own if threshold is None else threshold,
        float(detector.metadata.get("f1_threshold", str(own))),
        float(detector.metadata.get("navigation_threshold", str(own))),
    )
    detect = detect_by_class if paper_classes else detect_with_model
    return Scored(
        frames,
        [frame_truth(d, f) for d, f in frames],
        [detect(detector, d, f) for d, f in progress(frames)],
        [
            Scene(
                (f.values["altitude_m"] - f.values["ground_m"]) / 1000.0,
                f.values["sun_elevation_deg"],
                f.values["ground_m"],
                f.source,
            )
            for _, f in frames
        ],
        thresholds,
    )


def evaluate(
    model_octets: bytes,
    datasets: Dataset | Sequence[Dataset],
    split: str = "test",
    source: str = "",
    threshold: float | None = None,
    *,
    paper_classes: bool = False,
) -> dict[str, Any]:
    """Figures of a model on a split of one or several data sets; see `run` for what is refused."""
    datasets = [datasets] if isinstance(datasets, Dataset) else list(datasets)
    detector = open_for_evaluation(model_octets)
    scored = run(detector, datasets, split, source, threshold, paper_classes=paper_classes)
    return summary(detector, datasets, scored, split, source)


def summary(
    detector: OnnxDetector, datasets: Sequence[Dataset], scored: Scored, split: str, source: str = ""
) -> dict[str, Any]:
    """Figures of scored frames with what they rest on."""
    frames = [f for _, f in scored.frames]
    figures = score(scored.truths, scored.found, scored.thresholds, scored.scenes)
    return {
        "model_sha256": detector.sha256,
        "dataset": ", ".join(sorted({str(d.index["name"]) for d in datasets})),
        "dataset_sha256": [d.digest for d in datasets],
        "split": split,
        "source": source,
        "sources": sorted({frame.source for frame in frames}),
        "level": evidence_level(frames),
        "data": sorted({str(name) for d in datasets for name in d.index["data"]}),
        "frames": len(frames),
        **figures,
    }


def evidence_level(frames: Sequence[Frame]) -> str:
    """Return the evidence level of figures on these frames.

    The validation split fixes thresholds and choices, so its terrain counts as seen.
    """
    kinds = {frame.complete for frame in frames}
    split = {frame.split for frame in frames}
    held = "held out" if split <= {"test"} else "seen in training"
    if kinds == {True}:
        return f"2 (procedural Moon, {held})"
    if kinds == {False}:
        return f"3 (real terrain, {held})" if split <= {"test"} else f"3s (real terrain, {held})"
    return f"2 and {'3' if split <= {'test'} else '3s'} mixed ({held})"


def format_figures(figures: dict[str, Any]) -> str:
    """Return a short table of the figures and those of the paper."""
    lines = [
        f"{figures['frames']} frames of {', '.join(figures['sources'])}; evidence level {figures['level']}; "
        f"threshold {figures['threshold']:.2f} (fixed on validation)",
        f"{'':28}{'P':>7}{'R':>7}{'F1':>7}{'loc px':>8}{'median':>8}   paper P / R / loc",
    ]
    names = ("class 0 (5-10 km)", "class 1 (10-15 km)", "class 2 (15-30 km)")
    for name, row in zip(names, figures["per_class"], strict=True):
        paper = row["paper"]
        lines.append(_row(name, row) + f"   {paper['precision']:.2f} / {paper['recall']:.2f} / {paper['loc_px']:.2f}")
    lines.append(_row("5-30 km strict", figures["micro"]) + f"   F1 {_interval(figures['micro'])}")
    lines.append(_row("5-30 km ignore-aware", figures["ignore_aware"]) + f"   F1 {_interval(figures['ignore_aware'])}")
    lines.append(_row("3-30 km strict", figures["strict_3_to_30_km"]))
    lines.append(_row("3-30 km ignore-aware", figures["ignore_aware_3_to_30_km"]))
    lines.append(_row("5-30 km within 0.5 R", figures["micro_half_radius"]))
    for name in ("balanced", "navigation"):
        at = figures[name]
        lines.append(_row(f"{name} ({at['threshold']:.2f}) strict", at["strict"]))
        lines.append(_row(f"{name} ({at['threshold']:.2f}) ign.-aware", at["ignore_aware"]))
    recalls = ", ".join(
        f"{item['low']:g}-{item['high']:g}: {item['recall']:.2f} ({item['expected']})"
        for item in figures["recall_by_degradation"]
    )
    lines.append(f"recall by depth/diameter (craters): {recalls}")
    lines += _bias_lines(figures)
    average = figures["average_precision_half_radius"]
    lines.append(
        f"AP within 0.5 R: strict {average['strict']:.3f}, ignore-aware {average['ignore_aware']:.3f}; errors inside "
        f"one sigma {figures['sigma_calibration']['inside_one_sigma']:.2f}"
    )
    for row in figures["by_terrain"]:
        lines.append(_row(f"{row['name']} ({row['frames']} frames) strict", row["strict"]))
    return "\n".join(lines)


def _row(name: str, row: dict[str, float]) -> str:
    values = (row["precision"], row["recall"], row["f1"])
    return f"{name:28}" + "".join(f"{v:7.3f}" for v in values) + f"{row['loc_px']:8.2f}{row['loc_median_px']:8.2f}"


def _bias_lines(figures: dict[str, Any]) -> list[str]:
    """Signed bias by octant of the Sun's azimuth in the image."""
    bias = figures["bias_px"]
    lines = [
        f"bias px: right {bias['du_px']:+.2f}, down {bias['dv_px']:+.2f}, toward the Sun {bias['toward_sun_px']:+.2f}, "
        f"across {bias['across_sun_px']:+.2f}; longest by Sun octant {bias['worst_octant_px']:.2f} "
        f"(noise {bias['worst_octant_noise_px']:.2f})"
    ]
    lines += [
        f"  Sun at {row['sun_azimuth_image_deg'][0]:3d}-{row['sun_azimuth_image_deg'][1]:d} deg: "
        f"{row['pairs']:4d} pairs, "
        + ", ".join(
            f"{name} {row[key]:+.2f} [{row['interval_95'][key][0]:+.2f}, {row['interval_95'][key][1]:+.2f}]"
            for name, key in (
                ("right", "du_px"),
                ("down", "dv_px"),
                ("sunward", "toward_sun_px"),
                ("across", "across_sun_px"),
            )
        )
        + f", length {row['length_px']:.2f} (of the medians {row['median_length_px']:.2f})"
        for row in figures["bias_px_by_sun_octant"]
        if row["pairs"]
    ]
    return lines


def _interval(row: dict[str, Any]) -> str:
    low, high = row["f1_interval_95"]
    return f"[{low:.2f}, {high:.2f}]"


def refuse_other_camera(detector: OnnxDetector, dataset: Dataset) -> None:
    """Raise DatasetError where a data set's camera is not that of the detector's frames."""
    size = (dataset.width_px, dataset.height_px)
    fov_deg = float(dataset.index["camera"]["fov_deg"])
    trained = float(detector.metadata.get("camera_fov_deg", fov_deg))
    if size != (INPUT_SIZE_PX, INPUT_SIZE_PX) or abs(fov_deg - trained) > 0.01:
        raise DatasetError(
            f"{dataset.folder}: expected frames of the detector's camera ({INPUT_SIZE_PX} x {INPUT_SIZE_PX} pixels, "
            f"{trained:g} degrees), found {size[0]} x {size[1]} pixels, {fov_deg:g} degrees"
        )


def _on_ground(dataset: Dataset, frame: Frame, found: Detections) -> FrameDetections:
    """Detections with diameters on the ground, on the ground that is scored."""
    latitude, longitude, _ = spherical_from_mcmf(ground_points(dataset, frame, found.u_px, found.v_px))
    # A detection in the sky has no place on the ground and counts as wrong.
    scored = dataset.is_scored(frame, np.degrees(latitude), np.degrees(longitude)) | ~np.isfinite(latitude)
    found = found.select(np.flatnonzero(scored))
    return FrameDetections(
        found.u_px,
        found.v_px,
        found.diameter_px,
        diameter_on_ground_m(dataset, frame, found.u_px, found.v_px, found.diameter_px)
        if found.diameter_m is None
        else found.diameter_m,
        found.score,
        found.sigma_px,
        found.depth_ratio,
        None if found.size_class is None else found.size_class.astype(np.int8),
    )
