"""Figures over many passes: trend, groups, dependence, completeness."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from reports.arrays import FloatArray
from reports.figures.canvas import Canvas, TimeScale, log_length_axis, spread, time_axis
from reports.figures.theme import color
from reports.published import TABLE_II
from reports.values import CampaignPass

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Styles = Mapping[str, tuple[str, tuple[float, ...] | None]]

_LEFT, _RIGHT, _BOTTOM, _TOP = 0.72, 1.85, 0.50, 0.28
_FEW = 60


def campaign_time(passes: Sequence[CampaignPass]) -> TimeScale:
    """Span of the passes with a little room at both ends."""
    starts = [p.start_utc_ns for p in passes] or [0]
    room = max((max(starts) - min(starts)) // 40, 1_800_000_000_000)
    return TimeScale(min(starts) - room, max(starts) + room)


def statistic(passes: Sequence[CampaignPass], name: str, field: str) -> FloatArray:
    """One statistic of one solution over the passes, NaN where a pass does not have it."""
    return np.array(
        [float(getattr(p.navigation[name], field)) if name in p.navigation else np.nan for p in passes],
        dtype=np.float64,
    )


def draw_error_trend(
    canvas: Canvas, passes: Sequence[CampaignPass], names: Sequence[str], styles: Styles
) -> None:
    """Median (dot) and 95th percentile (end of the bar) of the 3-D error of every pass."""
    time = campaign_time(passes)
    axes = canvas.axes(_LEFT, _BOTTOM, canvas.width_in - _LEFT - _RIGHT, canvas.height_in - _BOTTOM - _TOP)
    time_axis(axes, time)
    x = time.x(np.array([p.start_utc_ns for p in passes], dtype=np.int64))
    every = [(statistic(passes, n, "median_3d_m"), statistic(passes, n, "p95_3d_m")) for n in names]
    log_length_axis(axes, "y", [v for pair in every for v in pair])
    axes.set_title("3-D position error of each pass")
    for name, (median, p95) in zip(names, every, strict=True):
        tint, dashes = styles[name]
        good = np.isfinite(median) & np.isfinite(p95)
        if dashes is None:
            width = 1.1 if len(passes) <= _FEW else 0.5
            axes.vlines(x[good], median[good], p95[good], color=tint, linewidth=canvas.pt(width), alpha=0.7)
        axes.plot(
            x[good],
            median[good],
            "o" if dashes is None else "_",
            color=tint,
            markersize=canvas.pt((4.5 if dashes is None else 6.0) if len(passes) <= _FEW else 2.5),
        )
    _names(canvas, axes, names, styles)


def _names(canvas: Canvas, axes: Axes, names: Sequence[str], styles: Styles) -> None:
    height = axes.get_position().height * canvas.height_in
    width = axes.get_position().width * canvas.width_in
    for i, name in enumerate(names):
        place = 0.96 - i * 0.19 / height
        tint, dashes = styles[name]
        axes.plot(
            [1 + 0.14 / width],
            [place],
            "o" if dashes is None else "_",
            color=tint,
            transform=axes.transAxes,
            clip_on=False,
            markersize=canvas.pt(4.5 if dashes is None else 6.0),
        )
        axes.text(
            1 + 0.26 / width,
            place,
            name,
            transform=axes.transAxes,
            va="center_baseline",
            fontsize="small",
            color=tint,
        )


def draw_groups(
    canvas: Canvas,
    passes: Sequence[CampaignPass],
    groups: Sequence[tuple[str, Sequence[str]]],
    names: Sequence[str],
    styles: Styles,
) -> None:
    """Median error of every pass by named groups: a dot each, a bar at the median of the group."""
    gap = 0.35
    weights = np.array([max(len(set(labels)), 1) + 0.5 for _, labels in groups])
    width = (canvas.width_in - _LEFT - _RIGHT - gap * (len(groups) - 1)) * weights / weights.sum()
    left = _LEFT
    values = [statistic(passes, n, "median_3d_m") for n in names]
    for i, (title, labels) in enumerate(groups):
        axes = canvas.axes(left, _BOTTOM, width[i], canvas.height_in - _BOTTOM - _TOP)
        left += width[i] + gap
        kinds = sorted({label for label in labels if label})
        log_length_axis(axes, "y", values)
        if i:
            axes.tick_params(axis="y", labelleft=False)
        axes.set_xlim(-0.6, max(len(kinds), 1) - 0.4)
        axes.set_xticks(range(len(kinds)), kinds)
        axes.set_xlabel(title)
        for k, (name, value) in enumerate(zip(names, values, strict=True)):
            for j, kind in enumerate(kinds):
                chosen = value[np.array([label == kind for label in labels], dtype=np.bool_)]
                chosen = chosen[np.isfinite(chosen)]
                place = j + (k - (len(names) - 1) / 2) * 0.8 / max(len(names), 1)
                tint = styles[name][0]
                if len(chosen):
                    axes.plot(
                        np.full(len(chosen), place),
                        chosen,
                        "o",
                        color=tint,
                        markersize=canvas.pt(3.0),
                        alpha=0.45,
                    )
                    middle = float(np.median(chosen))
                    axes.plot(
                        [place - 0.09, place + 0.09], [middle] * 2, color=tint, linewidth=canvas.pt(2.2)
                    )
        if i == len(groups) - 1:
            _names(canvas, axes, names, styles)


def draw_against(
    canvas: Canvas,
    passes: Sequence[CampaignPass],
    quantities: Sequence[tuple[str, FloatArray]],
    names: Sequence[str],
    styles: Styles,
) -> None:
    """Median error of every pass against a quantity such as altitude."""
    gap = 0.35
    width = (canvas.width_in - _LEFT - _RIGHT - gap * (len(quantities) - 1)) / max(len(quantities), 1)
    values = [statistic(passes, n, "median_3d_m") for n in names]
    for i, (title, quantity) in enumerate(quantities):
        axes = canvas.axes(_LEFT + i * (width + gap), _BOTTOM, width, canvas.height_in - _BOTTOM - _TOP)
        log_length_axis(axes, "y", values)
        if i:
            axes.tick_params(axis="y", labelleft=False)
        for name, value in zip(names, values, strict=True):
            tint, dashes = styles[name]
            axes.plot(
                quantity,
                value,
                "o" if dashes is None else "_",
                color=tint,
                markersize=canvas.pt(3.6 if dashes is None else 5.0),
                alpha=0.75,
            )
        axes.set_xlabel(title)
        if i == len(quantities) - 1:
            _names(canvas, axes, names, styles)


def draw_detector_trend(canvas: Canvas, passes: Sequence[CampaignPass]) -> None:
    """Precision and recall of each pass, with the range of the paper's three classes as bands."""
    time = campaign_time(passes)
    axes = canvas.axes(_LEFT, _BOTTOM, canvas.width_in - _LEFT - _RIGHT, canvas.height_in - _BOTTOM - _TOP)
    time_axis(axes, time)
    axes.set_ylim(0, 1.02)
    axes.set_title("precision and recall of each pass")
    x = time.x(np.array([p.start_utc_ns for p in passes], dtype=np.int64))
    width = canvas.width_in - _LEFT - _RIGHT
    labels: list[tuple[float, str, str]] = []
    for name, role, marker in (("precision", "gray1", "s"), ("recall", "blue", "o")):
        paper = [float(getattr(row, name)) for row in TABLE_II.values()]
        axes.axhspan(min(paper), max(paper), color=color(role), alpha=0.10, linewidth=0)
        labels.append((sum(paper) / len(paper), f"{name}, paper", "muted"))
        value = np.array([float(getattr(p, name)) for p in passes], dtype=np.float64)
        axes.plot(x, value, marker, color=color(role), markersize=canvas.pt(4.0))
        if np.isfinite(value).any():
            labels.append((float(np.nanmedian(value)), name, role))
    labels.sort()
    heights = spread([height for height, _, _ in labels], 0.17 / (canvas.height_in - _BOTTOM - _TOP))
    for height, (_, text, role) in zip(heights, labels, strict=True):
        axes.text(
            1 + 0.08 / width,
            height,
            text,
            transform=axes.get_yaxis_transform(),
            fontsize="small",
            va="center_baseline",
            color=color(role),
        )


def draw_completeness_trend(canvas: Canvas, passes: Sequence[CampaignPass]) -> None:
    """Share of packets received and of frames processed, pass by pass; what is missing is drawn, on its own scale."""
    time = campaign_time(passes)
    x = time.x(np.array([p.start_utc_ns for p in passes], dtype=np.int64))
    gap = 0.30
    height = (canvas.height_in - _BOTTOM - _TOP - gap) / 2
    parts = (
        ("packets lost", [_share(p.packets_lost, (p.packets or 0) + (p.packets_lost or 0)) for p in passes]),
        (
            "frames expected but not processed",
            [
                _share(
                    None if p.frames_processed is None else (p.frames_expected or 0) - p.frames_processed,
                    p.frames_expected,
                )
                for p in passes
            ],
        ),
    )
    for i, (title, shares) in enumerate(parts):
        axes = canvas.axes(_LEFT, _BOTTOM + (1 - i) * (height + gap), canvas.width_in - _LEFT - 0.15, height)
        time_axis(axes, time, labelled=i == 1)
        value = 100.0 * np.array(shares, dtype=np.float64)
        axes.vlines(x, 0.0, np.nan_to_num(value), color=color("vermillion"), linewidth=canvas.pt(2.0))
        nothing = np.isfinite(value) & (value == 0)
        axes.plot(
            x[nothing], value[nothing], "o", color=color("blue"), markersize=canvas.pt(2.5), clip_on=False
        )
        finite = value[np.isfinite(value)]
        axes.set_ylim(0, max(float(finite.max()) * 1.15 if len(finite) else 1.0, 0.5))
        axes.locator_params(axis="y", nbins=4)
        axes.set_title(title)
        axes.set_ylabel("%")


def _share(part: int | None, whole: int | None) -> float:
    return float("nan") if part is None or not whole else part / whole


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
