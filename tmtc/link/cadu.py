"""Attached sync markers: bit-level search for channel access data units (CADUs) in a stream of octets.

The synchroniser has the three usual states: *search* for a marker, *check* that another marker follows one period
later, *lock* while markers follow at that distance. In lock a single damaged marker is accepted (fly-wheel), and any
number of damaged markers while the frames behind them have a valid code or checksum; such frames are also followed
back from the first marker found. Otherwise the search restarts immediately after the marker of the last frame, so that
bits lost or inserted by the link affect only the frames in which they occur. If the next marker is a whole number of
periods later, the frames between are kept as well. A frame with a damaged marker has the polarity of its neighbours.

Markers are searched at every bit, upright and inverted (a receiver may lose bits and may lock with the wrong
polarity). A station may insert octets between CADUs, as a fixed header or a varying gap. Therefore, the distance of the
last two frames is tried as well as the period, and an isolated frame is accepted when its marker has at most one wrong
bit or when its code or checksum is valid. Where several places are possible, the one with a valid code or checksum is
taken.

References
----------
CCSDS 131.0-B section 9 (attached sync marker); CCSDS 130.1-G section 9 (frame synchronisation).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from tmtc.arrays import BoolArray, IntArray, OctetArray

ASM = bytes.fromhex("1ACFFC1D")
ASM_LENGTH = 4
DEFAULT_TOLERANCE = 3
"""Accepted number of wrong bits in a marker. Random data give one false marker in 4e5 bits, which the check removes."""

MARKER_BITS = 32
LONE_TOLERANCE = 1
"""Accepted number of wrong bits in the marker of an isolated frame without a valid code or checksum.

Random data give one false marker in 6e7 bits."""

MOST_BRIDGED = 64
"""Largest number of frames that the fly-wheel fills in between two periods of lock."""

LED_BACK = 8
"""Number of frames that are tried at once before a marker."""

_ASM_WORD = np.uint64(int.from_bytes(ASM, "big"))
_SCAN_BITS = 1 << 19
_CANDIDATES = 4096
SETTLED = 4
"""Number of frames in lock after which a damaged marker is accepted without a search."""

Verify = Callable[["CaduSync"], BoolArray]
"""Returns whether each CADU holds a frame with a valid code or checksum."""


@dataclass(frozen=True, slots=True, eq=False)
class CaduSync:
    """Whole CADUs of a stream in order: start bit (n,), polarity (n,) and wrong bits of the marker (n,).

    `period` is the length of a CADU in octets. `truncated` holds the start octets of CADUs that lost bits: the next
    marker followed too early.
    """

    start_bits: IntArray
    inverted: BoolArray
    marker_errors: IntArray
    truncated: IntArray
    period: int

    @property
    def offsets(self) -> IntArray:
        """Octet (n,) in which each CADU begins."""
        return self.start_bits >> 3

    def take(self, rows: IntArray) -> CaduSync:
        """Return the CADUs of these rows."""
        return CaduSync(
            self.start_bits[rows], self.inverted[rows], self.marker_errors[rows], self.truncated[:0], self.period
        )


def cadu_octets(octets: OctetArray, sync: CaduSync) -> OctetArray:
    """Return the CADUs (n, period), markers included, aligned to octets and upright."""
    n = sync.start_bits.size
    result = np.empty((n, sync.period), dtype=np.uint8)
    if not n:
        return result
    shifts = sync.start_bits & 7
    windows = np.lib.stride_tricks.sliding_window_view(octets, sync.period)
    for shift in np.unique(shifts).tolist():
        rows = np.flatnonzero(shifts == shift)
        first = sync.start_bits[rows] >> 3
        result[rows] = windows[first]
        if shift:
            # the bits of an octet that begins `shift` bits later
            result[rows] <<= shift
            result[rows, :-1] |= windows[first, 1:] >> (8 - shift)
            result[rows, -1] |= octets[first + sync.period] >> (8 - shift)
    result[sync.inverted] ^= 0xFF
    return result


def undamaged_candidates(octets: OctetArray) -> Iterator[IntArray]:
    """Yield the start bits of all markers without a wrong bit, upright or inverted, in order."""
    from tmtc.link import _markers

    readable = octets.view()
    readable.flags.writeable = False
    first, stop = 0, 8 * octets.size - MARKER_BITS + 1
    found = np.empty(_CANDIDATES, dtype=np.int64)
    while first < stop:
        count, first = _markers.find_undamaged(readable, first, stop, _markers.second_octets(), found)
        if count:
            yield found[:count].copy()


def are_inverted(octets: OctetArray, start_bits: IntArray) -> BoolArray:
    """Return whether the marker at each start bit (n,) is inverted."""
    return _marker_errors(octets, start_bits)[1]


def synchronise(
    octets: OctetArray,
    period: int,
    tolerance: int = DEFAULT_TOLERANCE,
    verify: Verify | None = None,
    record_octets: int = 0,
) -> CaduSync:
    """Return the CADUs of `period` octets in `octets`; markers with up to `tolerance` wrong bits are accepted.

    Parameters
    ----------
    verify
        Returns which CADUs have a valid code or checksum; isolated frames are accepted by it.
    record_octets
        Octets that the station inserts between two CADUs: the header and trailer of its records.
    """
    return _Synchroniser(octets, period, tolerance, verify, 8 * (period + record_octets)).run()


@dataclass(slots=True)
class _Synchroniser:
    """One pass over a stream."""

    octets: OctetArray
    period: int
    tolerance: int
    verify: Verify | None
    usual: int
    starts: list[IntArray] = field(default_factory=list)

    def run(self) -> CaduSync:
        """Return the CADUs of the stream."""
        length = 8 * self.period
        last = 8 * self.octets.size - length
        spacing, end = self.usual, 0
        position = self._search(0, 0, (spacing,))
        while position is not None and position <= last:
            count = self._in_lock(position, spacing)
            if count == 1 and spacing != self.usual:
                spacing = self.usual
                count = self._in_lock(position, spacing)
            before = self._led_back(position, spacing, end)
            self.starts.append(position + spacing * np.arange(-before, count, dtype=np.int64))
            final = position + spacing * (count - 1)
            expected = final + spacing
            end = final + length
            if expected > last + (spacing - length):
                break
            found = self._search(final + 1, end, (spacing, self.usual, length))
            if found is None or found > last:
                # no other marker follows: keep the frame expected here; its code or checksum decides whether it is
                # valid
                if expected <= last and count > 1:
                    self.starts.append(np.array([expected], dtype=np.int64))
                break
            if found > expected and (found - expected) % spacing == 0:
                missing = (found - expected) // spacing
                if missing <= MOST_BRIDGED and count > 1:
                    self.starts.append(expected + spacing * np.arange(missing, dtype=np.int64))
                    end = found
            else:
                distance = found - final
                spacing = distance if length <= distance < 2 * length else self.usual
            position = found
        return self._result()

    def _result(self) -> CaduSync:
        starts = np.concatenate([np.empty(0, dtype=np.int64), *self.starts])
        wrong, inverted = _marker_errors(self.octets, starts)
        damaged = np.flatnonzero(wrong > self.tolerance)
        sound = np.flatnonzero(wrong <= self.tolerance)
        turns = np.diff(inverted[sound])
        alone = sound[1:-1][turns[1:] & turns[:-1]]  # nearly all bits of a marker are wrong, or really inverted
        alone = alone[self._are_valid(starts[alone], ~inverted[alone])]
        damaged, sound = np.union1d(damaged, alone), np.setdiff1d(sound, alone)
        if damaged.size and sound.size:
            place = np.searchsorted(sound, damaged)
            polarity = inverted[sound[np.maximum(place - 1, 0)]]
            later = inverted[sound[np.minimum(place, sound.size - 1)]]
            doubtful = np.flatnonzero(polarity != later)
            if doubtful.size and self.verify is not None:
                valid = self._are_valid(starts[damaged[doubtful]], polarity[doubtful])
                polarity[doubtful[~valid]] ^= True
            wrong[damaged] = np.where(inverted[damaged] == polarity, wrong[damaged], MARKER_BITS - wrong[damaged])
            inverted[damaged] = polarity
        # a frame that lost bits reaches into the next one
        whole = np.append(np.diff(starts) >= 8 * self.period, True)[: starts.size]
        return CaduSync(starts[whole], inverted[whole], wrong[whole], starts[~whole] >> 3, self.period)

    def _in_lock(self, position: int, spacing: int) -> int:
        """Return the frames from `position` until two consecutive ones are lost; at least one."""
        last = 8 * self.octets.size - 8 * self.period
        count, block = 0, 4
        polarity = are_inverted(self.octets, np.array([position]))[0]
        while True:
            starts = position + spacing * np.arange(count, count + block, dtype=np.int64)
            starts = starts[starts <= last]
            if not starts.size:
                return max(count, 1)
            stands, polarity = self._stand(starts, polarity)
            follower = int(starts[-1]) + spacing
            is_followed = follower + MARKER_BITS <= 8 * self.octets.size and bool(
                self._stand(np.array([follower]), polarity)[0][0]
            )
            # a distance that occurred by chance may fit the frame after next
            settled = count + np.arange(starts.size) >= SETTLED
            lost = ~stands & (~np.append(stands[1:], is_followed) | ~settled)
            if lost.any():
                return max(count + int(np.argmax(lost)), 1)
            count += starts.size
            if starts.size < block:
                return count
            block = min(4 * block, 4096)

    def _led_back(self, position: int, spacing: int, end: int) -> int:
        """Return the number of valid frames with damaged markers that end at `position` and begin at or after `end`."""
        polarity = are_inverted(self.octets, np.array([position]))[0]
        count = 0
        while self.verify is not None:
            starts = position - spacing * np.arange(count + 1, count + 1 + LED_BACK, dtype=np.int64)
            starts = starts[starts >= end]
            valid = self._are_valid(starts, np.full(starts.size, polarity))
            if not valid.all() or starts.size < LED_BACK:
                return count + int(np.argmin(np.append(valid, False)))
            count += starts.size
        return 0

    def _stand(self, starts: IntArray, polarity: np.bool_) -> tuple[BoolArray, np.bool_]:
        """Return where a frame stands, by its marker, else by its code or checksum; and the polarity of the last one.

        `polarity` is that of the frame before; a damaged marker does not change it.
        """
        wrong, inverted = _marker_errors(self.octets, starts)
        stands = wrong <= self.tolerance
        if stands.all():
            return stands, inverted[-1]
        sound = np.flatnonzero(stands)
        place = np.searchsorted(sound, np.arange(starts.size), side="right")
        inverted = np.append(polarity, inverted[sound])[place]
        doubtful = np.flatnonzero(~stands & (starts + 8 * self.period <= 8 * self.octets.size))
        stands[doubtful] = self._are_valid(starts[doubtful], inverted[doubtful])
        return stands, inverted[-1]

    def _search(self, first: int, free: int, distances: tuple[int, ...]) -> int | None:
        """Return the first bit from `first` on at which a CADU probably begins; None if there is none.

        A valid code or checksum decides. Markers occur by chance as well, at the end of the stream, where no other can
        follow, and in the headers of records, which repeat from CADU to CADU. Within the length of a CADU, one with a
        valid code or checksum is therefore preferred to one that another marker follows, and this to an isolated one.

        `free`: end of the previous frame; isolated markers are accepted from this bit on.
        """
        length = 8 * self.period
        total = 8 * self.octets.size
        followed, cut_off = _Best(), _Best()
        lone: int | None = None
        for candidates in _candidates(self.octets, first, self.tolerance, 2 * length):
            wrong, inverted = _marker_errors(self.octets, candidates)
            has_follower, is_cut_off = self._followers(candidates, inverted, distances)
            for k in range(candidates.size):
                at = int(candidates[k])
                begun = lone if followed.first is None else followed.first
                if begun is not None and at >= begun + length:
                    return lone if followed.at is None else followed.at
                if at + length > total:
                    continue
                if self._are_valid(candidates[k : k + 1], inverted[k : k + 1])[0]:
                    return at
                if has_follower[k]:
                    followed.offer(at, int(wrong[k]))
                elif lone is None and wrong[k] <= LONE_TOLERANCE and at >= free:
                    lone = at
                if is_cut_off[k] and (self.verify is None or at >= free):
                    cut_off.offer(at, int(wrong[k]))
        if followed.at is not None:
            return followed.at
        return cut_off.at if lone is None else lone

    def _are_valid(self, start_bits: IntArray, inverted: BoolArray) -> BoolArray:
        """Return whether the CADU at each start bit (n,) has a valid code or checksum; False if it has neither."""
        if self.verify is None or not start_bits.size:
            return np.zeros(start_bits.size, dtype=np.bool_)
        unknown = np.zeros(start_bits.size, dtype=np.int64)
        return self.verify(CaduSync(start_bits, inverted, unknown, start_bits[:0], self.period))

    def _followers(
        self, candidates: IntArray, inverted: BoolArray, distances: tuple[int, ...]
    ) -> tuple[BoolArray, BoolArray]:
        """Return where a marker of the same polarity follows at one of `distances`, and where the stream ends first."""
        stands = np.zeros(candidates.size, dtype=np.bool_)
        cut_off = np.zeros(candidates.size, dtype=np.bool_)
        for distance in distances:
            follower = candidates + distance
            inside = follower + MARKER_BITS <= 8 * self.octets.size
            cut_off |= ~inside
            if inside.any():
                wrong, turned = _marker_errors(self.octets, follower[inside])
                stands[inside] |= (wrong <= self.tolerance) & (turned == inverted[inside])
        return stands, cut_off


@dataclass(slots=True)
class _Best:
    """The start bit with the fewest wrong bits among those offered, the first of equals; `first`: the first offered."""

    first: int | None = None
    at: int | None = None
    wrong: int = MARKER_BITS

    def offer(self, at: int, wrong: int) -> None:
        if self.first is None:
            self.first = at
        if wrong < self.wrong:
            self.at, self.wrong = at, wrong


def _candidates(octets: OctetArray, first: int, tolerance: int, stretch: int) -> Iterator[IntArray]:
    """Yield start bits of markers from bit `first` on, in order, in arrays of limited size.

    `stretch` bits are searched before the first array is yielded, and more before each later array.
    """
    from tmtc.link import _markers

    readable = octets.view()
    readable.flags.writeable = False
    stop = 8 * octets.size - MARKER_BITS + 1
    found = np.empty(_CANDIDATES, dtype=np.int64)
    while first < stop:
        until = min(first + stretch, stop)
        stretch = min(2 * stretch, _SCAN_BITS)
        count, first = _markers.find_markers(readable, first, until, tolerance, _markers.tables(), found)
        if count:
            yield found[:count].copy()


def _marker_errors(octets: OctetArray, start_bits: IntArray) -> tuple[IntArray, BoolArray]:
    """Return the number of wrong bits of the marker at each start bit, and whether the marker is inverted."""
    first, shift = start_bits >> 3, (start_bits & 7).astype(np.uint64)
    word = octets[first].astype(np.uint64)
    for k in range(1, ASM_LENGTH):
        word = word << np.uint64(8) | octets[first + k]
    # a fifth octet is needed only by a shifted marker; none follows an aligned marker at the end of the stream
    fifth = octets[np.minimum(first + ASM_LENGTH, octets.size - 1)]
    word = (word << np.uint64(8) | fifth) >> (np.uint64(8) - shift) & np.uint64(0xFFFFFFFF)
    wrong: IntArray = np.bitwise_count(word ^ _ASM_WORD).astype(np.int64)
    inverted = wrong > MARKER_BITS // 2
    return np.where(inverted, MARKER_BITS - wrong, wrong), inverted
