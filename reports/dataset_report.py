"""The report of a data set: how much, of what, from where, in which light, and whether it is whole."""

from __future__ import annotations

from reports.document import Block, Cell, Column, Document, Heading, Picture, Table
from reports.figures import dataset, gallery
from reports.figures.canvas import WIDTH_IN
from reports.published import FRAMES, LABEL_SHARES, LABELS
from reports.sections.opening import (
    about,
    absent,
    judgement,
    missing_and_remarks,
    provenance_and_data,
    settings,
)
from reports.text import count_text, percent_text
from reports.values import DatasetReport


def dataset_document(report: DatasetReport) -> Document:
    """The document of a data set."""
    blocks: list[Block] = [*judgement(report, counts_only=True), Heading("Frames and labels")]
    frames = sum(report.frames_by_part.values())
    if report.frames_by_part:
        blocks.append(_parts(report))
    else:
        blocks.append(absent(report, "frames_by_part", "Parts", "the frames were not counted"))
    if report.classes:
        blocks += _classes(report)
    else:
        blocks.append(absent(report, "classes", "Labels by class", "the labels were not counted"))
    blocks += missing_and_remarks(report)
    blocks.append(Heading("Is it whole?"))
    if report.integrity:
        blocks.append(_integrity(report))
    else:
        blocks.append(absent(report, "integrity", "Checks", "none was run"))
    blocks.append(Heading("What it covers"))
    if report.histograms:
        shown = report.histograms[:12]
        blocks.append(
            Picture(
                "histograms",
                "Distributions over the frames and labels, counts in each bin.",
                "Histograms of " + ", ".join(h.name for h in shown),
                dataset.histogram_height_in(len(shown)),
                lambda c: dataset.draw_histograms(c, shown),
            )
        )
    else:
        blocks.append(absent(report, "histograms", "Distributions", "none was computed"))
    places = report.places
    if places is not None and len(places.latitude_deg):
        blocks.append(
            Picture(
                "places",
                "Positions of the frames by part. The test part must be a separate region, not used for training.",
                "Map of the frames by part.",
                3.9,
                lambda c: dataset.draw_places(c, places, report.terrain),
            )
        )
    else:
        blocks.append(absent(report, "places", "Map of the frames", "their places were not given"))
    blocks.append(Heading("Frames with their labels"))
    if report.gallery:
        frames_shown = report.gallery[:9]
        blocks.append(
            Picture(
                "gallery",
                "Frames with their labels at their own size. Cyan: 5–10 km, yellow: 10–15 km, pink: 15–30 km, "
                "gray: smaller.",
                f"{len(frames_shown)} frames with labels.",
                gallery.gallery_height_in(len(frames_shown), 3, WIDTH_IN),
                lambda c: gallery.draw_gallery(c, frames_shown, 3),
            )
        )
    else:
        blocks.append(absent(report, "gallery", "Gallery", "no frames were given"))
    blocks += provenance_and_data(report)
    if report.configuration:
        blocks += [Heading("Configuration"), *settings(report.configuration)]
    facts = about(report, ("Frames", count_text(frames) if frames else ""))
    return Document("Data-set report", report.title, report.dataset_id, facts, tuple(blocks))


def _parts(report: DatasetReport) -> Table:
    total = sum(report.frames_by_part.values())
    rows: list[tuple[Cell | str, ...]] = [
        (Cell(part, swatch=dataset.PART_ROLES.get(part, "purple")), count_text(n), percent_text(n, total))
        for part, n in report.frames_by_part.items()
    ]
    rows.append((Cell("all", strong=True), Cell(count_text(total), strong=True), ""))
    return Table(
        f"Frames by part. The paper's data set has {count_text(FRAMES)}, split 80, 15 and 5 %.",
        (Column("part", numeric=False), Column("frames"), Column("share")),
        tuple(rows),
    )


def _classes(report: DatasetReport) -> list[Block]:
    parts = list(dict.fromkeys(p for c in report.classes for p in c.by_part))
    total = sum(sum(c.by_part.values()) for c in report.classes)
    rows = tuple(
        (
            c.label,
            *(count_text(c.by_part.get(p, 0)) for p in parts),
            count_text(sum(c.by_part.values())),
            percent_text(sum(c.by_part.values()), total),
            count_text(LABELS.get(c.size_class)),
            percent_text(LABEL_SHARES[c.size_class] / 100.0, 1.0) if c.size_class in LABEL_SHARES else "–",
        )
        for c in report.classes
    )
    table = Table(
        "Labels by size class, compared with those of the paper's data set.",
        (
            Column("class", numeric=False),
            *(Column(p, group="labels by part") for p in parts),
            Column("labels", group="here"),
            Column("share", group="here"),
            Column("labels", group="paper"),
            Column("share", group="paper"),
        ),
        rows,
    )
    picture = Picture(
        "classes",
        "Share of each size class among all labels.",
        "Shares of size classes.",
        0.85 + 0.3 * len(report.classes),
        lambda c: dataset.draw_class_shares(c, report.classes),
    )
    return [table, picture]


def _integrity(report: DatasetReport) -> Table:
    return Table(
        "Checks of the data set.",
        (
            Column("check", numeric=False),
            Column("looked at"),
            Column("failed"),
            Column("detail", numeric=False),
        ),
        tuple(
            (
                Cell(c.name, swatch="vermillion" if c.failed else "green", strong=bool(c.failed)),
                count_text(c.looked_at),
                count_text(c.failed),
                c.detail,
            )
            for c in report.integrity
        ),
    )
