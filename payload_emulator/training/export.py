"""From a training run to the network that flies: ONNX, parity check, thresholds and provenance in its metadata."""

from __future__ import annotations

import io
import json
import logging
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from payload_emulator.errors import ModelError
from payload_emulator.flight.detector import (
    GEOMETRY_NAME,
    HEATMAP_NAME,
    INPUT_NAME,
    INPUT_SIZE_PX,
    STRIDE_PX,
    OnnxDetector,
)
from payload_emulator.flight.preprocess import sun_up_turns, turn_forward
from payload_emulator.training.dataset import Dataset, Frame, frame_truth
from payload_emulator.training.evaluate import detect_with_network
from payload_emulator.training.scoring import (
    FrameDetections,
    FrameTruth,
    Tally,
    best_threshold,
    tally,
    threshold_for_precision,
)

PARITY_LIMIT = 2e-4
"""Greatest difference allowed between torch and ONNX Runtime: far under one count of a score in telemetry (1/255)."""

ON_BOARD_BETA = 0.5
"""The on-board threshold weighs precision twice as much as recall: a false crater costs a navigator more than a missed
one, and plains have fewer craters than the validation blocks, so every threshold is less precise there."""

NAVIGATION_PRECISION = 0.90
INPUT_CONVENTION = (
    "float32 (1, 1, 512, 512): square root of gray, zero mean, unit deviation, clipped at 4; Sun-up"
)


@dataclass(frozen=True, slots=True)
class Calibration:
    """What is fixed on the validation split."""

    score_threshold: float
    f1_threshold: float
    navigation_threshold: float
    geometry_shift: tuple[float, float, float, float]  # added to the network's geometry: cells, cells, ln, ln
    figures: dict[str, Any]


def load_network(path: Path) -> tuple[Any, dict[str, Any]]:
    """The averaged network of a checkpoint in evaluation mode, and the checkpoint's document."""
    import torch

    from payload_emulator.training.model import CraterNet, ModelConfig

    try:
        stored = torch.load(path, map_location="cpu", weights_only=False)
        network = CraterNet(ModelConfig(**stored["config"]))
        network.load_state_dict(stored["average"])
    except FileNotFoundError:
        raise ModelError(f"{path}: expected a checkpoint of a training run, found no file") from None
    except Exception as error:  # torch raises whatever its unpickler meets
        raise ModelError(
            f"{path}: expected a checkpoint of a training run, found: {str(error)[:120]}"
        ) from error
    return network.eval(), stored


def calibrate(network: Any, datasets: Sequence[Dataset], limit: int = 400) -> Calibration:
    """Thresholds and constant corrections from the validation split, on real terrain where there is any.

    Thresholds: greatest strict F0.5 (on board) and F1, and the precision that navigation may want. Corrections, each a
    median over matched craters: offset of the centre in the Sun-up image (walls in shadow draw it toward the Sun),
    logarithm of the diameter, and the scale of sigma that puts 68.3 % of the errors within one.
    """
    every = [(d, f) for d in datasets for f in d.frames("val")]
    if not every:
        return Calibration(0.4, 0.4, 0.6, (0.0, 0.0, 0.0, 0.0), {})
    every = [(d, f) for d, f in every if not f.complete] or every
    chosen = [every[k] for k in np.unique(np.linspace(0, len(every) - 1, limit).astype(int))]
    pairs = [_sun_up(frame_truth(d, f), detect_with_network(network, d, f), f) for d, f in chosen]
    truths, found = [truth for truth, _ in pairs], [detections for _, detections in pairs]
    provisional, _ = best_threshold(tally(truths, found))
    shift = geometry_shift(tally(truths, found, low_m=3_000.0, ignore_aware=True), provisional)
    strict = tally(truths, [_shifted(detections, shift) for detections in found])
    balanced, _ = best_threshold(strict)
    threshold, figures = best_threshold(strict, beta=ON_BOARD_BETA)
    return Calibration(
        round(threshold, 3),
        round(balanced, 3),
        round(max(threshold, threshold_for_precision(strict, NAVIGATION_PRECISION)), 3),
        shift,
        figures.to_dict(),
    )


def geometry_shift(tallied: Tally, threshold: float) -> tuple[float, float, float, float]:
    """What to add to the network's geometry so that errors in the Sun-up image are centred and sigma is one sigma."""
    right = (tallied.outcome == 1) & (tallied.score >= threshold)
    if np.count_nonzero(right) < 50:
        return (0.0, 0.0, 0.0, 0.0)
    error_u, error_v = tallied.error_u[right], tallied.error_v[right]
    bias_u, bias_v = float(np.median(error_u)), float(np.median(error_v))
    ratio = np.abs(np.concatenate([error_u - bias_u, error_v - bias_v])) / np.tile(tallied.sigma_px[right], 2)
    log_ratio = float(np.median(tallied.log_diameter_ratio[right]))
    return (-bias_u / STRIDE_PX, -bias_v / STRIDE_PX, -log_ratio, float(np.log(np.quantile(ratio, 0.683))))


def _shifted(found: FrameDetections, shift: tuple[float, float, float, float]) -> FrameDetections:
    """Detections in a Sun-up image as the corrected network would give them."""
    factor = float(np.exp(shift[2]))
    return replace(
        found,
        u_px=found.u_px + STRIDE_PX * shift[0],
        v_px=found.v_px + STRIDE_PX * shift[1],
        diameter_px=factor * found.diameter_px,
        diameter_m=factor * found.diameter_m,
        sigma_px=float(np.exp(shift[3])) * found.sigma_px,
    )


def _sun_up(truth: FrameTruth, found: FrameDetections, frame: Frame) -> tuple[FrameTruth, FrameDetections]:
    """Truth and detections of a frame in the coordinates of its Sun-up image."""
    turns = sun_up_turns(frame.sun_camera)
    shape = (truth.height_px, truth.width_px)
    truth_u, truth_v = turn_forward(truth.u_px, truth.v_px, turns, *shape)
    found_u, found_v = turn_forward(found.u_px, found.v_px, turns, *shape)
    return replace(truth, u_px=truth_u, v_px=truth_v), replace(found, u_px=found_u, v_px=found_v)


def export(
    checkpoint: Path,
    out: Path,
    datasets: Sequence[Dataset],
    revision: str = "",
    notes: dict[str, str] | None = None,
) -> dict[str, Any]:
    """Write the ONNX network of a checkpoint; its parity with torch and its metadata come back.

    Raises
    ------
    ModelError
        The checkpoint cannot be read, or torch and ONNX Runtime disagree by more than `PARITY_LIMIT`.
    """
    import onnx
    import torch

    from payload_emulator.training.model import ExportedCraterNet

    network, stored = load_network(checkpoint)
    calibration = calibrate(network, datasets)
    exported = ExportedCraterNet(network, calibration.geometry_shift).eval()
    example = torch.zeros(1, 1, INPUT_SIZE_PX, INPUT_SIZE_PX)
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            exported,
            (example,),
            dynamo=True,
            input_names=[INPUT_NAME],
            output_names=[HEATMAP_NAME, GEOMETRY_NAME],
            verbose=False,
        )
    assert program is not None
    model = program.model_proto
    metadata = {
        "project": "linna crater detector",
        "input": INPUT_CONVENTION,
        "outputs": "heatmap probability (1, 1, 128, 128); geometry (1, 4, 128, 128): right, down in cells, "
        "ln(diameter / 16 px), ln(sigma / 1 px)",
        "score_threshold": str(calibration.score_threshold),
        "f1_threshold": str(calibration.f1_threshold),
        "navigation_threshold": str(calibration.navigation_threshold),
        "geometry_shift": json.dumps([round(value, 5) for value in calibration.geometry_shift]),
        "validation": json.dumps(calibration.figures),
        "training_steps": str(stored["progress"]["step"]),
        "training_minutes": f"{stored['progress']['seconds'] / 60:.1f}",
        "model_config": json.dumps(stored["config"]),
        "data": json.dumps(
            [{"name": d.index["name"], "labels_sha256": d.digest, "data": d.index["data"]} for d in datasets]
        ),
        "git_revision": revision,
        **(notes or {}),
    }
    onnx.helper.set_model_props(model, metadata)
    del model.graph.metadata_props[:]
    for node in model.graph.node:
        del node.metadata_props[:]
        node.doc_string = ""
    buffer = io.BytesIO()
    onnx.save(model, buffer)
    octets = buffer.getvalue()
    difference = parity(exported, octets)
    if difference > PARITY_LIMIT:
        raise ModelError(
            f"{out}: expected torch and ONNX to agree within {PARITY_LIMIT:g}, found {difference:.2g}"
        )
    unfinished = out.with_name(f".{out.name}.unfinished")
    out.parent.mkdir(parents=True, exist_ok=True)
    unfinished.write_bytes(octets)
    unfinished.replace(out)
    return {
        "model": str(out),
        "model_bytes": len(octets),
        "parity_max_abs": difference,
        "geometry_shift": list(calibration.geometry_shift),
        "score_threshold": calibration.score_threshold,
        "f1_threshold": calibration.f1_threshold,
        "navigation_threshold": calibration.navigation_threshold,
        "validation": calibration.figures,
    }


def parity(exported: Any, octets: bytes, seed: int = 0, images: int = 3) -> float:
    """Greatest difference between torch and the flight detector's runtime over random images."""
    import torch

    detector = OnnxDetector(octets)
    rng = np.random.default_rng(seed)
    worst = 0.0
    for _ in range(images):
        image = rng.standard_normal((1, 1, INPUT_SIZE_PX, INPUT_SIZE_PX)).astype(np.float32)
        with torch.no_grad():
            expected = [part.numpy() for part in exported(torch.from_numpy(image))]
        found = detector.run_network(image)
        worst = max(worst, *(float(np.abs(a - b).max()) for a, b in zip(expected, found, strict=True)))
    return worst
