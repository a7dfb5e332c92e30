"""Thumbnails: the octets, and what is refused."""

import struct
import zlib

import numpy as np
import pytest

from tmtc.errors import ValueRefused
from tmtc.packets.thumbnails import HEADER, Thumbnail, pack_thumbnail, unpack_thumbnail


@pytest.mark.parametrize("shape", [(3, 5), (1, 1), (0, 0)])
def test_a_thumbnail_reads_back(shape: tuple[int, int]) -> None:
    levels = np.arange(shape[0] * shape[1], dtype=np.uint8).reshape(shape)
    octets = pack_thumbnail(Thumbnail(7, 2**40 + 1, levels))
    assert octets[:16] == struct.pack(">IQHH", 7, 2**40 + 1, *shape)
    found = unpack_thumbnail(octets)
    assert (found.frame_number, found.ticks) == (7, 2**40 + 1)
    np.testing.assert_array_equal(found.levels, levels)


@pytest.mark.parametrize(
    "octets",
    [
        b"",
        bytes(15),
        HEADER.pack(1, 2, 3, 4) + b"no zlib",
        HEADER.pack(1, 2, 3, 4) + zlib.compress(bytes(11)),
        HEADER.pack(1, 2, 3, 4) + zlib.compress(bytes(13)),
        HEADER.pack(1, 2, 3, 4) + zlib.compress(bytes(12))[:-5],
    ],
)
def test_what_is_no_thumbnail_is_refused(octets: bytes) -> None:
    with pytest.raises(ValueRefused, match="thumbnail"):
        unpack_thumbnail(octets)
