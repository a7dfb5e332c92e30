"""Report of a campaign: comparison of many passes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from reports.document import Block, Cell, Column, Document, Heading, NewPage, Picture, Table
from reports.figures import campaign
from reports.figures.theme import series_styles
from reports.sections.common import role_of
from reports.sections.opening import about, absent, judgement, missing_and_remarks, provenance_and_data
from reports.statistics import quantiles
from reports.text import NOT_A_VALUE, count_text, length_text, number_text, percent_text, utc_text
from reports.values import CampaignPass, CampaignReport

_MOST_ROWS = 400
Styles = dict[str, tuple[str, tuple[float, ...] | None]]


def campaign_document(report: CampaignReport) -> Document:
    """The document of a campaign."""
    passes = tuple(sorted(report.passes, key=lambda p: (p.start_utc_ns, p.pass_id)))
    blocks: list[Block] = [*judgement(report), Heading("At a glance")]
    if not passes:
        blocks += [absent(report, "passes", "Passes", "the campaign has none"), *missing_and_remarks(report)]
        blocks += provenance_and_data(report)
        return Document("Campaign report", report.title, report.campaign_id, about(report), tuple(blocks))
    names, styles = solutions(passes)
    if names:
        blocks += [_trend(passes, names, styles), solution_table(passes, names, styles)]
    else:
        blocks.append(absent(report, "navigation", "Navigation", "no pass has a navigation solution"))
    blocks += missing_and_remarks(report)
    blocks += provenance_and_data(report)
    if names:
        blocks += _groups(passes, names, styles)
    blocks += _detector(report, passes)
    blocks += _completeness(passes)
    blocks += [NewPage(), Heading("All passes"), _pass_table(passes, names)]
    facts = about(
        report,
        ("Passes", count_text(len(passes))),
        ("from", utc_text(passes[0].start_utc_ns)),
        ("to", utc_text(passes[-1].start_utc_ns)),
    )
    return Document("Campaign report", report.title, report.campaign_id, facts, tuple(blocks))


def solutions(passes: Sequence[CampaignPass]) -> tuple[tuple[str, ...], Styles]:
    """Names of all solutions, flown ones first, and their colours."""
    seen: dict[str, str] = {}
    for one in passes:
        for name in one.navigation:
            seen[name] = "baseline" if name in one.baselines else seen.get(name, "estimate")
    order = [n for n, k in seen.items() if k == "estimate"] + [n for n, k in seen.items() if k == "baseline"]
    return tuple(order), series_styles([(n, seen[n]) for n in order])


def _trend(passes: Sequence[CampaignPass], names: Sequence[str], styles: Styles) -> Picture:
    medians = {n: quantiles(campaign.statistic(passes, n, "median_3d_m"), (0.5,))[0] for n in names}
    words = "; ".join(f"{n}: {length_text(v)}" for n, v in medians.items())
    return Picture(
        "trend",
        "3-D position error of each pass: median (dot), up to the 95th percentile (line); baselines as "
        "dashes, median only. "
        f"Median over passes: {words}.",
        f"Error of each pass over time. Median over passes: {words}.",
        3.0,
        lambda c: campaign.draw_error_trend(c, passes, names, styles),
    )


def solution_table(
    passes: Sequence[CampaignPass], names: Sequence[str], styles: Styles, what: str = ""
) -> Table:
    """Figures of every solution over the passes."""
    rows: list[tuple[Cell | str, ...]] = []
    for name in names:
        median = campaign.statistic(passes, name, "median_3d_m")
        p95 = campaign.statistic(passes, name, "p95_3d_m")
        worst = campaign.statistic(passes, name, "max_3d_m")
        drift = campaign.statistic(passes, name, "drift_percent")
        reads = [p.anchor_reads_after_start[name] for p in passes if name in p.anchor_reads_after_start]
        low, middle, high = quantiles(median, (0.0, 0.5, 1.0))
        rows.append(
            (
                Cell(name, swatch=role_of(styles[name][0]), strong=styles[name][1] is None),
                count_text(int(np.isfinite(median).sum())),
                number_text(low, 0),
                number_text(middle, 0),
                number_text(high, 0),
                number_text(quantiles(p95, (0.5,))[0], 0),
                number_text(quantiles(worst, (1.0,))[0], 0),
                number_text(quantiles(drift, (0.5,))[0], 3),
                count_text(sum(reads)) if reads else NOT_A_VALUE,
            )
        )
    return Table(
        f"3-D position error over the passes{what}: each pass counts once.",
        (
            Column("solution", numeric=False),
            Column("passes"),
            Column("best", group="median of a pass, m"),
            Column("median", group="median of a pass, m"),
            Column("worst", group="median of a pass, m"),
            Column("median of 95 %", unit="m"),
            Column("largest error", unit="m"),
            Column("drift", unit="% of path"),
            Column("anchor reads", unit="after start"),
        ),
        tuple(rows),
    )


def _groups(passes: Sequence[CampaignPass], names: Sequence[str], styles: Styles) -> list[Block]:
    blocks: list[Block] = []
    groups = [
        (title, labels)
        for title, labels in (("build", [p.build for p in passes]), ("light", [p.light for p in passes]))
        if any(labels)
    ]
    if groups:
        blocks.append(
            Picture(
                "groups",
                "Median error of every pass by build and by light: a dot for each pass, a bar at the median "
                "of the group.",
                "Median error of every pass by build and by light.",
                2.7,
                lambda c: campaign.draw_groups(c, passes, groups, names, styles),
            )
        )
    quantities = [
        (title, value)
        for title, value in (
            ("mean altitude, km", np.array([p.altitude_km for p in passes], dtype=np.float64)),
            (
                "mean Sun elevation, degrees",
                np.array([p.sun_elevation_deg for p in passes], dtype=np.float64),
            ),
        )
        if np.isfinite(value).any()
    ]
    if quantities:
        blocks.append(
            Picture(
                "against",
                "Median error of every pass against its mean altitude and mean Sun elevation.",
                "Median error of every pass against altitude and Sun elevation.",
                2.6,
                lambda c: campaign.draw_against(c, passes, quantities, names, styles),
            )
        )
    return [Heading("What the error depends on"), *blocks] if blocks else []


def _detector(report: CampaignReport, passes: Sequence[CampaignPass]) -> list[Block]:
    recall = np.array([p.recall for p in passes], dtype=np.float64)
    if not np.isfinite(recall).any():
        return [
            Heading("The detector"),
            absent(report, "detector", "Precision and recall", "no pass has a score"),
        ]
    precision = np.array([p.precision for p in passes], dtype=np.float64)
    middle = [quantiles(v, (0.5,))[0] for v in (precision, recall)]
    return [
        Heading("The detector"),
        Picture(
            "detector",
            "Precision and recall of each pass over all classes; the bands span the three classes of the "
            "paper's Table II. "
            f"Median precision {middle[0]:.3f}, median recall {middle[1]:.3f}.",
            f"Median precision {middle[0]:.3f}, median recall {middle[1]:.3f}.",
            2.4,
            lambda c: campaign.draw_detector_trend(c, passes),
        ),
    ]


def _completeness(passes: Sequence[CampaignPass]) -> list[Block]:
    if all(p.packets is None and p.frames_expected is None for p in passes):
        return []
    lost, packets = sum(p.packets_lost or 0 for p in passes), sum(p.packets or 0 for p in passes)
    clean = sum(p.packets is not None and not p.packets_lost for p in passes)
    return [
        Heading("Completeness"),
        Picture(
            "completeness",
            f"What was lost, pass by pass; a blue dot is a pass without loss. {count_text(lost)} of "
            f"{count_text(lost + packets)} "
            f"packets were lost ({percent_text(lost, lost + packets, 2)}); {count_text(clean)} passes are complete.",
            f"Lost packets and frames of each pass; {clean} passes without loss.",
            2.8,
            lambda c: campaign.draw_completeness_trend(c, passes),
        ),
    ]


def _pass_table(passes: Sequence[CampaignPass], names: Sequence[str]) -> Table:
    flown = [n for n in names if any(n in p.navigation and n not in p.baselines for p in passes)][:3]
    columns = [
        Column("pass", numeric=False),
        Column("start, UTC", numeric=False),
        Column("build", numeric=False),
        Column("frames"),
        Column("lost", unit="packets"),
        Column("precision"),
        Column("recall"),
    ]
    for name in flown:
        columns += [Column("median", group=f"{name}, m"), Column("95 %", group=f"{name}, m")]
    rows = []
    for p in passes[:_MOST_ROWS]:
        row: list[Cell | str] = [
            p.pass_id,
            utc_text(p.start_utc_ns).removesuffix(" UTC"),
            p.build,
            count_text(p.frames_processed),
            count_text(p.packets_lost),
            number_text(p.precision, 3),
            number_text(p.recall, 3),
        ]
        for name in flown:
            found = p.navigation.get(name)
            row += (
                [number_text(found.median_3d_m, 0), number_text(found.p95_3d_m, 0)]
                if found
                else [NOT_A_VALUE] * 2
            )
        rows.append(tuple(row))
    rest = len(passes) - _MOST_ROWS
    note = f"{count_text(rest)} further passes are in the JSON form of this report." if rest > 0 else ""
    return Table("Passes in order of time.", tuple(columns), tuple(rows), note=note)
