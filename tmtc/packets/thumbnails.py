"""Thumbnails in large data: frame number (u32), on-board time (u64), rows (u16), columns (u16), compressed gray levels.

The levels are u8, row by row, compressed with zlib; numbers are big-endian.
"""

import struct
import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tmtc.errors import ValueRefused

HEADER = struct.Struct(">IQHH")


@dataclass(frozen=True, slots=True, eq=False)
class Thumbnail:
    """Reduced image of a frame: on-board time in ticks, gray levels (rows, columns)."""

    frame_number: int
    ticks: int
    levels: NDArray[np.uint8]


def pack_thumbnail(thumbnail: Thumbnail) -> bytes:
    """Return the octets of a thumbnail."""
    rows, columns = thumbnail.levels.shape
    head = HEADER.pack(thumbnail.frame_number & 0xFFFFFFFF, thumbnail.ticks, rows, columns)
    return head + zlib.compress(thumbnail.levels.astype(np.uint8).tobytes(), 9)


def unpack_thumbnail(octets: bytes) -> Thumbnail:
    """Return a thumbnail.

    Raises
    ------
    ValueRefused
        The octets are no thumbnail, or their levels are not as many as rows and columns.
    """
    if len(octets) < HEADER.size:
        raise ValueRefused("thumbnail", "header", f"{len(octets)} octets", f"{HEADER.size} octets")
    frame_number, ticks, rows, columns = HEADER.unpack_from(octets)
    wanted = rows * columns
    inflate: Any = zlib.decompressobj()
    try:
        levels = inflate.decompress(octets[HEADER.size :], wanted + 1)
    except zlib.error as error:
        raise ValueRefused("thumbnail", "levels", str(error), "levels compressed with zlib") from None
    if len(levels) != wanted or not inflate.eof:
        raise ValueRefused("thumbnail", "levels", f"{len(levels)} octets", f"{wanted} octets")
    return Thumbnail(frame_number, ticks, np.frombuffer(levels, dtype=np.uint8).reshape(rows, columns))
