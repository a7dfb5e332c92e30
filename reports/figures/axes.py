"""Axes and SVG output of matplotlib with less work: an axis of one moving tick, and short numbers."""

from functools import lru_cache
from typing import Any

import numpy as np
from matplotlib import _path
from matplotlib.axes import Axes
from matplotlib.axis import Axis, Tick, XAxis, YAxis
from matplotlib.backends.backend_svg import RendererSVG
from matplotlib.font_manager import FontProperties
from matplotlib.textpath import text_to_path
from matplotlib.ticker import NullLocator


class _OneTick(Axis):
    """An axis that draws all ticks with one tick object, which takes matplotlib 2 ms to make.

    What `grid`, `set_ticks` and `tick_params` state is kept by the axis and shown by the tick that is made last.
    """

    def reset_ticks(self) -> None:
        self.majorTicks, self.minorTicks = list[Tick](), list[Tick]()

    def get_major_ticks(self, numticks: int | None = None) -> list[Tick]:
        return []

    get_minor_ticks = get_major_ticks

    def draw(self: Any, renderer: Any) -> None:
        if not self.get_visible():
            return
        if not isinstance(self.minor.locator, NullLocator):
            self._draw_ticks(renderer, False, self.minor.formatter)
        label = self._draw_ticks(renderer, True, self.major.formatter)
        self.label.draw(renderer)
        if offset := self.major.formatter.get_offset():
            self._update_offset_text_position([label.get_window_extent(renderer)], [])
            self.offsetText.set_text(offset)
            self.offsetText.draw(renderer)

    def _draw_ticks(self: Any, renderer: Any, major: bool, formatter: Any) -> Any:
        """Draw the ticks, and return the label of the last one."""
        places = np.asarray(self.get_ticklocs(minor=not major), dtype=np.float64)
        texts = np.array(formatter.format_ticks(places), dtype=object)
        low, high = sorted(self.get_transform().transform(self.get_view_interval()))
        at, margin = self.get_transform().transform(places), 1e-10 * (high - low)
        inside = (low - margin <= at) & (at <= high + margin)
        tick, count = self._get_tick(major), int(inside.sum())
        tick.set_clip_path(self.axes.patch)
        grid = np.repeat(places[inside], 3), np.tile((0.0, 1.0, np.nan), count)
        lines = ((tick.gridline, grid), (tick.tick1line, (places[inside], np.zeros(count))))
        for line, data in lines:
            if line.get_visible() and (line is tick.gridline or line.get_markersize() > 0.0):
                line.set_data(*(data if self.axis_name == "x" else data[::-1]))
                line.draw(renderer)
        for place, text in zip(places[inside], texts[inside], strict=True):
            tick.update_position(place)
            tick.label1.set_text(text)
            tick.label1.draw(renderer)
        return tick.label1


class _XAxis(_OneTick, XAxis):
    pass


class _YAxis(_OneTick, YAxis):
    pass


class QuickAxes(Axes):
    """Axes of two such axes."""

    def _init_axis(self) -> None:
        self.xaxis, self.yaxis = _XAxis(self, clear=False), _YAxis(self, clear=False)
        for name, axis in (("bottom", self.xaxis), ("top", self.xaxis), ("left", self.yaxis), ("right", self.yaxis)):
            self.spines[name].register_axis(axis)


_extent = lru_cache(maxsize=4096)(text_to_path.get_text_width_height_descent)


class PageRenderer(RendererSVG):  # type: ignore[misc]
    """SVG with paths to a hundredth of a point; a text of one font is measured once for all figures."""

    def get_text_width_height_descent(self, s: str, prop: FontProperties, ismath: Any) -> tuple[float, float, float]:
        extent: tuple[float, float, float] = _extent(s, prop, ismath)
        return extent

    def _convert_path(
        self, path: Any, transform: Any = None, clip: Any = None, simplify: Any = None, sketch: Any = None
    ) -> str:
        inside = (0.0, 0.0, self.width, self.height) if clip else None
        letters = [b"M", b"L", b"Q", b"C", b"z"]
        draw: Any = _path
        text: bytes = draw.convert_to_string(path, transform, inside, simplify, sketch, 2, letters, False)
        return text.decode("ascii")
