"""Figures of data sets and of training: shares of classes, distributions, places, curves over epochs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from reports.figures.canvas import Canvas
from reports.figures.theme import color
from reports.figures.track_map import draw_underlay, latitude_label
from reports.published import LABEL_SHARES
from reports.values import ClassCount, FramePlaces, Histogram, NamedScore, TerrainMap, TrainingCurve

PART_ROLES = {"train": "gray3", "val": "orange", "test": "blue"}
HISTOGRAM_COLUMNS = 3
_PANEL_IN = 1.35


def draw_class_shares(canvas: Canvas, classes: Sequence[ClassCount]) -> None:
    """Share of each size class among all labels: here filled, in the paper open."""
    axes = canvas.axes(1.15, 0.50, canvas.width_in - 1.4, canvas.height_in - 0.62)
    total = max(sum(sum(c.by_part.values()) for c in classes), 1)
    places = np.arange(len(classes))[::-1]
    share = [100.0 * sum(c.by_part.values()) / total for c in classes]
    paper = [LABEL_SHARES.get(c.size_class, float("nan")) for c in classes]
    axes.barh(places, share, 0.5, color=color("blue"), linewidth=0)
    axes.plot(
        paper,
        places,
        "o",
        markerfacecolor=color("paper"),
        markeredgecolor=color("gray1"),
        markeredgewidth=canvas.pt(1.3),
        markersize=canvas.pt(7.0),
        linestyle="none",
    )
    axes.set_ylim(-0.6, len(classes) - 0.4)
    axes.set_yticks(places, [c.label for c in classes])
    axes.set_xlim(0, 100)
    axes.grid(True, axis="x")
    axes.grid(False, axis="y")
    axes.spines["left"].set_visible(False)
    axes.set_xlabel("share of labels, % (open: paper)")


def histogram_height_in(count: int) -> float:
    """Return the height of a sheet for a number of histograms."""
    return -(-count // HISTOGRAM_COLUMNS) * (_PANEL_IN + 0.72) + 0.05


def draw_histograms(canvas: Canvas, histograms: Sequence[Histogram]) -> None:
    """Distributions side by side, each on its own scale."""
    gap, left = 0.55, 0.62
    width = (canvas.width_in - left - 0.15 - gap * (HISTOGRAM_COLUMNS - 1)) / HISTOGRAM_COLUMNS
    for i, one in enumerate(histograms):
        row, column = divmod(i, HISTOGRAM_COLUMNS)
        bottom = canvas.height_in - (row + 1) * (_PANEL_IN + 0.72) + 0.50
        axes = canvas.axes(left + column * (width + gap), bottom, width, _PANEL_IN)
        edges = np.asarray(one.edges, dtype=np.float64)
        axes.bar(
            edges[:-1], one.counts, np.diff(edges) * 0.94, align="edge", color=color("blue"), linewidth=0
        )
        axes.set_xlabel(f"{one.name}{f', {one.unit}' if one.unit else ''}")
        axes.locator_params(axis="y", nbins=4)
        axes.ticklabel_format(axis="y", style="plain", useOffset=False)


def draw_places(canvas: Canvas, places: FramePlaces, terrain: TerrainMap | None) -> None:
    """Where the frames lie, by part."""
    height = canvas.height_in - 0.62
    axes = canvas.axes(0.72, 0.50, min(2 * height, canvas.width_in - 1.6), height)
    axes.set_xlim(0, 360)
    axes.set_ylim(-90, 90)
    axes.set_xticks(range(0, 361, 60), [f"{v}°" for v in range(0, 361, 60)])
    axes.set_yticks(range(-90, 91, 30), [latitude_label(v) for v in range(-90, 91, 30)])
    draw_underlay(canvas, axes, terrain)
    axes.grid(True, axis="both")
    axes.set_xlabel("longitude, degrees east")
    for side in ("top", "right"):
        axes.spines[side].set_visible(True)
    parts = np.array(places.part, dtype=object)
    kinds = [p for p in PART_ROLES if p in set(places.part)] + sorted(set(places.part) - set(PART_ROLES))
    for i, kind in enumerate(kinds):
        chosen = np.flatnonzero(parts == kind)
        chosen = chosen[:: max(1, len(chosen) // 1_500)]
        tint = color(PART_ROLES.get(kind, "purple"))
        axes.plot(
            places.longitude_deg[chosen] % 360.0,
            places.latitude_deg[chosen],
            "o",
            color=tint,
            markersize=canvas.pt(1.8),
        )
        axes.plot([1.02], [0.96 - 0.09 * i], "o", color=tint, transform=axes.transAxes, clip_on=False)
        axes.text(
            1.04, 0.96 - 0.09 * i, kind, transform=axes.transAxes, va="center_baseline", fontsize="small"
        )


def draw_training(canvas: Canvas, curves: Sequence[TrainingCurve]) -> None:
    """One small panel for each quantity over the epochs."""
    gap, left = 0.60, 0.62
    columns = min(len(curves), 3)
    rows = -(-len(curves) // columns)
    width = (canvas.width_in - left - 0.15 - gap * (columns - 1)) / columns
    height = (canvas.height_in - 0.5 - 0.75 * (rows - 1) - 0.28) / rows
    for i, curve in enumerate(curves):
        row, column = divmod(i, columns)
        axes = canvas.axes(
            left + column * (width + gap), 0.5 + (rows - 1 - row) * (height + 0.75), width, height
        )
        axes.plot(curve.epoch, curve.values, color=color("blue"), linewidth=canvas.pt(1.3))
        axes.set_title(curve.name, fontsize="small")
        axes.set_xlabel(curve.axis)
        axes.locator_params(axis="both", nbins=4)


def draw_named_scores(canvas: Canvas, scores: Sequence[NamedScore]) -> None:
    """Precision (square) and recall (dot) of each group; recall alone where no precision is known."""
    both = any(np.isfinite(s.precision) for s in scores)
    axes = canvas.axes(1.9, 0.50, canvas.width_in - 3.1, canvas.height_in - 0.62)
    places = np.arange(len(scores))[::-1]
    for place, one in zip(places, scores, strict=True):
        axes.plot(
            [one.recall, one.precision], [place, place], color=color("silver"), linewidth=canvas.pt(2.0)
        )
    axes.plot([s.precision for s in scores], places, "s", color=color("gray1"), markersize=canvas.pt(6.0))
    axes.plot([s.recall for s in scores], places, "o", color=color("blue"), markersize=canvas.pt(7.0))
    axes.set_xlim(0, 1)
    axes.set_ylim(-0.6, len(scores) - 0.4)
    axes.set_yticks(places, [s.label for s in scores])
    axes.grid(True, axis="x")
    axes.grid(False, axis="y")
    axes.spines["left"].set_visible(False)
    axes.set_xlabel("precision (square), recall (dot)" if both else "recall")
