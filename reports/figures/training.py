"""Figures of data sets and of training: shares of classes, distributions, places, curves over epochs."""

from collections.abc import Sequence

import numpy as np

from reports.figures.canvas import Canvas
from reports.figures.theme import color
from reports.values import NamedScore, TrainingCurve

_PANEL_IN = 1.35


def draw_training(canvas: Canvas, curves: Sequence[TrainingCurve]) -> None:
    """One small panel for each quantity over the epochs."""
    gap, left = 0.60, 0.62
    columns = min(len(curves), 3)
    rows = -(-len(curves) // columns)
    width = (canvas.width_in - left - 0.15 - gap * (columns - 1)) / columns
    height = (canvas.height_in - 0.5 - 0.75 * (rows - 1) - 0.28) / rows
    for i, curve in enumerate(curves):
        row, column = divmod(i, columns)
        axes = canvas.axes(left + column * (width + gap), 0.5 + (rows - 1 - row) * (height + 0.75), width, height)
        axes.plot(curve.epoch, curve.values, color=color("blue"), linewidth=1.3)
        axes.set_title(curve.name, fontsize="small")
        axes.set_xlabel(curve.axis)
        axes.locator_params(axis="both", nbins=4)


def draw_named_scores(canvas: Canvas, scores: Sequence[NamedScore]) -> None:
    """Precision (square) and recall (dot) of each group; recall alone where no precision is known."""
    both = any(np.isfinite(s.precision) for s in scores)
    axes = canvas.axes(1.9, 0.50, canvas.width_in - 3.1, canvas.height_in - 0.62)
    places = np.arange(len(scores))[::-1]
    for place, one in zip(places, scores, strict=True):
        axes.plot([one.recall, one.precision], [place, place], color=color("silver"), linewidth=2.0)
    axes.plot([s.precision for s in scores], places, "s", color=color("gray1"), markersize=6.0)
    axes.plot([s.recall for s in scores], places, "o", color=color("blue"), markersize=7.0)
    axes.set_xlim(0, 1)
    axes.set_ylim(-0.6, len(scores) - 0.4)
    axes.set_yticks(places, [s.label for s in scores])
    axes.grid(True, axis="x")
    axes.grid(False, axis="y")
    axes.spines["left"].set_visible(False)
    axes.set_xlabel("precision (square), recall (dot)" if both else "recall")
