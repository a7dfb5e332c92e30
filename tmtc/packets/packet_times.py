"""Times in the secondary headers of packets: CUC and CDS codes of any field size, many packets at once.

References
----------
CCSDS 301.0-B-4 sections 3.2 (CUC) and 3.3 (CDS).
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from tmtc.arrays import IntArray, Octets, as_octets

_SECONDS_LIMIT = 1 << 40
_DAYS_LIMIT = 100_000
"""Limits of what a code can state as elapsed; more would not fit 64-bit numbers of ticks or nanoseconds."""

_NS_PER_MILLISECOND = 1_000_000
_SUBMILLISECOND_NS = {0: (0, 1), 2: (1_000, 1), 4: (1, 1_000)}
"""Nanoseconds of the submillisecond unit as a fraction: microseconds in 2 octets, picoseconds in 4."""


@dataclass(frozen=True, slots=True)
class TimeCode:
    """Time code at a fixed place of a packet: `whole` octets of seconds (CUC) or of days (CDS).

    `fraction` octets follow: of a second (CUC), or below the millisecond (CDS: 0, 2 or 4). `offset` is that of the
    first octet of the code, which is the P-field if `p_field` is set.
    """

    code: Literal["cuc", "cds"]
    offset: int
    whole: int
    fraction: int
    p_field: bool = False

    @property
    def p_field_octets(self) -> int:
        """Octets of the P-field; 0 if the code has none."""
        extended = self.code == "cuc" and (self.whole > 4 or self.fraction > 3)
        return self.p_field * (2 if extended else 1)

    @property
    def end(self) -> int:
        """Offset of the octet behind the code."""
        milliseconds = 0 if self.code == "cuc" else 4
        return self.offset + self.p_field_octets + self.whole + milliseconds + self.fraction


def elapsed(
    buffer: Octets, offsets: IntArray, lengths: IntArray, code: TimeCode
) -> tuple[IntArray, IntArray, npt.NDArray[np.bool_]]:
    """Return what packets state as time since the epoch of their code.

    Parameters
    ----------
    offsets, lengths
        (n,) octets at which packets begin in `buffer`, and their lengths.

    Returns
    -------
    tuple
        CUC: seconds and units of 2^-16 s (n,); CDS: days and nanoseconds of the day (n,). Then whether a packet has a
        time (n,): its code lies in the packet, its P-field states the sizes, and its numbers are possible.
    """
    octets = as_octets(buffer)
    known = lengths >= code.end
    start = np.where(known, offsets, 0) + code.offset
    whole = np.zeros(len(offsets), dtype=np.int64)
    part = whole.copy()
    if not known.any():
        return whole, part, known
    rows = np.flatnonzero(known)
    at = start[rows]
    if code.p_field:
        for place, (mask, value) in enumerate(_p_field(code)):
            known[rows] &= octets[at + place] & mask == value
        at = at + code.p_field_octets
    whole[rows] = _number(octets, at, code.whole)
    at = at + code.whole
    if code.code == "cuc":
        part[rows] = _number(octets, at, min(code.fraction, 2)) << 8 * (2 - min(code.fraction, 2))
        known &= whole < _SECONDS_LIMIT
        return whole, part, known
    milliseconds = _number(octets, at, 4)
    unit, divisor = _SUBMILLISECOND_NS[code.fraction]
    fine = _number(octets, at + 4, code.fraction) * unit // divisor
    part[rows] = milliseconds * _NS_PER_MILLISECOND + fine
    possible = (milliseconds < 86_401_000) & (fine < _NS_PER_MILLISECOND)  # a leap second included
    known[rows] &= possible & (whole[rows] < _DAYS_LIMIT)
    return whole, part, known


def _p_field(code: TimeCode) -> list[tuple[int, int]]:
    """Return mask and value of the octets of the P-field that states the sizes of a code."""
    if code.code == "cds":
        sizes = (code.whole == 3) << 2 | (code.fraction // 2)
        return [(0xF7, 0x40 | sizes)]  # the epoch is not a size
    first = (min(code.whole, 4) - 1) << 2 | min(code.fraction, 3)
    if code.p_field_octets == 1:
        return [(0x8F, first)]
    return [
        (0x8F, 0x80 | first),
        (0xFC, (code.whole - min(code.whole, 4)) << 5 | (code.fraction - min(code.fraction, 3)) << 2),
    ]


def _number(octets: npt.NDArray[np.uint8], at: IntArray, size: int) -> IntArray:
    value = np.zeros(len(at), dtype=np.int64)
    for place in range(size):
        value = value << 8 | octets[at + place]
    return value
