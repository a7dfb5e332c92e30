"""The document that repeats the figures and tables of the LINNA paper, with the paper's values and the differences."""

from collections.abc import Iterator
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np

from reports import published
from reports.document import Block, Cell, Column, Document, Heading, Paragraph, Picture, Table, evidence_text
from reports.figures import navigation, outcomes
from reports.figures import paper as drawn
from reports.figures.canvas import WIDTH_IN, TimeScale
from reports.figures.theme import series_styles
from reports.paper_values import PaperReport, PaperSession, PaperValue
from reports.sections.detection import gallery_picture
from reports.sections.matching import outcome_table
from reports.sections.opening import about, absent, judgement, missing_and_remarks, provenance_and_data
from reports.statistics import completed
from reports.text import count_text, length_text, significant_text

FOV_THRESHOLD = 0.9
_LEVEL_1 = "1 (unit geometry)"
_NO_NUMBER = "the paper gives no number"


def paper_document(report: PaperReport) -> Document:
    """The document, in the order of the paper, then differences and provenance."""
    blocks: list[Block] = [
        *judgement(report),
        Paragraph(
            "Every figure and table of the paper's experiment follows under the number that it has in the paper, with "
            "the paper's values, the values of this system and their evidence level. The first part uses the paper's "
            "own method. The second part repeats it with the estimators of this system. A table at the end explains "
            "every difference."
        ),
        Heading("Orbit and camera (Table I, Section V-B)"),
        *_orbit(report),
        *_fov(report),
        Heading("Rendering of a place (Fig. 3)"),
        *_image(report, "region", "Fig. 3", 4.2),
        Heading("Crater catalogue (Fig. 4)"),
        *_catalogue(report),
        Heading("Data set (Fig. 5)"),
        *_dataset(report),
        Heading("Detection (Table II, Fig. 6)"),
        *_detection(report),
    ]
    for session in report.sessions:
        blocks += [Heading(session.heading), *_session(session)]
    if not report.sessions:
        blocks += [Heading("State estimation (Figs. 7 to 10)"), absent(report, "sessions", "Sessions", "not flown")]
    blocks += [Heading("Differences from the paper"), *_differences(report)]
    blocks += [*missing_and_remarks(report), *provenance_and_data(report)]
    return Document("The paper's figures", report.title, report.identity, about(report), tuple(blocks))


def paper_index(report: PaperReport) -> dict[str, Any]:
    """Return the figures, tables and differences of the document as plain data."""
    blocks = paper_document(report).blocks
    return {
        "figures": [
            {"number": n, "key": block.key, "caption": block.caption, "level": _level_in(block.caption)}
            for n, block in enumerate((b for b in blocks if isinstance(b, Picture)), 1)
        ],
        "tables": [
            {
                "number": n,
                "caption": block.caption,
                "columns": [" ".join(t for t in (c.group, c.label, c.unit) if t) for c in block.columns],
                "rows": [[c.text if isinstance(c, Cell) else c for c in row] for row in block.rows],
            }
            for n, block in enumerate((b for b in blocks if isinstance(b, Table)), 1)
        ],
        "differences": [asdict(one) for one in report.differences],
        "values": [one.row() for one in paper_values(report)],
    }


def paper_figures(report: PaperReport) -> Iterator[Picture]:
    """Yield the figures of the document."""
    return (block for block in paper_document(report).blocks if isinstance(block, Picture))


def paper_values(report: PaperReport) -> list[PaperValue]:
    """Return the numbers of the document with those of the paper."""
    rows: list[PaperValue] = []
    if (orbit := report.orbit) is not None:
        for word, ours in (("mean", orbit.mean_km), ("min", orbit.min_km), ("max", orbit.max_km)):
            theirs = published.ALTITUDE_KM[word]
            rows.append(PaperValue("Table I", f"altitude, {word}", "km", theirs, ours, _LEVEL_1))
        name, frames = "images of 24 h at 15 s within 60° of latitude", orbit.frames_of_a_day
        rows.append(PaperValue("Table I", name, "", published.SESSION_FRAMES, frames, _LEVEL_1))
    if report.fov is not None:
        chosen = report.fov.selected_fov_deg
        rows.append(PaperValue("V-B", "smallest field of view", "°", 120.0, chosen, _LEVEL_1))
    level = report.samples.level if report.samples else ""
    if report.dataset is not None:
        rows.append(PaperValue("Fig. 5", "images", "", published.FRAMES, report.dataset.frames, level))
    for k, name in enumerate(drawn.CLASS_NAMES):
        if report.catalogue is not None:
            count = report.catalogue.counts[k]
            rows.append(PaperValue("Fig. 4", name, "", published.CATALOGUE[k], count, _LEVEL_1))
        if report.dataset is not None and (total := sum(report.dataset.instances)):
            share = 100.0 * report.dataset.instances[k] / total
            words = f"share of labels, {name}"
            rows.append(PaperValue("Fig. 5", words, "%", published.LABEL_SHARES[k], share, level))
    for one in report.detectors:
        for k, score in published.TABLE_II.items():
            for key, unit in (("precision", ""), ("recall", ""), ("localisation_px", "px")):
                words = f"{one.name}, {score.label}, {key.partition('_')[0]}"
                ours = getattr(one.per_class[k], key)
                rows.append(PaperValue("Table II", words, unit, getattr(score, key), ours, one.level))
    for session in report.sessions:
        for series in (*session.series, *session.also):
            figures = completed(series)
            for key in ("median_3d_m", "p95_3d_m", "max_3d_m"):
                words, ours = f"{session.key}, {series.name}, {key[:-5]} error", getattr(figures, key)
                rows.append(PaperValue("Figs. 7 to 10", words, "m", None, ours, session.level))
    return rows


def _compared(report: PaperReport, place: str, caption: str, note: str = "") -> Table:
    """Return the numbers of one place of the paper with their differences."""
    rows = []
    for one in paper_values(report):
        if one.place == place and one.paper is not None:
            numbers = (one.paper, one.here, one.difference)
            rows.append((f"{one.quantity}{f', {one.unit}' if one.unit else ''}", *map(significant_text, numbers)))
    columns = (Column("", numeric=False), Column("paper"), Column("this system"), Column("difference"))
    return Table(caption, columns, tuple(rows), note=note)


def _level_in(caption: str) -> str:
    """Return the evidence level that a caption states."""
    return caption.rpartition("Evidence: ")[2].rstrip(".") if "Evidence: " in caption else ""


def _evidence(level: str) -> str:
    return f"Evidence: {evidence_text(level)}."


def _differences(report: PaperReport) -> list[Block]:
    if not report.differences:
        return [absent(report, "differences", "Differences", "none was computed")]
    names = ("subject", "paper", "this system", "reason")
    columns = tuple(Column(name, numeric=False) for name in names)
    rows = tuple((Cell(d.subject, strong=True), d.paper, d.here, d.reason) for d in report.differences)
    return [Table("Differences, each with its reason.", columns, rows)]


def _orbit(report: PaperReport) -> list[Block]:
    orbit = report.orbit
    if orbit is None:
        return [absent(report, "orbit", "Table I", "the orbit was not propagated")]
    rows: list[tuple[Cell | str, ...]] = [
        (name, published.TABLE_I[name], value) for name, value in orbit.elements.items()
    ]
    text = (Column("parameter", numeric=False), Column("paper"), Column("this system"))
    return [
        Table(f"The paper's Table I: initial elements. {_evidence(_LEVEL_1)}", text, tuple(rows)),
        _compared(
            report,
            "Table I",
            f"Altitudes over {orbit.days:g} days with {orbit.maneuvers} manoeuvres, and images. {_evidence(_LEVEL_1)}",
            f"Gravity field: {orbit.gravity}.",
        ),
    ]


def _fov(report: PaperReport) -> list[Block]:
    curves = report.fov
    if curves is None:
        return [absent(report, "fov", "Choice of the field of view", "the study was not run")]
    chosen = f"{curves.selected_fov_deg:g}°" if np.isfinite(curves.selected_fov_deg) else "none"
    caption = (
        f"Probability of craters of 5–30 km in the footprint (paper, Section V-B.3: 120° is the smallest with over "
        f"90 % for three craters). Smallest here: {chosen}, over {count_text(curves.positions)} positions with "
        f"{curves.source}. {_evidence(_LEVEL_1)}"
    )
    return [
        Picture(
            "fov", caption, "Curves of probability over the field of view.", 3.2,
            lambda c: drawn.draw_fov_curves(c, curves, FOV_THRESHOLD),
        )
    ]  # fmt: skip


def _image(report: PaperReport, field: str, name: str, width_in: float) -> list[Block]:
    picture = getattr(report, field)
    if picture is None:
        return [absent(report, field, f"Form of the paper's {name}", "it was not rendered")]
    height, width = picture.image.shape[:2]
    return [
        Picture(
            field, f"{picture.caption} {_evidence(picture.level)}", picture.caption, width_in * height / width,
            lambda c: drawn.draw_image(c, picture.image), width_in=width_in,
        )
    ]  # fmt: skip


def _catalogue(report: PaperReport) -> list[Block]:
    classes = report.catalogue
    if classes is None:
        return [absent(report, "catalogue", "Fig. 4", "no catalogue was read")]
    return [
        Picture(
            "classes",
            f"Form of the paper's Fig. 4: crater diameters by class, {classes.source}. {_evidence(_LEVEL_1)}",
            "Histogram of crater diameters in three classes.",
            3.0,
            lambda c: drawn.draw_class_histogram(c, classes.diameter_km),
        ),
        _compared(report, "Fig. 4", "Craters by class."),
    ]


def _dataset(report: PaperReport) -> list[Block]:
    blocks = _image(report, "samples", "Fig. 5", WIDTH_IN)
    counts = report.dataset
    if counts is None:
        return blocks
    return [*blocks, _compared(report, "Fig. 5", f"Images and labels; terrain here: {counts.terrain}.")]


def _detection(report: PaperReport) -> list[Block]:
    if not report.detectors:
        return [absent(report, "detectors", "Table II", "no network was evaluated")]
    levels = " ".join(
        f"{d.name}: {d.description}, {count_text(d.frames)} test images. {_evidence(d.level)}" for d in report.detectors
    )
    caption = "The paper's Table II: precision, recall and mean localisation error."
    blocks: list[Block] = [_compared(report, "Table II", caption, levels)]
    for number, one in enumerate(report.detectors):
        if one.gallery:
            lead = f"Form of the paper's Fig. 6, {one.name}. {_evidence(one.level)}"
            blocks.append(gallery_picture(f"detections-{number}", one.gallery[:6], 3, lead))
    return blocks


def _session(session: PaperSession) -> list[Block]:
    series = session.series
    styles = series_styles([(one.name, one.kind) for one in series])
    time = TimeScale(int(session.track.utc_ns[0]), int(session.track.utc_ns[-1]))
    resets = [utc_ns for utc_ns, _ in navigation.resets_of(series, time)]
    hour = navigation.zoom_span(time, session.arcs, resets=resets)
    blocks: list[Block] = [
        Paragraph(session.description),
        _outcomes(session),
        outcome_table([one for one in series if any(one.outcome)]),
        _statistics(session),
    ]
    blocks.append(
        Picture(
            f"{session.key}-ground",
            "Form of the paper's Fig. 8: error in latitude and longitude"
            + (" over one hour" if hour else "")
            + f"; {_NO_NUMBER}. {_evidence(session.level)}",
            "Errors in latitude and longitude over time, resets marked.",
            3.7,
            lambda c: navigation.draw_ground_error(c, series, session.track, styles, hour or time, session.arcs),
        )
    )
    if session.view is not None:
        view = session.view
        blocks.append(
            Picture(
                f"{session.key}-simulator",
                "Form of the paper's Fig. 9: one image of the session with its detections (crosses) and the catalogue "
                f"(dashed), the ground track, and the state of each estimator. {_evidence(session.level)}",
                "Image with detections, ground track and states.",
                3.6,
                lambda c: drawn.draw_simulator(c, session, view),
            )
        )
    for key, span, words in (("altitude", time, "over the session"), ("altitude-hour", hour, "over one hour")):
        if span is not None:
            blocks.append(
                Picture(
                    f"{session.key}-{key}",
                    f"Form of the paper's Fig. 10: altitude {words}, estimates over the reference. "
                    f"{_evidence(session.level)}",
                    "Altitude over time.",
                    3.7,
                    partial(
                        navigation.draw_altitude,
                        series=series,
                        track=session.track,
                        styles=styles,
                        time=span,
                        arcs=session.arcs,
                    ),
                )
            )
    return blocks


def _outcomes(session: PaperSession) -> Picture:
    shown = [one for one in session.series if any(one.outcome)][:4]
    return Picture(
        f"{session.key}-outcomes",
        f"Form of the paper's Fig. 7: outcomes of the {count_text(session.frames)} images by estimator; {_NO_NUMBER}. "
        f"{_evidence(session.level)}",
        "Rings of outcome shares.",
        min(2.15, (WIDTH_IN - 0.2) / max(len(shown), 1)) + 0.48,
        lambda c: outcomes.draw_outcome_shares(c, shown),
    )


def _statistics(session: PaperSession) -> Table:
    names = ("estimator", "median", "95 %", "largest", "altitude, median", "anchor reads")
    columns = tuple(Column(name, numeric=name != "estimator") for name in names)
    rows = []
    for one in (*session.series, *session.also):
        figures = completed(one)
        vertical = np.abs(one.error_rtn_m[:, 0])
        vertical = vertical[np.isfinite(vertical)]
        median = float(np.median(vertical)) if len(vertical) else float("nan")
        lengths = (figures.median_3d_m, figures.p95_3d_m, figures.max_3d_m, median)
        rows.append((one.name, *map(length_text, lengths), count_text(one.anchor_reads)))
    return Table(
        "Position error of each estimator against the reference, and reads of the anchor ephemeris (the ground truth "
        f"in the paper): at resets, and for the altitude that scales each image; {_NO_NUMBER}. "
        f"{_evidence(session.level)}",
        columns,
        tuple(rows),
    )
