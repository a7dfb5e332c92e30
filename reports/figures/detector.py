"""Figures of the detector: precision and recall by class, light and altitude; bias; curves and calibration."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from reports.arrays import FloatArray
from reports.figures.canvas import Canvas, spread
from reports.figures.theme import color
from reports.published import TABLE_II
from reports.values import BinScore, CalibrationBin, ClassScore, PrecisionRecallCurve, ResidualSeries

if TYPE_CHECKING:
    from matplotlib.axes import Axes

CLASS_ROLES = {0: "blue", 1: "orange", 2: "purple", 3: "gray2"}
OCTANTS = tuple(f"{low}–{low + 45}°" for low in range(0, 360, 45))


def draw_class_scores(canvas: Canvas, scores: Sequence[ClassScore]) -> None:
    """Precision, recall and localisation of each class: ours filled, the paper's open."""
    gap, left, bottom = 0.55, 1.10, 0.50
    width = (canvas.width_in - left - 0.25 - 2 * gap) / 3
    height = canvas.height_in - bottom - 0.50
    places = np.arange(len(scores))[::-1]
    parts = (
        ("precision", [s.precision for s in scores], [_published(s, "precision") for s in scores]),
        ("recall", [s.recall for s in scores], [_published(s, "recall") for s in scores]),
        ("localisation, px", [s.localisation_px for s in scores], [_published(s, "localisation_px") for s in scores]),
    )
    for i, (name, ours, theirs) in enumerate(parts):
        axes = canvas.axes(left + i * (width + gap), bottom, width, height)
        axes.grid(True, axis="x")
        axes.grid(False, axis="y")
        for place, mine, paper in zip(places, ours, theirs, strict=True):
            axes.plot([mine, paper], [place, place], color=color("silver"), linewidth=2.0, zorder=1)
        axes.plot(
            theirs, places, "o", markerfacecolor=color("paper"), markeredgecolor=color("gray1"),
            markeredgewidth=1.3, markersize=7.0, linestyle="none",
        )  # fmt: skip
        axes.plot(ours, places, "o", color=color("blue"), markersize=7.5, linestyle="none")
        axes.set_ylim(-0.6, len(scores) - 0.4)
        axes.set_yticks(places, [s.label for s in scores] if i == 0 else [""] * len(scores))
        axes.spines["left"].set_visible(False)
        axes.set_xlabel(name)
        if i < 2:
            axes.set_xlim(0, 1)
        else:
            top = np.nanmax([*ours, *theirs, 1.0])
            axes.set_xlim(0, float(top) * 1.12)
    y = canvas.height_in - 0.18
    sheet = canvas.axes(left, canvas.height_in - 0.36, canvas.width_in - left - 0.25, 0.36)
    sheet.set_axis_off()
    sheet.set_xlim(0, canvas.width_in - left - 0.25)
    sheet.set_ylim(0, 0.36)
    sheet.plot([0.08], [0.18], "o", color=color("blue"), markersize=7.5)
    sheet.plot(
        [1.38], [0.18], "o", markerfacecolor=color("paper"), markeredgecolor=color("gray1"),
        markeredgewidth=1.3, markersize=7.0,
    )  # fmt: skip
    canvas.text(left + 0.22, y, "this report", va="center_baseline", fontsize="small")
    canvas.text(left + 1.52, y, "LINNA paper, Table II", va="center_baseline", fontsize="small")


def _published(score: ClassScore, name: str) -> float:
    row = TABLE_II.get(score.size_class)
    return float(getattr(row, name)) if row is not None else float("nan")


def draw_bins(canvas: Canvas, parts: Sequence[tuple[str, Sequence[BinScore]]]) -> None:
    """Precision and recall in bins of a quantity, over the number of craters expected in each bin."""
    gap, left, bottom = 0.70, 0.62, 0.50
    width = (canvas.width_in - left - 1.05 - gap * (len(parts) - 1)) / len(parts)
    height = canvas.height_in - bottom - 0.28
    for i, (label, bins) in enumerate(parts):
        axes = canvas.axes(left + i * (width + gap), bottom, width, height)
        low = np.array([b.low for b in bins], dtype=np.float64)
        high = np.array([b.high for b in bins], dtype=np.float64)
        count = np.array([b.expected for b in bins], dtype=np.float64)
        axes.bar(
            low, count / max(count.max(), 1.0), (high - low) * 0.96, align="edge", color=color("grid"), linewidth=0
        )
        centre = (low + high) / 2
        lines: tuple[tuple[str, FloatArray, str, str], ...] = (
            ("precision", np.array([b.precision for b in bins]), "gray1", "s"),
            ("recall", np.array([b.recall for b in bins]), "blue", "o"),
        )
        ends: list[tuple[float, str, str]] = []
        for name, value, role, marker in lines:
            axes.plot(centre, value, color=color(role), marker=marker, markersize=4.5)
            finite = value[np.isfinite(value)]
            if i == len(parts) - 1 and len(finite):
                ends.append((float(finite[-1]), name, role))
        axes.set_ylim(0, 1.02)
        ends.sort()
        for place, (_, name, role) in zip(spread([e[0] for e in ends], 0.17 / height), ends, strict=True):
            axes.text(
                1.0 + 0.09 / width,
                place,
                name,
                transform=axes.get_yaxis_transform(),
                va="center_baseline",
                color=color(role),
                fontsize="small",
            )
        axes.set_xlabel(label)
        axes.set_title("share of the expected craters" if i == 0 else "")


def draw_residuals(canvas: Canvas, residuals: ResidualSeries) -> None:
    """Mean signed residual by Sun octant and by place in the image."""
    height = canvas.height_in - 0.85
    has_sun = bool(np.isfinite(octant_bias(residuals)[0]).any())
    size = height
    left = 0.75
    if has_sun:
        _octants(canvas.axes(left, 0.5, size, size), residuals)
        left += size + 1.6
    _image_map(canvas.axes(left, 0.5, size, size), residuals)


def octant_bias(residuals: ResidualSeries) -> tuple[FloatArray, FloatArray]:
    """Mean (du, dv) in pixels for each octant of Sun azimuth (8, 2), and the samples in each (8,).

    Octants begin at the top of the image, as those of the tables do.
    """
    azimuth = residuals.sun_azimuth_deg
    mean, count = np.full((8, 2), np.nan), np.zeros(8)
    if azimuth is None:
        return mean, count
    octant = np.floor((azimuth % 360.0) / 45.0).astype(np.int64) % 8
    good = np.isfinite(residuals.du_px) & np.isfinite(residuals.dv_px) & np.isfinite(azimuth)
    for k in range(8):
        chosen = good & (octant == k)
        count[k] = chosen.sum()
        if chosen.any():
            mean[k] = residuals.du_px[chosen].mean(), residuals.dv_px[chosen].mean()
    return mean, count


def _octants(axes: Axes, residuals: ResidualSeries) -> None:
    mean, _ = octant_bias(residuals)
    finite = np.isfinite(mean[:, 0])
    reach = float(np.nanmax(np.hypot(mean[:, 0], mean[:, 1]))) if finite.any() else 1.0
    limit = max(reach * 1.4, 0.05)
    axes.set_aspect("equal")
    axes.set_xlim(-limit, limit)
    axes.set_ylim(limit, -limit)
    axes.grid(True, axis="both")
    axes.axhline(0, color=color("faint"), linewidth=0.8)
    axes.axvline(0, color=color("faint"), linewidth=0.8)
    for k in np.flatnonzero(finite):
        u, v = mean[k]
        axes.annotate(
            "", (u, v), (0, 0),
            arrowprops={"arrowstyle": "-|>", "color": color("blue"), "linewidth": 1.3,
                        "shrinkA": 0, "shrinkB": 0, "mutation_scale": 8},
        )  # fmt: skip
    ends = mean[finite]
    out = np.maximum(np.hypot(ends[:, 0], ends[:, 1]), 1e-9)
    right = ends[:, 0] >= 0
    for side, align in ((True, "left"), (False, "right")):
        mine = np.flatnonzero(right == side)
        mine = mine[np.argsort(ends[mine, 1])]
        nudged = ends[mine] * (1 + 0.06 * limit / out[mine, None])
        heights = spread(nudged[:, 1].tolist(), 0.115 * limit)
        for k, across, down in zip(np.flatnonzero(finite)[mine], nudged[:, 0], heights, strict=True):
            axes.text(across, down, OCTANTS[k], ha=align, va="center", fontsize="small", color=color("ink"))
    axes.set_title("mean residual by Sun azimuth from the top")
    axes.set_xlabel("du, px (right)")
    axes.set_ylabel("dv, px (down)")


def _image_map(axes: Axes, residuals: ResidualSeries) -> None:
    cells, size = 6, 512.0
    edges = np.linspace(0.0, size, cells + 1)
    good = np.isfinite(residuals.du_px) & np.isfinite(residuals.dv_px)
    row = np.clip(np.digitize(residuals.v_px, edges) - 1, 0, cells - 1)
    column = np.clip(np.digitize(residuals.u_px, edges) - 1, 0, cells - 1)
    centre = (edges[:-1] + edges[1:]) / 2
    where, vectors = [], []
    for i in range(cells):
        for j in range(cells):
            chosen = good & (row == i) & (column == j)
            if chosen.sum() >= 5:
                where.append((centre[j], centre[i]))
                vectors.append((residuals.du_px[chosen].mean(), residuals.dv_px[chosen].mean()))
    axes.set_aspect("equal")
    axes.set_xlim(0, size)
    axes.set_ylim(size, 0)
    axes.set_xticks([0, 128, 256, 384, 512])
    axes.set_yticks([0, 128, 256, 384, 512])
    axes.grid(True, axis="both")
    axes.set_title("mean residual by place in the image")
    axes.set_xlabel("u, px")
    axes.set_ylabel("v, px")
    for side in ("top", "right"):
        axes.spines[side].set_visible(True)
    if not vectors:
        axes.text(
            size / 2, size / 2, "no data: no cell holds\nfive matched craters", ha="center", va="center",
            fontsize="small", color=color("muted"),
        )  # fmt: skip
        return
    place, vector = np.array(where), np.array(vectors)
    key = _nice(float(np.hypot(vector[:, 0], vector[:, 1]).max()))
    factor = 0.85 * size / cells / key
    axes.quiver(
        place[:, 0], place[:, 1], vector[:, 0] * factor, vector[:, 1] * factor, angles="xy", scale_units="xy",
        scale=1.0, color=color("blue"), width=0.008, headwidth=3.6, headlength=4.2, headaxislength=4.0,
    )  # fmt: skip
    axes.plot(
        [size * 1.05, size * 1.05 + key * factor],
        [size * 0.06, size * 0.06],
        color=color("blue"),
        linewidth=2.0,
        clip_on=False,
    )
    axes.text(size * 1.05, size * 0.09, f"{key:g} px", va="top", fontsize="small", color=color("muted"))


def _nice(value: float) -> float:
    decade = 10.0 ** np.floor(np.log10(max(value, 1e-6)))
    return float(next(m * decade for m in (1.0, 2.0, 5.0, 10.0) if m * decade >= value * 0.999))


def draw_curves(canvas: Canvas, curves: Sequence[PrecisionRecallCurve], calibration: Sequence[CalibrationBin]) -> None:
    """Precision against recall for each class, and the share of true detections against their score."""
    size = canvas.height_in - 0.85
    left = 0.72
    if curves:
        axes = canvas.axes(left, 0.5, size * 1.25, size)
        axes.set_xlim(0, 1)
        axes.set_ylim(0, 1.01)
        axes.grid(True, axis="both")
        for k, curve in enumerate(curves):
            role = CLASS_ROLES.get(k, "gray2")
            line = ("-", (0, (5, 1.5)), (0, (2, 1)))[k % 3]
            axes.plot(curve.recall, curve.precision, color=color(role), linestyle=line)
            height = 0.06 + 0.085 * (len(curves) - 1 - k)
            axes.plot([0.04, 0.12], [height, height], color=color(role), linestyle=line)
            axes.text(0.15, height, curve.label, va="center_baseline", fontsize="small")
        for row in TABLE_II.values():
            axes.plot(
                [row.recall], [row.precision], "o", markerfacecolor=color("paper"), markeredgecolor=color("gray1"),
                markeredgewidth=1.2, markersize=6.0,
            )  # fmt: skip
        axes.set_xlabel("recall")
        axes.set_ylabel("precision")
        axes.set_title("precision against recall (open: paper)")
        left += size * 1.25 + 0.95
    if calibration:
        axes = canvas.axes(left, 0.5, size * 1.25, size)
        axes.set_xlim(0, 1)
        axes.set_ylim(0, 1.01)
        axes.grid(True, axis="both")
        axes.plot([0, 1], [0, 1], color=color("muted"), linestyle=(0, (4, 3)), linewidth=0.9)
        score = [b.mean_score for b in calibration]
        true = [b.fraction_true for b in calibration]
        most = max(b.count for b in calibration)
        axes.plot(score, true, color=color("blue"), linewidth=1.2)
        axes.scatter(
            score,
            true,
            s=[(3 + 6 * (b.count / max(most, 1)) ** 0.5) ** 2 for b in calibration],
            color=color("blue"),
            linewidth=0,
            zorder=3,
        )
        axes.set_xlabel("score of the detector")
        axes.set_ylabel("share that is true")
        axes.set_title("calibration (dot size: number)")
