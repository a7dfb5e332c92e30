"""Pure computation of the ingest: packets with implausible times, fragments, and accounting of a piece."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise

import numpy as np

from ground_service.telemetry.packets import NO_TIME
from lunar.arrays import IntArray, OctetArray
from lunar.constants import DAY_NS
from lunar.plausible import AGREEING_PACKETS, CLOCK_ERROR_S, SILENCE_S, SIMULATED_AHEAD_S, UNSET_CLOCK_S
from tmtc.link.frames import UplinkSeen
from tmtc.packets.pus import NO_TICKS, TICKS_PER_SECOND
from tmtc.packets.space_packets import (
    CRC_LENGTH,
    IDLE_APID,
    PACKET_MAX_LENGTH,
    PRIMARY_HEADER_LENGTH,
    SEQUENCE_COUNT_LIMIT,
    crc16,
)
from tmtc.packets.stream import PacketForm

LONGEST_STEP = round(CLOCK_ERROR_S * TICKS_PER_SECOND)
UNSET_TICKS = round(UNSET_CLOCK_S * TICKS_PER_SECOND)
LONGEST_SILENCE = round(SILENCE_S * TICKS_PER_SECOND)
SIMULATED_AHEAD = round(SIMULATED_AHEAD_S * TICKS_PER_SECOND)


def implausible_times(
    ticks: IntArray, received: IntArray | None, newest: int | None, latest: int | None
) -> dict[int, str]:
    """Return the packets whose on-board time is implausible, with the reason.

    Time goes on in stretches without a longer silence than `LONGEST_STEP`. One that begins later than that after all
    telemetry is believed if a station received it then, or by a clock of the mission, or because enough of its packets
    agree. Without other telemetry, two packets agree. A clock that shows the time since its epoch was not set.

    Parameters
    ----------
    ticks
        On-board time (n,), `NO_TICKS` where a packet has none.
    received
        On-board time (n,) at which an ideal clock would have shown the reception, `NO_TICKS` if unknown.
    newest
        Greatest on-board time of the archive; None if the archive has too little to compare with.
    latest
        Greatest on-board time that the mission clock allows; None if no clock but telemetry states it.
    """
    timed = np.flatnonzero(ticks != NO_TICKS)
    order = timed[np.argsort(ticks[timed], kind="stable")]
    if not order.size:
        return {}
    times = ticks[order]
    doubts: dict[int, str] = {}
    known = None if received is None else (received != NO_TICKS) & (ticks != NO_TICKS)
    agreed = np.zeros(len(ticks), dtype=np.bool_)
    if received is not None and known is not None:
        ahead = known & (ticks > received + LONGEST_STEP)
        agreed = known & (np.abs(ticks - received) <= LONGEST_STEP)
        if agreed.any():  # otherwise the clock of the station is wrong
            doubts = {
                int(k): f"{span_words(int(ticks[k] - received[k]))} after its reception" for k in np.flatnonzero(ahead)
            }
    reached = newest
    for stretch in np.split(order, np.flatnonzero(np.diff(times) > LONGEST_STEP) + 1):
        first, last = int(ticks[stretch[0]]), int(ticks[stretch[-1]])
        reason = None
        if agreed[stretch].any():
            pass
        elif reached is None:
            if len(stretch) == 1 and (latest is None or first > latest):
                reason = "not judged: no clock, reception or other packet states this time"
        elif first - reached > LONGEST_STEP:
            if latest is not None:
                reason = f"{span_words(last - latest)} after the mission time" if last > latest else None
            elif len(stretch) < AGREEING_PACKETS:
                few = f"{len(stretch)} of {AGREEING_PACKETS} packets agree"
                reason = f"{span_words(first - reached)} after all other telemetry, {few}"
            elif first - reached > LONGEST_SILENCE:
                reason = f"{span_words(first - reached)} after all other telemetry"
        if reason is None:
            is_firm = newest is not None or len(stretch) >= AGREEING_PACKETS
            reached = max(reached or last, last) if is_firm else reached
        else:
            doubts.update(dict.fromkeys(stretch.tolist(), reason))
    if reached is not None and reached > 2 * UNSET_TICKS and times[0] < UNSET_TICKS:
        doubts.update(dict.fromkeys(order[times < UNSET_TICKS].tolist(), "the clock was not set"))
    return doubts


def fits_between(count: int, before: int | None, after: int | None) -> bool:
    """Return whether a 14-bit count is plausible between those of the packets around it in time."""
    if before is None or after is None:
        return True
    return (count - before) % SEQUENCE_COUNT_LIMIT <= (after - before) % SEQUENCE_COUNT_LIMIT


def span_words(ticks: int) -> str:
    """Return a span of on-board time in days or hours."""
    seconds = ticks / TICKS_PER_SECOND
    return f"{seconds / 86_400:.1f} d" if seconds >= 86_400 else f"{seconds / 3600:.1f} h"


COUNTS = 256
UNKNOWN = -1

Channel = tuple[int, int, int, int]
"""Spacecraft, virtual channel, and start and end of the packet zone in its frames."""

MOST_TRIED = 256
"""Largest number of sequences of fragments that are tried for one packet."""


@dataclass(frozen=True, slots=True)
class Fragment:
    """Octets of a packet in consecutive frames of a channel.

    `begins`: the packet begins in the first frame. `ends`: it ends in the last frame. `count` is the channel count of
    the first frame, `next_count` that of the frame after the last one. `first` and `last` are the positions of these
    frames in the recording `stream`, which is empty for a recording without other pieces.
    """

    channel: Channel
    begins: bool
    ends: bool
    count: int
    next_count: int
    first: int
    last: int
    octets: bytes
    stream: str = ""

    @property
    def zone(self) -> int:
        """Return the octets of a whole frame."""
        return self.channel[3] - self.channel[2]

    @property
    def fit(self) -> int:
        """Return the number of octets that the other fragments must have, or that these fill; -1 if unknown."""
        if not self.begins:
            return len(self.octets)
        length = packet_length(self.octets)
        return UNKNOWN if length == UNKNOWN else max(length - len(self.octets), 0)

    def precedes(self, other: Fragment) -> bool:
        """Return whether the next frame of the channel in the same recording is the first one of another fragment."""
        # within 256 frames, equal counts mean that no frame of the channel is missing
        near = self.last < other.first < self.last + COUNTS * self.zone
        return bool(self.stream) and self.stream == other.stream and near and self.next_count == other.count


Lookup = Callable[[Fragment, Mapping[int, int]], Iterable[Fragment]]
"""Returns the fragments that reach to, or begin at, frames of the channel with these counts, and that fit (`fits`)."""


def fits(fragment: Fragment, octets: int) -> bool:
    """Return whether a beginning lacks, or an end has, a number of octets; others and unknown numbers always fit."""
    return fragment.begins == fragment.ends or UNKNOWN in (octets, fragment.fit) or fragment.fit == octets


def complete(
    fragment: Fragment, before: Lookup, behind: Lookup, form: PacketForm
) -> tuple[tuple[Fragment, ...], bytes] | None:
    """Return the fragments and octets of the packet that a fragment belongs to; None if a part is missing.

    Fragments of different recordings can share frames; those of packets without a checksum must adjoin in one.
    """
    for begin in _beginnings(fragment, before):
        for path, octets in _paths(begin, behind):
            if len(octets) != packet_length(octets):
                continue
            apid = int.from_bytes(octets[:2], "big") & 0x7FF
            lacks = form.lacks_checksum(apid)
            if (lacks or apid in form.unknown) and all(one.precedes(other) for one, other in pairwise(path)):
                return path, octets
            if lacks:
                continue
            if len(octets) > PRIMARY_HEADER_LENGTH + CRC_LENGTH and crc16(octets) == 0:
                return path, octets
    return None


def _beginnings(fragment: Fragment, before: Lookup) -> Iterator[Fragment]:
    """Yield the beginnings of packets that may lead to a fragment."""
    zone = fragment.zone
    waiting = [(fragment, len(fragment.octets))]
    for _ in range(MOST_TRIED):
        if not waiting:
            return
        one, held = waiting.pop()
        if one.begins:
            yield one
        elif held < PACKET_MAX_LENGTH:
            lacking = _counted(one.count, 1, (len(one.octets) - 1) // zone, held, -zone)
            for other in before(one, lacking if fragment.ends else dict.fromkeys(lacking, UNKNOWN)):
                new = len(other.octets) - (other.next_count - one.count) % COUNTS * zone
                if new > 0:
                    waiting.append((other, held + new))


def _paths(begin: Fragment, behind: Lookup) -> Iterator[tuple[tuple[Fragment, ...], bytes]]:
    """Yield sequences of fragments from the beginning of a packet to its end, and their octets."""
    zone = begin.zone
    waiting: list[tuple[tuple[Fragment, ...], bytes]] = [((begin,), begin.octets)]
    for _ in range(MOST_TRIED):
        if not waiting:
            return
        path, octets = waiting.pop()
        length, count = packet_length(octets), path[-1].next_count
        if path[-1].ends or len(octets) == length:  # it can end with a frame that nothing follows
            yield path, octets
        elif len(octets) < PACKET_MAX_LENGTH and (length == UNKNOWN or len(octets) < length):
            lacking = _counted(count, -1, (len(octets) - 1) // zone, length - len(octets), zone)
            for other in behind(path[-1], lacking if length != UNKNOWN else dict.fromkeys(lacking, UNKNOWN)):
                shared = (count - other.count) % COUNTS * zone
                if other not in path and octets[len(octets) - shared :] == other.octets[:shared]:
                    waiting.append(((*path, other), octets + other.octets[shared:]))


def _counted(count: int, step: int, shared: int, octets: int, zone: int) -> dict[int, int]:
    """Return the octets that others have, by the count at which they meet, if they share up to so many frames."""
    return {(count + step * k) % COUNTS: octets + k * zone for k in range(min(shared + 1, COUNTS))}


def join(
    fragments: Sequence[Fragment], form_of: Callable[[int], PacketForm]
) -> tuple[list[tuple[int, bytes]], list[Fragment]]:
    """Complete packets with fragments of one reading; return spacecraft and octets of each, and the other fragments."""
    firsts: dict[tuple[Channel, int], list[Fragment]] = {}
    lasts: dict[tuple[Channel, int], list[Fragment]] = {}
    for one in fragments:
        if not one.begins:
            firsts.setdefault((one.channel, one.count), []).append(one)
        if not one.ends:
            lasts.setdefault((one.channel, one.next_count), []).append(one)
    used: set[Fragment] = set()

    def among(
        known: dict[tuple[Channel, int], list[Fragment]], one: Fragment, counts: Mapping[int, int]
    ) -> list[Fragment]:
        there = {other: octets for count, octets in counts.items() for other in known.get((one.channel, count), ())}
        return [other for other, octets in there.items() if other not in used and fits(other, octets)]

    packets = []
    for one in fragments:
        if not one.begins or one in used:
            continue
        found = complete(one, partial(among, lasts), partial(among, firsts), form_of(one.channel[0]))
        if found is not None:
            used.update(found[0])
            packets.append((one.channel[0], found[1]))
    return packets, [one for one in fragments if one not in used]


def packet_length(octets: bytes) -> int:
    """Return the length of the telemetry packet that begins here; -1 without a full header of one."""
    if len(octets) < PRIMARY_HEADER_LENGTH or octets[0] >> 4 or is_idle(octets):
        return UNKNOWN
    return int.from_bytes(octets[4:6], "big") + PRIMARY_HEADER_LENGTH + 1


def is_idle(octets: bytes) -> bool:
    """Return whether an idle packet begins here."""
    return len(octets) >= 2 and int.from_bytes(octets[:2], "big") & 0x7FF == IDLE_APID


CDS_EPOCH_DAYS = 4383
"""Days from 1958-01-01 to 1970-01-01."""


@dataclass(frozen=True, slots=True)
class RecordFormat:
    """Octets of a station's record around each CADU; `time_code` None: the header has no reception time."""

    header_octets: int = 0
    trailer_octets: int = 0
    time_code: str | None = None
    time_offset: int = 0

    @property
    def octets(self) -> int:
        """Octets of header and trailer."""
        return self.header_octets + self.trailer_octets

    def times_utc_ns(self, stream: OctetArray, offsets: IntArray) -> IntArray:
        """Return the reception times (n,) of the CADUs at `offsets` (n,); `NO_TIME` without a header in the stream."""
        times = np.full(offsets.size, NO_TIME, dtype=np.int64)
        if self.time_code is None:
            return times
        at = offsets - self.header_octets + self.time_offset
        known = at >= 0
        at = at[known]
        octets = 6 if self.time_code == "cds" else 8
        value = np.zeros(at.size, dtype=np.int64)
        for k in range(octets):
            value = value << 8 | stream[at + k]
        if self.time_code == "cds":
            days, milliseconds = value >> 32, value & 0xFFFFFFFF
            value = (days - CDS_EPOCH_DAYS) * DAY_NS + milliseconds * 1_000_000
        times[known] = np.where(value < 0, NO_TIME, value)
        return times


NO_RECORD = RecordFormat()


@dataclass(slots=True)
class LinkContent:
    """Counts of what a piece of a recording has completed: frames, packets, link quality, octets.

    Attributes
    ----------
    frames_bad
        Frames that cannot be used, truncated ones included.
    frames_joined
        Frames of which other pieces have a part.
    wrong_bits, checked_bits
        Corrected bits, and all bits, of the codewords that could be corrected and of the markers of good frames.
    lock_losses
        Frames that do not follow the previous one at the usual distance.
    frames_inverted
        Frames received with the wrong polarity.
    octets_frames, octets_records
        Octets of the frames with their markers, and of the station's records around them.
    octets_used
        Octets of the piece itself in frames and records, or in packets without frames.
    octets_unused
        Octets of frames in no packet.
    octets_waiting
        Octets at the ends of the recording, as far as it is known, that may belong to an incomplete frame or packet.
    first_utc_ns, last_utc_ns
        First and last reception time of the station's records; None without.
    uplink
        Telecommand channels by spacecraft and number, as the frames show them.
    """

    packets: int = 0
    crc_errors: int = 0
    frames: int = 0
    frames_good: int = 0
    frames_bad: int = 0
    frames_joined: int = 0
    codewords: int = 0
    codewords_lost: int = 0
    symbols_corrected: int = 0
    wrong_bits: int = 0
    checked_bits: int = 0
    lock_losses: int = 0
    frames_inverted: int = 0
    octets_frames: int = 0
    octets_records: int = 0
    octets_used: int = 0
    octets_unused: int = 0
    octets_waiting: int = 0
    first_utc_ns: int | None = None
    last_utc_ns: int | None = None
    uplink: dict[tuple[int, int], UplinkSeen] = field(default_factory=dict)

    @property
    def bit_error_rate(self) -> float | None:
        """Estimated bit error rate of what could be corrected, which is a lower bound; None without such bits."""
        return self.wrong_bits / self.checked_bits if self.checked_bits else None

    def add_times(self, times_utc_ns: IntArray) -> None:
        """Include reception times (n,); `NO_TIME` is left out."""
        times_utc_ns = times_utc_ns[times_utc_ns != NO_TIME]
        if times_utc_ns.size:
            first, last = int(times_utc_ns.min()), int(times_utc_ns.max())
            self.first_utc_ns = first if self.first_utc_ns is None else min(self.first_utc_ns, first)
            self.last_utc_ns = last if self.last_utc_ns is None else max(self.last_utc_ns, last)
