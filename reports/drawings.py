"""Figures of a document, drawn once."""

from __future__ import annotations

from reports.document import Picture
from reports.figures.svg import draw_svg


class Drawings:
    """Figures of one document, each drawn once for all its renderings."""

    def __init__(self) -> None:
        self._drawn: dict[str, str] = {}

    def svg(self, picture: Picture) -> str:
        """Return the SVG of a picture; the keys of the pictures of a document are unique."""
        if picture.key not in self._drawn:
            self._drawn[picture.key] = draw_svg(
                picture.key, picture.width_in, picture.height_in, picture.draw, picture.alt
            )
        return self._drawn[picture.key]
