"""Reader of the OpenEXR files that the Cycles renderer hands over: one part, scan lines, uncompressed, 32-bit floats.

File layout after the OpenEXR technical introduction (magic 20000630, version 2): attributes, a table of line offsets,
then for every line its number, its size and the channels one after another in the order of their names.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import numpy.typing as npt

from payload_emulator.errors import RendererError

MAGIC = 20_000_630
LONG_NAMES = 0x400
FLOAT = 2
UNCOMPRESSED = 0


def read_exr(path: Path) -> dict[str, npt.NDArray[np.float32]]:
    """Planes (H, W) of a picture by channel name.

    Raises
    ------
    RendererError
        The file is no EXR of this kind, or ends early.
    """
    octets = path.read_bytes()
    try:
        attributes, place = _attributes(octets, path)
        names = _channels(attributes["channels"], path)
        if attributes["compression"][0] != UNCOMPRESSED:
            raise RendererError(
                f"{path}: expected an uncompressed EXR, found method {attributes['compression'][0]}"
            )
        left, top, right, bottom = struct.unpack("<4i", attributes["dataWindow"])
    except (KeyError, IndexError, struct.error, ValueError) as error:
        raise RendererError(
            f"{path}: expected the header of an EXR file, found it damaged ({error})"
        ) from None
    wide, high = right - left + 1, bottom - top + 1
    line = np.dtype([("number", "<i4"), ("size", "<i4"), ("values", "<f4", (len(names), wide))])
    start = place + 8 * high
    if len(octets) < start + high * line.itemsize:
        raise RendererError(
            f"{path}: expected {high} lines of {line.itemsize} octets after octet {start}, found "
            f"{len(octets) - start} octets"
        )
    lines = np.frombuffer(octets, line, high, start)
    values = np.empty((high, len(names), wide), np.float32)
    values[lines["number"] - top] = lines["values"]
    return {name: np.ascontiguousarray(values[:, n]) for n, name in enumerate(names)}


def _attributes(octets: bytes, path: Path) -> tuple[dict[str, bytes], int]:
    """Values of the header's attributes by name, and where the header ends."""
    magic, version = struct.unpack_from("<ii", octets)
    if magic != MAGIC or version & ~LONG_NAMES != 2:
        raise RendererError(
            f"{path}: expected a single-part EXR of version 2, found octets {octets[:8].hex()}"
        )
    attributes = {}
    place = 8
    while octets[place] != 0:
        name, place = _text(octets, place)
        _, place = _text(octets, place)
        (size,) = struct.unpack_from("<i", octets, place)
        attributes[name] = octets[place + 4 : place + 4 + size]
        place += 4 + size
    return attributes, place + 1


def _channels(octets: bytes, path: Path) -> list[str]:
    names = []
    place = 0
    while octets[place] != 0:
        name, place = _text(octets, place)
        kind, _, across, down = struct.unpack_from("<iiii", octets, place)
        if (kind, across, down) != (FLOAT, 1, 1):
            raise RendererError(f"{path}: expected 32-bit floats in channel {name}, found type {kind}")
        names.append(name)
        place += 16
    return names


def _text(octets: bytes, place: int) -> tuple[str, int]:
    end = octets.index(0, place)
    return octets[place:end].decode("latin-1"), end + 1
