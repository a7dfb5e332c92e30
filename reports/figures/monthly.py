"""Figure of a month: metrics of each pass over time, with changes of level."""

from collections.abc import Mapping

import numpy as np

from reports.arrays import FloatArray
from reports.figures.canvas import Canvas, TimeScale, time_axis
from reports.figures.theme import color
from reports.text import utc_ns_of
from reports.values import MonthlyReportValue

_LEFT, _RIGHT, _BOTTOM, _TOP, _GAP = 0.85, 0.2, 0.50, 0.25, 0.22


def series(report: MonthlyReportValue) -> dict[str, FloatArray]:
    """Return the values (n,) of each metric over the passes; the offset of the list only where one is known."""
    found = {
        name: np.array([getattr(one, name) for one in report.passes], dtype=np.float64)
        for name in ("recall", "drift_percent", "median_error_m", "map_offset_m")
    }
    return {name: one for name, one in found.items() if name != "map_offset_m" or np.isfinite(one).any()}


def draw_trend(canvas: Canvas, report: MonthlyReportValue, metrics: Mapping[str, tuple[str, str, float, int]]) -> None:
    """Draw one panel for each metric; vertical lines are changes of its level."""
    starts = np.array([utc_ns_of(one.start) for one in report.passes], dtype=np.int64)
    room = max(int(starts.max() - starts.min()) // 40, 1_800_000_000_000)
    time = TimeScale(int(starts.min()) - room, int(starts.max()) + room)
    panels = series(report)
    height = (canvas.height_in - _BOTTOM - _TOP - (len(panels) - 1) * _GAP) / len(panels)
    for row, (name, values) in enumerate(panels.items()):
        label, unit, scale, _ = metrics[name]
        bottom = canvas.height_in - _TOP - (row + 1) * height - row * _GAP
        axes = canvas.axes(_LEFT, bottom, canvas.width_in - _LEFT - _RIGHT, height)
        time_axis(axes, time, labelled=row == len(panels) - 1)
        axes.set_ylabel(f"{label}\n{unit}")
        known = np.isfinite(values)
        axes.plot(time.x(starts[known]), scale * values[known], "o", color=color("blue"), markersize=3.5)
        if known.any():
            axes.set_ylim(bottom=0.0, top=max(1.1 * scale * float(values[known].max()), 1e-6))
        for change in report.changes:
            if change.metric == name:
                axes.axvline(float(time.x(utc_ns_of(change.time))), color=color("vermillion"), linewidth=1.1)
