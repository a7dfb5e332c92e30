"""Matching outcomes."""

from collections.abc import Sequence
from functools import partial

from reports.document import Block, Cell, Column, Heading, Picture, Table
from reports.figures import outcomes
from reports.figures.canvas import WIDTH_IN
from reports.figures.theme import OUTCOMES
from reports.sections.common import PassView
from reports.text import count_text, percent_text
from reports.values import FIX_OUTCOMES, NavigationSeries


def matching(view: PassView) -> list[Block]:
    blocks: list[Block] = [Heading("Matching outcomes")]
    series = view.with_outcomes
    if not series:
        blocks.append(view.absent("outcomes", "Matcher outcomes"))
        return blocks
    shown = series[:4]
    largest = []
    for one in shown:
        own = outcomes.outcome_counts(one)
        name = max(own, key=lambda o: own[o])
        largest.append(
            f"{one.name}: {OUTCOMES.get(name, (name,))[0].lower()} in {percent_text(own[name], sum(own.values()))}"
        )
    blocks.append(
        Picture(
            "outcomes",
            "Share of frames that ended in each outcome, one ring for each estimator (form of the paper's "
            "Fig. 7). The most "
            f"frequent: {'; '.join(largest)}. Colours as in the table below.",
            "Rings of outcome shares. " + "; ".join(largest),
            min(2.15, (WIDTH_IN - 0.2) / max(len(shown), 1)) + 0.48,
            partial(outcomes.draw_outcome_shares, series=shown),
        )
    )
    blocks.append(outcome_table(series))
    blocks.append(
        Picture(
            "course",
            f"{_course_words(series, view)}, colours as in the table. A long run of prediction or of misses "
            "means that the "
            "detector gave the matcher too little to work with.",
            "Outcome of each frame over time, one row for each estimator.",
            0.58 + 0.52 * len(series),
            partial(outcomes.draw_outcome_course, series=series, time=view.time, arcs=view.report.imaging_arcs),
        )
    )
    return blocks


def outcome_table(series: Sequence[NavigationSeries]) -> Table:
    """Return numbers and shares of frames by outcome."""
    counts = [outcomes.outcome_counts(one) for one in series]
    totals = [sum(one.values()) for one in counts]
    columns = [Column("outcome", numeric=False)]
    for one in series:
        columns += [Column("frames", group=one.name), Column("share", group=one.name)]
    rows = []
    named = {outcome for one in counts for outcome in one}
    for outcome in [*(name for name in OUTCOMES if name in named), *sorted(named - {*OUTCOMES})]:
        label, role = OUTCOMES.get(outcome, (outcome, "gray3"))
        cells: list[Cell | str] = [Cell(label, swatch=role)]
        for i, n in enumerate(one.get(outcome, 0) for one in counts):
            possible = outcome in FIX_OUTCOMES if _is_filter(series[i]) else outcome not in FIX_OUTCOMES
            cells += [count_text(n), percent_text(n, totals[i])] if possible or n else ["", ""]
        rows.append(tuple(cells))
    rows.append((Cell("All", strong=True), *(c for n in totals for c in (Cell(count_text(n), strong=True), ""))))
    return Table("Outcomes of all frames.", tuple(columns), tuple(rows), note=_fix_note(series))


def _course_words(series: tuple[NavigationSeries, ...], view: PassView) -> str:
    if not any(outcomes.is_long(s) for s in series):
        return "Outcome of each frame over the pass"
    return (
        "Shares of outcomes in each imaging arc"
        if len(view.report.imaging_arcs) > 1
        else "Shares of outcomes over time"
    )


def _is_filter(one: NavigationSeries) -> bool:
    return any(o in FIX_OUTCOMES for o in one.outcome)


def _fix_note(series: Sequence[NavigationSeries]) -> str:
    wrong = [f"{s.name}: {count_text(s.wrong_fixes)}" for s in series if s.wrong_fixes is not None]
    return f"Fixes found wrong against the reference: {'; '.join(wrong)}." if wrong else ""
