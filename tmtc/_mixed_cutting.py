"""Compiled part of packet cutting where packets of some APIDs do not end with a checksum.

Such a packet is accepted by what follows it: the end of the octets, a packet with a right checksum, or another header
of such an APID or of an idle packet. Its content is not checked.
"""

# numba wants numpy integers where annotations say int
# mypy: disable-error-code="return-value,arg-type,no-any-return"

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from kernels.compiled import njit
from tmtc._cutting import GOOD, _crc, header_at, is_idle, length_at, search

Array = npt.NDArray[Any]


@njit(nogil=True)
def _is_unchecked(buffer: Array, p: int, unchecked: Array) -> bool:
    return unchecked[(np.int64(buffer[p]) & 0x07) << 8 | np.int64(buffer[p + 1])]


@njit(nogil=True)
def unchecked_length(buffer: Array, p: int, stop: int, packet_type: int, unchecked: Array) -> int:
    """Octets of the packet without a checksum whose header stands at `p`; 0 if there is none or it does not end."""
    length = header_at(buffer, p, stop, packet_type)
    if length == 0 or length > stop - p or is_idle(buffer, p) or not _is_unchecked(buffer, p, unchecked):
        return 0
    return length


@njit(nogil=True)
def follows(
    buffer: Array,
    e: int,
    stop: int,
    packet_type: int,
    unchecked: Array,
    tables: Array,
    open_end: bool,
) -> bool:
    """Return whether a packet can end at `e`; `open_end`: more octets will follow `stop`."""
    if e == stop:
        return not open_end
    if stop - e < 7:
        return not open_end and (buffer[e] >> 4) == packet_type
    claimed = header_at(buffer, e, stop, packet_type)
    if claimed == 0:
        return False
    if is_idle(buffer, e) or _is_unchecked(buffer, e, unchecked):
        return True
    if claimed > stop - e:
        return True
    return length_at(buffer, e, stop, packet_type) > 0 and _crc(buffer, e, e + claimed, tables) == 0


@njit(nogil=True)
def walk_mixed(
    buffer: Array, p: int, stop: int, packet_type: int, tables: Array, rows: Array, count: int,
    unchecked: Array, open_end: bool,
) -> tuple[int, int]:  # fmt: skip
    """As `_cutting.walk`, with packets without a checksum that are followed as they must."""
    while p < stop and count < rows.shape[0]:
        length = unchecked_length(buffer, p, stop, packet_type, unchecked)
        if length:
            if not follows(buffer, p + length, stop, packet_type, unchecked, tables, open_end):
                break
        else:
            length = length_at(buffer, p, stop, packet_type)
            if length == 0 or is_idle(buffer, p) or _crc(buffer, p, p + length, tables) != 0:
                break
        rows[count, 0] = GOOD
        rows[count, 1] = p
        p += length
        rows[count, 2] = p
        count += 1
    return p, count


@njit(nogil=True)
def search_mixed(
    buffer: Array, first: int, limit: int, stop: int, packet_type: int,
    prefix: Array, known: Array, tables: Array, powers: Array, unchecked: Array,
) -> int:  # fmt: skip
    """As `_cutting.search`; two packets without a checksum must follow each other before a place is believed."""
    checked = search(buffer, first, limit, stop, packet_type, prefix, known, tables, powers)
    for q in range(first, checked):
        length = unchecked_length(buffer, q, stop, packet_type, unchecked)
        if length == 0:
            continue
        e = q + length
        if e == stop:
            return q
        second = unchecked_length(buffer, e, stop, packet_type, unchecked)
        if second == 0:
            if follows(buffer, e, stop, packet_type, unchecked, tables, False):
                return q
        elif follows(buffer, e + second, stop, packet_type, unchecked, tables, False):
            return q
    return checked
