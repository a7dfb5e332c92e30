"""Packets that were cut at the end of a run of frames, completed by frame count.

A packet that is cut leaves a fragment with its beginning, one with its end, and possibly fragments with whole frames
between. The channel counts of the frames, the length in the header and the checksum decide whether they belong
together, wherever the frames were received.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

from tmtc.crc import CRC_LENGTH, crc16
from tmtc.packets import IDLE_APID, PACKET_MAX_LENGTH, PRIMARY_HEADER_LENGTH
from tmtc.stream import PacketForm

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
    def fit(self) -> int:
        """Return the number of octets that the other fragments must have, or that these fill; -1 if unknown."""
        if not self.begins:
            return len(self.octets)
        length = packet_length(self.octets)
        return UNKNOWN if length == UNKNOWN else max(length - len(self.octets), 0)

    def precedes(self, other: Fragment) -> bool:
        """Return whether the next frame of the channel in the same recording is the first one of another fragment."""
        zone = self.channel[3] - self.channel[2]
        # within 256 frames, equal counts mean that no frame of the channel is missing
        near = self.last < other.first < self.last + COUNTS * zone
        return bool(self.stream) and self.stream == other.stream and near and self.next_count == other.count


Lookup = Callable[[Fragment, int], Iterable[Fragment]]
"""Returns the fragments before or behind a fragment by count, of which a beginning or an end has the given `fit`."""


def complete(
    fragment: Fragment, before: Lookup, behind: Lookup, form: PacketForm
) -> tuple[list[Fragment], bytes] | None:
    """Return the fragments and octets of the packet that a fragment belongs to; None if a part is missing.

    The fragments of packets without a checksum must adjoin in one recording.
    """
    for begin in _beginnings(fragment, before):
        for path in _paths(begin, behind):
            octets = b"".join(one.octets for one in path)
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
    waiting = [(fragment, 0)]
    for _ in range(MOST_TRIED):
        if not waiting:
            return
        one, held = waiting.pop()
        if one.begins:
            yield one
        elif (held := held + len(one.octets)) < PACKET_MAX_LENGTH:
            waiting += [(other, held) for other in before(one, held if fragment.ends else UNKNOWN)]


def _paths(begin: Fragment, behind: Lookup) -> Iterator[list[Fragment]]:
    """Yield sequences of fragments from the beginning of a packet to its end."""
    waiting = [[begin]]
    for _ in range(MOST_TRIED):
        if not waiting:
            return
        path = waiting.pop()
        octets = b"".join(one.octets for one in path)
        length = packet_length(octets)
        if path[-1].ends or len(octets) == length:  # it can end with a frame that nothing follows
            yield path
        elif len(octets) < PACKET_MAX_LENGTH and (length == UNKNOWN or len(octets) < length):
            fit = UNKNOWN if length == UNKNOWN else length - len(octets)
            waiting += [[*path, one] for one in behind(path[-1], fit) if one not in path]


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

    def among(known: list[Fragment], fit: int) -> list[Fragment]:
        whole = [
            one for one in known if one.begins == one.ends or UNKNOWN in (fit, one.fit) or one.fit == fit
        ]
        return [one for one in whole if one not in used]

    packets = []
    for one in fragments:
        if not one.begins or one in used:
            continue
        found = complete(
            one,
            lambda other, fit: among(lasts.get((other.channel, other.count), []), fit),
            lambda other, fit: among(firsts.get((other.channel, other.next_count), []), fit),
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
