"""The first page: verdict, figures, the errors of all solutions at a glance, what is missing."""

import math
from functools import partial

from reports.document import Block, Cell, Column, Heading, Picture, Table, Verdict
from reports.figures import navigation
from reports.figures.canvas import TimeScale
from reports.sections.common import PassView, arc_words, role_of
from reports.sections.opening import judgement, missing_and_remarks
from reports.statistics import completed, error_3d_m, quantiles
from reports.text import NOT_A_VALUE, count_text, length_text, number_text, significant_text

NO_BREAK_SPACE = "\u00a0"


def summary(view: PassView) -> list[Block]:
    """Verdict and figures, errors at a glance, what is missing."""
    report = view.report
    blocks = judgement(report)
    if report.experiment:
        blocks.insert(1, Verdict(report.experiment, report.experiment_level, "Experiment"))
    blocks += [*requirements_table(view), Heading("At a glance")]
    if view.with_error:
        blocks.append(error_picture(view, "glance", 2.75, view.time))
        blocks.append(_statistics_table(view))
    else:
        blocks.append(view.no_error())
    return [*blocks, *missing_and_remarks(view.report)]


def requirements_table(view: PassView) -> list[Block]:
    """Return the table of requirements: limit, value, margin and status."""
    rows: list[tuple[Cell | str, ...]] = []
    for one in view.report.requirements:
        judged = one.status != "not judged"
        limit = NOT_A_VALUE
        if one.limit is not None:
            limit = f"{'≤' if one.at_most else '≥'} {_with_unit(one.limit, one.unit)}"
        rows.append(
            (
                one.name,
                Cell(one.status.replace(" ", NO_BREAK_SPACE), strong=one.status == "not met"),
                "unknown" if one.value is None else _with_unit(one.value, one.unit),
                limit,
                NOT_A_VALUE if one.margin is None or not judged else _with_unit(one.margin, ""),
                one.note,
            )
        )
    if not rows:
        return []
    return [
        Heading("Requirements"),
        Table(
            "Requirements of the mission description, and the results of this pass.",
            (
                Column("requirement", numeric=False),
                Column("status", numeric=False),
                Column("value"),
                Column("limit"),
                Column("margin"),
                Column("of", numeric=False),
            ),
            tuple(rows),
            note="Accuracy is that of the estimator that the mission declares. A requirement without a limit is not "
            "judged; an unknown value never counts as met. The limit of a comparison is the median error of the "
            "baseline.",
        ),
    ]


def _with_unit(value: float, unit: str) -> str:
    """Return a number with three significant digits and its unit; whole numbers below a thousand are unchanged."""
    whole = float(value).is_integer() and abs(value) < 1000.0
    text = number_text(value, 0) if whole else significant_text(value)
    return f"{text}{NO_BREAK_SPACE}{unit}" if unit else text


def _statistics_table(view: PassView) -> Table:
    rows: list[tuple[Cell | str, ...]] = []
    for one in view.report.navigation:
        s = completed(one)
        color = view.styles[one.name][0]
        reads = one.anchor_reads_after_start
        kind = {"baseline": "baseline", "smoothed": "smoothed"}.get(one.kind, "flown")
        words = "flown, not applicable" if one.not_applicable else kind
        rows.append(
            (
                Cell(one.name, swatch=role_of(color), strong=one.kind != "baseline"),
                words,
                number_text(s.median_3d_m, 0),
                number_text(s.p68_3d_m, 0),
                number_text(s.p95_3d_m, 0),
                number_text(s.p99_3d_m, 0),
                number_text(s.max_3d_m, 0),
                number_text(s.end_of_pass_m, 0),
                number_text(s.drift_percent, 3),
                NOT_A_VALUE if kind != "flown" else count_text(one.anchor_reads if reads is None else reads),
            )
        )
    return Table(
        "3-D position error against the reference, over all samples and without any alignment.",
        (
            Column("solution", numeric=False),
            Column("kind", numeric=False),
            Column("median", group="3-D error, m"),
            Column("68 %", group="3-D error, m"),
            Column("95 %", group="3-D error, m"),
            Column("99 %", group="3-D error, m"),
            Column("largest", group="3-D error, m"),
            Column("at the end", group="3-D error, m"),
            Column("drift", unit="% of path"),
            Column("anchor reads", unit="after start"),
        ),
        tuple(rows),
        note="Drift is the horizontal error gathered since the last reset, at the instant before the next, over the "
        "path since that reset; the median over resets. A dash means that there is no such value."
        + "".join(f" Not applicable: {one.not_applicable}." for one in view.report.navigation if one.not_applicable),
    )


def error_picture(view: PassView, key: str, height_in: float, time: TimeScale) -> Picture:
    series, arcs = view.with_error, view.report.imaging_arcs
    smallest = _smallest_medians(view, time)
    resets = len(navigation.resets_of(view.estimates, time))
    marks = ""
    if resets == 1:
        marks = " The dashed gray line marks a reset to the anchor ephemeris."
    elif resets:
        marks = f" Dashed gray lines, or ticks at the top, mark {count_text(resets)} resets to the anchor."
    return Picture(
        key,
        f"{'' if time is view.time else 'One hour of it: '}3-D position error of every solution, flown (full "
        "lines) and computed for comparison (gray), on a logarithmic axis. "
        f"{smallest}{arc_words(time, arcs)}{marks}",
        f"Error over time. {smallest}",
        height_in,
        partial(navigation.draw_error_over_time, series=series, styles=view.styles, time=time, arcs=arcs),
    )


def _smallest_medians(view: PassView, time: TimeScale) -> str:
    """Words for the best of the flown solutions and the best of the baselines."""
    parts = []
    for kind, words in (
        ("estimate", "of those flown"),
        ("smoothed", "afterwards on the ground"),
        ("baseline", "of the baselines"),
    ):
        known = [
            (quantiles(error_3d_m(s.error_rtn_m)[time.inside(s.utc_ns)], (0.5,))[0], s.name)
            for s in view.with_error
            if s.kind == kind
        ]
        finite = [k for k in known if math.isfinite(k[0])]
        if finite:
            median, name = min(finite)
            parts.append(f"{words} {name}, {length_text(median)}")
    return f"Smallest median: {'; '.join(parts)}." if parts else ""
