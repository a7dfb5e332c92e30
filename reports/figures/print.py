"""Words, rules and boxes set straight onto a page of a PDF.

A page knows where its text stands, so nothing of it has to be measured again: a `matplotlib.text.Text` lays every
string out twice, which is half the time of a page of tables.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

from matplotlib.artist import Artist
from matplotlib.font_manager import FontProperties
from matplotlib.path import Path
from matplotlib.transforms import Affine2D


@lru_cache(maxsize=64)
def _face(family: str, weight: str, size: float) -> FontProperties:
    return FontProperties(family=family, weight=weight, size=size)


class Print(Artist):
    """What is printed on one page, in points from its lower left corner; boxes lie below words."""

    def __init__(self) -> None:
        super().__init__()
        self.set_zorder(3)
        self._boxes: list[tuple[float, float, float, float, str]] = []
        self._words: list[tuple[float, float, str, FontProperties, str]] = []

    def word(self, x: float, y: float, text: str, size: float, tint: str, family: str, weight: str) -> None:
        """Text whose baseline begins at a point."""
        self._words.append((x, y, text, _face(family, weight, size), tint))

    def box(self, x: float, y: float, width: float, height: float, tint: str) -> None:
        """A filled rectangle from its lower left corner."""
        self._boxes.append((x, y, width, height, tint))

    def draw(self, renderer: Any) -> None:
        """Put everything on the renderer of a PDF."""
        gc = renderer.new_gc()
        gc.set_linewidth(0.0)
        for x, y, width, height, tint in self._boxes:
            gc.set_foreground(tint)
            place = Affine2D().scale(width, height).translate(x, y)
            renderer.draw_path(gc, Path.unit_rectangle(), place, gc.get_rgb())
        for x, y, text, face, tint in self._words:
            gc.set_foreground(tint)
            renderer.draw_text(gc, x, y, text, face, 0.0)
        gc.restore()
