"""Map made by the payload, compared with the catalogue."""

import numpy as np

from reports.figures.canvas import Canvas
from reports.figures.theme import color
from reports.values import PayloadMap

# Landmarks further off than this many times the median are not drawn: a few would shrink all others to a dot.
_SHOWN_OF_MEDIAN = 6.0


def draw_payload_map(canvas: Canvas, mapped: PayloadMap) -> None:
    """Offsets east and north of the landmarks that the catalogue knows, and the ratio of offset to claim."""
    size = canvas.height_in - 0.85
    distance = np.hypot(mapped.offset_m[:, 0], mapped.offset_m[:, 1])
    claimed = float(np.sqrt(np.mean(mapped.sigma_m**2)))
    limit = 1.1 * max(min(float(distance.max()), _SHOWN_OF_MEDIAN * float(np.median(distance))), 2.0 * claimed)
    axes = canvas.axes(0.85, 0.5, size, size)
    axes.set_aspect("equal")
    axes.set_xlim(-limit, limit)
    axes.set_ylim(-limit, limit)
    axes.grid(True, axis="both")
    shown = distance <= limit
    axes.plot(
        mapped.offset_m[shown, 0],
        mapped.offset_m[shown, 1],
        "o",
        color=color("blue"),
        markersize=3.0,
        alpha=0.6,
        linestyle="none",
    )
    angle = np.linspace(0.0, 2.0 * np.pi, 121)
    axes.plot(2.0 * claimed * np.cos(angle), 2.0 * claimed * np.sin(angle), color=color("vermillion"), linewidth=1.6)
    axes.set_xlabel("east, m")
    axes.set_ylabel("north, m")
    axes.set_title("landmark minus catalogue")
    left = 0.85 + size + 1.3
    panel = canvas.axes(left, 0.5, canvas.width_in - left - 0.3, size)
    ratio = np.abs(mapped.offset_m / mapped.sigma_m).reshape(-1)
    edges = np.linspace(0.0, 5.0, 21)
    share = np.histogram(np.minimum(ratio, 4.999), edges)[0] / ratio.size
    panel.bar(edges[:-1], share, np.diff(edges) * 0.92, align="edge", color=color("blue"), linewidth=0)
    middle = (edges[:-1] + edges[1:]) / 2
    normal = 2.0 * np.exp(-0.5 * middle**2) / np.sqrt(2.0 * np.pi) * np.diff(edges)
    panel.plot(middle, normal, color=color("vermillion"), linewidth=1.6)
    panel.set_xlim(0.0, 5.0)
    panel.set_xlabel("offset over claimed sigma, east and north")
    panel.set_title("share of the landmarks")
