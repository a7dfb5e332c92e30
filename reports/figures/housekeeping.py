"""Housekeeping parameters over time, one small panel each."""

from collections.abc import Sequence

import numpy as np

from reports.figures.canvas import Canvas, TimeScale, shade_arcs, time_axis
from reports.figures.theme import color
from reports.values import HousekeepingParameter, TimeSpan

COLUMNS = 3
_PANEL_IN = 1.05
_SUFFIXES = {"°C": "c", "V": "v", "W": "w", "KiB": "kib", "‰": "permille"}
"""Last words of parameter names that say nothing but the unit."""


def housekeeping_height_in(count: int) -> float:
    """Return the height of a sheet for a number of parameters."""
    rows = -(-count // COLUMNS)
    return rows * (_PANEL_IN + 0.42) + 0.42


def parameter_title(parameter: HousekeepingParameter) -> str:
    """Name and unit as a reader expects them: "bus voltage, V" for bus_voltage_v in V."""
    words = parameter.name.split("_")
    if len(words) > 1 and words[-1] == _SUFFIXES.get(parameter.unit):
        words = words[:-1]
    return " ".join(words) + (f", {parameter.unit}" if parameter.unit else "")


def draw_housekeeping(
    canvas: Canvas, parameters: Sequence[HousekeepingParameter], time: TimeScale, arcs: Sequence[TimeSpan]
) -> None:
    """Small panels with one time axis; each has its own scale, with its unit in the title."""
    gap, left = 0.60, 0.62
    width = (canvas.width_in - left - 0.15 - gap * (COLUMNS - 1)) / COLUMNS
    for i, parameter in enumerate(parameters):
        row, column = divmod(i, COLUMNS)
        bottom = canvas.height_in - (row + 1) * (_PANEL_IN + 0.42) + 0.12
        axes = canvas.axes(left + column * (width + gap), bottom, width, _PANEL_IN)
        last = i + COLUMNS >= len(parameters)
        time_axis(axes, time, labelled=last, most=4)
        shade_arcs(axes, time, arcs)
        axes.set_title(parameter_title(parameter), fontsize="small")
        finite = np.isfinite(parameter.values)
        alone = int(finite.sum()) == 1
        axes.plot(
            time.x(parameter.utc_ns),
            parameter.values,
            "o" if alone else "-",
            color=color("blue"),
            linewidth=1.2,
            markersize=3.5,
        )
        axes.locator_params(axis="y", nbins=4)
        if finite.any():
            low, high = float(parameter.values[finite].min()), float(parameter.values[finite].max())
            room = (high - low) * 0.12 if high > low else max(abs(high) * 0.01, 0.5)
            axes.set_ylim(low - room, high + room)
        axes.ticklabel_format(axis="y", style="plain", useOffset=False)
