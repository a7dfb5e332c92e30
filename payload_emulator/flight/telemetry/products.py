"""Products of images: thumbnails, checksums, and the map of landmarks that were used.

Thumbnail: see `tmtc.packets.large_data`. Landmark map: for every crater, by identity: identity (u32), frames that
used it (u16). Big-endian.
"""

import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lunar.arrays import FloatArray
from tmtc.packets.large_data import Thumbnail, pack_thumbnail

_LANDMARK = np.dtype([("crater_id", ">u4"), ("frames", ">u2")])


def thumbnail_octets(image: NDArray[Any], factor: int, frame_number: int, ticks: int) -> bytes:
    """The image in gray, averaged over squares of `factor` pixels; edges that fill no square are left out.

    Integer levels are scaled to 8 bits, fractions to 0..255.
    """
    gray = image.astype(np.float64)
    gray = gray.mean(axis=2) if gray.ndim == 3 else gray
    full = float(np.iinfo(image.dtype).max) if image.dtype.kind in "ui" else 1.0
    rows, columns = (size // factor for size in gray.shape)
    squares = gray[: rows * factor, : columns * factor].reshape(rows, factor, columns, factor)
    levels = np.nan_to_num(squares.mean(axis=(1, 3)) * (255.0 / full)) if squares.size else squares[:, 0, :, 0]
    return pack_thumbnail(Thumbnail(frame_number, ticks, np.clip(np.rint(levels), 0, 255).astype(np.uint8)))


def image_report(image: NDArray[Any], attitude: FloatArray) -> dict[str, int]:
    """Return size and checksums of an image and its attitude message, as the packet `image_report` has them."""
    rows, columns = image.shape[:2] if image.ndim >= 2 and image.size else (0, 0)
    return {
        "width_px": columns,
        "height_px": rows,
        "image_crc": zlib.crc32(np.ascontiguousarray(image).tobytes()) if image.size else 0,
        "inputs_crc": zlib.crc32(np.ascontiguousarray(attitude, dtype=">f8").tobytes()),
    }


def map_octets(sightings: Mapping[int, int]) -> bytes:
    """Return the octets of the landmark map: how many frames used each crater."""
    rows = np.array([(crater, min(count, 0xFFFF)) for crater, count in sorted(sightings.items())], dtype=_LANDMARK)
    return rows.tobytes()
