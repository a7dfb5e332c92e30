"""The detector's report as a value: figures of `figures.score`, galleries, curves of the run, cost."""

import csv
from pathlib import Path
from typing import Any

import numpy as np

from lunar.catalogue import size_class
from payload_emulator.flight.vision.detector import OnnxDetector
from payload_emulator.training.evaluate.evaluate import Scored
from payload_emulator.training.evaluate.scoring import MatchRule, Tally, match, tally
from reports.detector_figures import detector_score, detector_values
from reports.values import DetectorReport, GalleryFrame, ResidualSeries, TrainingCurve

_WORST_FRAMES = 24
_GALLERY_FRAMES = 9
_FEWEST_CRATERS = 5  # a frame with fewer says little about the detector
_GALLERY_LEAST_PX = 9.0


def detector_report(
    detector: OnnxDetector, scored: Scored, figures: dict[str, Any], run: Path | None = None
) -> DetectorReport:
    """The report of an evaluation; `run` is the folder of the training run whose curves are shown."""
    threshold = figures["threshold"]
    strict = tally(scored.truths, scored.found)
    order = _frame_order(strict, threshold, len(scored.frames))
    middle = order[:: max(1, len(order) // _GALLERY_FRAMES)][:_GALLERY_FRAMES]
    metadata = detector.metadata
    return DetectorReport(
        title=f"Crater detector on {', '.join(figures['sources'])}",
        model_id=f"model {detector.sha256[:12]}",
        score=detector_score(figures, _residuals(scored, threshold, strict)),
        training=() if run is None else _curves(run),
        cost={"Model": f"{len(detector.model_octets) / 1e6:.2f} MB"},
        gallery=tuple(_picture(scored, k, threshold) for k in middle),
        worst_frames=tuple(_picture(scored, k, threshold) for k in order[:_WORST_FRAMES]),
        provenance={
            "Model SHA-256": detector.sha256,
            "Data set": figures["dataset"],
            **{f"Labels SHA-256 ({k + 1})": value for k, value in enumerate(figures["dataset_sha256"])},
            "Split": figures["split"],
            "Trained at revision": metadata.get("git_revision", ""),
            "Training seed": metadata.get("training_seed", ""),
            "Thresholds": "fixed on the validation split",
        },
        configuration={
            "model": {
                key: metadata[key]
                for key in ("input", "model_config", "geometry_shift", "parallax_per_px")
                if key in metadata
            }
        },
        not_available={
            "cost": "latency depends on the machine: `python -m benchmarks detector` measures it",
            **({"training": "no training run was given"} if run is None else {}),
        },
        **detector_values(figures),
    )


def _residuals(scored: Scored, threshold: float, strict: Tally) -> ResidualSeries:
    right = (strict.outcome == 1) & (strict.score >= threshold)
    azimuth = np.degrees(np.array([truth.sun_azimuth_image_rad for truth in scored.truths])) % 360.0
    return ResidualSeries(
        strict.detection_u[right],
        strict.detection_v[right],
        strict.error_u[right],
        strict.error_v[right],
        azimuth[strict.detection_frame[right].astype(int)],
    )


def _curves(run: Path) -> tuple[TrainingCurve, ...]:
    path = run / "curves.csv"
    if not path.is_file():
        return ()
    with path.open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    step = np.array([float(row["step"]) for row in rows])
    names = ("total", "heat", "offset", "diameter", "sigma", "f1", "precision", "recall", "loc_px")
    return tuple(
        TrainingCurve(name, step, np.array([float(row[name]) for row in rows]), "step") for name in names if rows
    )


def _frame_order(strict: Tally, threshold: float, frames: int) -> list[int]:
    """Frames with enough craters, the worst F1 first, most errors first among equals."""
    with np.errstate(invalid="ignore"):
        found = strict.crater_score >= threshold
    wrong = (strict.score >= threshold) & (strict.outcome == 0)
    of_crater, of_detection = strict.crater_frame.astype(int), strict.detection_frame.astype(int)
    expected = np.bincount(of_crater, minlength=frames)
    right = np.bincount(of_crater[found], minlength=frames)
    false = np.bincount(of_detection[wrong], minlength=frames)
    f1 = 2.0 * right / np.maximum(right + false + expected, 1)
    order = np.lexsort((-(expected - right + false), f1))
    return [int(k) for k in order if expected[k] >= _FEWEST_CRATERS]


def _picture(scored: Scored, k: int, threshold: float) -> GalleryFrame:
    dataset, frame = scored.frames[k]
    truth, found, scene = scored.truths[k], scored.found[k], scored.scenes[k]
    d = np.flatnonzero((found.score >= threshold) & (found.diameter_m >= 3_000.0))
    inside = (truth.u_px >= 0) & (truth.u_px < truth.width_px) & (truth.v_px >= 0) & (truth.v_px < truth.height_px)
    c = np.flatnonzero(inside & (truth.diameter_m >= 3_000.0) & (truth.diameter_px >= _GALLERY_LEAST_PX))
    hit = match(found.u_px[d], found.v_px[d], truth.u_px[c], truth.v_px[c], truth.diameter_px[c], MatchRule())
    matched = np.zeros(c.size, bool)
    matched[hit[hit >= 0]] = True
    return GalleryFrame(
        frame_number=frame.number,
        utc_ns=None,
        image=dataset.gray(frame),
        detection_u_px=found.u_px[d],
        detection_v_px=found.v_px[d],
        detection_diameter_px=found.diameter_px[d],
        detection_class=np.asarray(size_class(found.diameter_m[d]), np.int64),
        catalogue_u_px=truth.u_px[c],
        catalogue_v_px=truth.v_px[c],
        catalogue_diameter_px=truth.diameter_px[c],
        catalogue_class=np.asarray(size_class(truth.diameter_m[c]), np.int64),
        detection_matched=hit >= 0,
        catalogue_matched=matched,
        caption=f"{scene.source}, {scene.altitude_km:.0f} km, Sun {scene.sun_elevation_deg:.0f}°",
    )
