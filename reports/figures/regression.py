"""Passes of a candidate build against those of the baseline."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from reports.arrays import FloatArray
from reports.figures.canvas import Canvas, log_length_axis
from reports.figures.theme import color


def draw_paired(canvas: Canvas, pairs: Sequence[tuple[str, FloatArray, FloatArray, bool]]) -> None:
    """Candidate against baseline, a dot for each pass, with the diagonal on which nothing changes."""
    gap = 0.85
    size = min((canvas.width_in - 0.8 - gap * (len(pairs) - 1)) / max(len(pairs), 1), canvas.height_in - 0.9)
    for i, (title, before, after, lengths) in enumerate(pairs):
        axes = canvas.axes(0.75 + i * (size + gap), 0.55, size, size)
        good = np.isfinite(before) & np.isfinite(after)
        if lengths:
            log_length_axis(axes, "x", [before, after])
            log_length_axis(axes, "y", [before, after])
        else:
            axes.set_xlim(0, 1)
            axes.set_ylim(0, 1)
        low, high = axes.get_xlim()
        axes.plot(
            [low, high], [low, high], color=color("muted"), linestyle=(0, (4, 3)), linewidth=canvas.pt(0.9)
        )
        better = (after <= before) if lengths else (after >= before)
        for mask, role in ((good & better, "blue"), (good & ~better, "vermillion")):
            axes.plot(before[mask], after[mask], "o", color=color(role), markersize=canvas.pt(4.5), alpha=0.8)
        axes.grid(True, axis="both")
        axes.set_title(title)
        axes.set_xlabel("baseline")
        axes.set_ylabel("candidate")
