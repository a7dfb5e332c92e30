"""Figures of filter consistency (NEES, NIS) and of what the error depends on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from reports import statistics
from reports.arrays import FloatArray
from reports.figures.canvas import Canvas, TimeScale, log_length_axis, shade_arcs, thinned, time_axis
from reports.figures.theme import Styles, color
from reports.values import NavigationSeries, TimeSpan, TrackSeries

if TYPE_CHECKING:
    from matplotlib.axes import Axes


_LEFT, _RIGHT, _BOTTOM = 0.72, 1.85, 0.50


DIAGONAL = "sum of squared normalised errors (diagonal)"
"""Name of the quantity used instead of the NEES if only standard deviations are available."""


def squared_errors(one: NavigationSeries) -> tuple[str, FloatArray] | None:
    """Return the name and values (n,) of the available squared errors: NEES, or the sum over the diagonal."""
    for name, values in (("NEES", one.nees), (DIAGONAL, one.squared_normalised_errors)):
        if values is not None and np.isfinite(values).any():
            return name, values
    return None


def quantities(one: NavigationSeries) -> list[tuple[str, FloatArray, FloatArray]]:
    """Return name, values and degrees of freedom (n,; NaN where unknown) of squared errors and innovations."""
    errors = squared_errors(one)
    found = [] if errors is None else [(*errors, np.full(len(errors[1]), 3.0))]
    if one.nis is not None and one.nis_dof is not None and np.isfinite(one.nis).any():
        found.append(("NIS", one.nis, np.where(one.nis_dof > 0, one.nis_dof, np.nan)))
    return found


def draw_consistency(
    canvas: Canvas, one: NavigationSeries, styles: Styles, time: TimeScale, arcs: Sequence[TimeSpan]
) -> None:
    """Normalised errors and innovations, each divided by its degrees of freedom, with the 95 % bounds of one sample."""
    parts = quantities(one)
    gap = 0.34
    height = (canvas.height_in - _BOTTOM - 0.28 - gap * (len(parts) - 1)) / max(len(parts), 1)
    keep = time.inside(one.utc_ns)
    x = time.x(one.utc_ns[keep])
    for i, (name, value, dof) in enumerate(parts):
        row = len(parts) - 1 - i
        axes = canvas.axes(_LEFT, _BOTTOM + row * (height + gap), canvas.width_in - _LEFT - _RIGHT, height)
        time_axis(axes, time, labelled=row == 0)
        shade_arcs(axes, time, arcs)
        scaled, freedom = value[keep] / dof[keep], dof[keep]
        finite = np.isfinite(scaled)
        axes.set_yscale("log")
        axes.set_title(f"{name} per degree of freedom")
        typical = float(np.median(freedom[finite])) if finite.any() else 3.0
        low = float(statistics.chi2_quantile(0.025, typical)) / typical
        high = float(statistics.chi2_quantile(0.975, typical)) / typical
        axes.axhspan(max(low, 1e-3), high, color=color("silver"), alpha=0.45, linewidth=0)
        axes.axhline(1.0, color=color("muted"), linewidth=0.8, linestyle=(0, (4.0, 3.0)))
        tint = styles[one.name][0]
        shown = np.flatnonzero(finite)[:: max(1, int(finite.sum()) // 700)]
        axes.plot(x[shown], scaled[shown], ".", color=tint, markersize=3.0, alpha=0.55)
        window = max(5, int(finite.sum() // 40))
        axes.plot(*thinned(x, statistics.running_mean(scaled, window), 400), color=tint, linewidth=1.6)
        bottom, top = statistics.quantiles(scaled, (0.005, 0.995))
        axes.set_ylim(min(max(bottom, 1e-3), 0.1) * 0.8, max(top * 1.3, 10.0))
        ticks = [t for t in (0.01, 0.1, 1.0, 10.0, 100.0, 1000.0) if axes.get_ylim()[0] <= t <= axes.get_ylim()[1]]
        axes.set_yticks(ticks, [f"{t:g}" for t in ticks])
        axes.set_yticks([], minor=True)
        count, mean, within = statistics.per_degree(value[keep], dof[keep])
        axes.text(
            1.015, 0.96,
            f"mean {mean:.2f}\n{100 * within:.0f} % inside 95 "
            f"%\n{count} samples",
            transform=axes.transAxes, va="top", fontsize="small", color=color("muted"), linespacing=1.45,
        )  # fmt: skip


def dependences(one: NavigationSeries, track: TrackSeries | None) -> list[tuple[str, str, statistics.Binned]]:
    """Return the error of one solution by each known quantity: name, axis label and bins.

    The altitude is that of the reference: bins of an estimated altitude would correlate with the error.
    """
    error = statistics.error_3d_m(one.error_rtn_m)
    altitude_m = None if track is None else statistics.reference_at(track, one.utc_ns)[2]
    quantities: list[tuple[str, str, FloatArray | None]] = [
        ("altitude", "reference altitude, km", None if altitude_m is None else altitude_m / 1e3),
        ("sun_elevation", "Sun elevation, degrees", one.sun_elevation_deg),
        ("matched", "craters matched", None if one.matched is None else one.matched.astype(np.float64)),
        (
            "time_since_fix",
            "time since last fix, min",
            None if one.time_since_fix_s is None else one.time_since_fix_s / 60.0,
        ),
    ]
    found = []
    for name, label, quantity in quantities:
        if quantity is None:
            continue
        edges = statistics.round_edges(quantity[np.isfinite(error)])
        if name == "matched" and len(edges) > 1 and edges[1] - edges[0] <= 1.0:
            edges = np.arange(np.floor(edges[0]), np.ceil(edges[-1]) + 1) - 0.5
        bins = statistics.binned(quantity, error, edges)
        if len(bins.centre) >= 3:
            found.append((name, label, bins))
    return found


def draw_dependence(
    canvas: Canvas, series: Sequence[NavigationSeries], track: TrackSeries | None, styles: Styles
) -> None:
    """Median (dot) and 95th percentile (bar) of the error by altitude, light, matches and time since a fix."""
    known = {one.name: dependences(one, track) for one in series}
    names = [
        n
        for n in ("altitude", "sun_elevation", "matched", "time_since_fix")
        if any(n == name for items in known.values() for name, _, _ in items)
    ]
    terrain = sorted({t for one in series for t in one.terrain if t})
    panels = len(names) + bool(terrain)
    if not panels:
        return
    columns = min(panels, 3)
    rows = -(-panels // columns)
    gap, between = 0.30, 0.66
    width = (canvas.width_in - _LEFT - 0.12 - gap * (columns - 1)) / columns
    height = (canvas.height_in - _BOTTOM - 0.36 - between * (rows - 1)) / rows
    values = [np.concatenate([b.median, b.p95]) for items in known.values() for _, _, b in items]

    def panel(i: int) -> Axes:
        row, column = divmod(i, columns)
        axes = canvas.axes(
            _LEFT + column * (width + gap), _BOTTOM + (rows - 1 - row) * (height + between), width, height
        )
        log_length_axis(axes, "y", values)
        if column:
            axes.tick_params(axis="y", labelleft=False)
        return axes

    for i, name in enumerate(names):
        axes = panel(i)
        for k, one in enumerate(series):
            for found, label, bins in known[one.name]:
                if found != name:
                    continue
                step = float(np.diff(bins.centre).min()) if len(bins.centre) > 1 else 1.0
                x = bins.centre + (k - (len(series) - 1) / 2) * 0.16 * step
                tint = styles[one.name][0]
                axes.vlines(x, bins.median, bins.p95, color=tint, linewidth=1.2)
                axes.plot(x, bins.median, "o", color=tint, markersize=4.0)
                axes.set_xlabel(label)
    if terrain:
        axes = panel(len(names))
        for k, one in enumerate(series):
            error = statistics.error_3d_m(one.error_rtn_m)
            for j, kind in enumerate(terrain):
                chosen = error[np.array([t == kind for t in one.terrain], dtype=np.bool_)] if one.terrain else error[:0]
                p50, p95 = statistics.quantiles(chosen, (0.5, 0.95))
                if np.isfinite(p50):
                    place = j + (k - (len(series) - 1) / 2) * 0.16
                    axes.vlines([place], [p50], [p95], color=styles[one.name][0], linewidth=1.2)
                    axes.plot([place], [p50], "o", color=styles[one.name][0], markersize=4.0)
        axes.set_xlim(-0.6, len(terrain) - 0.4)
        axes.set_xticks(range(len(terrain)), terrain)
        axes.set_xlabel("terrain")
    for k, one in enumerate(series):
        left = _LEFT + 1.5 * k
        canvas.text(
            left, canvas.height_in - 0.16, "●", color=styles[one.name][0], fontsize="medium", va="center_baseline"
        )
        canvas.text(left + 0.18, canvas.height_in - 0.16, one.name, fontsize="small", va="center_baseline")
