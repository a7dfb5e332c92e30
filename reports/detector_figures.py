"""Values of a detector report, from the figures of an evaluation (`linna detector evaluate --json`)."""

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from reports.values import (
    BiasBin,
    BinScore,
    CalibrationBin,
    ClassScore,
    DetectorScore,
    HeadlineFigure,
    NamedScore,
    PrecisionRecallCurve,
    ResidualSeries,
    ScoreGroup,
    SigmaBin,
)

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Value = TypeVar("Value", bound="DataclassInstance")
CLASS_LABELS = ("5–10 km", "10–15 km", "15–30 km")
STRICT_F1_GOAL = 0.58
"""Strict F1 on real terrain, as the project set itself."""


def detector_values(figures: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of a `DetectorReport` that follow from the figures alone."""
    verdict, level = _verdict(figures)
    return {
        "by_degradation": tuple(
            NamedScore(f"depth/diameter {row['low']:g}–{row['high']:g}", row["expected"], float("nan"), row["recall"])
            for row in figures["recall_by_degradation"]
        ),
        "by_source": _named(figures["by_source"], lambda row: str(row["name"])),
        "groups": _groups(figures),
        "bias": _bias(figures),
        "sigma": _sigma(figures["sigma_calibration"]),
        "verdict": verdict,
        "verdict_level": level,
        "evidence_level": str(figures["level"]),
        "headline": _headline(figures),
        "data_sources": tuple(figures["data"]),
        "remarks": _remarks(figures),
    }


def detector_score(figures: dict[str, Any], residuals: ResidualSeries) -> DetectorScore:
    """Return the scores of a `DetectorReport`."""
    curves = zip(
        (*CLASS_LABELS, "5–30 km"), (*figures["precision_recall_per_class"], figures["precision_recall"]), strict=True
    )
    return DetectorScore(
        per_class=tuple(
            _class_score(k, label, row)
            for k, (label, row) in enumerate(zip(CLASS_LABELS, figures["per_class"], strict=True))
        ),
        micro=_class_score(-1, "5–30 km", figures["micro"]),
        method=(
            "strict: every catalogued crater with its centre in the frame is expected; one-to-one within "
            f"10 px, best score first; threshold {figures['threshold']:.2f}"
        ),
        by_altitude_km=_bins(figures["by_altitude_km"]),
        by_sun_elevation_deg=_bins(figures["by_sun_elevation_deg"]),
        curves=tuple(
            PrecisionRecallCurve(
                label, *(np.array([point[name] for point in curve]) for name in ("threshold", "precision", "recall"))
            )
            for label, curve in curves
        ),
        calibration=tuple(_filled(CalibrationBin, row) for row in figures["score_calibration"]),
        residuals=residuals,
    )


def _class_score(k: int, label: str, row: dict[str, Any]) -> ClassScore:
    return _filled(ClassScore, row, size_class=k, label=label, localisation_px=row["loc_px"])


def _bins(rows: Sequence[dict[str, Any]]) -> tuple[BinScore, ...]:
    return tuple(_filled(BinScore, row | row["strict"], localisation_px=row["strict"]["loc_px"]) for row in rows)


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
    on_board = {"threshold": figures["threshold"], "strict": figures["micro"], "ignore_aware": figures["ignore_aware"]}
    at = [
        {"name": f"{name} {row['threshold']:.2f}", **row}
        for name, row in (
            ("on board", on_board),
            ("balanced", figures["balanced"]),
            ("navigation", figures["navigation"]),
        )
    ]
    return (
        ScoreGroup("By threshold", _named(at, lambda row: row["name"]), f"Thresholds fixed on validation. {rule}"),
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
                ("Sun azimuth", "by_sun_octant", "°", "Azimuth of the Sun in the image, clockwise from its top"),
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
    keys = {"right_px": "du_px", "down_px": "dv_px", "sunward_px": "toward_sun_px", "across_px": "across_sun_px"}
    return tuple(
        _filled(BiasBin, row, label=label, **{name: (row[key], *row["interval_95"][key]) for name, key in keys.items()})
        for label, row in rows
        if row["pairs"]
    )


def _sigma(calibration: dict[str, Any]) -> tuple[SigmaBin, ...]:
    rows = [("all", calibration)]
    rows += [(f"{row['low']:g}–{row['high']:g} km up", row) for row in calibration["by_altitude_km"]]
    return tuple(_filled(SigmaBin, row, label=label) for label, row in rows if row["pairs"])


def _headline(figures: dict[str, Any]) -> tuple[HeadlineFigure, ...]:
    micro, fair = figures["micro"], figures["ignore_aware"]
    low, high = micro["f1_interval_95"]
    bias = figures["bias_px"]
    return (
        HeadlineFigure("Precision", micro["precision"], "", f"strict; ignore-aware {fair['precision']:.2f}"),
        HeadlineFigure("Recall", micro["recall"], "", f"strict; ignore-aware {fair['recall']:.2f}"),
        HeadlineFigure(
            "F1", micro["f1"], "", f"strict, 95 % {low:.2f} to {high:.2f} over blocks; ignore-aware {fair['f1']:.2f}"
        ),
        HeadlineFigure("Localisation", micro["loc_px"], "px", f"mean; median {micro['loc_median_px']:.2f}"),
        HeadlineFigure(
            "Bias, worst octant",
            None if bias["worst_octant"] is None else bias["worst_octant_px"],
            "px",
            f"of Sun azimuth, with enough craters; noise alone gives {bias['worst_octant_noise_px']:.2f}",
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
        + ", ".join(f"{label} {value:.3f}" for label, value in zip(CLASS_LABELS, average["per_class"], strict=True))
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


def _filled(kind: type[Value], row: Mapping[str, Any], **stated: Any) -> Value:
    """Return a value of the report with the figures of a row that it names, and the stated ones."""
    named = {one.name for one in fields(kind)}
    return kind(**{name: value for name, value in row.items() if name in named} | stated)
