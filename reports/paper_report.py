"""The document that repeats the figures and tables of the LINNA paper, with the paper's values and the differences."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from reports import published
from reports.document import Block, Cell, Column, Document, Heading, Paragraph, Picture, Table, evidence_text
from reports.figures import navigation, outcomes
from reports.figures import paper as drawn
from reports.figures.canvas import WIDTH_IN, TimeScale
from reports.figures.theme import OUTCOMES, series_styles
from reports.paper_values import PaperReport, PaperSession
from reports.sections.detection import gallery_picture
from reports.sections.opening import about, absent, judgement, missing_and_remarks, provenance_and_data
from reports.statistics import completed
from reports.text import count_text, length_text, number_text, percent_text
from reports.values import NavigationSeries

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
        *_image(report, "region", "Fig. 3", 4.2, 4.2),
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
        blocks += [
            Heading("State estimation (Figs. 7 to 10)"),
            absent(report, "sessions", "Sessions", "not flown"),
        ]
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
        "differences": [
            {"subject": d.subject, "paper": d.paper, "here": d.here, "reason": d.reason}
            for d in report.differences
        ],
    }


def _level_in(caption: str) -> str:
    """Return the evidence level that a caption states."""
    return caption.rpartition("Evidence: ")[2].rstrip(".") if "Evidence: " in caption else ""


def _evidence(level: str) -> str:
    return f"Evidence: {evidence_text(level)}."


def _differences(report: PaperReport) -> list[Block]:
    if not report.differences:
        return [absent(report, "differences", "Differences", "none was computed")]
    columns = (
        Column("subject", numeric=False),
        Column("paper", numeric=False),
        Column("this system", numeric=False),
        Column("reason", numeric=False),
    )
    rows = tuple((Cell(d.subject, strong=True), d.paper, d.here, d.reason) for d in report.differences)
    return [Table("Differences, each with its reason.", columns, rows)]


def _orbit(report: PaperReport) -> list[Block]:
    orbit = report.orbit
    if orbit is None:
        return [absent(report, "orbit", "Table I", "the orbit was not propagated")]
    rows: list[tuple[Cell | str, ...]] = [
        (name, published.TABLE_I[name], value) for name, value in orbit.elements.items()
    ]
    month = published.ALTITUDE_KM
    rows += [
        (f"Altitude, {word}", f"{theirs:.1f} km", f"{ours:.1f} km")
        for word, theirs, ours in (
            ("mean", month["mean"], orbit.mean_km),
            ("minimum", month["min"], orbit.min_km),
            ("maximum", month["max"], orbit.max_km),
        )
    ]
    rows.append(
        (
            "Images of 24 h at 15 s within 60° of latitude",
            count_text(published.SESSION_FRAMES),
            count_text(orbit.frames_of_a_day),
        )
    )
    return [
        Table(
            f"The paper's Table I: initial elements, and the altitudes that follow over {orbit.days:g} days with "
            f"{orbit.maneuvers} manoeuvres. {_evidence(_LEVEL_1)}",
            (Column("parameter", numeric=False), Column("paper"), Column("this system")),
            tuple(rows),
            note=f"Gravity field: {orbit.gravity}.",
        )
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


def _image(report: PaperReport, field: str, name: str, width_in: float, height_in: float) -> list[Block]:
    picture = getattr(report, field)
    if picture is None:
        return [absent(report, field, f"Form of the paper's {name}", "it was not rendered")]
    return [
        Picture(
            field, f"{picture.caption} {_evidence(picture.level)}", picture.caption, height_in,
            lambda c: drawn.draw_image(c, picture.image), width_in=width_in,
        )
    ]  # fmt: skip


def _catalogue(report: PaperReport) -> list[Block]:
    classes = report.catalogue
    if classes is None:
        return [absent(report, "catalogue", "Fig. 4", "no catalogue was read")]
    counts = [count_text(n) for n in classes.counts]
    return [
        Picture(
            "classes",
            f"Form of the paper's Fig. 4: crater diameters by class, {classes.source}. {_evidence(_LEVEL_1)}",
            "Histogram of crater diameters in three classes.",
            3.0,
            lambda c: drawn.draw_class_histogram(c, classes.diameter_km),
        ),
        Table(
            "Craters by class.",
            (Column("class", numeric=False), Column("paper"), Column("this system")),
            tuple(
                (name, count_text(theirs), ours)
                for name, theirs, ours in zip(drawn.CLASS_NAMES, published.CATALOGUE, counts, strict=True)
            ),
        ),
    ]


def _dataset(report: PaperReport) -> list[Block]:
    blocks: list[Block] = []
    if report.samples is not None:
        height, width = report.samples.image.shape[:2]
        blocks += _image(report, "samples", "Fig. 5", WIDTH_IN, WIDTH_IN * height / width)
    else:
        blocks.append(absent(report, "samples", "Form of the paper's Fig. 5", "no data set was rendered"))
    counts = report.dataset
    if counts is None:
        return blocks
    total = max(sum(counts.instances), 1)
    rows: list[tuple[Cell | str, ...]] = [
        ("images", count_text(published.FRAMES), "", count_text(counts.frames), "")
    ]
    rows += [
        (
            name,
            count_text(published.LABELS[k]),
            f"{published.LABEL_SHARES[k]:.1f} %",
            count_text(counts.instances[k]),
            percent_text(counts.instances[k], total),
        )
        for k, name in enumerate(drawn.CLASS_NAMES)
    ]
    columns = (
        Column("", numeric=False),
        Column("count", group="paper"),
        Column("share", group="paper"),
        Column("count", group="this system"),
        Column("share", group="this system"),
    )
    return [*blocks, Table(f"Images and labels; terrain here: {counts.terrain}.", columns, tuple(rows))]


def _detection(report: PaperReport) -> list[Block]:
    if not report.detectors:
        return [absent(report, "detectors", "Table II", "no network was evaluated")]
    columns = [Column("class", numeric=False)]
    for name in ("paper", *(d.name for d in report.detectors)):
        columns += [Column("P", group=name), Column("R", group=name), Column("loc", group=name, unit="px")]
    rows: list[tuple[Cell | str, ...]] = []
    for k, theirs in published.TABLE_II.items():
        cells: list[Cell | str] = [
            theirs.label,
            *_score(theirs.precision, theirs.recall, theirs.localisation_px),
        ]
        for one in report.detectors:
            mine = one.per_class[k]
            cells += _score(mine.precision, mine.recall, mine.localisation_px)
        rows.append(tuple(cells))
    cells = ["All", "", "", ""]
    for one in report.detectors:
        cells += _score(one.micro.precision, one.micro.recall, one.micro.localisation_px)
    rows.append(tuple(cells))
    levels = " ".join(
        f"{d.name}: {d.description}, {count_text(d.frames)} test images. {_evidence(d.level)}"
        for d in report.detectors
    )
    blocks: list[Block] = [
        Table(
            "The paper's Table II: precision, recall and mean localisation error.",
            tuple(columns),
            tuple(rows),
            note=levels,
        )
    ]
    for number, one in enumerate(report.detectors):
        if one.gallery:
            lead = f"Form of the paper's Fig. 6, {one.name}. {_evidence(one.level)}"
            blocks.append(gallery_picture(f"detections-{number}", one.gallery[:6], 3, lead))
    return blocks


def _score(precision: float, recall: float, localisation_px: float) -> tuple[str, str, str]:
    return number_text(precision, 3), number_text(recall, 3), number_text(localisation_px, 2)


def _session(session: PaperSession) -> list[Block]:
    series = session.series
    styles = series_styles([(one.name, one.kind) for one in series])
    time = TimeScale(int(session.track.utc_ns[0]), int(session.track.utc_ns[-1]))
    resets = [utc_ns for utc_ns, _ in navigation.resets_of(series, time)]
    hour = navigation.zoom_span(time, session.arcs, resets=resets)
    blocks: list[Block] = [
        Paragraph(session.description),
        _outcomes(session),
        _outcome_table(series),
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
            lambda c: navigation.draw_ground_error(
                c, series, session.track, styles, hour or time, session.arcs
            ),
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
    for key, span, words in (
        ("altitude", time, "over the session"),
        ("altitude-hour", hour, "over one hour"),
    ):
        if span is not None:
            blocks.append(_altitude(session, styles, span, key, words))
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


def _outcome_table(series: Sequence[NavigationSeries]) -> Table:
    shown = [one for one in series if any(one.outcome)]
    counts = outcomes.outcome_table(shown)
    totals = [sum(row[i] for row in counts.values()) for i in range(len(shown))]
    columns = [Column("outcome", numeric=False)]
    for one in shown:
        columns += [Column("images", group=one.name), Column("share", group=one.name)]
    rows = []
    for outcome, row in counts.items():
        label, role = OUTCOMES.get(outcome, (outcome, "gray3"))
        cells: list[Cell | str] = [Cell(label, swatch=role)]
        for i, n in enumerate(row):
            cells += [count_text(n), percent_text(n, totals[i])]
        rows.append(tuple(cells))
    return Table("Outcomes by estimator.", tuple(columns), tuple(rows))


def _statistics(session: PaperSession) -> Table:
    columns = (
        Column("estimator", numeric=False),
        Column("median"),
        Column("95 %"),
        Column("largest"),
        Column("altitude, median"),
        Column("anchor reads"),
    )
    rows = []
    for one in (*session.series, *session.also):
        figures = completed(one)
        vertical = np.abs(one.error_rtn_m[:, 0])
        vertical = vertical[np.isfinite(vertical)]
        rows.append(
            (
                one.name,
                length_text(figures.median_3d_m),
                length_text(figures.p95_3d_m),
                length_text(figures.max_3d_m),
                length_text(float(np.median(vertical)) if len(vertical) else float("nan")),
                count_text(one.anchor_reads),
            )
        )
    return Table(
        "Position error of each estimator against the reference, and reads of the anchor ephemeris (the ground truth "
        f"in the paper): at resets, and for the altitude that scales each image; {_NO_NUMBER}. "
        f"{_evidence(session.level)}",
        columns,
        tuple(rows),
    )


def _altitude(
    session: PaperSession, styles: navigation.Styles, span: TimeScale, key: str, words: str
) -> Picture:
    return Picture(
        f"{session.key}-{key}",
        f"Form of the paper's Fig. 10: altitude {words}, estimates over the reference. {_evidence(session.level)}",
        "Altitude over time.",
        3.7,
        lambda c: navigation.draw_altitude(c, session.series, session.track, styles, span, session.arcs),
    )
