"""Compiled search for sync markers at every bit of a stream."""

# numba wants numpy integers where annotations say int
# mypy: disable-error-code="return-value,arg-type,no-any-return"

from __future__ import annotations

import functools

import numpy as np

from tmtc._compile import njit
from tmtc.arrays import RecordArray

_HIGH, _LOW = 0x1ACF, 0xFC1D


@functools.cache
def tables() -> RecordArray:
    """Return (2, 65536) uint8: the number of bits in which each 16-bit word differs from each half of the marker."""
    words = np.arange(1 << 16, dtype=np.uint16)
    return np.stack([np.bitwise_count(words ^ np.uint16(half)) for half in (_HIGH, _LOW)])


@njit
def find_markers(
    octets: RecordArray, first: int, stop: int, tolerance: int, distance: RecordArray, found: RecordArray
) -> tuple[int, int]:
    """Find start bits in [first, stop) of markers with at most `tolerance` wrong bits; return (count, next bit).

    The start bits are written to `found`; the search ends when it is full. 32 bits must follow every start bit.
    """
    count = 0
    bit = first
    size = octets.size
    while bit < stop:
        at = bit >> 3
        word = np.uint64(0)
        for k in range(5):
            octet = octets[at + k] if at + k < size else np.uint8(0)
            word = (word << np.uint64(8)) | np.uint64(octet)
        for shift in range(bit & 7, 8):
            if bit >= stop:
                break
            here = (word >> np.uint64(8 - shift)) & np.uint64(0xFFFFFFFF)
            wrong = np.int64(distance[0, here >> np.uint64(16)]) + np.int64(
                distance[1, here & np.uint64(0xFFFF)]
            )
            if wrong <= tolerance or wrong >= 32 - tolerance:
                found[count] = bit
                count += 1
                if count == found.size:
                    return count, bit + 1
            bit += 1
    return count, bit
