"""A sheet measured in inches, and what every figure shares: UTC axes, lengths, shaded arcs, labels at line ends."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from reports.arrays import FloatArray
from reports.figures.theme import color
from reports.text import month_name, utc_fields
from reports.values import ByteArray, TimeSpan

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

WIDTH_IN = 9.0
_NAME_OF_X_IN, _NAME_OF_Y_IN = 0.28, 0.52
"""Distances of the names of axes from their axes."""
_STEPS_S = (1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1_800, 3_600, 7_200, 10_800, 21_600, 43_200, 86_400)
_DAY_S = 86_400


@dataclass(frozen=True, slots=True, eq=False)
class Photo:
    """An image that a page embeds unchanged, uint8 (H, W) or (H, W, 3)."""

    image: ByteArray


@dataclass(frozen=True, slots=True)
class Canvas:
    """Canvas of a drawing function: a (sub)figure of ``width_in`` by ``height_in`` design inches.

    Where ``photos`` is a list, images are collected there in the order of drawing and only a place is kept in the
    drawing.
    """

    figure: Figure | SubFigure
    width_in: float
    height_in: float
    photos: list[Photo] | None = None

    def axes(self, left: float, bottom: float, width: float, height: float, **kwargs: Any) -> Axes:
        """Axes with their frame at a place in design inches from the lower left corner."""
        box = (left / self.width_in, bottom / self.height_in, width / self.width_in, height / self.height_in)
        from reports.figures.axes import QuickAxes

        axes = self.figure.add_axes(box, axes_class=QuickAxes, **kwargs)
        # At fixed distances panels line up, and matplotlib does not measure the tick labels a second time.
        axes.xaxis.set_label_coords(0.5, -_NAME_OF_X_IN / height)
        axes.yaxis.set_label_coords(-_NAME_OF_Y_IN / width, 0.5)
        return axes

    def text(self, x: float, y: float, text: str, **kwargs: Any) -> None:
        """Text at a place in design inches."""
        self.figure.text(x / self.width_in, y / self.height_in, text, **kwargs)

    def photo(
        self, axes: Axes, image: ByteArray, extent: tuple[float, float, float, float], opacity: float = 1.0
    ) -> None:
        """A gray or RGB image into the box left, right, bottom, top of data coordinates; row 0 at ``top``."""
        shown = image
        if self.photos is not None:
            self.photos.append(Photo(image))
            shown = np.zeros((2, 2), dtype=np.uint8)
        limits = axes.get_xlim(), axes.get_ylim()
        axes.imshow(
            shown,
            cmap="gray",
            vmin=0,
            vmax=255,
            alpha=opacity,
            aspect="auto",
            interpolation="none",
            extent=extent,
            zorder=0,
        )
        axes.set_xlim(limits[0])
        axes.set_ylim(limits[1])


@dataclass(frozen=True, slots=True)
class TimeScale:
    """UTC nanoseconds to the abscissa in seconds, over one span."""

    start_utc_ns: int
    stop_utc_ns: int

    @property
    def length_s(self) -> float:
        return max((self.stop_utc_ns - self.start_utc_ns) / 1e9, 1.0)

    def x(self, utc_ns: NDArray[np.int64] | int) -> Any:
        """Seconds since the start."""
        return (np.asarray(utc_ns) - self.start_utc_ns) / 1e9

    def inside(self, utc_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
        return np.asarray((utc_ns >= self.start_utc_ns) & (utc_ns <= self.stop_utc_ns))

    def label(self) -> str:
        """Name of the axis: the day or days it covers."""
        first = utc_fields(self.start_utc_ns)
        last = utc_fields(self.stop_utc_ns)
        if first[:3] == last[:3]:
            return f"UTC, {first[2]} {month_name(first[1])} {first[0]}"
        if first[:2] == last[:2]:
            return f"UTC, {first[2]}–{last[2]} {month_name(first[1])} {first[0]}"
        return f"UTC, {first[2]} {month_name(first[1])} – {last[2]} {month_name(last[1])} {last[0]}"

    def ticks(self, most: int = 9) -> tuple[list[float], list[str]]:
        """Round times inside the span and their labels; the date stands where the day changes."""
        step = next((s for s in _STEPS_S if self.length_s / s <= most), None)
        if step is None:
            step = _DAY_S * math.ceil(self.length_s / _DAY_S / most)
        start_s = self.start_utc_ns / 1e9
        first = math.ceil(start_s / step) * step
        places, labels = [], []
        tick = first
        while tick <= self.stop_utc_ns / 1e9 + 1e-6:
            _, month, day, hour, minute, second = utc_fields(int(tick) * 1_000_000_000)
            if step >= _DAY_S:
                text = f"{day} {month_name(month)[:3]}"
            elif step < 60:
                text = f"{hour:02d}:{minute:02d}:{second:02d}"
            else:
                text = f"{hour:02d}:{minute:02d}"
            places.append(tick - start_s)
            labels.append(text)
            tick += step
        return places, labels


def time_axis(axes: Axes, time: TimeScale, *, labelled: bool = True, most: int = 9) -> None:
    """Limits, ticks and name of a UTC axis; without labels where another axis below carries them."""
    places, labels = time.ticks(most)
    axes.set_xlim(0.0, time.length_s)
    axes.set_xticks(places, labels if labelled else [""] * len(labels))
    if labelled:
        axes.set_xlabel(time.label())


def arcs_differ(time: TimeScale, arcs: Iterable[TimeSpan]) -> bool:
    """True where imaging arcs cover some but not all of a span."""
    covered = sum(max(0, min(a.stop_utc_ns, time.stop_utc_ns) - max(a.start_utc_ns, time.start_utc_ns)) for a in arcs)
    return 0.0 < covered / 1e9 < 0.985 * time.length_s


def shade_arcs(axes: Axes, time: TimeScale, arcs: Iterable[TimeSpan]) -> None:
    """Tint the imaging arcs, where there is anything else to tell them from."""
    from matplotlib.collections import PolyCollection

    if not arcs_differ(time, arcs):
        return
    edges = [(float(time.x(arc.start_utc_ns)), float(time.x(arc.stop_utc_ns))) for arc in arcs]
    kept = [(max(a, 0.0), min(b, time.length_s)) for a, b in edges if b > 0.0 and a < time.length_s]
    # One artist for all arcs: a day has twenty and more in every panel.
    boxes = PolyCollection(
        [[(a, 0.0), (a, 1.0), (b, 1.0), (b, 0.0)] for a, b in kept],
        facecolor=color("sunlit"),
        linewidth=0,
        zorder=0,
        transform=axes.get_xaxis_transform(),
    )
    axes.add_collection(boxes, autolim=False)


def thinned(x: FloatArray, y: FloatArray, buckets: int = 600) -> tuple[FloatArray, FloatArray]:
    """Fewer samples of a long line: the least and the greatest of each bucket in their order, gaps kept."""
    if len(x) <= 3 * buckets:
        return x, y
    per = -(-len(x) // buckets)
    rows = -(-len(x) // per)
    filled = np.full(rows * per, np.nan)
    filled[: len(y)] = y
    table = filled.reshape(rows, per)
    finite = np.isfinite(table)
    start = np.arange(rows) * per
    low = start + np.argmin(np.where(finite, table, np.inf), axis=1)
    high = start + np.argmax(np.where(finite, table, -np.inf), axis=1)
    hole = start + np.argmin(finite, axis=1)
    keep = np.unique(np.concatenate([low, high, hole]))
    keep = keep[keep < len(x)]
    return x[keep], y[keep]


def length_label(metres: float) -> str:
    """A tick label of a length in metres: 10 m, 1 km."""
    if metres == 0:
        return "0"
    if abs(metres) >= 1000:
        return f"{metres / 1000:g} km"
    if abs(metres) >= 1:
        return f"{metres:g} m"
    return f"{metres * 100:g} cm"


def log_length_axis(axes: Axes, which: str, values: Sequence[NDArray[np.float64]]) -> bool:
    """Decades of metres on a logarithmic axis that holds all the values; False when there is nothing to hold."""
    positive = [v[np.isfinite(v) & (v > 0)] for v in values]
    positive = [v for v in positive if len(v)]
    if not positive:
        return False
    medians = [float(np.median(v)) for v in positive]
    low = max(min(float(np.quantile(v, 0.02)) for v in positive), min(medians) / 10.0)
    high = max(float(v.max()) for v in positive)
    bottom = 10.0 ** math.floor(math.log10(max(low, 1e-2)) + 0.05)
    top = 10.0 ** math.ceil(math.log10(max(high * 1.05, bottom * 10)))
    decades = np.arange(round(math.log10(bottom)), round(math.log10(top)) + 1)
    every = 1 if len(decades) <= 8 else 2
    ticks = [10.0 ** int(d) for d in decades[::every]]
    labels = [length_label(t) for t in ticks]
    if which == "y":
        axes.set_yscale("log")
        axes.set_ylim(bottom, top)
        axes.set_yticks(ticks, labels)
        axes.set_yticks([], minor=True)
    else:
        axes.set_xscale("log")
        axes.set_xlim(bottom, top)
        axes.set_xticks(ticks, labels)
        axes.set_xticks([], minor=True)
    return True


def end_labels(
    axes: Axes,
    entries: Sequence[tuple[str, float, str]],
    *,
    line_height: float,
    samples: Mapping[str, Any],
    line_width: float,
    axes_width_in: float,
) -> None:
    """Names of lines, each after a short sample of it, at their right ends, moved apart where they would touch.

    Parameters
    ----------
    entries : name, last value in data coordinates and colour of each line
    line_height : height of a line of text as a fraction of the axes
    samples : line style of each name
    """
    usable = [(name, value, tint) for name, value, tint in entries if math.isfinite(value)]
    if not usable:
        return
    low, high = axes.get_ylim()
    logarithmic = axes.get_yscale() == "log"

    def place(value: float) -> float:
        if logarithmic:
            value, bottom, top = math.log10(max(value, low)), math.log10(low), math.log10(high)
        else:
            bottom, top = low, high
        return min(max((value - bottom) / (top - bottom), 0.0), 1.0)

    ordered = sorted(usable, key=lambda e: place(e[1]))
    heights = spread([place(value) for _, value, _ in ordered], line_height)
    for (name, _, tint), height in zip(ordered, heights, strict=True):
        axes.plot(
            [1.0 + 0.08 / axes_width_in, 1.0 + 0.32 / axes_width_in],
            [height, height],
            color=tint,
            linestyle=samples[name],
            linewidth=line_width,
            transform=axes.transAxes,
            clip_on=False,
        )
        axes.text(
            1.0 + 0.38 / axes_width_in,
            height,
            name,
            color=tint,
            transform=axes.transAxes,
            va="center_baseline",
            ha="left",
            fontsize="small",
        )


def spread(wanted: list[float], gap: float) -> list[float]:
    """Sorted heights moved as little as possible so that neighbours are at least a gap apart."""
    groups: list[list[float]] = []  # [centre, count]
    for height in wanted:
        groups.append([height, 1.0])
        while len(groups) > 1:
            (below, n), (above, m) = groups[-2], groups[-1]
            if above - below >= gap * (n + m) / 2:
                break
            groups[-2:] = [[(below * n + above * m) / (n + m), n + m]]
    heights: list[float] = []
    for centre, count in groups:
        first = centre - gap * (count - 1) / 2
        heights.extend(first + gap * i for i in range(int(count)))
    return heights
