"""Reader of a downlink in windows: packets are returned when complete, every octet is accounted for.

Windows of a CADU stream do not overlap: an incomplete CADU or packet at the end of a window is kept for the next.
Incomplete units at the ends of the stream are returned as edges, to be joined with those of other files.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ground_service.ingest.edges import CLOSER, MIDDLE, OPENER, UNKNOWN, Edge, packet_octets_missing
from ground_service.ingest.frames import (
    COUNTS,
    ChannelEdge,
    ChannelReader,
    FrameBlock,
    control_words,
    frames_of,
    is_checked,
    read_frames,
)
from ground_service.ingest.packets import PacketBatch, batch_of_cut
from lunar.arrays import IntArray, OctetArray
from tmtc import cadu
from tmtc.cadu import ASM, ASM_LENGTH
from tmtc.clcw import UplinkSeen, uplink_seen
from tmtc.dictionary import DICTIONARY
from tmtc.downlink import decode, proof_of
from tmtc.errors import LinkFormatError
from tmtc.frames import FRAME_HEADER_LENGTH, frame_headers
from tmtc.link import LinkSettings
from tmtc.packets import PACKET_MAX_LENGTH, PRIMARY_HEADER_LENGTH
from tmtc.randomiser import randomise
from tmtc.schema import Dictionary, as_octets
from tmtc.stream import cut_packets

WINDOW_OCTETS = 2 << 20
"""Octets decoded and stored at a time: large enough to spread the cost of a transaction, small against memory:
decoding and storing take about ten times as much."""

PROBE_OCTETS = 256 << 10
"""Number of octets used to determine the link settings; the whole window if the stream begins with noise."""

CADU_MAX_OCTETS = 2048 + 2 * 16 * 8 + ASM_LENGTH
"""Length of the longest CADU of the known link settings."""

FOREIGN_FRAMES = 2
"""Number of frames from which a spacecraft is accepted in a stream of frames without code or checksum."""

_CONTEXT_CADUS = 6
"""Number of CADUs of one window used to synchronise the next: enough for a stable lock."""

_LED_BACK = 64
"""Number of CADUs tried before the first marker."""

_REGULAR_FRAMES = 3
"""Number of equally spaced frames without code or checksum needed to determine their link."""

_CERTAIN_PERIODS = 8
"""Number of equal marker distances that exclude chance: an unknown coding is then an error."""


@dataclass(frozen=True, slots=True)
class Link:
    """Form of a downlink: CADUs with link settings, or bare packets (None)."""

    settings: LinkSettings | None


BARE = Link(None)


@dataclass(slots=True)
class LinkAccounting:
    """What was met on the way so far."""

    octets: int = 0
    packets: int = 0
    crc_errors: int = 0
    octets_skipped: int = 0
    frames: int = 0
    frames_bad: int = 0
    symbols_corrected: int = 0
    uplink: dict[tuple[int, int], UplinkSeen] = field(default_factory=dict)
    """Telecommand channels by spacecraft and number, as the frames show them."""


class DownlinkReader:
    """Reader of one stream of CADUs or bare space packets, distinguished by content.

    After the last batch, `link` is the form of the stream (None: unreadable), `edges` holds the fragments at its ends,
    and `take_channel_edges` returns the fragments in its channels.

    Parameters
    ----------
    spacecraft_id
        Only frames of this spacecraft are used; None: those of every spacecraft in the stream. Bare packets carry no
        spacecraft id.
    known
        Links that are tried before the settings are determined from the stream.
    """

    def __init__(
        self,
        spacecraft_id: int | None = None,
        dictionary: Dictionary = DICTIONARY,
        window_octets: int = WINDOW_OCTETS,
        known: Sequence[Link] = (),
    ) -> None:
        self.accounting = LinkAccounting()
        self.link: Link | None = None
        self.edges: list[Edge] = []
        self._spacecraft_id = spacecraft_id
        self._dictionary = dictionary
        self._window_octets = window_octets
        self._known = known
        self._channels = ChannelReader(dictionary)
        self._last_words: dict[int, NDArray[np.uint32]] = {}
        self._believed: set[int] = set()
        self._held: OctetArray = np.empty(0, dtype=np.uint8)
        self._context = 0
        self._position = 0
        self._located = False

    def take_channel_edges(self) -> list[ChannelEdge]:
        """Return the fragments in the channels since the last call."""
        edges, self._channels.edges = self._channels.edges, []
        return edges

    def batches(self, blocks: Iterable[bytes]) -> Iterator[PacketBatch]:
        """The packets of the stream, in batches.

        Raises
        ------
        LinkFormatError
            If frames stand in the stream whose coding is not known.
        """
        rest = b""
        for block, final in _last_marked(_rebuffered(blocks, self._window_octets)):
            self.accounting.octets += len(block)
            window = rest + block
            rest = b""
            if self.link is None:
                self.link = self._link_of(window)
            if self.link is None:
                rest = window if final else window[-2 * CADU_MAX_OCTETS :]
                self.accounting.octets_skipped += len(window) - (0 if final else len(rest))
                self._position += len(window) - len(rest)
            elif self.link.settings is None:
                rest, batch = self._packets(window, final)
                yield batch
            else:
                yield from self._frames(as_octets(window), self.link.settings, final)
        if self.link is not None and self.link.settings is not None:
            self._channels.close()
            self._count_channels()
        elif self.link is None and rest:
            self.edges = fragment_edges(rest, None)

    def _link_of(self, window: bytes) -> Link | None:
        """Return the link of a stream that begins with these octets; None if it cannot be determined yet."""
        for link in self._known:
            if link.settings is not None and _good_frames(window, link.settings):
                return link
        found = proposed_link(window, self._dictionary)
        if found is None and BARE in self._known and np.any(cut_packets(window).crc_ok):
            return BARE
        return found

    def _packets(self, window: bytes, final: bool) -> tuple[bytes, PacketBatch]:
        """Return the remaining octets and the packets of a window of bare packets."""
        cut = cut_packets(window, final=final)
        if not self._located and (len(cut) or final):
            self._located = True
            head = int(cut.skipped[0, 1]) if len(cut.skipped) and cut.skipped[0, 0] == 0 else 0
            if 0 < head <= PACKET_MAX_LENGTH and self._position == 0:
                self.edges.append(Edge(CLOSER, UNKNOWN, UNKNOWN, window[:head], 0))
        if final and len(cut.skipped) and cut.skipped[-1, 1] == len(window):
            start = int(cut.skipped[-1, 0])
            if 0 < len(window) - start <= PACKET_MAX_LENGTH and (start or self._position):
                self.edges.append(Edge(OPENER, UNKNOWN, UNKNOWN, window[start:], self._position + start))
        self._position += cut.consumed
        self.accounting.octets_skipped += cut.octets_skipped
        self.accounting.packets += int(np.count_nonzero(cut.crc_ok))
        self.accounting.crc_errors += cut.crc_errors
        rest = b"" if final else bytes(memoryview(window)[cut.consumed :])
        return rest, batch_of_cut(window, cut, self._dictionary, self._spacecraft_id)

    def _frames(self, window: OctetArray, settings: LinkSettings, final: bool) -> Iterator[PacketBatch]:
        """Yield the batches of every spacecraft in a window."""
        length = settings.cadu_length
        stream = np.concatenate((self._held, window))
        base, context = self._position - self._held.size, self._context
        sync = cadu.synchronise(stream, length, verify=proof_of(stream, settings))
        truncated = int(np.count_nonzero(sync.truncated >= context))
        sync = sync.take(np.flatnonzero(sync.offsets >= context))
        offsets, cadus = sync.offsets, cadu.cadu_octets(stream, sync)
        if not self._located and offsets.size and not sync.start_bits[0] & 7:
            before = _led_back(stream, int(offsets[0]), settings)
            offsets = np.concatenate((before, offsets))
            cadus = np.concatenate((_cadus_at(stream, before, length), cadus))
        block = frames_of(cadus, offsets, settings)
        first_found = not self._located and offsets.size > 0
        own = 0
        for spacecraft in self._wanted(block):
            own += int(np.count_nonzero(block.of(spacecraft)))
            self._uplink(spacecraft, control_words(block, spacecraft))
            yield self._channels.read(block, spacecraft)
        accounting = self.accounting
        accounting.frames += offsets.size
        accounting.frames_bad += offsets.size - own + truncated
        accounting.symbols_corrected += int(block.corrected.sum())
        end = int(offsets[-1]) + length if offsets.size else context
        if first_found:
            self._located = True
            self._head_edge(stream, block, base)
        if final:
            self._tail_edge(stream, block, end, base)
            accounting.octets_skipped += int(stream.size - context - offsets.size * length)
            return
        # keep the last CADUs, to synchronise the next window, and the incomplete one
        kept_from = max(end - _CONTEXT_CADUS * length, 0) if offsets.size or context else 0
        if stream.size - end > 2 * length:
            kept_from = end = stream.size - 2 * length
        accounting.octets_skipped += int(end - context - offsets.size * length)
        self._held, self._context = stream[kept_from:].copy(), end - kept_from
        self._position = base + stream.size

    def _wanted(self, block: FrameBlock) -> list[int]:
        """Return the spacecraft whose frames are used."""
        found = block.spacecraft()
        if self._spacecraft_id is not None:
            return [one for one in found if one == self._spacecraft_id]
        if is_checked(block.settings):
            return found
        for position, one in enumerate(found):
            enough = int(np.count_nonzero(block.of(one))) >= FOREIGN_FRAMES
            if enough or (position == 0 and not self._believed):
                self._believed.add(one)
        return [one for one in found if one in self._believed]

    def _uplink(self, spacecraft: int, words: NDArray[np.uint32]) -> None:
        last = self._last_words.get(spacecraft, np.empty(0, dtype=np.uint32))
        channels = self.accounting.uplink
        for words_now, sign in ((np.concatenate((last, words)), 1), (last, -1)):
            for seen in uplink_seen(words_now):
                key = (spacecraft, seen.virtual_channel)
                channels[key] = channels[key].followed_by(seen, sign) if key in channels else seen
        both = np.concatenate((last, words))
        _, newest = np.unique((both >> np.uint32(18) & np.uint32(0x3F))[::-1], return_index=True)
        self._last_words[spacecraft] = both[::-1][np.sort(newest)][::-1]

    def _head_edge(self, stream: OctetArray, block: FrameBlock, base: int) -> None:
        """Add the octets before the first CADU, the end of a CADU that began before the stream, to the edges."""
        loose = int(block.offsets[0]) % block.settings.cadu_length
        if base or self._context or not loose:
            return
        count = UNKNOWN
        if len(block.spacecraft()) == 1:
            first = int(np.flatnonzero(block.good)[0])
            away, odd = divmod(int(block.offsets[first]) - loose, block.settings.cadu_length)
            count = UNKNOWN if odd else (int(block.header.master_count[first]) - 1 - away) % COUNTS
        self.edges.append(Edge(CLOSER, count, UNKNOWN, stream[:loose].tobytes(), 0))

    def _tail_edge(self, stream: OctetArray, block: FrameBlock, end: int, base: int) -> None:
        """Add the octets after the last CADU, the start of a CADU that continues after the stream, to the edges."""
        settings = block.settings
        if 0 < stream.size - end < settings.cadu_length and (self._located or block.offsets.size):
            count = UNKNOWN
            if block.good.any() and len(block.spacecraft()) == 1:
                last = int(np.flatnonzero(block.good)[-1])
                away, odd = divmod(end - int(block.offsets[last]), settings.cadu_length)
                count = UNKNOWN if odd else (int(block.header.master_count[last]) + away) % COUNTS
            self.edges.append(opener_of(stream[end:].tobytes(), settings, base + end, count))

    def _count_channels(self) -> None:
        self.accounting.packets += self._channels.packets
        self.accounting.crc_errors += self._channels.crc_errors
        self.accounting.octets_skipped += self._channels.octets_unused


def proposed_link(window: bytes, dictionary: Dictionary = DICTIONARY) -> Link | None:
    """Return the link of a stream with these octets; None if they are not sufficient evidence.

    Raises
    ------
    LinkFormatError
        If markers have a regular distance and no known coding fits.
    """
    try:
        probe = decode(window[:PROBE_OCTETS], dictionary=dictionary)
        if probe.settings is None and len(window) > PROBE_OCTETS and ASM in window:
            probe = decode(window, dictionary=dictionary)
    except LinkFormatError:
        period = cadu.find_period(as_octets(window))
        if len(window) >= _CERTAIN_PERIODS * max(period, CADU_MAX_OCTETS // 2):
            raise
        return None
    if probe.settings is not None:
        good = probe.frame_count - probe.frames_bad
        enough = good >= 1 if is_checked(probe.settings) else good >= _REGULAR_FRAMES and probe.packets >= 2
        return Link(probe.settings) if enough else None
    octets = probe.octets["packets"]
    return BARE if probe.packets >= 2 or (octets and 2 * octets >= len(window)) else None


def fragment_edges(octets: bytes, settings: LinkSettings | None) -> list[Edge]:
    """Return the edges of a piece without a complete unit: around a marker, or a middle.

    For a piece that ends with the first octets of a marker, both are returned.
    """
    if settings is None:
        if len(octets) > PACKET_MAX_LENGTH:
            return []
        middle = Edge(MIDDLE, UNKNOWN, UNKNOWN, octets, 0)
        return [Edge(OPENER, UNKNOWN, UNKNOWN, octets, 0), middle] if _begins_packet(octets) else [middle]
    length = settings.cadu_length
    found = octets.find(ASM)
    if found >= 0:
        return _around(octets, found, settings)
    edges = []
    for part in (3, 2, 1):
        if len(octets) > part and octets.endswith(ASM[:part]):
            edges += _around(octets, len(octets) - part, settings)
    if len(octets) < length:
        edges.append(Edge(MIDDLE, UNKNOWN, UNKNOWN, octets, 0))
    return edges


def _begins_packet(octets: bytes) -> bool:
    """Return whether an incomplete PUS-C telemetry packet seems to begin here."""
    return (
        len(octets) > PRIMARY_HEADER_LENGTH
        and octets[0] & 0xF8 == 0x08
        and octets[PRIMARY_HEADER_LENGTH] >> 4 == 2
        and packet_octets_missing(octets) > 0
    )


def _around(octets: bytes, marker: int, settings: LinkSettings) -> list[Edge]:
    """Return the end of the CADU before a marker, and the start of the CADU at it."""
    opener = opener_of(octets[marker:], settings, marker, UNKNOWN)
    edges = []
    if 0 < marker < settings.cadu_length:
        count = UNKNOWN if opener.next_count == UNKNOWN else (opener.next_count - 1) % COUNTS
        edges.append(Edge(CLOSER, count, UNKNOWN, octets[:marker], 0))
    if len(opener.octets) < settings.cadu_length:
        edges.append(opener)
    return edges


def opener_of(octets: bytes, settings: LinkSettings, start: int, count: int) -> Edge:
    """Return the start of a CADU as an opener; its count is that of its header if complete, else `count`."""
    header = randomise(as_octets(octets)[ASM_LENGTH:], settings.randomiser)[:FRAME_HEADER_LENGTH]
    if header.size == FRAME_HEADER_LENGTH:
        fields = frame_headers(header[None])
        if fields.version[0] == 0 and header[4] >> 3 & 0b111 == 0b011:
            count = int(fields.master_count[0])
    return Edge(OPENER, UNKNOWN, count, octets, start, settings.cadu_length - len(octets))


def _good_frames(window: bytes, settings: LinkSettings) -> bool:
    """Return whether a window holds a good frame with these settings."""
    for octets in (window[:PROBE_OCTETS], window if len(window) > PROBE_OCTETS and ASM in window else b""):
        stream = as_octets(octets)
        sync = cadu.synchronise(stream, settings.cadu_length, verify=proof_of(stream, settings))
        for first in range(0, sync.start_bits.size, 64):
            some = sync.take(np.arange(first, min(first + 64, sync.start_bits.size)))
            block = frames_of(cadu.cadu_octets(stream, some), some.offsets, settings)
            if not is_checked(settings):
                regular = block.good & (block.frames[:, 4] >> 3 == 0b00011)
                return bool(np.count_nonzero(regular) * 2 > regular.size)
            if block.good.any():
                return True
    return False


def _led_back(stream: OctetArray, first: int, settings: LinkSettings) -> IntArray:
    """Return the start of good CADUs with damaged markers before the first CADU found."""
    length = settings.cadu_length
    before = first - length * np.arange(min(first // length, _LED_BACK), 0, -1, dtype=np.int64)
    if not before.size or not is_checked(settings):
        return before[:0]
    good = np.flatnonzero(read_frames(stream, before, settings).good)
    return before[good[0] :] if good.size else before[:0]


def _cadus_at(stream: OctetArray, offsets: IntArray, length: int) -> OctetArray:
    if not offsets.size:
        return np.empty((0, length), dtype=np.uint8)
    cadus: OctetArray = np.lib.stride_tricks.sliding_window_view(stream, length)[offsets]
    return cadus


def _rebuffered(blocks: Iterable[bytes], octets: int) -> Iterator[bytes]:
    """The same octets in blocks of about `octets`."""
    pieces: list[bytes] = []
    held = 0
    for block in blocks:
        pieces.append(block)
        held += len(block)
        if held >= octets:
            yield b"".join(pieces)
            pieces, held = [], 0
    if pieces:
        yield b"".join(pieces)


def _last_marked(blocks: Iterable[bytes]) -> Iterator[tuple[bytes, bool]]:
    """Yield every block, and whether it is the last one."""
    previous: bytes | None = None
    for block in blocks:
        if previous is not None:
            yield previous, False
        previous = block
    if previous is not None:
        yield previous, True
