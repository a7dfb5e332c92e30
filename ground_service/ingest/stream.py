"""Reader of a downlink in windows: packets are returned when complete, every octet is accounted for.

Windows of a CADU stream do not overlap: an incomplete CADU or packet at the end of a window is kept for the next.
Incomplete units at the ends of the stream are returned as edges, to be joined with those of other files.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ground_service.ingest.edges import CLOSER, MIDDLE, OPENER, UNKNOWN, Edge, packet_octets_missing
from ground_service.ingest.frames import (
    COUNTS,
    ChannelEdge,
    ChannelReader,
    FrameBlock,
    UncheckedApids,
    all_checked,
    control_words,
    frames_of,
    is_checked,
    read_frames,
)
from ground_service.ingest.packets import PacketBatch, batch_of_cut
from ground_service.ingest.quality import NO_RECORD, LinkQuality, RecordFormat
from lunar.arrays import IntArray, OctetArray
from tmtc import cadu
from tmtc.arrays import as_octets
from tmtc.cadu import ASM, ASM_LENGTH
from tmtc.clcw import UplinkSeen, uplink_seen
from tmtc.dictionary import DICTIONARY
from tmtc.downlink import plan_of
from tmtc.errors import UnknownCoding
from tmtc.frame_reading import proof_of
from tmtc.frames import FRAME_HEADER_LENGTH, frame_headers
from tmtc.link import LinkSettings
from tmtc.link_plan import LinkPlan
from tmtc.packets import PACKET_MAX_LENGTH, PRIMARY_HEADER_LENGTH
from tmtc.randomiser import randomise
from tmtc.schema import Dictionary
from tmtc.stream import PacketCut, cut_packets

WINDOW_OCTETS = 2 << 20
"""Octets decoded and stored at a time: large enough to spread the cost of a transaction, small against memory:
decoding and storing take about ten times as much."""

PROBE_OCTETS = 256 << 10
"""Number of octets around a small piece from which its link is determined."""

CADU_MAX_OCTETS = 2048 + 2 * 16 * 8 + ASM_LENGTH
"""Length of the longest CADU of the known link settings."""

FOREIGN_FRAMES = 2
"""Number of frames from which a spacecraft is accepted in a stream of frames without code or checksum."""

_CONTEXT_CADUS = 6
"""Number of CADUs of one window used to synchronise the next: enough for a stable lock."""

_LED_BACK = 64
"""Number of CADUs tried before the first marker."""

_CERTAIN_OCTETS = 8 * CADU_MAX_OCTETS // 2
"""Length of a stream from which an unknown coding is an error, and not a lack of evidence."""


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
    quality: LinkQuality = field(default_factory=LinkQuality)
    uplink: dict[tuple[int, int], UplinkSeen] = field(default_factory=dict)
    """Telecommand channels by spacecraft and number, as the frames show them."""

    def add(self, later: LinkAccounting) -> None:
        """Add the accounting of a later section of the same stream."""
        self.octets += later.octets
        self.packets += later.packets
        self.crc_errors += later.crc_errors
        self.octets_skipped += later.octets_skipped
        self.frames += later.frames
        self.frames_bad += later.frames_bad
        self.symbols_corrected += later.symbols_corrected
        self.quality.add(later.quality)
        for key, seen in later.uplink.items():
            self.uplink[key] = self.uplink[key].followed_by(seen, 1) if key in self.uplink else seen


@dataclass(frozen=True, slots=True)
class Reach:
    """Octets [start, stop) of a stream that have one link; `whole` is the size of the stream."""

    link: Link
    start: int
    stop: int
    whole: int


class DownlinkReader:
    """Reader of one section of a stream: CADUs with one link, or bare space packets.

    After the last batch, `edges` holds the fragments at the ends of the stream, and `take_channel_edges` returns the
    fragments in its channels.

    Parameters
    ----------
    reach
        Section of the stream that is read.
    spacecraft_id
        Only frames of this spacecraft are used; None: those of every spacecraft in the stream. Bare packets carry no
        spacecraft id.
    unchecked_apids
        APIDs of each spacecraft whose packets do not end with a checksum.
    record
        Octets of the station around each CADU.
    error_control
        Whether packets end with a checksum.
    """

    def __init__(
        self,
        reach: Reach,
        spacecraft_id: int | None = None,
        dictionary: Dictionary = DICTIONARY,
        window_octets: int = WINDOW_OCTETS,
        unchecked_apids: UncheckedApids = all_checked,
        record: RecordFormat = NO_RECORD,
        error_control: bool = True,
    ) -> None:
        self.accounting = LinkAccounting()
        self.reach = reach
        self.edges: list[Edge] = []
        self._spacecraft_id = spacecraft_id
        self._dictionary = dictionary
        self._window_octets = window_octets
        self._record = record
        self._error_control = error_control
        self._next_bit: int | None = None
        self._channels = ChannelReader(dictionary, unchecked_apids, error_control)
        self._unchecked = all_checked(0) if spacecraft_id is None else unchecked_apids(spacecraft_id)
        self._last_words: dict[int, NDArray[np.uint32]] = {}
        self._believed: set[int] = set()
        self._held: OctetArray = np.empty(0, dtype=np.uint8)
        self._context = 0
        self._position = reach.start
        self._located = False

    def take_channel_edges(self) -> list[ChannelEdge]:
        """Return the fragments in the channels since the last call."""
        edges, self._channels.edges = self._channels.edges, []
        return edges

    def batches(self, blocks: Iterable[bytes]) -> Iterator[PacketBatch]:
        """Yield the packets of the section in batches; `blocks` are its octets."""
        rest = b""
        settings = self.reach.link.settings
        for block, final in _last_marked(_rebuffered(blocks, self._window_octets)):
            self.accounting.octets += len(block)
            self.accounting.quality.octets += len(block)
            if settings is None:
                rest, batch = self._packets(rest + block, final)
                yield batch
            else:
                yield from self._frames(as_octets(block), settings, final)
        if settings is not None:
            self._channels.close()
            self._count_channels()

    def _packets(self, window: bytes, final: bool) -> tuple[bytes, PacketBatch]:
        """Return the remaining octets and the packets of a window of bare packets."""
        if self._error_control:
            cut = cut_packets(window, final=final, unchecked_apids=self._unchecked)
        else:
            cut = _cut_unchecked(window, final)
        if not self._located and (len(cut) or final):
            self._located = True
            head = int(cut.skipped[0, 1]) if len(cut.skipped) and cut.skipped[0, 0] == 0 else 0
            if 0 < head <= PACKET_MAX_LENGTH and self._position == 0:
                self.edges.append(Edge(CLOSER, UNKNOWN, UNKNOWN, window[:head], 0))
        if final and self._ends and len(cut.skipped) and cut.skipped[-1, 1] == len(window):
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
        prove = proof_of(stream, settings)
        sync = cadu.synchronise(stream, length, verify=prove, record_octets=self._record.octets)
        truncated = int(np.count_nonzero(sync.truncated >= context))
        sync = sync.take(np.flatnonzero(sync.offsets >= context))
        offsets, cadus = sync.offsets, cadu.cadu_octets(stream, sync)
        self._note_lock(stream, sync, base, length)
        if not self._located and offsets.size and not sync.start_bits[0] & 7:
            before = _led_back(stream, int(offsets[0]), settings)
            offsets = np.concatenate((before, offsets))
            cadus = np.concatenate((_cadus_at(stream, before, length), cadus))
        times = self._record.times_utc_ns(stream, offsets)
        self.accounting.quality.add_times(times)
        block = replace(frames_of(cadus, offsets, settings), received_utc_ns=times)
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
        self._note_errors(
            block, int(sync.marker_errors[block.good[offsets.size - sync.offsets.size :]].sum())
        )
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

    def _note_lock(self, stream: OctetArray, sync: cadu.CaduSync, base: int, length: int) -> None:
        """Count the CADUs of a window that are not where the lock expects them."""
        quality = self.accounting.quality
        quality.frames_inverted += int(np.count_nonzero(sync.inverted))
        quality.octets_records += sync.offsets.size * self._record.octets
        if sync.start_bits.size:
            starts = sync.start_bits + 8 * base
            expected = starts[:-1] + 8 * (length + self._record.octets)
            if self._next_bit is not None:
                quality.lock_losses += int(starts[0] != self._next_bit)
            quality.lock_losses += int(np.count_nonzero(starts[1:] != expected))
            self._next_bit = int(starts[-1]) + 8 * (length + self._record.octets)

    def _note_errors(self, block: FrameBlock, marker_bits: int) -> None:
        """Count the frames and corrected errors of a window; `marker_bits`: wrong bits in markers of good frames."""
        quality, code = self.accounting.quality, block.settings.code
        good = int(np.count_nonzero(block.good))
        depth = 0 if code is None else code.interleave
        words, lost = depth * block.offsets.size, int(block.codewords_lost.sum())
        bits = 0 if code is None else 8 * code.block_length // depth
        quality.frames += block.offsets.size
        quality.frames_good += good if is_checked(block.settings) else 0
        quality.codewords += words
        quality.codewords_lost += lost
        quality.symbols_corrected += int(block.corrected.sum())
        quality.wrong_bits += int(block.wrong_bits.sum()) + marker_bits
        quality.checked_bits += (words - lost) * bits + cadu.MARKER_BITS * good
        quality.octets_frames += block.offsets.size * block.settings.cadu_length

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
        if not self._ends:
            return
        if 0 < stream.size - end < settings.cadu_length and (self._located or block.offsets.size):
            count = UNKNOWN
            if block.good.any() and len(block.spacecraft()) == 1:
                last = int(np.flatnonzero(block.good)[-1])
                away, odd = divmod(end - int(block.offsets[last]), settings.cadu_length)
                count = UNKNOWN if odd else (int(block.header.master_count[last]) + away) % COUNTS
            self.edges.append(opener_of(stream[end:].tobytes(), settings, base + end, count))

    @property
    def _ends(self) -> bool:
        """Whether the stream ends with this section."""
        return self.reach.stop == self.reach.whole

    def _count_channels(self) -> None:
        self.accounting.packets += self._channels.packets
        self.accounting.crc_errors += self._channels.crc_errors
        self.accounting.octets_skipped += self._channels.octets_unused


def reaches_of(
    octets: OctetArray,
    known: Sequence[Link] = (),
    *,
    stated: LinkSettings | None = None,
    dictionary: Dictionary = DICTIONARY,
    unchecked_apids: frozenset[int] = frozenset(),
    error_control: bool = True,
) -> tuple[list[Reach], LinkPlan | None]:
    """Return the sections of a stream and the plan they follow from; no sections without sufficient evidence.

    Parameters
    ----------
    octets
        The whole stream; a memory map for a large file.
    known
        Links that the stream is expected to have.
    stated
        Settings that are used without evidence.
    unchecked_apids
        APIDs whose packets do not end with a checksum, in a stream of bare packets.
    error_control
        Whether packets end with a checksum.

    Raises
    ------
    UnknownCoding
        If markers have a regular distance and no known coding fits.
    """
    size = int(octets.size)
    if stated is not None:
        return [Reach(Link(stated.explicit), 0, size, size)], None
    expected = [link.settings for link in known if link.settings is not None]
    try:
        plan = plan_of(octets, expected, dictionary=dictionary, error_control=error_control)
    except UnknownCoding:
        if size >= _CERTAIN_OCTETS:
            raise
        return [], None
    if plan.sections:
        return [Reach(Link(one.settings.explicit), one.start, one.stop, size) for one in plan.sections], plan
    if _has_packets(octets, BARE in known, error_control):
        return [Reach(BARE, 0, size, size)], plan
    if unchecked_apids:
        cut = cut_packets(octets[:WINDOW_OCTETS], unchecked_apids=unchecked_apids)
        packets = cut.lengths[cut.crc_ok]
        if packets.size >= 2 and 2 * int(packets.sum()) >= min(size, WINDOW_OCTETS):
            return [Reach(BARE, 0, size, size)], plan
    return [], plan


def _cut_unchecked(window: bytes, final: bool) -> PacketCut:
    """Return the packets without error control of a window, as far as the octets behind confirm them."""
    cut = cut_packets(window, error_control=False)
    if final:
        return cut
    border = len(window) - 2 * PACKET_MAX_LENGTH
    starts = cut.offsets[cut.crc_ok & (cut.offsets <= border)]
    consumed = int(starts[-1]) if starts.size else 0
    whole = cut.offsets < consumed
    return PacketCut(
        cut.offsets[whole],
        cut.lengths[whole],
        cut.crc_ok[whole],
        cut.skipped[cut.skipped[:, 1] <= consumed],
        cut.idle[cut.idle[:, 1] <= consumed],
        consumed,
    )


def _has_packets(octets: OctetArray, is_known: bool, error_control: bool) -> bool:
    """Return whether a stream contains bare packets; `is_known`: bare packets have been received before."""
    if not error_control:
        window = octets[:WINDOW_OCTETS]
        cut = cut_packets(window, error_control=False)
        return 2 * int(cut.lengths[cut.crc_ok].sum()) > window.size
    for start in range(0, octets.size, WINDOW_OCTETS):
        window = octets[start : start + WINDOW_OCTETS + PACKET_MAX_LENGTH]
        cut = cut_packets(window)
        packets = int(np.count_nonzero(cut.crc_ok))
        if packets >= 2 or (packets and (is_known or 2 * int(cut.lengths[cut.crc_ok].sum()) >= window.size)):
            return True
    return False


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
