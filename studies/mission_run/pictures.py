"""Figures of the closing report of a mission run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lunar.timescales import parse_utc
from reports.arrays import FloatArray
from reports.figures.canvas import Canvas, TimeScale, end_labels, log_length_axis, time_axis
from reports.figures.theme import color, series_styles

_LEFT, _RIGHT, _BOTTOM, _TOP, _GAP = 0.85, 1.15, 0.50, 0.15, 0.22
_PERCENT = (("recall", "recall", 100.0), ("nees_inside_percent", "NEES inside", 1.0))


def draw_windows(canvas: Canvas, trend: Sequence[Mapping[str, Any]]) -> None:
    """Draw the median error of each estimator, recall and share of NEES inside its bounds of each window."""
    starts = np.array([parse_utc(str(row["start"])) for row in trend], dtype=np.int64)
    room = max(int(starts.max() - starts.min()) // 40, 1_800_000_000_000)
    time = TimeScale(int(starts.min()) - room, int(starts.max()) + room)
    names = sorted({name for row in trend for name in row.get("median_m") or {}})
    styles = series_styles([(name, "estimate") for name in names])
    errors = {name: _column([(row.get("median_m") or {}).get(name) for row in trend]) for name in names}
    shares = {label: factor * _column([row.get(key) for row in trend]) for key, label, factor in _PERCENT}
    tints = dict(zip(shares, ("green", "orange"), strict=True))
    height = (canvas.height_in - _BOTTOM - _TOP - _GAP) / 2.0
    width = canvas.width_in - _LEFT - _RIGHT
    above = canvas.axes(_LEFT, _BOTTOM + height + _GAP, width, height)
    time_axis(above, time, labelled=False)
    log_length_axis(above, "y", list(errors.values()))
    above.set_ylabel("median error")
    below = canvas.axes(_LEFT, _BOTTOM, width, height)
    time_axis(below, time)
    below.set_ylim(0.0, 105.0)
    below.set_ylabel("share, %")
    for axes, series, tint in (
        (above, errors, {name: styles[name][0] for name in names}),
        (below, shares, {label: color(role) for label, role in tints.items()}),
    ):
        for name, values in series.items():
            axes.plot(time.x(starts), values, "o", color=tint[name], markersize=canvas.pt(3.0))
        end_labels(
            axes,
            [(name, float(_last(values)), tint[name]) for name, values in series.items()],
            line_height=0.17 / height,
            samples=dict.fromkeys(series, "-"),
            line_width=canvas.pt(1.4),
            axes_width_in=width,
        )


def draw_memory(
    canvas: Canvas, series: Mapping[str, Sequence[float]], lives: Mapping[str, Sequence[Sequence[float]]]
) -> None:
    """Draw the memory of each process over mission time; a line is broken where the process was started again."""
    width = canvas.width_in - _LEFT - _RIGHT
    height = canvas.height_in - _BOTTOM - _TOP
    axes = canvas.axes(_LEFT, _BOTTOM, width, height)
    axes.set_xlabel("mission time, days")
    axes.set_ylabel("memory, MiB")
    roles = ("blue", "vermillion", "green", "orange", "purple", "sky", "gray1", "gray3")
    tints = {name: color(roles[i % len(roles)]) for i, name in enumerate(series)}
    for name, samples in series.items():
        days, levels = [], []
        for i, (used, (day, process)) in enumerate(zip(samples, lives[name], strict=True)):
            if i and lives[name][i - 1][1] != process:
                days.append(day)
                levels.append(np.nan)
            days.append(day)
            levels.append(used)
        axes.plot(days, levels, color=tints[name], linewidth=canvas.pt(1.1))
    axes.set_xlim(left=0.0)
    axes.set_ylim(bottom=0.0)
    end_labels(
        axes,
        [(name, float(samples[-1]), tints[name]) for name, samples in series.items() if samples],
        line_height=0.17 / height,
        samples=dict.fromkeys(series, "-"),
        line_width=canvas.pt(1.4),
        axes_width_in=width,
    )


def _column(values: Sequence[float | None]) -> FloatArray:
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)


def _last(values: FloatArray) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known[-5:])) if known.size else float("nan")
