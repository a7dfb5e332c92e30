"""The report of a regression: a candidate build against a baseline over the same archived passes."""

import math
from functools import partial

from reports.document import Block, Cell, Column, Document, Heading, Picture, Table
from reports.figures.canvas import Canvas
from reports.figures.theme import color
from reports.sections.detection import gallery_picture
from reports.sections.opening import about, absent, judgement, missing_and_remarks, provenance_and_data
from reports.text import count_text, loss_text, number_text, significant_text
from reports.values import ChangedCraters, Gate, RegressionReport

_ORDER = ("fail", "inconclusive", "not judged", "pass")
_SWATCHES = {"pass": "green", "inconclusive": "orange", "fail": "vermillion", "not judged": ""}


def regression_document(report: RegressionReport) -> Document:
    counts = {outcome: sum(g.outcome == outcome for g in report.gates) for outcome in _ORDER}
    blocks: list[Block] = [*judgement(report), Heading("Craters that changed"), *_changed(report)]
    blocks += [Heading("Passes"), _passes(report), Heading("Gates")]
    if report.gates:
        blocks.append(_gates(report))
    else:
        blocks.append(absent(report, "gates", "Gates", "no gate was judged, so the verdict is inconclusive"))
    blocks += missing_and_remarks(report)
    blocks += provenance_and_data(report)
    facts = about(
        report,
        ("Candidate", report.candidate),
        ("baseline", report.baseline),
        ("gates", f"{counts['fail']} failed, {counts['inconclusive']} inconclusive, {counts['pass']} passed"),
        ("passes", count_text(len(report.passes))),
    )
    return Document("Regression report", report.title, report.regression_id, facts, tuple(blocks))


def _gates(report: RegressionReport) -> Table:
    rows = tuple(
        (
            Cell(g.name, swatch=_SWATCHES[g.outcome], strong=g.outcome != "pass"),
            g.pass_id or "all",
            significant_text(g.baseline),
            significant_text(g.candidate),
            significant_text(g.limit),
            g.unit,
            loss_text(g.resolution, g.relative) if g.evidence and math.isfinite(g.resolution) else "",
            Cell(_outcome_text(g), strong=g.outcome != "pass"),
        )
        for g in sorted(report.gates, key=lambda g: _ORDER.index(g.outcome))
    )
    return Table(
        "Gates, failed gates first. The last number is the loss that these frames find with a power of 0.8.",
        (
            Column("gate", numeric=False),
            Column("pass", numeric=False),
            Column("baseline"),
            Column("candidate"),
            Column("limit"),
            Column("unit", numeric=False),
            Column("detectable loss"),
            Column("outcome", numeric=False),
        ),
        rows,
    )


def _outcome_text(gate: Gate) -> str:
    """Return the outcome of a gate with its reason and evidence."""
    parts = [{"pass": "passed", "fail": "failed"}.get(gate.outcome, gate.outcome), gate.reason, gate.evidence]
    if gate.outcome == "inconclusive" and gate.frames_needed is not None:
        parts.append(f"about {count_text(gate.frames_needed)} frames decide, {count_text(gate.frames)} compared")
    return ", ".join(filter(None, parts))


def _changed(report: RegressionReport) -> list[Block]:
    """Return the craters that changed: map, list, and both builds side by side, two pairs to a row."""
    blocks: list[Block] = []
    craters = report.craters
    if craters is not None and len(craters.change):
        lost, gained = int((craters.change < 0).sum()), int((craters.change > 0).sum())
        counts = f"{lost} of {len(craters.change)} tracks of craters lost, {gained} gained"
        blocks.append(
            Picture(
                "craters",
                f"{counts}. Vermillion: the candidate detects the crater in fewer frames; blue: in more; gray: in as "
                f"many. Crosses: {len(craters.false_latitude_deg)} places where the candidate alone has a detection "
                "without a crater.",
                counts,
                3.6,
                partial(_draw_changed_craters, craters=craters),
            )
        )
    if not report.changed_tracks:
        return [*blocks, absent(report, "changed_tracks", "Tracks", "no track of a crater changed")]
    columns = (
        Column("pass", numeric=False),
        Column("latitude", unit="degrees"),
        Column("longitude", unit="degrees"),
        Column("diameter", unit="km"),
        Column("frames"),
        Column("lost"),
        Column("gained"),
    )
    rows = tuple(
        (
            one.pass_id,
            number_text(one.latitude_deg, 2),
            number_text(one.longitude_deg, 2),
            number_text(one.diameter_km, 1),
            count_text(one.frames),
            count_text(one.lost),
            count_text(one.gained),
        )
        for one in report.changed_tracks
    )
    sides = tuple(side for one in report.changed_tracks for side in (one.baseline, one.candidate))
    lead = "Left the baseline, right the candidate, around one crater, in the order of the list; contrast stretched."
    return [
        *blocks,
        Table(
            "Tracks that changed most: one crater in one visit. Frames in which one build alone detects it.",
            columns,
            rows,
        ),
        gallery_picture("changed", sides, 4, lead),
    ]


def _passes(report: RegressionReport) -> Block:
    """Return the table of the passes with both builds."""
    if not report.passes:
        return absent(report, "passes", "Passes", "no pass was run with both builds")
    names = ("recall", "precision", "median error")
    rows = tuple(
        (
            one.pass_id,
            count_text(one.frames),
            "none" if one.first_difference is None else count_text(one.first_difference),
            *(
                number_text(value, digits)
                for pair, digits in ((one.recall, 3), (one.precision, 3), (one.median_3d_m, 1))
                for value in pair
            ),
        )
        for one in report.passes
    )
    figures = (
        Column(side, group=name, unit="m" if name == "median error" else "")
        for name in names
        for side in ("baseline", "candidate")
    )
    columns = (Column("pass", numeric=False), Column("frames"), Column("first different frame"), *figures)
    return Table("Passes with both builds; position errors of the anchored estimator.", columns, rows)


def _draw_changed_craters(canvas: Canvas, craters: ChangedCraters) -> None:
    """Draw tracks of craters by longitude and latitude, coloured by their change, and new false detections."""
    axes = canvas.axes(0.75, 0.55, canvas.width_in - 1.0, canvas.height_in - 0.75)
    for chosen, role, size in (
        (craters.change == 0, "muted", 2.0),
        (craters.change > 0, "blue", 5.0),
        (craters.change < 0, "vermillion", 5.0),
    ):
        x, y = craters.longitude_deg[chosen], craters.latitude_deg[chosen]
        axes.plot(x, y, "o", color=color(role), markersize=size, alpha=0.8)
    x, y = craters.false_longitude_deg, craters.false_latitude_deg
    axes.plot(x, y, "x", color=color("orange"), markersize=4.0)
    axes.grid(True, axis="both")
    axes.set_xlabel("longitude, degrees east")
    axes.set_ylabel("latitude, degrees")
