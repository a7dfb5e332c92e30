"""Figures of what the matchers did: shares of outcomes (paper, Fig. 7) and their course in time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from reports.arrays import FloatArray
from reports.figures.canvas import Canvas, TimeScale, shade_arcs, time_axis
from reports.figures.theme import OUTCOMES, color
from reports.statistics import runs
from reports.text import percent_text
from reports.values import NavigationSeries, TimeSpan

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_STRIP_FRAMES = 420
_BINS = 96


def outcome_counts(one: NavigationSeries) -> dict[str, int]:
    """Count each outcome, in the order of the dictionary; samples without an outcome do not count."""
    named = [o for o in one.outcome if o]
    order = [*OUTCOMES, *sorted({o for o in named if o not in OUTCOMES})]
    return {o: n for o in order if (n := named.count(o))}


def outcome_color(outcome: str) -> str:
    """Colour of an outcome."""
    return color(OUTCOMES[outcome][1]) if outcome in OUTCOMES else color("gray3")


def draw_outcome_shares(canvas: Canvas, series: Sequence[NavigationSeries]) -> None:
    """One ring per estimator: the share of frames that ended in each outcome, the largest named inside."""
    size = min(2.15, (canvas.width_in - 0.2) / max(len(series), 1))
    step = canvas.width_in / max(len(series), 3)
    left = (canvas.width_in - step * len(series)) / 2
    for i, one in enumerate(series):
        counts = outcome_counts(one)
        total = sum(counts.values())
        axes = canvas.axes(left + step * i + (step - size) / 2, 0.12, size, size)
        axes.set_aspect("equal")
        axes.set_axis_off()
        axes.set_xlim(-1.12, 1.12)
        axes.set_ylim(-1.12, 1.12)
        if total:
            axes.pie(
                list(counts.values()),
                radius=1.0,
                startangle=90,
                counterclock=False,
                colors=[outcome_color(o) for o in counts],
                wedgeprops={"width": 0.34, "edgecolor": color("paper"), "linewidth": 1.2},
            )
            for wedge, outcome in zip(axes.patches, counts, strict=True):
                wedge.set_label(f"{one.name}, {outcome}")
            largest = max(counts, key=lambda o: counts[o])
            axes.text(
                0, 0.09, percent_text(counts[largest], total), ha="center", va="center", fontsize="x-large",
                weight="bold",
            )  # fmt: skip
            words = OUTCOMES.get(largest, (largest, ""))[0].lower().replace(" on the", "\non the")
            axes.text(
                0, -0.10, words, ha="center", va="top", fontsize="small", color=color("muted"),
                linespacing=1.15,
            )  # fmt: skip
        canvas.text(left + step * (i + 0.5), size + 0.24, one.name, ha="center", va="bottom", weight="bold")


def draw_outcome_course(
    canvas: Canvas, series: Sequence[NavigationSeries], time: TimeScale, arcs: Sequence[TimeSpan]
) -> None:
    """Outcome of every frame over time; shares in each arc where frames are too many to be seen one by one."""
    edges = course_edges(time, arcs)
    left, right, bottom, top, gap = 1.15, 0.15, 0.50, 0.08, 0.10
    height = (canvas.height_in - bottom - top - gap * (len(series) - 1)) / max(len(series), 1)
    for i, one in enumerate(series):
        row = len(series) - 1 - i
        axes = canvas.axes(left, bottom + row * (height + gap), canvas.width_in - left - right, height)
        time_axis(axes, time, labelled=row == 0)
        axes.grid(False)
        axes.spines["left"].set_visible(False)
        axes.set_ylim(0, 1)
        axes.set_yticks([0.5], [one.name])
        axes.tick_params(axis="y", labelcolor=color("ink"))
        if is_long(one):
            _shares_in_time(axes, one, time, edges)
        else:
            shade_arcs(axes, time, arcs)
            _strip(axes, one, time)


def is_long(one: NavigationSeries) -> bool:
    """True where frames are too many to be drawn one by one."""
    return len(one.outcome) > _STRIP_FRAMES


def course_edges(time: TimeScale, arcs: Sequence[TimeSpan]) -> FloatArray:
    """Edges of the bins of a long course, seconds: those of the imaging arcs, or equal ones without arcs."""
    if len(arcs) < 2:
        return np.linspace(0.0, time.length_s, _BINS + 1)
    places = {0.0, time.length_s}
    for arc in arcs:
        places.update((float(time.x(arc.start_utc_ns)), float(time.x(arc.stop_utc_ns))))
    return np.array(sorted(p for p in places if 0.0 <= p <= time.length_s))


def _strip(axes: Axes, one: NavigationSeries, time: TimeScale) -> None:
    x = time.x(one.utc_ns)
    step = float(np.median(np.diff(x))) if len(x) > 1 else time.length_s
    spans: dict[str, list[tuple[float, float]]] = {}
    for first, after, outcome in runs(one.outcome):
        if outcome:
            begin = float(x[first]) - step / 2
            spans.setdefault(outcome, []).append((begin, float(x[after - 1]) + step / 2 - begin))
    for outcome, ranges in spans.items():
        axes.broken_barh(ranges, (0.0, 1.0), color=outcome_color(outcome), linewidth=0)


def _shares_in_time(axes: Axes, one: NavigationSeries, time: TimeScale, edges: FloatArray) -> None:
    from matplotlib.collections import PolyCollection

    x = time.x(one.utc_ns)
    total = np.histogram(x[np.array([bool(o) for o in one.outcome])], edges)[0]
    floor = np.zeros(len(edges) - 1)
    for outcome in outcome_counts(one):
        count = np.histogram(x[np.array([o == outcome for o in one.outcome])], edges)[0]
        share = np.where(total > 0, count / np.maximum(total, 1), 0.0)
        some = np.flatnonzero(share > 0)
        left, right = edges[some], edges[some + 1] - 0.0015 * time.length_s
        low, high = floor[some], floor[some] + share[some]
        boxes = np.stack([left, low, right, low, right, high, left, high], axis=-1).reshape(-1, 4, 2)
        axes.add_collection(PolyCollection(list(boxes), facecolors=outcome_color(outcome), linewidths=0))
        floor = floor + share
