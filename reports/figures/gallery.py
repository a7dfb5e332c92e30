"""Image frames with detections (crosses) and catalogue (dashed circles), as in the paper's Fig. 6."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from reports.arrays import BoolArray, FloatArray
from reports.figures.canvas import Canvas
from reports.figures.theme import color
from reports.text import utc_text
from reports.values import GalleryFrame

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# On top of gray photographs in every theme, so these are not roles.
CLASS_TINTS = {0: "#5cd6ff", 1: "#ffd23f", 2: "#ff8ad0", 3: "#d7dde4"}
FALSE_TINT = "#ff5a36"
SMALL_TINT = "#b9c1cb"
SCORED_CLASSES = (0, 1, 2)
_NO_CLASS_TINT = "#ffffff"
_LETTER_IN = 0.0605


def draw_gallery(canvas: Canvas, frames: Sequence[GalleryFrame], columns: int) -> None:
    """Frames side by side, each with its number, its time and its caption above."""
    gap, head = 0.14, 0.44
    size = (canvas.width_in - gap * (columns - 1)) / columns
    sheet = canvas.axes(0.0, 0.0, canvas.width_in, canvas.height_in)
    sheet.set_axis_off()
    sheet.set_xlim(0.0, canvas.width_in)
    sheet.set_ylim(0.0, canvas.height_in)
    for i, frame in enumerate(frames):
        row, column = divmod(i, columns)
        left = column * (size + gap)
        top = canvas.height_in - row * (size + head + gap)
        title = f"frame {frame.frame_number}"
        if frame.utc_ns is not None:
            title += f" · {utc_text(frame.utc_ns, date=False)}"
        canvas.text(left, top - 0.15, title, va="center_baseline", fontsize="small", weight="bold")
        canvas.text(
            left, top - 0.33, _fitted(frame.caption, size), va="center_baseline", fontsize="small", color=color("muted")
        )
        draw_frame(canvas, sheet, left, top - head - size, size, frame)


def _fitted(caption: str, width_in: float) -> str:
    """A caption cut to the width of its frame."""
    most = int(width_in / _LETTER_IN)
    return caption if len(caption) <= most else f"{caption[: most - 1].rstrip()}…"


def gallery_height_in(count: int, columns: int, width_in: float) -> float:
    """Return the height of a sheet for a number of frames."""
    gap, head = 0.14, 0.44
    size = (width_in - gap * (columns - 1)) / columns
    rows = -(-count // columns)
    return rows * (size + head) + (rows - 1) * gap


def draw_frame(canvas: Canvas, sheet: Axes, left: float, bottom: float, size: float, frame: GalleryFrame) -> None:
    """One frame with its marks, ``size`` inches wide, at a place of a sheet whose data units are inches."""
    from matplotlib.patches import Rectangle

    height, width = frame.image.shape[:2]
    inches = size / width
    canvas.photo(sheet, frame.image, (left, left + size, bottom + size - height * inches, bottom + size))
    border = Rectangle((left, bottom + size - height * inches), size, height * inches, visible=False)
    sheet.add_patch(border)

    def x(u: FloatArray) -> FloatArray:
        return np.asarray(left + (u + 0.5) * inches)

    def y(v: FloatArray) -> FloatArray:
        return np.asarray(bottom + size - (v + 0.5) * inches)

    missed = _not(frame.catalogue_matched, len(frame.catalogue_u_px))
    false = _not(frame.detection_matched, len(frame.detection_u_px))
    dashes = {True: (0, (0.9, 1.7)), False: (0, (4.0, 2.2))}
    for size_class in np.unique(frame.catalogue_class):
        for lost in (True, False):
            chosen = (frame.catalogue_class == size_class) & (missed == lost)
            if chosen.any():
                circles = _circles(
                    x(frame.catalogue_u_px[chosen]),
                    y(frame.catalogue_v_px[chosen]),
                    frame.catalogue_diameter_px[chosen] / 2 * inches,
                )
                (line,) = sheet.plot(*circles, color=tint_of(int(size_class)), linestyle=dashes[lost], linewidth=1.3)
                line.set_clip_path(border)
    scored = np.isin(frame.detection_class, SCORED_CLASSES)
    found = ~false | scored
    tints = np.array([tint_of(int(c)) for c in frame.detection_class], dtype=object)
    tints = np.where(false, FALSE_TINT, tints)
    u, v = x(frame.detection_u_px), y(frame.detection_v_px)
    crosses = _crosses(u, v, 0.045)

    def strokes(chosen: BoolArray, tint: str, wide: float) -> None:
        (line,) = sheet.plot(*_joined(crosses[chosen]), color=tint, linewidth=wide, solid_capstyle="butt")
        line.set_clip_path(border)

    if (~found).any():
        (dots,) = sheet.plot(u[~found], v[~found], ".", color=SMALL_TINT, markersize=2.6, markeredgewidth=0)
        dots.set_clip_path(border)
    if found.any():
        strokes(found, "#0b0e12", 2.7)
    for tint in sorted(set(tints[found].tolist())):
        strokes(found & (tints == tint), tint, 1.3)


def tint_of(size_class: int) -> str:
    """Colour of a size class on a photograph."""
    return CLASS_TINTS.get(size_class, _NO_CLASS_TINT)


def _not(matched: BoolArray | None, count: int) -> BoolArray:
    return np.zeros(count, dtype=np.bool_) if matched is None else ~np.asarray(matched, dtype=np.bool_)


def _crosses(x: FloatArray, y: FloatArray, arm: float) -> FloatArray:
    """Strokes of crosses, (n, 6, 2), parted by NaN."""
    across = np.array([-1.0, 1.0, np.nan, -1.0, 1.0, np.nan]) * arm
    down = np.array([-1.0, 1.0, np.nan, 1.0, -1.0, np.nan]) * arm
    return np.stack([x[:, None] + across, y[:, None] + down], axis=-1)


def _circles(x: FloatArray, y: FloatArray, radius: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Outlines of circles, parted by NaN."""
    angle = np.append(np.linspace(0.0, 2.0 * np.pi, 33), np.nan)
    outline = np.stack([np.cos(angle), np.sin(angle)], axis=-1) * radius[:, None, None]
    return _joined(outline + np.stack([x, y], axis=-1)[:, None, :])


def _joined(strokes: FloatArray) -> tuple[FloatArray, FloatArray]:
    return strokes[..., 0].ravel(), strokes[..., 1].ravel()
