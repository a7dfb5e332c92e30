"""Section on the craters that the payload mapped."""

import math
from functools import partial

from reports.document import Block, Column, Heading, Picture, Table
from reports.figures import payload_map as figure
from reports.sections.common import PassView
from reports.text import count_text, percent_text

_FEWEST_DRAWN = 5


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
                partial(figure.draw_payload_map, mapped=mapped),
            )
        )
    return blocks


def _metres(value: float) -> str:
    return "unknown" if math.isnan(value) else f"{value:+,.0f}"
