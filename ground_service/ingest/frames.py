"""Transfer frames of a downlink, the packets of their virtual channels, and the fragments at the edges of both.

Packets are extracted from runs of frames with consecutive channel counts. Octets of incomplete packets are returned as
channel edges, so that they can be joined with those of other runs, also from other files.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ground_service.ingest.edges import CLOSER, MIDDLE, OPENER, UNKNOWN, Edge
from ground_service.ingest.packets import PacketBatch, batch_of_cut
from lunar.arrays import IntArray, OctetArray
from tmtc import reed_solomon
from tmtc.cadu import ASM, ASM_LENGTH
from tmtc.crc import CRC_LENGTH
from tmtc.frames import (
    FRAME_HEADER_LENGTH,
    OCF_LENGTH,
    ONLY_IDLE_DATA,
    TmFrameHeaders,
    frame_checksums_hold,
    frame_headers,
)
from tmtc.link import LinkSettings
from tmtc.packets import IDLE_APID, PACKET_MAX_LENGTH, PRIMARY_HEADER_LENGTH
from tmtc.randomiser import randomise
from tmtc.schema import Dictionary
from tmtc.stream import PacketCut, cut_packets

COUNTS = 256
_BATCH = 512


@dataclass(frozen=True, slots=True, eq=False)
class FrameBlock:
    """Corrected frames (n, frame_length) of CADUs at known offsets, `good` (n,) if codes and checksums are valid.

    `corrected` (n,) is the number of corrected symbols, `wrong_bits` (n,) that of corrected bits, and
    `codewords_lost` (n,) that of codewords with too many errors. `received_utc_ns` (n,) is the reception time in the
    records of the station, `NO_TIME` where there is none; None: no such times.
    """

    settings: LinkSettings
    offsets: IntArray
    frames: OctetArray
    header: TmFrameHeaders
    good: NDArray[np.bool_]
    corrected: IntArray
    wrong_bits: IntArray
    codewords_lost: IntArray
    received_utc_ns: IntArray | None = None

    def of(self, spacecraft_id: int) -> NDArray[np.bool_]:
        """Return which frames (n,) are good frames of a spacecraft."""
        mine: NDArray[np.bool_] = self.good & (self.header.spacecraft_id == spacecraft_id)
        return mine

    def only(self, index: int) -> FrameBlock:
        """Return a block with one of the frames."""
        one = slice(index, index + 1)
        frames = self.frames[one]
        return FrameBlock(
            self.settings,
            self.offsets[one],
            frames,
            frame_headers(frames),
            self.good[one],
            self.corrected[one],
            self.wrong_bits[one],
            self.codewords_lost[one],
        )

    def spacecraft(self) -> list[int]:
        """Return the spacecraft ids of good frames, the most frequent first."""
        ids, counts = np.unique(self.header.spacecraft_id[self.good], return_counts=True)
        return [int(i) for i in ids[np.argsort(-counts, kind="stable")]]


def marker_errors(octets: OctetArray, starts: IntArray) -> IntArray:
    """Return the number of wrong marker bits in the four octets at each of `starts` (n,)."""
    word = octets[starts].astype(np.uint32)
    for k in range(1, ASM_LENGTH):
        word = word << np.uint32(8) | octets[starts + k]
    wrong: IntArray = np.bitwise_count(word ^ np.uint32(int.from_bytes(ASM, "big"))).astype(np.int64)
    return wrong


def is_checked(settings: LinkSettings) -> bool:
    """Return whether frames have a code or a checksum."""
    return settings.proves_frames


def read_frames(stream: OctetArray, offsets: IntArray, settings: LinkSettings) -> FrameBlock:
    """Return the frames of complete CADUs that begin at octets `offsets` (n,) of `stream`."""
    length = settings.cadu_length
    if not offsets.size:
        return frames_of(np.empty((0, length), dtype=np.uint8), offsets, settings)
    windows = np.lib.stride_tricks.sliding_window_view(stream, length)
    return frames_of(windows[offsets], offsets, settings)


def frames_of(cadus: OctetArray, offsets: IntArray, settings: LinkSettings) -> FrameBlock:
    """Return the frames of CADUs (n, length), markers included, at `offsets` (n,)."""
    code = settings.code
    n = offsets.size
    frames = np.empty((n, settings.frame_length), dtype=np.uint8)
    good = np.ones(n, dtype=np.bool_)
    corrected, wrong_bits, lost = (np.zeros(n, dtype=np.int64) for _ in range(3))
    for first in range(0, n, _BATCH):
        part = slice(first, min(first + _BATCH, n))
        blocks = randomise(np.ascontiguousarray(cadus[part, ASM_LENGTH:]), settings.randomiser)
        if code is None:
            frames[part] = blocks
        else:
            repaired = reed_solomon.decode(blocks, code)
            frames[part] = repaired.frames
            good[part] = (repaired.corrected >= 0).all(axis=1)
            corrected[part] = np.where(repaired.corrected > 0, repaired.corrected, 0).sum(axis=1)
            wrong_bits[part] = repaired.wrong_bits
            lost[part] = np.count_nonzero(repaired.corrected < 0, axis=1)
    if settings.checksum and n:
        usable = np.flatnonzero(good)
        good[usable[~frame_checksums_hold(frames[usable])]] = False
    header = frame_headers(frames)
    good &= header.version == 0
    return FrameBlock(settings, offsets, frames, header, good, corrected, wrong_bits, lost)


def control_words(block: FrameBlock, spacecraft_id: int) -> NDArray[np.uint32]:
    """Return the operational control fields (n,) of the good frames of a spacecraft that have one, in order."""
    end = block.settings.frame_length - (CRC_LENGTH if block.settings.checksum else 0)
    mine = np.flatnonzero(block.of(spacecraft_id) & block.header.ocf)
    words = np.ascontiguousarray(block.frames[mine, end - OCF_LENGTH : end]).view(">u4")
    return words[:, 0].astype(np.uint32) if mine.size else np.empty(0, dtype=np.uint32)


Channel = tuple[int, int, int, int]
"""Spacecraft, virtual channel, and start and end of the packet zone in its frames."""


@dataclass(frozen=True, slots=True)
class ChannelEdge:
    """Edge of a run of frames of one channel."""

    channel: Channel
    edge: Edge


UncheckedApids = Callable[[int], frozenset[int]]
"""APIDs of a spacecraft whose packets do not end with a checksum."""


def all_checked(_spacecraft_id: int) -> frozenset[int]:
    """Return no APIDs: all packets end with a checksum."""
    return frozenset()


@dataclass(slots=True)
class ChannelReader:
    """Reader of the packets of all channels of one stream, one block of frames at a time.

    Incomplete packets at the end of a block are kept for the next one; `edges` collects the fragments at gaps.
    """

    dictionary: Dictionary
    unchecked_apids: UncheckedApids = all_checked
    error_control: bool = True
    edges: list[ChannelEdge] = field(default_factory=list)
    packets: int = 0
    crc_errors: int = 0
    octets_unused: int = 0
    _open: dict[Channel, Edge] = field(default_factory=dict)

    def read(self, block: FrameBlock, spacecraft_id: int) -> PacketBatch:
        """Return the decoded packets of a spacecraft that are complete with this block."""
        buffer, cut, received_utc_ns = self._cut(block, spacecraft_id)
        return batch_of_cut(buffer, cut, self.dictionary, spacecraft_id, received_utc_ns)

    def cut(self, block: FrameBlock, spacecraft_id: int) -> tuple[bytes, PacketCut]:
        """Return octets, and the positions in them of the packets of a spacecraft that are complete with this block."""
        buffer, cut, _ = self._cut(block, spacecraft_id)
        return buffer, cut

    def _cut(self, block: FrameBlock, spacecraft_id: int) -> tuple[bytes, PacketCut, IntArray | None]:
        """Return what `cut` does, and the reception time of each packet where the block has such times.

        It is that of the frame in which the packet begins; of a packet that began before the block, that of its end.
        """
        parts: list[bytes | OctetArray] = []
        segments: list[tuple[int, int]] = []
        starts, frames_used = [np.empty(0, dtype=np.int64)], [np.empty(0, dtype=np.int64)]
        filled = 0
        for channel, zones, count, pointer, rows in _channels(block, spacecraft_id):
            checked = is_checked(block.settings)
            for octets, ranges, used in self._channel(channel, zones, count, pointer, checked):
                parts.append(octets)
                segments += [(filled + start, filled + stop) for start, stop in ranges]
                starts.append(filled + zones.shape[1] * np.arange(used.size, dtype=np.int64))
                frames_used.append(rows[used])
                filled += len(octets)
        buffer = b"".join(bytes(part) for part in parts)
        ranges_used = np.array(segments, dtype=np.int64).reshape(-1, 2)
        cut = cut_packets(
            buffer,
            segments=ranges_used,
            error_control=self.error_control,
            unchecked_apids=self.unchecked_apids(spacecraft_id),
        )
        self.packets += int(np.count_nonzero(cut.crc_ok))
        self.crc_errors += cut.crc_errors
        self.octets_unused += _not_in_packets(ranges_used, cut)
        if block.received_utc_ns is None:
            return buffer, cut, None
        frame = np.searchsorted(np.concatenate(starts), cut.offsets, side="right") - 1
        return buffer, cut, block.received_utc_ns[np.concatenate(frames_used)[frame]]

    def close(self) -> None:
        """Add the incomplete packets to the edges."""
        for channel, edge in self._open.items():
            self._cut_off(channel, edge)
        self._open.clear()

    def _cut_off(self, channel: Channel, edge: Edge) -> None:
        self.octets_unused += len(edge.octets)
        if edge.role == OPENER and _is_idle(edge.octets):
            return
        self.edges.append(ChannelEdge(channel, edge))

    def _channel(
        self, channel: Channel, zones: OctetArray, count: IntArray, pointer: IntArray, checked: bool
    ) -> Iterator[tuple[bytes | OctetArray, list[tuple[int, int]], IntArray]]:
        """Yield octets, the segments of them that hold complete packets, and the frames whose zones they are."""
        zone = zones.shape[1]
        idle = pointer == ONLY_IDLE_DATA
        filled = np.flatnonzero(~idle)
        buffer = np.ascontiguousarray(zones[~idle]).reshape(-1)
        row = np.concatenate(([0], np.cumsum(~idle)))
        breaks = np.flatnonzero(np.diff(count) % COUNTS != 1) + 1
        ranges: list[tuple[int, int]] = []
        for first, stop in pairwise([0, *breaks.tolist(), len(count)]):
            before, after = int(count[first]), int(count[stop - 1] + 1) % COUNTS
            kept = self._open.pop(channel, None)
            if kept is not None and kept.next_count != before:
                self._cut_off(channel, kept)
                kept = None
            low, high = int(row[first]), int(row[stop])
            if low == high:  # only idle frames: the run continues without octets
                if kept is not None:
                    self._open[channel] = kept.followed_by(b"", after)
                continue
            begins = np.flatnonzero(pointer[first:stop][~idle[first:stop]] < zone)
            pointers = pointer[first:stop][~idle[first:stop]]
            if not begins.size:
                octets = buffer[low * zone : high * zone].tobytes()
                whole = kept.followed_by(octets, after) if kept else Edge(MIDDLE, before, after, octets)
                if len(whole.octets) <= PACKET_MAX_LENGTH:
                    self._open[channel] = whole
                else:
                    self.octets_unused += len(whole.octets)
                continue
            begin = (low + int(begins[0])) * zone + int(pointers[begins[0]])
            head = buffer[low * zone : begin].tobytes()
            end = packets_end(buffer, (low + int(begins[-1])) * zone + int(pointers[begins[-1]]), high * zone)
            if kept is not None and kept.role == OPENER:
                joint = kept.octets + head
                yield joint, [(0, len(joint))], filled[low + begins[:1]]
            else:
                lead = kept.octets + head if kept is not None else head
                if lead:
                    closer = Edge(CLOSER, kept.count if kept is not None else before, UNKNOWN, lead)
                    self._cut_off(channel, closer)
            tail = buffer[end : high * zone].tobytes()
            ranges.append((begin, end if checked else high * zone))
            if tail:
                self._open[channel] = Edge(OPENER, UNKNOWN, after, tail)
                if not checked:  # its octets are also searched and counted
                    self.octets_unused -= len(tail)
        yield buffer, ranges, filled


def packets_end(buffer: OctetArray | bytes, start: int, stop: int) -> int:
    """Return the start of the packet that does not end within [start, stop), by packet lengths; else `stop`."""
    while stop - start >= PRIMARY_HEADER_LENGTH:
        length = (int(buffer[start + 4]) << 8 | int(buffer[start + 5])) + PRIMARY_HEADER_LENGTH + 1
        if start + length > stop:
            break
        start += length
    return start


def _channels(
    block: FrameBlock, spacecraft_id: int
) -> Iterator[tuple[Channel, OctetArray, IntArray, IntArray, IntArray]]:
    """Yield the frames of each channel of a spacecraft.

    Packet zones (m, zone), channel counts, first header pointers and indices in the block (m,).
    """
    header = block.header
    end = block.settings.frame_length - (CRC_LENGTH if block.settings.checksum else 0)
    secondary = block.frames[:, FRAME_HEADER_LENGTH] & 0x3F
    start = FRAME_HEADER_LENGTH + np.where(header.secondary_header, secondary.astype(np.int64) + 1, 0)
    stop = end - np.where(header.ocf, OCF_LENGTH, 0)
    layout = np.stack((header.virtual_channel, start, stop), axis=1)
    mine = block.of(spacecraft_id) & (start < stop)
    for channel, low, high in np.unique(layout[mine], axis=0).tolist():
        rows = np.flatnonzero(mine & (layout == (channel, low, high)).all(axis=1))
        zones, count = block.frames[rows, low:high], header.channel_count[rows]
        pointer = header.first_header_pointer[rows]
        again = np.flatnonzero(np.diff(count) == 0) + 1
        if again.size:  # the same frame twice in succession
            again = again[(zones[again] == zones[again - 1]).all(axis=1)]
            keep = np.ones(rows.size, dtype=np.bool_)
            keep[again] = False
            zones, count, pointer, rows = zones[keep], count[keep], pointer[keep], rows[keep]
        yield (spacecraft_id, channel, low, high), zones, count, pointer, rows


def _is_idle(octets: bytes) -> bool:
    return len(octets) >= 2 and int.from_bytes(octets[:2], "big") & 0x7FF == IDLE_APID


def _not_in_packets(ranges: IntArray, cut: PacketCut) -> int:
    total: Any = (ranges[:, 1] - ranges[:, 0]).sum()
    return int(total) - int(cut.lengths.sum()) - cut.octets_idle
