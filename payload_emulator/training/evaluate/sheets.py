"""Pictures for people: labels drawn on frames as in the paper's Fig. 5, contact sheets, also of data sets."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lunar.arrays import OctetArray
from lunar.catalogue import size_class
from payload_emulator.errors import DatasetError
from payload_emulator.sim.render.sensor import Picture
from payload_emulator.training.data.dataset import Dataset, Frame, in_picture, write_whole

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
    remarks = "; ".join(text for text in (item["reason"], item["pixels"]) if text)
    lines = [f"{item['file']}: {item['quality']}, {len(rows)} craters{f' ({remarks})' if remarks else ''}"]
    if rows:
        lines += ["    u px    v px  diameter px  score  class"]
    return "\n".join(
        lines
        + [
            f"{row['u_px']:8.1f}{row['v_px']:8.1f}{row['diameter_px']:13.1f}{row['score']:7.2f}{row['class']:7}"
            for row in rows
        ]
    )


def draw_sheet(dataset: Dataset, split: str = "", columns: int = 4, rows: int = 2, tile_px: int = 512) -> Rgb:
    """Contact sheet of frames spread evenly over a split (all where not named), every labelled rim drawn.

    Raises
    ------
    DatasetError
        The split has no frames.
    """
    frames = dataset.frames(split)
    if not frames:
        raise DatasetError(f"{dataset.folder}: expected frames of split {split!r}, found none")
    wanted = min(columns * rows, len(frames))
    chosen = [frames[int((k + 0.5) * len(frames) / wanted)] for k in range(wanted)]
    pictures = [draw_frame(dataset, frame, tile_px) for frame in chosen]
    return contact_sheet(pictures, [_caption(frame) for frame in chosen], min(columns, wanted))


def draw_frame(dataset: Dataset, frame: Frame, tile_px: int = 512) -> Rgb:
    """RGB picture (tile_px, tile_px, 3) of a frame with the rims of its labelled craters."""
    import cv2

    gray, craters = dataset.gray(frame), frame.craters
    scale = tile_px / max(gray.shape)
    size = round(gray.shape[1] * scale), round(gray.shape[0] * scale)
    picture = np.zeros((tile_px, tile_px, 3), np.uint8)
    resized = gray if size == gray.shape[::-1] else cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
    picture[: size[1], : size[0]] = resized[..., None]
    classes = size_class(craters["diameter_m"].astype(np.float64))
    inside = in_picture(craters, dataset.width_px, dataset.height_px)
    labels = [
        {
            "class": int(classes[k]),
            "inside": bool(inside[k]),
            # Pixel centres are integers in labels; the picture's corner is half a pixel before.
            **{name: (float(craters[name][k]) + 0.5) * scale - 0.5 for name in ("u_px", "v_px")},
            "ellipse": {
                **{name: float(craters[name][k]) * scale for name in ("major_px", "minor_px")},
                "angle_deg": math.degrees(float(craters["angle_rad"][k])),
            },
        }
        for k in range(classes.size)
    ]
    return draw_labels(picture, labels)


def contact_sheet(pictures: Sequence[Rgb], captions: Sequence[str], columns: int) -> Rgb:
    """Pictures (H, W, 3) of one size in rows, each with a line of text under it."""
    cells = [_captioned(picture, caption) for picture, caption in zip(pictures, captions, strict=True)]
    high, wide = cells[0].shape[:2]
    rows = math.ceil(len(cells) / columns)
    sheet = np.full((rows * (high + GAP_PX) + GAP_PX, columns * (wide + GAP_PX) + GAP_PX, 3), GROUND, np.uint8)
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
    write_whole(path, octets.tobytes())


def _caption(frame: Frame) -> str:
    v = frame.values
    return (
        f"{frame.number:06d} {frame.split}  {v['latitude_deg']:+.2f} {v['longitude_deg']:.2f}E  "
        f"{v['altitude_m'] / 1000:.1f} km  Sun {v['sun_elevation_deg']:.0f}/{v['sun_azimuth_deg']:+.0f} deg"
    )


def _captioned(picture: Rgb, caption: str) -> Rgb:
    import cv2

    strip = np.full((CAPTION_PX, picture.shape[1], 3), GROUND, np.uint8)
    scale = 0.42 if picture.shape[1] >= 360 else 0.32
    cv2.putText(strip, caption, (4, CAPTION_PX - 7), cv2.FONT_HERSHEY_SIMPLEX, scale, (INK,) * 3, 1, cv2.LINE_AA)
    return np.concatenate([picture, strip])
