"""The report of a detector: scores by class, curves, calibration, bias, cost, galleries."""

from collections.abc import Sequence
from functools import partial

import numpy as np

from reports.document import Block, Column, Document, Heading, Picture, Properties, Table
from reports.figures import training
from reports.figures.detector import OCTANTS, octant_bias
from reports.sections.detection import detector_blocks, gallery_picture
from reports.sections.opening import about, absent, judgement, missing_and_remarks, provenance_and_data, settings
from reports.text import NOT_A_VALUE, count_text, number_text
from reports.values import BiasBin, DetectorReport, NamedScore, ResidualSeries, SigmaBin


def detector_document(report: DetectorReport) -> Document:
    blocks: list[Block] = [*judgement(report), Heading("Scores")]
    found = detector_blocks(report.score) if report.score is not None else []
    blocks += found or [absent(report, "score", "Scores", "the detector was not evaluated")]
    if report.bias:
        blocks.append(_signed_bias(report.bias))
    elif report.score is not None and report.score.residuals is not None:
        table = _bias_table(report.score.residuals)
        blocks += [table] if table is not None else []
    blocks += missing_and_remarks(report)
    for heading, key, scores, caption in (
        (
            "By state of degradation",
            "degradation",
            report.by_degradation,
            "Scores by state of degradation. A false alarm is no crater and has no state, so that precision may be "
            "missing.",
        ),
        ("By source of the images", "sources", report.by_source, "Precision and recall by where the images come from."),
    ):
        if scores:
            blocks += [Heading(heading), *_named(key, scores, caption)]
    for number, group in enumerate(report.groups):
        blocks += [Heading(group.heading), *_named(f"group-{number}", group.scores, group.caption)]
    if report.sigma:
        blocks += [Heading("Predicted uncertainty"), _sigma_table(report.sigma)]
    if report.training:
        curves = report.training[:9]
        rows = -(-len(curves) // 3)
        blocks += [
            Heading("Training"),
            Picture(
                "training",
                "Quantities over the training run.",
                "Training curves: " + ", ".join(c.name for c in curves),
                0.78 + rows * 1.25 + (rows - 1) * 0.75,
                partial(training.draw_training, curves=curves),
            ),
        ]
    blocks.append(Heading("Cost on board"))
    if report.cost:
        blocks.append(Properties(tuple(report.cost.items())))
    else:
        blocks.append(absent(report, "cost", "Latency and memory", "they were not measured"))
    blocks.append(Heading("Detections over the images"))
    if report.gallery:
        lead = "Frames of the test set (form of the paper's Fig. 6)."
        blocks.append(gallery_picture("gallery", report.gallery[:9], 3, lead))
    else:
        blocks.append(absent(report, "gallery", "Gallery of detections", "no images were given"))
    if report.worst_frames:
        worst = report.worst_frames[:24]
        blocks.append(
            gallery_picture("worst", worst, 4, f"The worst {len(worst)} frames, chosen by number, not by hand.")
        )
    blocks += provenance_and_data(report)
    if report.configuration:
        blocks += [Heading("Configuration"), *settings(report.configuration)]
    return Document("Detector report", report.title, report.model_id, about(report), tuple(blocks))


def _named(key: str, scores: Sequence[NamedScore], caption: str) -> list[Block]:
    columns = tuple(
        (column, shown)
        for column, shown in (
            (Column("precision"), [number_text(s.precision, 3) for s in scores]),
            (Column("recall"), [number_text(s.recall, 3) for s in scores]),
            (Column("localisation", unit="px"), [number_text(s.localisation_px, 2) for s in scores]),
            (Column("precision, ignore-aware"), [number_text(s.fair_precision, 3) for s in scores]),
            (Column("recall, ignore-aware"), [number_text(s.fair_recall, 3) for s in scores]),
        )
        if any(text != NOT_A_VALUE for text in shown)
    )
    table = Table(
        caption,
        (Column("group", numeric=False), Column("expected", unit="craters"), *(column for column, _ in columns)),
        tuple((s.label, count_text(s.expected), *(shown[row] for _, shown in columns)) for row, s in enumerate(scores)),
    )
    picture = Picture(
        key, caption, caption, 0.85 + 0.3 * len(scores), partial(training.draw_named_scores, scores=scores)
    )
    return [picture, table]


def _sigma_table(bins: Sequence[SigmaBin]) -> Table:
    return Table(
        "Centre errors of matched craters over the standard deviation that the network predicted for each.",
        (
            Column("craters seen", numeric=False),
            Column("pairs"),
            Column("mean sigma", unit="px"),
            Column("rms of error over sigma"),
            Column("inside 1 sigma"),
            Column("inside 3 sigma"),
        ),
        tuple(
            (s.label, count_text(s.pairs), number_text(s.mean_sigma_px, 2), number_text(s.rms, 2),
             number_text(s.inside_one_sigma, 3), number_text(s.inside_three_sigma, 3))
            for s in bins
        ),
        note="1, 0.683 and 0.997 would be perfect for Gaussian errors of each axis.",
    )  # fmt: skip


def _signed_bias(bins: Sequence[BiasBin]) -> Table:
    def part(value: tuple[float, float, float]) -> str:
        mean, low, high = (f"{x:+.2f}".replace("-", "−") for x in value)
        return f"{mean} [{low}, {high}]"

    return Table(
        "Mean signed error of matched craters by azimuth of the Sun in the image, detected minus catalogued.",
        (
            Column("Sun from the top, clockwise", numeric=False),
            Column("craters"),
            Column("right", unit="px"),
            Column("down", unit="px"),
            Column("toward the Sun", unit="px"),
            Column("across", unit="px, to its right"),
            Column("length", unit="px"),
            Column("length of medians", unit="px"),
        ),
        tuple(
            (
                row.label,
                count_text(row.pairs),
                part(row.right_px),
                part(row.down_px),
                part(row.sunward_px),
                part(row.across_px),
                number_text(float(np.hypot(row.right_px[0], row.down_px[0])), 2),
                number_text(row.median_length_px, 2),
            )
            for row in bins
        ),
        note="In brackets the 95 % interval over resampled frames.",
    )


def _bias_table(residuals: ResidualSeries) -> Table | None:
    if residuals.sun_azimuth_deg is None:
        return None
    mean, count = octant_bias(residuals)
    rows = tuple(
        (
            OCTANTS[k],
            count_text(int(count[k])),
            number_text(float(mean[k, 0]), 3),
            number_text(float(mean[k, 1]), 3),
            number_text(float(np.hypot(*mean[k])), 3),
        )
        for k in range(8)
        if count[k]
    )
    return Table(
        "Mean residual by octant of Sun azimuth, detected minus expected.",
        (
            Column("Sun from", numeric=False),
            Column("craters"),
            Column("du", unit="px, right"),
            Column("dv", unit="px, down"),
            Column("length", unit="px"),
        ),
        rows,
    )
