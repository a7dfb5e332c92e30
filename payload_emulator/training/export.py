"""From a training run to the network that flies: ONNX, parity check, thresholds and provenance in its metadata."""

from __future__ import annotations

import io
import json
import logging
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from payload_emulator.errors import ModelError
from payload_emulator.flight.detector import (
    GEOMETRY_NAME,
    HEATMAP_NAME,
    INPUT_NAME,
    INPUT_SIZE_PX,
    OnnxDetector,
)
from payload_emulator.training.dataset import Dataset, frame_truth

PARITY_LIMIT = 2e-4
"""Greatest difference allowed between torch and ONNX Runtime: far under one count of a score in telemetry (1/255)."""

NAVIGATION_PRECISION = 0.90
INPUT_CONVENTION = (
    "float32 (1, 1, 512, 512): square root of gray, zero mean, unit deviation, clipped at 4; Sun-up"
)


@dataclass(frozen=True, slots=True)
class Calibration:
    """What is fixed on the validation split."""

    score_threshold: float
    navigation_threshold: float
    log_sigma_shift: float
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
    """Thresholds (greatest strict F1; navigation precision) and sigma scale from the validation split."""
    from payload_emulator.training.evaluate import detect_with_network
    from payload_emulator.training.scoring import best_threshold, tally, threshold_for_precision

    every = [(d, f) for d in datasets for f in d.frames("val")]
    if not every:
        return Calibration(0.4, 0.6, 0.0, {})
    chosen = [every[k] for k in np.unique(np.linspace(0, len(every) - 1, limit).astype(int))]
    # Real terrain decides where there is any: it is where the detector is judged.
    real = [(d, f) for d, f in chosen if not f.complete]
    chosen = real or chosen
    found = [detect_with_network(network, d, f) for d, f in chosen]
    truths = [frame_truth(d, f) for d, f in chosen]
    strict = tally(truths, found)
    threshold, figures = best_threshold(strict)
    fair = tally(truths, found, low_m=3_000.0, ignore_aware=True)
    right = (fair.outcome == 1) & (fair.score >= threshold)
    errors = np.concatenate([fair.error_u[right], fair.error_v[right]])
    sigma = np.concatenate([fair.sigma_px[right]] * 2)
    ratio = np.abs(errors) / sigma
    # Between the core of the distribution and its tail: the 68.3 % point of |error| / sigma becomes 1.
    shift = float(np.log(np.quantile(ratio, 0.683))) if ratio.size > 50 else 0.0
    return Calibration(
        round(threshold, 3),
        round(max(threshold, threshold_for_precision(strict, NAVIGATION_PRECISION)), 3),
        shift,
        figures.to_dict(),
    )


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
    exported = ExportedCraterNet(network, calibration.log_sigma_shift).eval()
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
        "navigation_threshold": str(calibration.navigation_threshold),
        "log_sigma_shift": f"{calibration.log_sigma_shift:.4f}",
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
        "score_threshold": calibration.score_threshold,
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
