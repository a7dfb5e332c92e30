"""The detector's report as a value: figures of `figures.score`, galleries, curves of the run, cost."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from lunar.catalogue import size_class
from payload_emulator.flight.vision.detector import OnnxDetector
from payload_emulator.training.evaluate.evaluate import Scored
from payload_emulator.training.evaluate.localisation import FEWEST_PAIRS
from payload_emulator.training.evaluate.scoring import MatchRule, Tally, match, tally
from reports.values import (
    BiasBin,
    BinScore,
    CalibrationBin,
    ClassScore,
    DetectorReport,
    DetectorScore,
    GalleryFrame,
    HeadlineFigure,
    NamedScore,
    PrecisionRecallCurve,
    ResidualSeries,
    ScoreGroup,
    SigmaBin,
    TrainingCurve,
)

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Value = TypeVar("Value", bound="DataclassInstance")
_CLASS_LABELS = ("5–10 km", "10–15 km", "15–30 km")
_WORST_FRAMES = 24
_GALLERY_FRAMES = 9
_FEWEST_CRATERS = 5  # a frame with fewer says little about the detector
_GALLERY_LEAST_PX = 9.0
STRICT_F1_GOAL = 0.58  # real terrain, as the project set itself


def detector_report(
    detector: OnnxDetector, scored: Scored, figures: dict[str, Any], run: Path | None = None
) -> DetectorReport:
    """The report of an evaluation; `run` is the folder of the training run whose curves are shown."""
    threshold = figures["threshold"]
    strict = tally(scored.truths, scored.found)
    order = _frame_order(strict, threshold, len(scored.frames))
    middle = order[:: max(1, len(order) // _GALLERY_FRAMES)][:_GALLERY_FRAMES]
    verdict, level = _verdict(figures)
    metadata = detector.metadata
    return DetectorReport(
        title=f"Crater detector on {', '.join(figures['sources'])}",
        model_id=f"model {detector.sha256[:12]}",
        score=_score(scored, figures, strict),
        by_degradation=tuple(
            NamedScore(
                f"depth/diameter {row['low']:g}–{row['high']:g}", row["expected"], float("nan"), row["recall"]
            )
            for row in figures["recall_by_degradation"]
        ),
        by_source=_named(figures["by_source"], lambda row: str(row["name"])),
        groups=_groups(figures),
        bias=_bias(figures),
        sigma=_sigma(figures["sigma_calibration"]),
        training=() if run is None else _curves(run),
        cost={"Model": f"{len(detector.model_octets) / 1e6:.2f} MB"},
        gallery=tuple(_picture(scored, k, threshold) for k in middle),
        worst_frames=tuple(_picture(scored, k, threshold) for k in order[:_WORST_FRAMES]),
        verdict=verdict,
        verdict_level=level,
        evidence_level=str(figures["level"]),
        headline=_headline(figures),
        provenance={
            "Model SHA-256": detector.sha256,
            "Data set": figures["dataset"],
            **{f"Labels SHA-256 ({k + 1})": value for k, value in enumerate(figures["dataset_sha256"])},
            "Split": figures["split"],
            "Trained at revision": metadata.get("git_revision", ""),
            "Training seed": metadata.get("training_seed", ""),
            "Thresholds": "fixed on the validation split",
        },
        data_sources=tuple(figures["data"]),
        configuration={
            "model": {
                key: metadata[key]
                for key in ("input", "model_config", "geometry_shift", "parallax_per_px")
                if key in metadata
            }
        },
        remarks=_remarks(figures),
        not_available={
            "cost": "latency depends on the machine: `python -m benchmarks detector` measures it",
            **({"training": "no training run was given"} if run is None else {}),
        },
    )


def _score(scored: Scored, figures: dict[str, Any], strict: Tally) -> DetectorScore:
    right = (strict.outcome == 1) & (strict.score >= figures["threshold"])
    azimuth = np.degrees(np.array([truth.sun_azimuth_image_rad for truth in scored.truths])) % 360.0
    per_class = tuple(
        _class_score(k, label, row)
        for k, (label, row) in enumerate(zip(_CLASS_LABELS, figures["per_class"], strict=True))
    )
    curves = [
        PrecisionRecallCurve(
            label,
            *(np.array([point[name] for point in curve]) for name in ("threshold", "precision", "recall")),
        )
        for label, curve in zip(
            (*_CLASS_LABELS, "5–30 km"),
            (*figures["precision_recall_per_class"], figures["precision_recall"]),
            strict=True,
        )
    ]
    return DetectorScore(
        per_class=per_class,
        micro=_class_score(-1, "5–30 km", figures["micro"]),
        method=(
            "strict: every catalogued crater with its centre in the frame is expected; one-to-one within "
            f"10 px, best score first; threshold {figures['threshold']:.2f}"
        ),
        by_altitude_km=_bins(figures["by_altitude_km"]),
        by_sun_elevation_deg=_bins(figures["by_sun_elevation_deg"]),
        curves=tuple(curves),
        calibration=tuple(_filled(CalibrationBin, row) for row in figures["score_calibration"]),
        residuals=ResidualSeries(
            strict.detection_u[right],
            strict.detection_v[right],
            strict.error_u[right],
            strict.error_v[right],
            azimuth[strict.detection_frame[right].astype(int)],
        ),
    )


def _filled(kind: type[Value], row: Mapping[str, Any], **stated: Any) -> Value:
    """Return a value of the report with the figures of a row that it names, and the stated ones."""
    named = {one.name for one in fields(kind)}
    return kind(**{name: value for name, value in row.items() if name in named} | stated)


def _class_score(k: int, label: str, row: dict[str, Any]) -> ClassScore:
    return _filled(ClassScore, row, size_class=k, label=label, localisation_px=row["loc_px"])


def _bins(rows: Sequence[dict[str, Any]]) -> tuple[BinScore, ...]:
    return tuple(
        _filled(BinScore, row | row["strict"], localisation_px=row["strict"]["loc_px"]) for row in rows
    )


def _named(rows: Sequence[dict[str, Any]], label: Any) -> tuple[NamedScore, ...]:
    return tuple(
        _filled(
            NamedScore,
            row["strict"],
            label=label(row),
            localisation_px=row["strict"]["loc_px"],
            fair_precision=row["ignore_aware"]["precision"],
            fair_recall=row["ignore_aware"]["recall"],
        )
        for row in rows
    )


def _groups(figures: dict[str, Any]) -> tuple[ScoreGroup, ...]:
    rule = "Strict scores drawn; the table also gives the ignore-aware scores."
    on_board = {
        "threshold": figures["threshold"],
        "strict": figures["micro"],
        "ignore_aware": figures["ignore_aware"],
    }
    at = [
        {"name": f"{name} {row['threshold']:.2f}", **row}
        for name, row in (
            ("on board", on_board),
            ("balanced", figures["balanced"]),
            ("navigation", figures["navigation"]),
        )
    ]
    return (
        ScoreGroup(
            "By threshold", _named(at, lambda row: row["name"]), f"Thresholds fixed on validation. {rule}"
        ),
        ScoreGroup(
            "By type of terrain",
            _named(figures["by_terrain"], lambda row: f"{row['name']} ({row['frames']} frames)"),
            f"Lowland: mean ground of the frame below −1 km, mostly mare. {rule}",
        ),
        *(
            ScoreGroup(
                f"By {name}",
                _named(figures[key], lambda row, unit=unit: f"{row['low']:g}–{row['high']:g}{unit}"),
                f"{meaning}. {rule}",
            )
            for name, key, unit, meaning in (
                ("altitude", "by_altitude_km", " km", "Altitude"),
                ("Sun elevation", "by_sun_elevation_deg", "°", "Elevation of the Sun"),
                (
                    "Sun azimuth",
                    "by_sun_octant",
                    "°",
                    "Azimuth of the Sun in the image, clockwise from its top",
                ),
            )
        ),
    )


def _bias(figures: dict[str, Any]) -> tuple[BiasBin, ...]:
    rows = [("any azimuth", figures["bias_px"])]
    rows += [
        (f"{low}–{high}°", row)
        for row in figures["bias_px_by_sun_octant"]
        for low, high in (row["sun_azimuth_image_deg"],)
    ]
    keys = {
        "right_px": "du_px",
        "down_px": "dv_px",
        "sunward_px": "toward_sun_px",
        "across_px": "across_sun_px",
    }
    return tuple(
        _filled(
            BiasBin,
            row,
            label=label,
            **{name: (row[key], *row["interval_95"][key]) for name, key in keys.items()},
        )
        for label, row in rows
        if row["pairs"]
    )


def _sigma(calibration: dict[str, Any]) -> tuple[SigmaBin, ...]:
    rows = [("all", calibration)]
    rows += [(f"{row['low']:g}–{row['high']:g} km up", row) for row in calibration["by_altitude_km"]]
    return tuple(_filled(SigmaBin, row, label=label) for label, row in rows if row["pairs"])


def _curves(run: Path) -> tuple[TrainingCurve, ...]:
    path = run / "curves.csv"
    if not path.is_file():
        return ()
    with path.open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    step = np.array([float(row["step"]) for row in rows])
    names = ("total", "heat", "offset", "diameter", "sigma", "f1", "precision", "recall", "loc_px")
    return tuple(
        TrainingCurve(name, step, np.array([float(row[name]) for row in rows]), "step")
        for name in names
        if rows
    )


def _headline(figures: dict[str, Any]) -> tuple[HeadlineFigure, ...]:
    micro, fair = figures["micro"], figures["ignore_aware"]
    low, high = micro["f1_interval_95"]
    bias = figures["bias_px"]
    return (
        HeadlineFigure("Precision", micro["precision"], "", f"strict; ignore-aware {fair['precision']:.2f}"),
        HeadlineFigure("Recall", micro["recall"], "", f"strict; ignore-aware {fair['recall']:.2f}"),
        HeadlineFigure(
            "F1",
            micro["f1"],
            "",
            f"strict, 95 % {low:.2f} to {high:.2f} over blocks; ignore-aware {fair['f1']:.2f}",
        ),
        HeadlineFigure("Localisation", micro["loc_px"], "px", f"mean; median {micro['loc_median_px']:.2f}"),
        HeadlineFigure(
            "Bias, worst octant",
            None if bias["worst_octant"] is None else bias["worst_octant_px"],
            "px",
            f"of Sun azimuth, {FEWEST_PAIRS} craters at least; noise alone gives {bias['worst_octant_noise_px']:.2f}",
        ),
    )


def _verdict(figures: dict[str, Any]) -> tuple[str, str]:
    beaten = [
        k
        for k, row in enumerate(figures["per_class"])
        if row["precision"] > row["paper"]["precision"]
        and row["recall"] > row["paper"]["recall"]
        and row["loc_px"] < row["paper"]["loc_px"]
    ]
    on_board, balanced = figures["micro"]["f1"], figures["balanced"]["strict"]["f1"]
    text = (
        f"strict F1 {on_board:.2f} on board and {balanced:.2f} at the balanced "
        f"threshold; {len(beaten)} of 3 size classes better than the paper in precision, recall and localisation"
    )
    reached = (max(on_board, balanced) >= STRICT_F1_GOAL, len(beaten) == 3)
    return text, "met" if all(reached) else "partly met" if any(reached) else "not met"


def _remarks(figures: dict[str, Any]) -> tuple[str, ...]:
    average = figures["average_precision_half_radius"]
    state = figures["degradation_state"]
    remarks = [
        f"Average precision within half a radius: {average['strict']:.3f} strict, {average['ignore_aware']:.3f} "
        "ignore-aware; by class "
        + ", ".join(
            f"{label} {value:.3f}" for label, value in zip(_CLASS_LABELS, average["per_class"], strict=True)
        )
        + ".",
        f"Craters of 3 to 5 km: precision {figures['class_3_to_5_km']['precision']:.2f}, recall "
        f"{figures['class_3_to_5_km']['recall']:.2f} strict, "
        f"{figures['class_3_to_5_km']['ignore_aware']['recall']:.2f} ignore-aware.",
        f"{figures['unique_craters']} different craters in {figures['blocks']} blocks of ground.",
    ]
    if state["craters"]:
        remarks.append(
            f"State (fresh, worn, degraded) agrees with the terrain's own depth/diameter for "
            f"{100 * state['agreement']:.0f} % of {state['craters']} matched craters; median error of depth/diameter "
            f"{state['depth_ratio_median_error']:.3f}."
        )
    return tuple(remarks)


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
    inside = (
        (truth.u_px >= 0) & (truth.u_px < truth.width_px) & (truth.v_px >= 0) & (truth.v_px < truth.height_px)
    )
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
