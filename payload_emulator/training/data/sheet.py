"""Contact sheets of data sets: frames with their labels in the colours of the paper's Fig. 5."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from lunar.arrays import OctetArray
from lunar.catalogue import size_class
from payload_emulator.errors import DatasetError
from payload_emulator.training.data.dataset import Dataset, Frame, in_picture

CLASS_COLOURS = ((0, 255, 255), (0, 255, 0), (255, 255, 0))
"""Cyan, lime and yellow (RGB) for craters of 5-10, 10-15 and 15-30 km, as in the paper's Fig. 5."""

_GAP_PX = 6
_CAPTION_PX = 18
_PAPER = (24, 24, 28)
_INK = (225, 225, 225)
_LETTERS_TO_WIDTH = 62  # that many letters fill a picture of 512 px at scale 1 of the font below
_SUB_PIXEL_BITS = 4


def draw_sheet(
    dataset: Dataset, split: str = "", columns: int = 4, rows: int = 2, tile_px: int = 512
) -> OctetArray:
    """RGB picture (H, W, 3) of frames spread evenly over a split (all where not named), every labelled rim drawn.

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
    columns = min(columns, wanted)
    rows = math.ceil(wanted / columns)
    high, wide = tile_px + _CAPTION_PX + _GAP_PX, tile_px + _GAP_PX
    sheet = np.full((rows * high + _GAP_PX, columns * wide + _GAP_PX, 3), _PAPER, np.uint8)
    for k, frame in enumerate(chosen):
        top, left = _GAP_PX + k // columns * high, _GAP_PX + k % columns * wide
        sheet[top : top + tile_px, left : left + tile_px] = draw_frame(dataset, frame, tile_px)
        _write(sheet, _caption(frame), (left, top + tile_px + 13), tile_px)
    return sheet


def draw_frame(dataset: Dataset, frame: Frame, tile_px: int = 512) -> OctetArray:
    """RGB picture (tile_px, tile_px, 3) of a frame with the rims of its labelled craters."""
    import cv2

    gray = dataset.gray(frame)
    scale = tile_px / max(gray.shape)
    size = round(gray.shape[1] * scale), round(gray.shape[0] * scale)
    picture = np.zeros((tile_px, tile_px, 3), np.uint8)
    resized = gray if size == gray.shape[::-1] else cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
    picture[: size[1], : size[0]] = resized[..., None]
    craters = frame.craters
    classes = size_class(craters["diameter_m"].astype(np.float64))
    inside = in_picture(craters, dataset.width_px, dataset.height_px)
    one = 1 << _SUB_PIXEL_BITS
    for k in np.flatnonzero(inside & (classes >= 0) & (classes < len(CLASS_COLOURS))):
        # Pixel centres are integers in labels; the picture's corner is half a pixel before.
        centre = [round(((float(craters[name][k]) + 0.5) * scale - 0.5) * one) for name in ("u_px", "v_px")]
        axes = [round(0.5 * float(craters[name][k]) * scale * one) for name in ("major_px", "minor_px")]
        cv2.ellipse(
            picture,
            centre,
            axes,
            math.degrees(float(craters["angle_rad"][k])),
            0.0,
            360.0,
            CLASS_COLOURS[int(classes[k])],
            1,
            cv2.LINE_AA,
            _SUB_PIXEL_BITS,
        )
    return picture


def _caption(frame: Frame) -> str:
    v = frame.values
    return (
        f"{frame.number:06d} {frame.split}  {v['latitude_deg']:+.2f} {v['longitude_deg']:.2f}E  "
        f"{v['altitude_m'] / 1000:.1f} km  Sun {v['sun_elevation_deg']:.0f}/{v['sun_azimuth_deg']:+.0f} deg"
    )


def _write(picture: OctetArray, text: str, place: Sequence[int], width_px: int) -> None:
    import cv2

    scale = min(0.45, 0.45 * width_px / 512 * _LETTERS_TO_WIDTH / max(len(text), 1))
    cv2.putText(picture, text, list(place), cv2.FONT_HERSHEY_SIMPLEX, scale, _INK, 1, cv2.LINE_AA)
