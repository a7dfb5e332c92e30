"""Compiled search for sync markers at every bit of a stream."""

# numba wants numpy integers where annotations say int
# mypy: disable-error-code="return-value,arg-type,no-any-return"

import functools

import numpy as np

from kernels.compiled import njit
from tmtc.arrays import RecordArray

_HIGH, _LOW = 0x1ACF, 0xFC1D


@functools.cache
def tables() -> RecordArray:
    """Return (2, 65536) uint8: the number of bits in which each 16-bit word differs from each half of the marker."""
    words = np.arange(1 << 16, dtype=np.uint16)
    return np.stack([np.bitwise_count(words ^ np.uint16(half)) for half in (_HIGH, _LOW)])


@njit(nogil=True, ahead="u1[::1].copy(readonly=True), i8, i8, i8, u1[:, ::1], i8[::1]")
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
            wrong = np.int64(distance[0, here >> np.uint64(16)]) + np.int64(distance[1, here & np.uint64(0xFFFF)])
            if wrong <= tolerance or wrong >= 32 - tolerance:
                found[count] = bit
                count += 1
                if count == found.size:
                    return count, bit + 1
            bit += 1
    return count, bit


@functools.cache
def second_octets() -> RecordArray:
    """Return (256,) uint8: whether an octet can be the second one of an undamaged marker at some bit, or inverted."""
    result = np.zeros(256, dtype=np.uint8)
    marker = _HIGH << 16 | _LOW
    for shift in range(8):
        for word in (marker, marker ^ 0xFFFFFFFF):
            # of the 40 bits around a marker that begins `shift` bits later, the second octet lies in the marker
            result[(word << (8 - shift)) >> 24 & 0xFF] = 1
    return result


@njit(nogil=True, ahead="u1[::1].copy(readonly=True), i8, i8, u1[::1], i8[::1]")
def find_undamaged(
    octets: RecordArray, first: int, stop: int, second: RecordArray, found: RecordArray
) -> tuple[int, int]:
    """Find start bits of undamaged markers like `find_markers`; most octets cost one table look-up."""
    count = 0
    size = octets.size
    marker = np.uint64(0x1ACFFC1D)
    inverse = np.uint64(0xE53003E2)
    at = first >> 3
    end = (stop + 7) >> 3
    while at < end:
        if at + 1 < size and second[octets[at + 1]] == 0:
            at += 1
            continue
        word = np.uint64(0)
        for k in range(5):
            octet = octets[at + k] if at + k < size else np.uint8(0)
            word = (word << np.uint64(8)) | np.uint64(octet)
        for shift in range(8):
            here = (word >> np.uint64(8 - shift)) & np.uint64(0xFFFFFFFF)
            if here == marker or here == inverse:  # noqa: SIM109 (numba compares faster than it searches a tuple)
                bit = 8 * at + shift
                if first <= bit < stop:
                    found[count] = bit
                    count += 1
                    if count == found.size:
                        return count, bit + 1
        at += 1
    return count, stop
