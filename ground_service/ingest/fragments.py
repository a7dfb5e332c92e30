"""Packets that were cut at the end of a run of frames, completed by frame count.

A packet that is cut leaves a fragment with its beginning, one with its end, and possibly fragments with whole frames
between. The channel counts of the frames, the length in the header and the checksum decide whether they belong
together, wherever the frames were received.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

from tmtc.packets.crc import CRC_LENGTH, crc16
from tmtc.packets.space_packets import IDLE_APID, PACKET_MAX_LENGTH, PRIMARY_HEADER_LENGTH
from tmtc.packets.stream import PacketForm

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
        there = {
            other: octets for count, octets in counts.items() for other in known.get((one.channel, count), ())
        }
        return [other for other, octets in there.items() if other not in used and fits(other, octets)]

    packets = []
    for one in fragments:
        if not one.begins or one in used:
            continue
        found = complete(
            one,
            partial(among, lasts),
            partial(among, firsts),
            form_of(one.channel[0]),
        )
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
