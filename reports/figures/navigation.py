"""Figures of navigation: error over time, its parts, its distribution, drift, altitude."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from reports.arrays import FloatArray
from reports.figures.canvas import Canvas, TimeScale, end_labels, log_length_axis, shade_arcs, thinned, time_axis
from reports.figures.theme import REFERENCE, TRIGGERS, LineStyle, Styles, color
from reports.statistics import containment, cumulative, error_3d_m, inside, north_east_error_m, reference_at
from reports.text import length_text
from reports.values import NavigationSeries, TimeSpan, TrackSeries

if TYPE_CHECKING:
    from matplotlib.axes import Axes


_LEFT, _RIGHT, _BOTTOM, _TOP = 0.72, 2.0, 0.50, 0.28
_MOST_NAMED_RESETS = 9
_DENSE = 900
_GAP_STEPS = 8.0
_AXES_OF_RTN = ("radial", "along-track", "cross-track")


def resets_of(series: Sequence[NavigationSeries], time: TimeScale) -> list[tuple[int, str]]:
    """Times and triggers of all resets inside a span, those of several estimators at one instant only once."""
    found: dict[int, str] = {}
    for one in series:
        for utc_ns, trigger in zip(one.utc_ns.tolist(), one.reset_trigger, strict=False):
            if trigger in TRIGGERS and time.start_utc_ns <= utc_ns <= time.stop_utc_ns:
                found.setdefault(utc_ns, TRIGGERS[trigger])
    return sorted(found.items())


def mark_resets(axes: Axes, time: TimeScale, resets: Sequence[tuple[int, str]], named: bool) -> None:
    """Dashed gray lines at resets; their triggers next to them where there is room, ticks at the top otherwise."""
    few = len(resets) <= _MOST_NAMED_RESETS
    for utc_ns, trigger in resets:
        x = float(time.x(utc_ns))
        if not few:
            axes.axvline(x, ymin=0.965, color=color("muted"), linewidth=0.8)
            continue
        axes.axvline(x, color=color("gray2"), linewidth=0.8, linestyle=(0, (4.0, 3.0)))
        if named:
            axes.annotate(
                trigger,
                (x, 0.985),
                xycoords=("data", "axes fraction"),
                xytext=(3.0, 0.0),
                textcoords="offset points",
                rotation=90,
                ha="left",
                va="top",
                fontsize="small",
                color=color("muted"),
            )


def draw_lines(axes: Axes, x: FloatArray, y: FloatArray, style: LineStyle, name: str = "") -> None:
    """One series; samples without a finite neighbour are drawn as dots."""
    tint, dashes = style
    x, y = thinned(x, y)
    width = (1.4 if dashes == "-" else 1.2) * (0.75 if len(y) > _DENSE else 1.0)
    axes.plot(x, y, color=tint, linestyle=dashes, linewidth=width, label=name)
    finite = np.isfinite(y)
    known = np.zeros(len(y) + 2, dtype=np.bool_)
    known[1:-1] = finite
    alone = finite & ~known[:-2] & ~known[2:]
    if alone.any():
        axes.plot(x[alone], y[alone], ".", color=tint, markersize=4.0)


def broken(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a line with NaN in gaps of more than `_GAP_STEPS` usual steps, where nothing was estimated."""
    if len(x) < 3:
        return x, y
    step = np.diff(x)
    after = np.flatnonzero(step > _GAP_STEPS * np.median(step)) + 1
    return np.insert(x, after, x[after - 1]), np.insert(y, after, np.nan)


def _positive(length: FloatArray) -> FloatArray:
    """Lengths that a logarithmic axis can show; NaN for those of a reset."""
    return np.where(length > 1e-3, length, np.nan)


def _last_finite(values: FloatArray) -> float:
    finite = values[np.isfinite(values)]
    return float(finite[-1]) if len(finite) else float("nan")


def _name_lines(
    canvas: Canvas, axes: Axes, height_in: float, entries: Sequence[tuple[str, float]], styles: Styles
) -> None:
    width_in = axes.get_position().width * canvas.width_in
    for_labels = [(name, value, styles[name][0]) for name, value in entries]
    end_labels(
        axes,
        for_labels,
        line_height=0.165 / height_in,
        samples={name: styles[name][1] for name, _ in entries},
        line_width=1.4,
        axes_width_in=width_in,
    )


def draw_error_over_time(
    canvas: Canvas, series: Sequence[NavigationSeries], styles: Styles, time: TimeScale, arcs: Sequence[TimeSpan]
) -> None:
    """3-D position error of every solution on one logarithmic axis."""
    height = canvas.height_in - _BOTTOM - _TOP
    axes = canvas.axes(_LEFT, _BOTTOM, canvas.width_in - _LEFT - _RIGHT, height)
    time_axis(axes, time)
    shade_arcs(axes, time, arcs)
    lines = [(s, _positive(error_3d_m(s.error_rtn_m)), time.inside(s.utc_ns)) for s in series]
    log_length_axis(axes, "y", [e[keep] for _, e, keep in lines])
    axes.set_title("3-D position error")
    entries = []
    for one, error, keep in sorted(lines, key=lambda item: item[0].kind != "baseline"):
        draw_lines(axes, time.x(one.utc_ns[keep]), error[keep], styles[one.name], one.name)
        entries.append((one.name, _last_finite(error[keep])))
    mark_resets(axes, time, resets_of(series, time), named=True)
    _name_lines(canvas, axes, height, entries, styles)


def draw_rtn(canvas: Canvas, one: NavigationSeries, styles: Styles, time: TimeScale, arcs: Sequence[TimeSpan]) -> None:
    """Radial, along-track and cross-track error of one solution, with its own three-sigma bounds where it has them."""
    gap = 0.16
    height = (canvas.height_in - _BOTTOM - _TOP - 2 * gap) / 3
    tint = styles[one.name][0]
    keep = time.inside(one.utc_ns)
    x = time.x(one.utc_ns[keep])
    for i, name in enumerate(_AXES_OF_RTN):
        bottom = _BOTTOM + (2 - i) * (height + gap)
        axes = canvas.axes(_LEFT, bottom, canvas.width_in - _LEFT - _RIGHT, height)
        time_axis(axes, time, labelled=i == 2)
        shade_arcs(axes, time, arcs)
        error = one.error_rtn_m[keep, i]
        sigma = one.sigma_rtn_m[keep, i] if one.sigma_rtn_m is not None else np.full(len(x), np.nan)
        held = containment(error, sigma)
        limit, factor, unit = _usual_limit(error, 3 * sigma)
        if np.isfinite(held):
            step = max(1, len(x) // 900)
            bound = 3 * sigma[::step] / factor
            axes.fill_between(x[::step], -bound, bound, color=color("silver"), alpha=0.45, linewidth=0)
            for edge in (-bound, bound):
                axes.plot(x[::step], edge, color=color("gray2"), linewidth=0.9)
        axes.axhline(0.0, color=color("faint"), linewidth=0.7)
        draw_lines(axes, x, error / factor, (tint, "-"))
        axes.set_ylim(-limit / factor, limit / factor)
        axes.set_ylabel(unit)
        lines = [f"rms {length_text(float(np.sqrt(np.nanmean(error**2))))}"] if np.isfinite(error).any() else []
        if np.isfinite(held):
            lines.append(f"{100 * held:.1f} % within ±3σ")
        beyond = int(np.sum(np.abs(error) > limit))
        if beyond:
            lines.append(f"{beyond} samples off the axis")
        axes.text(1.015, 0.94, name, transform=axes.transAxes, va="top", weight="bold", fontsize="small")
        axes.text(
            1.015, 0.74, "\n".join(lines), transform=axes.transAxes, va="top", fontsize="small",
            color=color("muted"), linespacing=1.45,
        )  # fmt: skip
        if i == 0:
            axes.set_title(one.name)


def _symmetric_limit(values: FloatArray) -> tuple[float, float, str]:
    """Half height of an axis that holds the values, and the unit it is best read in."""
    finite = values[np.isfinite(values)]
    limit = 1.08 * float(finite.max()) if len(finite) and finite.max() > 0 else 1.0
    return (limit, 1000.0, "km") if limit >= 1500 else (limit, 1.0, "m")


def _usual_limit(error: FloatArray, bound: FloatArray) -> tuple[float, float, str]:
    """As `_symmetric_limit`, but for the usual course: a short transient may leave the axis."""
    error = np.abs(error[np.isfinite(error)])
    bound = bound[np.isfinite(bound)]
    if not len(error):
        return _symmetric_limit(error)
    usual = 1.25 * float(np.quantile(error, 0.97))
    if len(bound):
        usual = max(usual, 1.15 * float(np.quantile(bound, 0.9)))
    largest = float(error.max())
    # The axis always includes the usual bounds, also for small errors.
    shown = max(1.08 * largest, usual) if 1.08 * largest < 2.0 * usual else usual
    return _symmetric_limit(np.array([shown / 1.08]))


def draw_ground_error(
    canvas: Canvas,
    series: Sequence[NavigationSeries],
    track: TrackSeries,
    styles: Styles,
    time: TimeScale,
    arcs: Sequence[TimeSpan],
) -> None:
    """Accumulated error in latitude and in longitude of the odometry, resets annotated (paper, Fig. 8)."""
    gap = 0.36
    height = (canvas.height_in - _BOTTOM - _TOP - gap) / 2
    errors = [(s, north_east_error_m(s, track), time.inside(s.utc_ns)) for s in series]
    resets = resets_of(series, time)
    for i, name in enumerate(("latitude", "longitude")):
        axes = canvas.axes(_LEFT, _BOTTOM + (1 - i) * (height + gap), canvas.width_in - _LEFT - _RIGHT, height)
        time_axis(axes, time, labelled=i == 1)
        shade_arcs(axes, time, arcs)
        shown = [e[i][keep] for _, e, keep in errors]
        limit, factor, unit = _symmetric_limit(np.abs(np.concatenate(shown)) if shown else np.zeros(0))
        axes.set_ylim(-limit / factor, limit / factor)
        axes.axhline(0.0, color=color("faint"), linewidth=0.7)
        axes.set_ylabel(unit)
        axes.set_title(f"{name} error, {'north' if i == 0 else 'east'} positive")
        entries = []
        for (one, _, keep), error in zip(errors, shown, strict=True):
            draw_lines(axes, *broken(time.x(one.utc_ns[keep]), error / factor), styles[one.name], one.name)
            entries.append((one.name, _last_finite(error / factor)))
        mark_resets(axes, time, resets, named=i == 0)
        _name_lines(canvas, axes, height, entries, styles)


def draw_altitude(
    canvas: Canvas,
    series: Sequence[NavigationSeries],
    track: TrackSeries,
    styles: Styles,
    time: TimeScale,
    arcs: Sequence[TimeSpan],
) -> None:
    """Estimated altitude over the reference, and the error of each below where there are any (paper, Fig. 10)."""
    gap, low_height = (0.38, 1.15) if series else (0.0, 0.0)
    high = canvas.height_in - _BOTTOM - _TOP - gap - low_height
    width = canvas.width_in - _LEFT - _RIGHT
    axes = canvas.axes(_LEFT, _BOTTOM + low_height + gap, width, high)
    below = canvas.axes(_LEFT, _BOTTOM, width, low_height) if series else None
    resets = resets_of(series, time)
    for panel in (axes, below):
        if panel is None:
            continue
        time_axis(panel, time, labelled=panel is below or below is None)
        shade_arcs(panel, time, arcs)
        mark_resets(panel, time, resets, named=panel is axes)
    axes.set_title("altitude over the 1737.4 km sphere")
    axes.set_ylabel("km")
    keep = time.inside(track.utc_ns)
    axes.plot(
        *broken(time.x(track.utc_ns[keep]), track.altitude_m[keep] / 1e3),
        color=color(REFERENCE),
        linewidth=5.0,
        alpha=0.3,
        label="reference",
    )
    entries, errors = [("reference", _last_finite(track.altitude_m[keep] / 1e3))], []
    for one in series:
        kept = time.inside(one.utc_ns)
        x = time.x(one.utc_ns[kept])
        draw_lines(axes, *broken(x, one.altitude_m[kept] / 1e3), styles[one.name], one.name)
        error = np.abs(one.altitude_m[kept] - reference_at(track, one.utc_ns[kept])[2])
        errors.append((one, x, _positive(error)))
        entries.append((one.name, _last_finite(one.altitude_m[kept] / 1e3)))
    with_reference = {**styles, "reference": (color(REFERENCE), "-")}
    low, top = axes.get_ylim()
    axes.set_ylim(max(0.0, low) if low > -1e6 else 0.0, top)
    _name_lines(canvas, axes, high, entries, with_reference)
    if below is None:
        return
    log_length_axis(below, "y", [error for _, _, error in errors])
    below.set_title("altitude error, magnitude")
    for one, x, error in errors:
        draw_lines(below, *broken(x, error), styles[one.name], one.name)


def draw_distribution(
    canvas: Canvas, series: Sequence[NavigationSeries], styles: Styles, arcs: Sequence[TimeSpan]
) -> None:
    """Cumulative distribution of the 3-D error, imaging arcs and the rest side by side."""
    masks = [inside(s.utc_ns, arcs) for s in series]
    errors = [error_3d_m(s.error_rtn_m) for s in series]
    dark = any(np.isfinite(e[~m]).any() for e, m in zip(errors, masks, strict=True))
    panels = [("imaging arcs", True), ("between imaging arcs", False)] if dark else [("imaging arcs", True)]
    if not arcs:
        panels = [("whole pass", False)]
    gap = 0.45
    width = (canvas.width_in - _LEFT - _RIGHT - gap * (len(panels) - 1)) / len(panels)
    height = canvas.height_in - _BOTTOM - _TOP
    for i, (name, lit) in enumerate(panels):
        axes = canvas.axes(_LEFT + i * (width + gap), _BOTTOM, width, height)
        log_length_axis(axes, "x", errors)
        axes.set_ylim(0.0, 1.0)
        axes.set_yticks([0, 0.5, 0.68, 0.95], ["0", "50 %", "68 %", "95 %"] if i == 0 else [""] * 4)
        axes.set_xlabel("3-D position error")
        axes.set_title(name)
        axes.grid(True, axis="x")
        for one, error, mask in zip(series, errors, masks, strict=True):
            value, share = cumulative(error[mask == lit])
            if len(value):
                draw_lines(axes, value, share, styles[one.name], one.name)
        if i == len(panels) - 1:
            _legend(canvas, axes, height, [one.name for one in series], styles)


def _legend(canvas: Canvas, axes: Axes, height_in: float, names: Sequence[str], styles: Styles) -> None:
    """Names of lines in the order given, at the right of the axes."""
    low, high = axes.get_ylim()
    step = 0.19 / height_in
    places = [(name, low + (high - low) * (0.97 - step * i)) for i, name in enumerate(names)]
    _name_lines(canvas, axes, height_in, places, styles)


def draw_drift(canvas: Canvas, series: Sequence[NavigationSeries], styles: Styles) -> None:
    """Relative drift against path length, and the error at the instant before each reset."""
    swept = [s for s in series if s.drift_by_length]
    reset = [s for s in series if s.reset_error_m is not None and np.isfinite(s.reset_error_m).any()]
    panels = bool(swept) + bool(reset)
    gap = 0.95
    width = (canvas.width_in - _LEFT - _RIGHT - gap * (panels - 1)) / max(panels, 1)
    height = canvas.height_in - _BOTTOM - _TOP
    left = _LEFT
    if swept:
        axes = canvas.axes(left, _BOTTOM, width, height)
        lengths = [np.array([d.path_length_m for d in s.drift_by_length]) / 1e3 for s in swept]
        axes.set_xscale("log")
        axes.set_yscale("log")
        ticks = sorted({float(v) for x in lengths for v in x})
        axes.set_xticks(ticks, [f"{t:g}" for t in ticks])
        axes.set_xticks([], minor=True)
        axes.set_xlabel("path length, km")
        axes.set_title("relative drift, median and 95 %")
        everything = np.concatenate(
            [np.array([[d.median_percent, d.p95_percent] for d in s.drift_by_length]).ravel() for s in swept]
        )
        _log_percent_axis(axes, everything)
        for one, x in zip(swept, lengths, strict=True):
            tint, dashes = styles[one.name]
            median = np.array([d.median_percent for d in one.drift_by_length])
            p95 = np.array([d.p95_percent for d in one.drift_by_length])
            axes.fill_between(x, median, p95, color=tint, alpha=0.14, linewidth=0)
            axes.plot(x, median, color=tint, marker="o", markersize=3.5, linestyle=dashes)
        left += width + gap
    last = None
    if reset:
        axes = canvas.axes(left, _BOTTOM, width, height)
        values = [s.reset_error_m for s in reset if s.reset_error_m is not None]
        log_length_axis(axes, "y", values)
        for one, value in zip(reset, values, strict=True):
            shown = value[np.isfinite(value)]
            axes.plot(
                np.arange(1, len(shown) + 1),
                shown,
                marker="o",
                markersize=3.5,
                linewidth=0.7,
                color=styles[one.name][0],
            )
        most = max(int(np.isfinite(value).sum()) for value in values)
        axes.set_xlim(0.5, most + 0.5)
        axes.set_xticks(np.arange(1, most + 1, max(1, -(-most // 8))))
        axes.set_xlabel("reset, in order of time")
        axes.set_title("horizontal error before each reset")
        last = axes
    names = [s.name for s in series if s in swept or s in reset]
    _legend(canvas, last if last is not None else axes, height, names, styles)


def _log_percent_axis(axes: Axes, values: FloatArray) -> None:
    positive = values[np.isfinite(values) & (values > 0)]
    if not len(positive):
        return
    low, high = np.floor(np.log10(positive.min())), np.ceil(np.log10(positive.max()))
    ticks = [10.0 ** int(d) for d in np.arange(low, max(high, low + 1) + 1)]
    axes.set_ylim(ticks[0], ticks[-1])
    axes.set_yticks(ticks, [f"{t:g} %" for t in ticks])
    axes.set_yticks([], minor=True)


def zoom_span(time: TimeScale, arcs: Sequence[TimeSpan], resets: Sequence[int] = ()) -> TimeScale | None:
    """Return the hour to enlarge, with a reset or else an imaging arc; None for spans under two hours.

    Parameters
    ----------
    resets
        Times (UTC ns) of the resets. The reset nearest the middle of the span, except one at the start, is placed at
        two thirds of the hour, so that the growth of the error before it is visible. Without resets, the hour begins
        shortly before the imaging arc nearest the middle.
    """
    length_ns = 3_600 * 10**9
    if time.stop_utc_ns - time.start_utc_ns < 2 * length_ns:
        return None
    middle = (time.start_utc_ns + time.stop_utc_ns) // 2
    start = middle - length_ns // 2
    later = [utc_ns for utc_ns in resets if utc_ns > time.start_utc_ns + length_ns // 60]
    if later:
        start = min(later, key=lambda utc_ns: abs(utc_ns - middle)) - 2 * length_ns // 3
    elif arcs:
        arc = min(arcs, key=lambda a: abs((a.start_utc_ns + a.stop_utc_ns) // 2 - middle))
        start = arc.start_utc_ns - 480_000_000_000
    start = min(max(start, time.start_utc_ns), time.stop_utc_ns - length_ns)
    return TimeScale(start, start + length_ns)


def terrain_kinds(series: Sequence[NavigationSeries]) -> tuple[str, ...]:
    """Names of terrain types met, in order of the alphabet."""
    return tuple(sorted({t for s in series for t in s.terrain if t}))
