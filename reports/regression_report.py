"""The report of a regression: a candidate build against a baseline over the same archived passes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from reports.arrays import FloatArray
from reports.document import Block, Cell, Column, Document, Heading, Picture, Table
from reports.figures.regression import draw_paired
from reports.figures.theme import series_styles
from reports.sections.common import role_of
from reports.sections.detection import gallery_picture
from reports.sections.opening import about, absent, judgement, missing_and_remarks, provenance_and_data
from reports.statistics import quantiles
from reports.text import count_text, number_text, significant_text
from reports.values import RegressionGate, RegressionPass, RegressionReport

_ORDER = ("fail", "inconclusive", "not judged", "pass")
_SWATCHES = {"pass": "green", "inconclusive": "orange", "fail": "vermillion", "not judged": ""}


def regression_document(report: RegressionReport) -> Document:
    """The document of a regression."""
    counts = {outcome: sum(g.outcome == outcome for g in report.gates) for outcome in _ORDER}
    blocks: list[Block] = [*judgement(report), Heading("Gates")]
    if report.gates:
        blocks.append(_gates(report))
    else:
        blocks.append(absent(report, "gates", "Gates", "no gate was judged, so the verdict is inconclusive"))
    blocks += missing_and_remarks(report)
    before, after = _paired(report)
    if before:
        blocks += [Heading("Candidate against baseline"), *_comparison(before, after)]
    else:
        blocks += [
            Heading("Candidate against baseline"),
            absent(report, "candidate_passes", "Passes", "no pass was run with both builds"),
        ]
    blocks += [Heading("Frames that changed most"), _changed(report)]
    blocks += provenance_and_data(report)
    facts = about(
        report,
        ("Candidate", report.candidate),
        ("baseline", report.baseline),
        (
            "gates",
            f"{counts['fail']} failed, {counts['inconclusive']} inconclusive, {counts['pass']} passed",
        ),
        ("passes", count_text(len(before))),
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
            significant_text(g.resolution) if g.evidence else "",
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


def _outcome_text(gate: RegressionGate) -> str:
    """Return the outcome of a gate with its reason and evidence, and the reason of a waiver."""
    parts = [{"pass": "passed", "fail": "failed"}.get(gate.outcome, gate.outcome), gate.reason, gate.evidence]
    if gate.outcome == "inconclusive" and gate.frames_needed is not None:
        parts.append(
            f"about {count_text(gate.frames_needed)} frames decide, {count_text(gate.frames)} compared"
        )
    text = ", ".join(filter(None, parts))
    return f"{text}; waived: {gate.waived}" if gate.waived else text


def _changed(report: RegressionReport) -> Block:
    """Frames with both builds side by side, a pair to a row."""
    if not report.changed_frames:
        return absent(report, "changed_frames", "Frames", "no frame with an image changed")
    sides = tuple(side for pair in report.changed_frames for side in (pair.baseline, pair.candidate))
    return gallery_picture(
        "changed",
        sides,
        2,
        "Left the baseline, right the candidate, on the same image: the frames in which most craters were found by "
        "one build and not by the other.",
    )


def _paired(report: RegressionReport) -> tuple[list[RegressionPass], list[RegressionPass]]:
    """Passes run with both builds, in the same order."""
    after = {p.pass_id: p for p in report.candidate_passes}
    both = [p for p in sorted(report.baseline_passes, key=lambda p: p.start_utc_ns) if p.pass_id in after]
    return both, [after[p.pass_id] for p in both]


def _comparison(before: list[RegressionPass], after: list[RegressionPass]) -> list[Block]:
    names = list(dict.fromkeys(name for one in (*before, *after) for name in one.navigation))
    flown = sorted(names, key=lambda n: quantiles(_statistic(before, n, "median_3d_m"), (0.5,))[0])
    pairs: list[tuple[str, FloatArray, FloatArray, bool]] = [
        (
            f"median error, {name}",
            _statistic(before, name, "median_3d_m"),
            _statistic(after, name, "median_3d_m"),
            True,
        )
        for name in flown[:2]
    ]
    recall = [np.array([p.recall for p in passes], dtype=np.float64) for passes in (before, after)]
    if np.isfinite(recall[0]).any() and np.isfinite(recall[1]).any():
        pairs.append(("recall", recall[0], recall[1], False))
    blocks: list[Block] = []
    if pairs:
        worse = [
            f"{title}: {int(np.sum((b > a) if lengths else (b < a)))} of {len(before)}"
            for title, a, b, lengths in pairs
        ]
        blocks.append(
            Picture(
                "paired",
                "Each pass with both builds. On the dashed line nothing has changed; blue: the candidate is "
                "not worse; vermillion: worse. "
                f"Passes that became worse: {'; '.join(worse)}.",
                "Candidate against baseline for each pass. Worse: " + "; ".join(worse),
                3.3,
                lambda c: draw_paired(c, pairs),
            )
        )
    blocks.append(_solutions(before, names, "baseline"))
    blocks.append(_solutions(after, names, "candidate"))
    return blocks


def _solutions(passes: Sequence[RegressionPass], names: Sequence[str], build: str) -> Table:
    """Figures of every solution over the passes."""
    styles = series_styles([(name, "estimate") for name in names])
    rows: list[tuple[Cell | str, ...]] = []
    for name in names:
        median = _statistic(passes, name, "median_3d_m")
        low, middle, high = quantiles(median, (0.0, 0.5, 1.0))
        rows.append(
            (
                Cell(name, swatch=role_of(styles[name][0]), strong=True),
                count_text(int(np.isfinite(median).sum())),
                number_text(low, 0),
                number_text(middle, 0),
                number_text(high, 0),
                number_text(quantiles(_statistic(passes, name, "p95_3d_m"), (0.5,))[0], 0),
                number_text(quantiles(_statistic(passes, name, "max_3d_m"), (1.0,))[0], 0),
                number_text(quantiles(_statistic(passes, name, "drift_percent"), (0.5,))[0], 3),
            )
        )
    return Table(
        f"3-D position error over the passes, {build}: each pass counts once.",
        (
            Column("solution", numeric=False),
            Column("passes"),
            Column("best", group="median of a pass, m"),
            Column("median", group="median of a pass, m"),
            Column("worst", group="median of a pass, m"),
            Column("median of 95 %", unit="m"),
            Column("largest error", unit="m"),
            Column("drift", unit="% of path"),
        ),
        tuple(rows),
    )


def _statistic(passes: Sequence[RegressionPass], name: str, field: str) -> FloatArray:
    """Return one statistic of one solution over the passes, NaN where a pass does not have it."""
    return np.array(
        [float(getattr(p.navigation[name], field)) if name in p.navigation else np.nan for p in passes],
        dtype=np.float64,
    )
