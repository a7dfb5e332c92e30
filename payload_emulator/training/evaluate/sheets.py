"""Pictures for people: labels drawn on frames as in the paper's Fig. 5, contact sheets."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lunar.arrays import OctetArray
from payload_emulator.sim.render.sensor import Picture

Rgb = OctetArray

CLASS_COLOURS = {0: (0, 255, 255), 1: (0, 255, 0), 2: (255, 255, 0)}
"""Cyan, lime and yellow by size class (paper, Fig. 5)."""

CAPTION_PX = 22
GAP_PX = 4
GROUND = 20
INK = 230


def eight_bits(image: Picture) -> Rgb:
    """An 8-bit picture (H, W, 3) of one in 8 or 16 bits."""
    return np.asarray(image if image.dtype == np.uint8 else image >> 8, dtype=np.uint8)


def draw_labels(image: Picture, labels: Sequence[dict[str, Any]]) -> Rgb:
    """A copy of the picture with the rims' ellipses of classes 0 to 2 on it, whose centres lie in the picture."""
    import cv2

    drawn = np.ascontiguousarray(eight_bits(image)).copy()
    for label in labels:
        colour = CLASS_COLOURS.get(label["class"])
        if colour is None or not label["inside"]:
            continue
        axes = label["ellipse"]
        # Sixteenths of a pixel: rims sit where they are.
        cv2.ellipse(
            drawn,
            (round(16.0 * label["u_px"]), round(16.0 * label["v_px"])),
            (round(8.0 * axes["major_px"]), round(8.0 * axes["minor_px"])),
            axes["angle_deg"],
            0.0,
            360.0,
            colour,
            1,
            cv2.LINE_AA,
            4,
        )
    return drawn


def draw_detections(image: Any, detections: Sequence[dict[str, Any]]) -> Rgb:
    """A copy of the picture, (H, W) or (H, W, 3), with the circles of detections on it."""
    labels = [
        row
        | {"class": max(row["class"], 0), "inside": True}
        | {"ellipse": {"major_px": row["diameter_px"], "minor_px": row["diameter_px"], "angle_deg": 0.0}}
        for row in detections
    ]
    return draw_labels(image[..., None].repeat(3, -1) if image.ndim == 2 else image, labels)


def format_detections(item: dict[str, Any]) -> str:
    """Rows of the detections in a file, the largest first."""
    rows = sorted(item["detections"], key=lambda row: -row["diameter_px"])
    lines = [f"{item['file']}: {item['quality']}, {len(rows)} craters"]
    if rows:
        lines += ["    u px    v px  diameter px  score  class"]
    return "\n".join(
        lines
        + [
            f"{row['u_px']:8.1f}{row['v_px']:8.1f}{row['diameter_px']:13.1f}{row['score']:7.2f}{row['class']:7}"
            for row in rows
        ]
    )


def contact_sheet(pictures: Sequence[Rgb], captions: Sequence[str], columns: int) -> Rgb:
    """Pictures (H, W, 3) of one size in rows, each with a line of text under it."""
    cells = [_captioned(picture, caption) for picture, caption in zip(pictures, captions, strict=True)]
    high, wide = cells[0].shape[:2]
    rows = math.ceil(len(cells) / columns)
    sheet = np.full(
        (rows * (high + GAP_PX) + GAP_PX, columns * (wide + GAP_PX) + GAP_PX, 3), GROUND, np.uint8
    )
    for number, cell in enumerate(cells):
        top = GAP_PX + number // columns * (high + GAP_PX)
        left = GAP_PX + number % columns * (wide + GAP_PX)
        sheet[top : top + high, left : left + wide] = cell
    return sheet


def save_png(image: Picture, path: Path) -> None:
    """Write a picture (H, W, 3) in 8 or 16 bits: the whole file or none of it."""
    import cv2

    done, octets = cv2.imencode(".png", image[..., ::-1])
    assert done
    save_octets(octets.tobytes(), path)


def save_octets(octets: bytes, path: Path) -> None:
    """Write a whole file or none of it."""
    partial = path.with_name(f".{path.name}.partial")
    try:
        partial.write_bytes(octets)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def _captioned(picture: Rgb, caption: str) -> Rgb:
    import cv2

    strip = np.full((CAPTION_PX, picture.shape[1], 3), GROUND, np.uint8)
    scale = 0.42 if picture.shape[1] >= 360 else 0.32
    cv2.putText(
        strip, caption, (4, CAPTION_PX - 7), cv2.FONT_HERSHEY_SIMPLEX, scale, (INK,) * 3, 1, cv2.LINE_AA
    )
    return np.concatenate([picture, strip])
