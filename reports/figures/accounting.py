"""Figures of what arrived: frames step by step, packets over time."""

from collections.abc import Sequence

import numpy as np

from reports.figures.canvas import Canvas, TimeScale, shade_arcs, time_axis
from reports.figures.theme import color
from reports.text import count_text, percent_text
from reports.values import CompletenessSeries, TimeSpan


def draw_frame_steps(canvas: Canvas, steps: Sequence[tuple[str, int]]) -> None:
    """Bars of the frames left after each step, with their count and their share of the first."""
    axes = canvas.axes(1.25, 0.08, canvas.width_in - 2.85, canvas.height_in - 0.16)
    whole = max(steps[0][1], 1) if steps else 1
    places = np.arange(len(steps))[::-1]
    axes.barh(places, [whole] * len(steps), 0.62, color=color("grid"), linewidth=0)
    axes.barh(places, [n for _, n in steps], 0.62, color=color("blue"), linewidth=0)
    axes.set_xlim(0, whole)
    axes.set_ylim(-0.6, len(steps) - 0.4)
    axes.grid(False)
    axes.set_xticks([])
    axes.set_yticks(places, [name for name, _ in steps])
    for side in ("left", "bottom"):
        axes.spines[side].set_visible(False)
    for place, (_, count) in zip(places, steps, strict=True):
        axes.text(1.10, place, count_text(count), transform=axes.get_yaxis_transform(), ha="right", va="center")
        axes.text(
            1.225, place, percent_text(count, whole), transform=axes.get_yaxis_transform(), ha="right",
            va="center", color=color("muted"),
        )  # fmt: skip


def draw_completeness(
    canvas: Canvas, series: CompletenessSeries, time: TimeScale, arcs: Sequence[TimeSpan], gaps: Sequence[TimeSpan]
) -> None:
    """Share of expected packets received over the pass; gaps in the colour of a fault."""
    axes = canvas.axes(0.72, 0.50, canvas.width_in - 0.87, canvas.height_in - 0.78)
    time_axis(axes, time)
    shade_arcs(axes, time, arcs)
    axes.set_title("packets received of those expected")
    axes.set_ylim(0, 1.04)
    axes.set_yticks([0, 0.5, 1.0], ["0", "50 %", "100 %"])
    expected = np.asarray(series.expected, dtype=np.float64)
    share = np.where(expected > 0, series.received / np.maximum(expected, 1), np.nan)
    edges = time.x(series.edges_utc_ns)
    whole = share >= 1.0
    for mask, tint in ((whole, "blue"), (~whole & np.isfinite(share), "vermillion")):
        if mask.any():
            axes.bar(
                edges[:-1][mask], share[mask], np.diff(edges)[mask] * 0.9, align="edge", color=color(tint), linewidth=0
            )
    for gap in gaps:
        left, right = float(time.x(gap.start_utc_ns)), float(time.x(gap.stop_utc_ns))
        axes.plot([left, right], [1.02, 1.02], color=color("vermillion"), linewidth=3.0, clip_on=False)
