"""Figures of a document: drawn once for its renderings, and as files."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from reports.document import Picture
from reports.figures.canvas import Canvas
from reports.figures.svg import draw_svg
from reports.figures.theme import drawing

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PNG_DPI = 200


class Drawings(dict[str, str]):
    """SVG of the figures of one document by key, each drawn once for all its renderings."""

    def svg(self, one: Picture) -> str:
        """Return the SVG of a picture; the keys of the pictures of a document are unique."""
        if one.key not in self:
            self[one.key] = draw_svg(one.key, one.width_in, one.height_in, one.draw, one.alt)
        return self[one.key]


def picture_files(picture: Picture) -> tuple[bytes, str]:
    """Return a figure as PNG, and what it plots as CSV; x of an axis of UTC is in seconds from the start of the axis.

    An image has no rows.
    """
    from matplotlib.figure import Figure

    octets, text = io.BytesIO(), io.StringIO()
    with drawing():
        figure = Figure(figsize=(picture.width_in, picture.height_in))
        picture.draw(Canvas(figure, picture.width_in, picture.height_in))
        figure.savefig(octets, format="png", dpi=PNG_DPI, metadata={"Software": None})
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["panel", "x_axis", "series", "x", "y"])
    for axes in figure.axes:
        for series, x, y in _plotted(axes):
            table.writerow([axes.get_title(), axes.get_xlabel(), series, f"{x:.9g}", f"{y:.9g}"])
    return octets.getvalue(), text.getvalue()


def _plotted(axes: Axes) -> Iterator[tuple[str, float, float]]:
    """Yield name, x and y of named lines, of bars (their middle) and of rings (number, share)."""
    from matplotlib.patches import Wedge

    for line in axes.lines:
        name = str(line.get_label())
        if name and not name.startswith("_"):
            yield from ((name, float(x), float(y)) for x, y in np.asarray(line.get_xydata()))
    for bars in axes.containers:
        for bar in bars:
            yield str(bars.get_label()), bar.get_x() + bar.get_width() / 2.0, bar.get_height()
    for number, patch in enumerate(axes.patches):
        if isinstance(patch, Wedge):
            yield str(patch.get_label()), number, (patch.theta2 - patch.theta1) / 360.0
