"""Report of a month of a spacecraft: performance over the passes, by condition, changes, requirements."""

import numpy as np

from reports.document import VERDICT_ROLES, Block, Bullets, Cell, Column, Document, Heading, Paragraph, Picture, Table
from reports.figures import monthly
from reports.sections.opening import about, absent, judgement, missing_and_remarks, provenance_and_data
from reports.text import count_text, number_text, percent_text, significant_text, utc_ns_of, utc_text
from reports.values import MonthlyReportValue

METRICS = {
    "recall": ("recall", "%", 100.0, 1),
    "drift_percent": ("drift", "% of path", 1.0, 3),
    "median_error_m": ("median error", "m", 1.0, 0),
}
"""Name, unit, scale and decimals of the metrics."""
_DRAWN = METRICS | {"map_offset_m": ("offset of the list", "m", 1.0, 0)}


def monthly_document(report: MonthlyReportValue) -> Document:
    blocks: list[Block] = [*judgement(report), Heading("Passes over time")]
    if report.passes:
        blocks.append(_trend(report))
    else:
        blocks.append(absent(report, "passes", "Passes", "no pass has a report"))
    blocks += [Heading("Changes of level"), *_changes(report)]
    blocks += [Heading("Requirements"), *_requirements(report)]
    blocks += missing_and_remarks(report)
    blocks += [Heading("By condition"), *_groups(report)]
    blocks += provenance_and_data(report)
    blocks += [Heading("All passes"), _passes(report)]
    facts = about(report, ("Passes", count_text(len(report.passes))), ("month", report.month))
    return Document("Monthly report", report.title, report.month, facts, tuple(blocks))


def _trend(report: MonthlyReportValue) -> Picture:
    series = monthly.series(report)
    medians = {
        name: float(np.nanmedian(values)) if np.isfinite(values).any() else float("nan")
        for name, values in series.items()
    }
    words = "; ".join(
        f"{label}: {number_text(scale * medians[name], decimals)} {unit}"
        for name, (label, unit, scale, decimals) in _DRAWN.items()
        if name in medians
    )
    return Picture(
        "monthly-trend",
        "Recall, drift, median error and offset of the crater list as learned on board, of each pass; vertical lines "
        "are changes of level. "
        f"Median of the passes: {words}.",
        f"Recall, drift and median error over time. Median of the passes: {words}.",
        0.6 + 1.2 * len(series),
        lambda canvas: monthly.draw_trend(canvas, report, _DRAWN),
    )


def _changes(report: MonthlyReportValue) -> list[Block]:
    note = Paragraph(
        "A change of level is a significant split of the ranks of a metric in the order of the passes (CUSUM of ranks "
        "with random permutations, binary segmentation). With constant levels, the probability of any change in this "
        f"report is at most {report.false_alarm_rate:g}. A change of the conditions also appears as a change of level.",
        small=True,
    )
    if not report.changes:
        return [absent(report, "changes", "Changes of level", "no metric changed significantly"), note]
    rows = []
    for one in report.changes:
        label, unit, scale, decimals = METRICS[one.metric]
        rows.append(
            (
                Cell(label, strong=True),
                str(one.pass_id),
                utc_text(utc_ns_of(one.time)),
                f"{number_text(scale * one.before, decimals)} {unit}",
                f"{number_text(scale * one.after, decimals)} {unit}",
                count_text(one.passes_before),
                count_text(one.passes_after),
                significant_text(one.p_value),
            )
        )
    columns = (
        Column("metric", numeric=False),
        Column("first pass"),
        Column("time", numeric=False),
        Column("before", group="median"),
        Column("after", group="median"),
        Column("before", group="passes"),
        Column("after", group="passes"),
        Column("p"),
    )
    return [Table("Changes of level.", columns, tuple(rows)), note]


def _requirements(report: MonthlyReportValue) -> list[Block]:
    if not report.requirements:
        return [absent(report, "requirements", "Requirements", "the reports of the passes have none")]
    rows = []
    for one in report.requirements:
        judged = one.met + one.not_met
        share = percent_text(one.met, judged) if judged else "not judged"
        between = "–"
        if judged and one.low is not None and one.high is not None:
            between = f"{100.0 * one.low:.0f} to {100.0 * one.high:.0f} %"
        swatch = "" if not judged else "green" if not one.not_met else "vermillion"
        rows.append(
            (
                Cell(one.name, swatch=swatch, strong=bool(one.not_met)),
                "not stated" if one.limit is None else f"{significant_text(one.limit)} {one.unit}".rstrip(),
                count_text(one.met),
                count_text(one.not_met),
                count_text(one.unknown),
                share,
                between,
            )
        )
    columns = (
        Column("requirement", numeric=False),
        Column("limit"),
        Column("met", group="passes"),
        Column("not met", group="passes"),
        Column("unknown", group="passes"),
        Column("share met"),
        Column("95 % interval"),
    )
    table = Table(f"Requirements over the last {report.window_days:g} days of passes.", columns, tuple(rows))
    remarks = tuple(f"{one.name}, {one.remark}" for one in report.requirements if one.remark)
    return [table, Bullets(remarks)] if remarks else [table]


def _groups(report: MonthlyReportValue) -> list[Block]:
    names = list(dict.fromkeys((one.factor, one.group) for one in report.groups))
    found = {(one.factor, one.group, one.metric): one for one in report.groups}
    rows = []
    for factor, group in names:
        cells: list[Cell | str] = [factor, group, count_text(max(found[factor, group, m].passes for m in METRICS))]
        for metric, (_, _, scale, decimals) in METRICS.items():
            one = found[factor, group, metric]
            mean, low, high = (number_text(_scaled(value, scale), decimals) for value in (one.mean, one.low, one.high))
            cells += [mean, "unknown" if one.low is None else f"{low} to {high}"]
        rows.append(tuple(cells))
    if not rows:
        return [absent(report, "groups", "Conditions", "no pass has a report")]
    columns = [Column("condition", numeric=False), Column("group", numeric=False), Column("passes")]
    for label, unit, _, _ in METRICS.values():
        columns += [Column("mean", group=f"{label}, {unit}"), Column("95 % interval", group=f"{label}, {unit}")]
    return [
        Table(
            "Mean of the passes of each group. Each pass counts once; the interval is Student's t over the passes.",
            tuple(columns),
            tuple(rows),
        )
    ]


def _scaled(value: float | None, scale: float) -> float | None:
    return None if value is None else scale * value


def _passes(report: MonthlyReportValue) -> Table:
    rows = tuple(
        (
            Cell(str(one.pass_id), swatch=VERDICT_ROLES.get(one.verdict_level, "")),
            utc_text(utc_ns_of(one.start)),
            number_text(_scaled(one.recall, 100.0), 1),
            number_text(one.drift_percent, 3),
            number_text(one.median_error_m, 0),
            number_text(one.altitude_km, 1),
            number_text(one.sun_elevation_deg, 1),
            one.build or "not known",
            f"{count_text(one.packets_lost)} of {count_text(one.packets + one.packets_lost)}",
        )
        for one in report.passes
    )
    return Table(
        "Passes in order of time; the colour is that of the verdict of the report of the pass.",
        (
            Column("pass"),
            Column("start", numeric=False),
            Column("recall", unit="%"),
            Column("drift", unit="% of path"),
            Column("median error", unit="m"),
            Column("altitude", unit="km"),
            Column("Sun elevation", unit="°"),
            Column("build", numeric=False),
            Column("packets lost"),
        ),
        rows,
    )
