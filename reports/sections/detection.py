"""Detector sections: scores compared with the paper's, bias, curves and galleries."""

import math
from functools import partial

import numpy as np

from reports.document import Block, Cell, Column, Heading, Paragraph, Picture, Table
from reports.figures import detector, gallery
from reports.figures.canvas import WIDTH_IN
from reports.published import SOURCE, TABLE_II
from reports.sections.common import PassView
from reports.text import NOT_A_VALUE, count_text, number_text, significant_text
from reports.values import ClassScore, DetectorScore, GalleryFrame, ResidualSeries


def detector_table(score: DetectorScore) -> Table:
    """Return the scores by class, compared with the paper's."""
    rows: list[tuple[Cell | str, ...]] = []

    def row(s: ClassScore, strong: bool) -> tuple[Cell | str, ...]:
        paper = TABLE_II.get(s.size_class)
        return (
            Cell(s.label, strong=strong),
            count_text(s.expected),
            count_text(s.detected_true),
            count_text(s.false_alarms),
            number_text(s.precision, 4),
            number_text(paper.precision, 4) if paper else NOT_A_VALUE,
            number_text(s.recall, 4),
            number_text(paper.recall, 4) if paper else NOT_A_VALUE,
            number_text(s.localisation_px, 2),
            number_text(paper.localisation_px, 2) if paper else NOT_A_VALUE,
        )

    rows = [row(s, False) for s in score.per_class]
    if score.micro is not None:
        rows.append(row(score.micro, True))
    return Table(
        f"Detection by size class, compared with the {SOURCE}.",
        (
            Column("class", numeric=False),
            Column("expected", group="craters"),
            Column("found", group="craters"),
            Column("false", group="craters"),
            Column("here", group="precision"),
            Column("paper", group="precision"),
            Column("here", group="recall"),
            Column("paper", group="recall"),
            Column("here", group="localisation, px"),
            Column("paper", group="localisation, px"),
        ),
        tuple(rows),
        note=f"{_sentence(score.method)}The paper's figures are for its own synthetic test set: a mark to "
        "compare with, not the same experiment.",
    )


def detector_blocks(score: DetectorScore) -> list[Block]:
    """Table and figures of a detector score."""
    blocks: list[Block] = []
    scores = tuple(score.per_class)
    if scores:
        blocks.append(detector_table(score))
        beats = sum(
            s.size_class in TABLE_II
            and s.precision > TABLE_II[s.size_class].precision
            and s.recall > TABLE_II[s.size_class].recall
            and s.localisation_px < TABLE_II[s.size_class].localisation_px
            for s in scores
        )
        blocks.append(
            Picture(
                "classes",
                "Precision, recall and mean distance of the centres by size class. Filled: here; open: the paper. "
                f"Better than the paper in all three: {beats} of {len(scores)} classes.",
                f"Precision, recall and localisation by class; better than the paper in all three: {beats} of "
                f"{len(scores)} classes.",
                1.15 + 0.34 * len(scores),
                partial(detector.draw_class_scores, scores=scores),
            )
        )
    blocks += _bins(score)
    if score.curves or score.calibration:
        blocks.append(
            Picture(
                "curves",
                _curves_caption(bool(score.curves), bool(score.calibration)),
                "Precision-recall curves and calibration.",
                2.95,
                partial(detector.draw_curves, curves=score.curves, calibration=score.calibration),
            )
        )
    if score.residuals is not None and np.isfinite(score.residuals.du_px).any():
        blocks.append(_residuals(score.residuals))
    return blocks


def _bins(score: DetectorScore) -> list[Block]:
    """Return precision and recall by altitude and by light; a sentence where all craters are in one bin."""
    blocks: list[Block] = []
    parts = [
        (label, bins)
        for label, bins in (
            ("altitude, km", score.by_altitude_km),
            ("Sun elevation, degrees", score.by_sun_elevation_deg),
        )
        if bins
    ]
    # A plot with one bin shows no dependence; a sentence replaces it.
    single = [(label, bins) for label, bins in parts if sum(b.expected > 0 for b in bins) == 1]
    parts = [(label, bins) for label, bins in parts if sum(b.expected > 0 for b in bins) > 1]
    for label, bins in single:
        only = next(b for b in bins if b.expected > 0)
        name, _, unit = label.partition(", ")
        blocks.append(
            Paragraph(
                f"All craters were expected at one {name}, {only.low:g} to {only.high:g} {unit}. "
                "The dependence of the detector on it cannot be determined.",
                small=True,
            )
        )
    if parts:
        by = {"altitude, km": "altitude", "Sun elevation, degrees": "light"}
        blocks.append(
            Picture(
                "detector-bins",
                f"Precision and recall by {' and by '.join(by[label] for label, _ in parts)}, over the craters "
                "expected in each bin (gray, separate scale).",
                f"Precision and recall in bins of {' and '.join(by[label] for label, _ in parts)}.",
                2.3,
                partial(detector.draw_bins, parts=parts),
            )
        )
    return blocks


def _residuals(residuals: ResidualSeries) -> Picture:
    """Return the picture of the mean distances between detected and expected centres."""
    mean, _ = detector.octant_bias(residuals)
    whole = float(np.hypot(np.nanmean(residuals.du_px), np.nanmean(residuals.dv_px)))
    worst = float(np.nanmax(np.hypot(mean[:, 0], mean[:, 1]))) if np.isfinite(mean).any() else math.nan
    text = f", and {significant_text(worst, 2)} px in the worst octant of Sun azimuth" if math.isfinite(worst) else ""
    return Picture(
        "residuals",
        "Mean signed distance between detected and expected centres. Over all it is "
        f"{significant_text(whole, 2)} px{text}. A bias "
        "common to a frame moves the whole fix and does not show in the innovations.",
        f"Mean residual over all {significant_text(whole, 2)} px.",
        3.5,
        partial(detector.draw_residuals, residuals=residuals),
    )


def _curves_caption(curves: bool, calibration: bool) -> str:
    """Return the caption of the panels that are shown."""
    left = "precision against recall for varying threshold"
    right = "share of true detections by score; on the dashed line the score equals the probability"
    if curves and calibration:
        return f"Left: {left}. Right: {right}."
    only = left if curves else right
    return f"{only[0].upper()}{only[1:]}."


def detector_section(view: PassView) -> list[Block]:
    blocks: list[Block] = [Heading("The detector")]
    score = view.report.detector
    found = detector_blocks(score) if score is not None else []
    return [*blocks, *found] if found else [*blocks, view.absent("detector", "Recall, precision, localisation")]


def _sentence(text: str) -> str:
    """A text as a sentence before another, whether or not it was written as one."""
    text = text.strip()
    if not text:
        return ""
    return f"{text[0].upper()}{text[1:]}{'' if text.endswith('.') else '.'} "


def gallery_picture(key: str, frames: tuple[GalleryFrame, ...], columns: int, lead: str) -> Picture:
    """A sheet of frames with the key to its marks in the caption."""
    return Picture(
        key,
        f"{lead} Crosses: detections in the colour of their class; vermillion: of 5–30 km with no crater of the "
        "catalogue; gray dots: other sizes, not matched and not scored. Dashed circles: craters of the catalogue at "
        "their own size; dotted: not detected. Cyan: 5–10 km, yellow: 10–15 km, pink: 15–30 km, white: others.",
        f"{len(frames)} image frames with detections and catalogue craters.",
        gallery.gallery_height_in(len(frames), columns, WIDTH_IN),
        partial(gallery.draw_gallery, frames=frames, columns=columns),
    )


def galleries(view: PassView) -> list[Block]:
    report = view.report
    blocks: list[Block] = [Heading("Detections over the images")]
    if report.gallery:
        blocks.append(
            gallery_picture("gallery", report.gallery[:9], 3, "Frames of the pass (form of the paper's Fig. 6).")
        )
    else:
        blocks.append(view.absent("gallery", "Gallery of detections"))
    if report.worst_frames:
        worst = report.worst_frames[:9]
        blocks.append(gallery_picture("worst", worst, 3, "Frames with the lowest recall, of all frames of the pass."))
    if report.gallery and "worst_frames" in report.not_available:
        blocks.append(view.absent("worst_frames", "Frames with the lowest recall"))
    return blocks
