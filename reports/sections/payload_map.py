"""Section on the craters that the payload mapped."""

import math
from functools import partial

import numpy as np

from reports.document import Block, Column, Heading, Picture, Table
from reports.figures.canvas import Canvas
from reports.figures.theme import color
from reports.sections.common import PassView
from reports.text import count_text, percent_text
from reports.values import PayloadMap

_FEWEST_DRAWN = 5
# Landmarks further off than this many times the median are not drawn: a few would shrink all others to a dot.
_SHOWN_OF_MEDIAN = 6.0


def payload_map(view: PassView) -> list[Block]:
    """The landmark map of the payload; nothing where none came down."""
    mapped = view.report.payload_map
    if mapped is None:
        return []
    source = mapped.source or "the catalogue"
    rows = [
        ("landmarks mapped", count_text(mapped.mapped)),
        ("of these mapped again on a later pass", count_text(mapped.mapped_again)),
        ("of these used in fixes", count_text(mapped.used)),
        (
            "detections in fixes that were landmarks",
            f"{count_text(mapped.pairs)} ({percent_text(mapped.pairs, mapped.pairs_of_all)})",
        ),
        (f"landmarks that {source} knows", count_text(mapped.catalogued)),
    ]
    if mapped.catalogued:
        east, north, up = (_metres(value) for value in mapped.median_offset_m)
        rows += [
            ("horizontal distance from it, rms", f"{mapped.horizontal_rms_m:,.0f} m"),
            ("median offset east, north, up", f"{east}, {north}, {up} m"),
            ("square of offset over claimed sigma, mean", f"{mapped.normalised_square:.2f}"),
        ]
    blocks: list[Block] = [
        Heading("The payload's own map"),
        Table(
            "Craters that no catalogue on board holds, mapped by the payload and compared on the ground.",
            (Column("quantity", numeric=False), Column("value")),
            tuple(rows),
            note="The last row is 1 where the payload's claims hold. A landmark serves on passes after its own.",
        ),
    ]
    if mapped.catalogued >= _FEWEST_DRAWN:
        blocks.append(
            Picture(
                "payload_map",
                f"Landmarks that {source} knows. Left: offset of each from it; vermillion: twice the claimed sigma "
                "(rms). Right: offsets over the claimed sigma; vermillion: as a normal distribution would have them; "
                "the last bar holds all beyond.",
                f"Scatter of {mapped.catalogued} offsets between the payload's map and the catalogue.",
                3.6,
                partial(_draw_payload_map, mapped=mapped),
            )
        )
    return blocks


def _metres(value: float) -> str:
    return "unknown" if math.isnan(value) else f"{value:+,.0f}"


def _draw_payload_map(canvas: Canvas, mapped: PayloadMap) -> None:
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
