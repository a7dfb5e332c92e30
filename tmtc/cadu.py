"""Attached sync markers: where channel access data units (CADUs) stand in a stream of octets.

The synchroniser has three states, as flight practice asks: *search* for a marker, *check* that another
stands one period later, *lock* as long as markers keep standing there. In lock a single damaged marker is
passed over (fly-wheel); at two in a row the search begins anew, from just behind the last frame's marker,
so that octets lost or inserted by the link cost the frames they hit and no other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

OctetArray = npt.NDArray[np.uint8]
IntArray = npt.NDArray[np.int64]

ASM = bytes.fromhex("1ACFFC1D")
ASM_LENGTH = 4
DEFAULT_TOLERANCE = 3

_ASM_WORD = np.uint32(int.from_bytes(ASM, "big"))
_WINDOW = 1 << 16


@dataclass(frozen=True, slots=True, eq=False)
class CaduSync:
    """Starts of whole CADUs (n,), `period` octets each, and the wrong bits of each marker (n,).

    `truncated` holds the starts of those that lost octets, so that the next marker came too early.
    """

    offsets: IntArray
    marker_errors: IntArray
    truncated: IntArray
    period: int

    def head(self, count: int) -> CaduSync:
        """The first `count` CADUs."""
        return CaduSync(self.offsets[:count], self.marker_errors[:count], self.truncated[:0], self.period)


def find_period(octets: OctetArray, limit: int = 1 << 22) -> int:
    """Octets from one marker to the next, by the commonest distance of undamaged markers; 0 where there is
    no stream.

    A single marker at the very start stands for a stream of one CADU.
    """
    head = octets[:limit].tobytes()
    found = []
    at = head.find(ASM)
    while at >= 0:
        found.append(at)
        at = head.find(ASM, at + 1)
    if len(found) >= 2:
        distances, counts = np.unique(np.diff(found), return_counts=True)
        return int(distances[np.argmax(counts)])
    return octets.size if found == [0] else 0


def synchronise(octets: OctetArray, period: int, tolerance: int = DEFAULT_TOLERANCE) -> CaduSync:
    """CADUs of `period` octets in `octets`, markers with up to `tolerance` wrong bits accepted."""
    offsets: list[IntArray] = []
    errors: list[IntArray] = []
    last = octets.size - period  # last possible start of a whole CADU
    p = _search(octets, 0, period, tolerance)
    while p <= last:
        starts = np.arange(p, last + 1, period, dtype=np.int64)
        wrong = _marker_errors(octets, starts)
        bad = wrong > tolerance
        # lock ends at a damaged marker that is not followed by a good one
        lost = bad.copy()
        lost[:-1] &= bad[1:]
        if starts.size and bad[-1]:
            follower = starts[-1] + period
            lost[-1] = not (
                follower + ASM_LENGTH <= octets.size
                and _marker_errors(octets, np.array([follower]))[0] <= tolerance
            )
        count = int(np.argmax(lost)) if lost.any() else starts.size
        offsets.append(starts[:count])
        errors.append(wrong[:count])
        if count == starts.size:
            break
        expected = int(starts[count])
        p = _search(octets, expected - period + 1, period, tolerance)
        if p > last:
            # nothing better follows: the frame that should stand here is kept, its own checks will judge it
            offsets.append(starts[count : count + 1])
            errors.append(wrong[count : count + 1])
            break
    none = np.empty(0, dtype=np.int64)
    starts, wrong = np.concatenate([none, *offsets]), np.concatenate([none, *errors])
    # a frame that lost octets reaches into the next one
    whole = np.append(np.diff(starts) >= period, True)[: starts.size]
    return CaduSync(starts[whole], wrong[whole], starts[~whole], period)


def _search(octets: OctetArray, p: int, period: int, tolerance: int) -> int:
    """First position from `p` on with a marker, and with another one period later where the stream reaches so far."""
    end = octets.size - ASM_LENGTH + 1
    while p < end:
        window = np.arange(p, min(p + _WINDOW, end), dtype=np.int64)
        for at in window[_marker_errors(octets, window) <= tolerance].tolist():
            follower = at + period
            if follower >= end or _marker_errors(octets, np.array([follower]))[0] <= tolerance:
                return int(at)
        p += _WINDOW
    return octets.size


def _marker_errors(octets: OctetArray, starts: IntArray) -> IntArray:
    """Bits in which the four octets at `starts` differ from the marker."""
    word = octets[starts].astype(np.uint32)
    for k in range(1, ASM_LENGTH):
        word = word << np.uint32(8) | octets[starts + k]
    wrong: IntArray = np.bitwise_count(word ^ _ASM_WORD).astype(np.int64)
    return wrong
