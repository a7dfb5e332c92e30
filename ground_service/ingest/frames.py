"""Frames of a section of a recording, and the packets of their virtual channels.

A section is read in windows. Frames that the octets before or after a piece give by themselves were read with those
pieces; the others are read now. Octets of packets that are not complete are left as fragments.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ground_service.ingest.core import COUNTS, UNKNOWN, Channel, Fragment, LinkContent, RecordFormat, is_idle
from ground_service.telemetry.packets import PacketBatch, batch_of_cut
from lunar.arrays import BoolArray, IntArray, OctetArray
from tmtc.dictionary.payload import DICTIONARY
from tmtc.dictionary.schema import Dictionary
from tmtc.link import cadu
from tmtc.link.frame_reading import Frames, proof_of, read_frames
from tmtc.link.frames import FRAME_HEADER_LENGTH, FRAME_MAX_LENGTH, OCF_LENGTH, ONLY_IDLE_DATA, uplink_seen
from tmtc.link.settings import LinkSettings
from tmtc.packets.space_packets import CRC_LENGTH, PACKET_MAX_LENGTH, PRIMARY_HEADER_LENGTH
from tmtc.packets.stream import CHECKED, PacketCut, PacketForm, cut_packets

CADU_MAX_OCTETS = FRAME_MAX_LENGTH + 2 * 16 * 8 + cadu.ASM_LENGTH
"""Length of the longest CADU of the known link settings."""

CONTEXT_CADUS = 6
"""Number of CADUs of one window used to synchronise the next: enough for a stable lock."""

REACH_OCTETS = (CONTEXT_CADUS + 2) * CADU_MAX_OCTETS
"""Octets before and after a piece that are read with it."""

FOREIGN_FRAMES = 2
"""Number of frames from which a spacecraft is accepted in a stream of frames without code or checksum."""

Known = tuple[int, OctetArray]
"""Octets of earlier pieces and their place in the run."""

FormOf = Callable[[int], PacketForm]
"""Returns the form of the packets of a spacecraft."""


def all_checked(_spacecraft_id: int) -> PacketForm:
    """Return that all packets end with a checksum."""
    return CHECKED


@dataclass(frozen=True, slots=True)
class Section:
    """Octets [start, stop) of a run that have one link, and the octets [first, last) of the piece that is read.

    `begins` and `ends`: the section is the first or last one of the run. `settings` None: packets without frames.
    `position` is that of the run in its recording.
    """

    settings: LinkSettings | None
    start: int
    stop: int
    first: int
    last: int
    begins: bool = True
    ends: bool = True
    position: int = 0
    stream: str = ""

    def of_piece(self, starts: IntArray, stops: IntArray) -> int:
        """Return how many octets of ranges [start, stop) (n,) belong to the piece."""
        inside: Any = np.clip(stops, self.first, self.last) - np.clip(starts, self.first, self.last)
        return int(inside.sum())


@dataclass(frozen=True, slots=True, eq=False)
class FrameBlock:
    """Frames (n,) of a window; `offset` (n,) in the run, `received_utc_ns` (n,) by the records of the station."""

    settings: LinkSettings
    offset: IntArray
    found: Frames
    received_utc_ns: IntArray | None = None

    def of(self, spacecraft_id: int) -> BoolArray:
        """Return which frames (n,) are good frames of a spacecraft."""
        mine: BoolArray = self.good & (self.found.header.spacecraft_id == spacecraft_id)
        return mine

    @property
    def good(self) -> BoolArray:
        """Return which frames (n,) can be used."""
        good: BoolArray = self.found.valid & (self.found.header.version == 0)
        return good

    @property
    def spacecraft(self) -> list[int]:
        """Spacecraft ids of good frames, the most frequent first."""
        ids, counts = np.unique(self.found.header.spacecraft_id[self.good], return_counts=True)
        return [int(i) for i in ids[np.argsort(-counts, kind="stable")]]

    def control_words(self, spacecraft_id: int) -> NDArray[np.uint32]:
        """Return the operational control fields (n,) of the good frames of a spacecraft that have one, in order."""
        end = self.settings.frame_length - (CRC_LENGTH if self.settings.checksum else 0)
        mine = np.flatnonzero(self.of(spacecraft_id) & self.found.header.ocf)
        words = np.ascontiguousarray(self.found.octets[mine, end - OCF_LENGTH : end]).view(">u4")
        return words[:, 0].astype(np.uint32) if mine.size else np.empty(0, dtype=np.uint32)


class FrameReader:
    """Reader of one section of CADUs.

    Parameters
    ----------
    spacecraft_id
        Only frames of this spacecraft are used; None: those of every spacecraft in the stream.
    form_of
        Form of the packets of each spacecraft.
    record
        Octets of the station around each CADU.

    Attributes
    ----------
    end
        End of the last frame that was read, in the run.
    """

    def __init__(
        self,
        section: Section,
        settings: LinkSettings,
        found: LinkContent,
        *,
        spacecraft_id: int | None = None,
        dictionary: Dictionary = DICTIONARY,
        form_of: FormOf = all_checked,
        record: RecordFormat,
    ) -> None:
        self.section, self.settings, self.found = section, settings, found
        self._spacecraft_id = spacecraft_id
        self._record = record
        self._channels = ChannelReader(dictionary, form_of, section.position, section.stream)
        self._length = settings.cadu_length
        self._new = (8 * section.start, 8 * section.stop)
        self.end = 0
        self._end: int | None = None
        self._last_words: dict[int, NDArray[np.uint32]] = {}
        self._believed: set[int] = set()
        self._held: OctetArray = np.empty(0, dtype=np.uint8)
        self._context = 0
        self._position = section.start

    def take_fragments(self) -> list[Fragment]:
        """Return the fragments of packets since the last call."""
        fragments, self._channels.fragments = self._channels.fragments, []
        return fragments

    def begin_at(self, end: int) -> None:
        """Read only frames from an octet on, up to which another reader has read."""
        self._new = max(self._new[0], 8 * end), self._new[1]

    def exclude(self, before: Iterable[Known], after: Iterable[Known]) -> None:
        """Exclude the valid frames that the octets before and after the piece, nearest first, give by themselves."""
        first, last = self._new
        for at, octets in before:
            if (starts := self._valid_starts(octets)).size:
                first = 8 * (at + self._length) + int(starts[-1])
                break
        for at, octets in after:
            if (starts := self._valid_starts(octets)).size:
                last = 8 * at + int(starts[0])
                break
        self._new = first, last

    def batches(self, windows: Iterable[tuple[OctetArray, bool]]) -> Iterator[PacketBatch]:
        """Yield the packets of the section; `windows` are its octets, each with whether it is the last one."""
        for window, final in windows:
            yield from self._read(window, final)
        self._channels.close()
        self.found.packets += self._channels.packets
        self.found.crc_errors += self._channels.crc_errors
        self.found.octets_unused += self._channels.octets_unused

    def _synchronise(self, stream: OctetArray) -> cadu.CaduSync:
        verify = proof_of(stream, self.settings)
        return cadu.synchronise(stream, self._length, verify=verify, record_octets=self._record.octets)

    def _valid_starts(self, stream: OctetArray) -> IntArray:
        """Return the start bits of the valid frames of a stream."""
        sync = self._synchronise(stream)
        return sync.start_bits[read_frames(stream, sync, self.settings).valid]

    def _read(self, window: OctetArray, final: bool) -> Iterator[PacketBatch]:
        """Yield the batches of every spacecraft in a window."""
        stream = np.concatenate((self._held, window)) if self._held.size else window
        base, context = self._position - self._held.size, self._context
        sync = self._synchronise(stream)
        truncated = 8 * (base + sync.truncated[sync.truncated >= context])
        sync = sync.take(np.flatnonzero(sync.offsets >= context))
        self._add_times(stream, sync.offsets, base)
        starts = sync.start_bits + 8 * base
        first, last = self._new
        new = np.flatnonzero((starts >= first) & (starts + 8 * self._length <= last))
        self._count_places(starts, final, base + stream.size)
        if new.size:
            self.end = int(starts[new[-1]] + 8 * self._length + 7) >> 3
            yield from self._frames(stream, sync.take(new), base)
        self.found.frames_bad += int(np.count_nonzero((truncated >= first) & (truncated < last)))
        end = int(sync.offsets[-1]) + self._length if starts.size else context
        # keep the last CADUs, to synchronise the next window, and the incomplete one
        kept_from = max(end - CONTEXT_CADUS * self._length, 0) if starts.size or context else 0
        if stream.size - end > 2 * self._length:
            kept_from = end = stream.size - 2 * self._length
        self._held, self._context = stream[kept_from:].copy(), end - kept_from
        self._position = base + stream.size

    def _add_times(self, stream: OctetArray, offsets: IntArray, base: int) -> None:
        """Note the times of records of which the piece has a part: an earlier piece may have the frame, but no time."""
        record, section = self._record, self.section
        first = section.first - base - self._length - record.trailer_octets
        mine = (offsets > first) & (offsets - record.header_octets < section.last - base)
        self.found.add_times(record.times_utc_ns(stream, offsets[mine]))

    def _frames(self, stream: OctetArray, sync: cadu.CaduSync, base: int) -> Iterator[PacketBatch]:
        """Yield the batches of frames that are read now."""
        offset, found, record = sync.offsets + base, self.found, self._record
        frames = read_frames(stream, sync, self.settings)
        block = FrameBlock(self.settings, offset, frames, record.times_utc_ns(stream, sync.offsets))
        good = block.good
        self._count_errors(block, int(sync.marker_errors[good].sum()))
        found.frames_inverted += int(np.count_nonzero(sync.inverted))
        outside = (offset < self.section.first) | (offset + self._length > self.section.last)
        found.frames_joined += int(np.count_nonzero(outside & good))
        own = 0
        for spacecraft in self._wanted(block):
            own += int(np.count_nonzero(block.of(spacecraft)))
            self._uplink(spacecraft, block.control_words(spacecraft))
            yield self._channels.read(block, spacecraft)
        found.frames_bad += offset.size - own

    def _count_places(self, starts: IntArray, final: bool, stop: int) -> None:
        """Count lock losses, and the octets of the piece in CADUs and records, of CADUs at bits `starts` (n,)."""
        section, record, length = self.section, self._record, 8 * self._length
        ends = starts + length
        usual = 8 * record.octets
        before = ends[:-1] if self._end is None else np.append(self._end, ends)[: starts.size]
        behind = starts[starts.size - before.size :]
        # both of a pair may have been read with pieces before or after
        is_new = (behind + length > self._new[0]) & (before - length < self._new[1])
        self.found.lock_losses += int(np.count_nonzero((behind != before + usual) & is_new))
        first, last = (starts >> 3) - record.header_octets, (ends >> 3) + record.trailer_octets
        first[1:] = np.maximum(first[1:], last[:-1])
        self.found.octets_used += section.of_piece(first, last)
        if self._end is None and starts.size and section.begins:
            loose = (int(starts[0]) >> 3) - record.header_octets - section.start
            if section.position + section.start == 0 and section.stream:
                loose = 0  # nothing comes before
            self.found.octets_waiting += max(loose, 0) % (self._length + record.octets)
        if starts.size:
            self._end = int(ends[-1])
        if final and section.ends and self._end is not None:
            loose = stop - (self._end >> 3) - record.trailer_octets
            self.found.octets_waiting += loose if 0 < loose < self._length + record.octets else 0

    def _count_errors(self, block: FrameBlock, marker_bits: int) -> None:
        """Count frames and corrected errors; `marker_bits`: wrong bits in the markers of good frames."""
        found, code, n = self.found, self.settings.code, block.offset.size
        good = int(np.count_nonzero(block.good))
        corrected = block.found.corrected
        depth = 0 if code is None else code.interleave
        lost = int(np.count_nonzero(corrected < 0))
        bits = 0 if code is None else 8 * code.block_length // depth
        found.frames += n
        found.frames_good += good if self.settings.proves_frames else 0
        found.codewords += depth * n
        found.codewords_lost += lost
        found.symbols_corrected += int(corrected[corrected > 0].sum())
        found.wrong_bits += int(block.found.wrong_bits.sum()) + marker_bits
        found.checked_bits += (depth * n - lost) * bits + cadu.MARKER_BITS * good
        found.octets_frames += n * self._length
        found.octets_records += n * self._record.octets

    def _wanted(self, block: FrameBlock) -> list[int]:
        """Return the spacecraft whose frames are used."""
        found = block.spacecraft
        if self._spacecraft_id is not None:
            return [one for one in found if one == self._spacecraft_id]
        if self.settings.proves_frames:
            return found
        for position, one in enumerate(found):
            enough = int(np.count_nonzero(block.of(one))) >= FOREIGN_FRAMES
            if enough or (position == 0 and not self._believed):
                self._believed.add(one)
        return [one for one in found if one in self._believed]

    def _uplink(self, spacecraft: int, words: NDArray[np.uint32]) -> None:
        last = self._last_words.get(spacecraft, np.empty(0, dtype=np.uint32))
        channels = self.found.uplink
        both = np.concatenate((last, words))
        for words_now, sign in ((both, 1), (last, -1)):
            for seen in uplink_seen(words_now):
                key = (spacecraft, seen.virtual_channel)
                channels[key] = channels[key].followed_by(seen, sign) if key in channels else seen
        _, newest = np.unique((both >> np.uint32(18) & np.uint32(0x3F))[::-1], return_index=True)
        self._last_words[spacecraft] = both[::-1][np.sort(newest)][::-1]


@dataclass(slots=True)
class ChannelReader:
    """Reader of the packets of all channels of one section, one block of frames at a time.

    Incomplete packets at the end of a block are kept for the next one; `fragments` are those at gaps. `position` is
    that of the run in its recording `stream`.
    """

    dictionary: Dictionary
    form_of: FormOf = all_checked
    position: int = 0
    stream: str = ""
    fragments: list[Fragment] = field(default_factory=list)
    packets: int = 0
    crc_errors: int = 0
    octets_unused: int = 0
    _open: dict[Channel, Fragment] = field(default_factory=dict)

    def read(self, block: FrameBlock, spacecraft_id: int) -> PacketBatch:
        """Return the decoded packets of a spacecraft that are complete with this block.

        The reception time of a packet is that of the frame in which it begins; of a packet that began before the block,
        that of its end.
        """
        parts: list[bytes | OctetArray] = []
        segments: list[tuple[int, int]] = []
        starts, frames_used = [np.empty(0, dtype=np.int64)], [np.empty(0, dtype=np.int64)]
        filled = 0
        for channel, zones, rows in _channels(block, spacecraft_id):
            for octets, ranges, used in self._channel(block, channel, zones, rows):
                parts.append(octets)
                segments += [(filled + start, filled + stop) for start, stop in ranges]
                starts.append(filled + zones.shape[1] * np.arange(used.size, dtype=np.int64))
                frames_used.append(rows[used])
                filled += len(octets)
        buffer = b"".join(bytes(part) for part in parts)
        ranges_used = np.array(segments, dtype=np.int64).reshape(-1, 2)
        cut = cut_packets(buffer, segments=ranges_used, form=self.form_of(spacecraft_id).in_frames)
        self.packets += int(np.count_nonzero(cut.crc_ok))
        self.crc_errors += cut.crc_errors
        self.octets_unused += _not_in_packets(ranges_used, cut)
        received = None
        if block.received_utc_ns is not None:
            frame = np.searchsorted(np.concatenate(starts), cut.offsets, side="right") - 1
            received = block.received_utc_ns[np.concatenate(frames_used)[frame]]
        return batch_of_cut(buffer, cut, self.dictionary, spacecraft_id, received)

    def close(self) -> None:
        """Leave the incomplete packets as fragments."""
        for fragment in self._open.values():
            self._leave(fragment)
        self._open.clear()

    def _leave(self, fragment: Fragment) -> None:
        self.octets_unused += len(fragment.octets)
        if not (fragment.begins and is_idle(fragment.octets)):
            self.fragments.append(fragment)

    def _channel(
        self, block: FrameBlock, channel: Channel, zones: OctetArray, rows: IntArray
    ) -> Iterator[tuple[bytes | OctetArray, list[tuple[int, int]], IntArray]]:
        """Yield octets, the segments of them that hold complete packets, and the frames whose zones they are."""
        zone = zones.shape[1]
        header, offset = block.found.header, block.offset + self.position
        count, pointer = header.channel_count[rows], header.first_header_pointer[rows]
        idle = pointer == ONLY_IDLE_DATA
        filled = np.flatnonzero(~idle)
        buffer = np.ascontiguousarray(zones[~idle]).reshape(-1)
        row = np.concatenate(([0], np.cumsum(~idle)))
        breaks = np.flatnonzero(np.diff(count) % COUNTS != 1) + 1
        ranges: list[tuple[int, int]] = []
        for first, stop in pairwise([0, *breaks.tolist(), len(count)]):
            before, after = int(count[first]), int(count[stop - 1] + 1) % COUNTS
            at = int(offset[rows[first]]), int(offset[rows[stop - 1]])
            kept = self._open.pop(channel, None)
            if kept is not None and kept.next_count != before:
                self._leave(kept)
                kept = None
            low, high = int(row[first]), int(row[stop])
            begins = np.flatnonzero(pointer[first:stop][~idle[first:stop]] < zone)
            pointers = pointer[first:stop][~idle[first:stop]]
            if not begins.size:  # without octets if all frames are idle
                self._continue(channel, kept, before, after, at, buffer[low * zone : high * zone].tobytes())
                continue
            begin = (low + int(begins[0])) * zone + int(pointers[begins[0]])
            head = buffer[low * zone : begin].tobytes()
            end = packets_end(buffer, (low + int(begins[-1])) * zone + int(pointers[begins[-1]]), high * zone)
            if kept is not None and kept.begins:
                joint = kept.octets + head
                yield joint, [(0, len(joint))], filled[low + begins[:1]]
            elif lead := (b"" if kept is None else kept.octets) + head:
                opened = (before, at[0]) if kept is None else (kept.count, kept.first)
                self._leave(Fragment(channel, False, True, opened[0], UNKNOWN, opened[1], at[1], lead, self.stream))
            tail = buffer[end : high * zone].tobytes()
            ranges.append((begin, end if block.settings.proves_frames else high * zone))
            if tail:
                self._open[channel] = Fragment(channel, True, False, UNKNOWN, after, at[0], at[1], tail, self.stream)
                if not block.settings.proves_frames:  # its octets are also searched and counted
                    self.octets_unused -= len(tail)
        yield buffer, ranges, filled

    def _continue(
        self, channel: Channel, kept: Fragment | None, before: int, after: int, at: tuple[int, int], octets: bytes
    ) -> None:
        """Keep the octets of frames in which no packet begins."""
        if kept is not None:
            octets = kept.octets + octets
        if len(octets) > PACKET_MAX_LENGTH:
            self.octets_unused += len(octets)
            return
        begins, count, first = (False, before, at[0]) if kept is None else (kept.begins, kept.count, kept.first)
        if octets:
            self._open[channel] = Fragment(channel, begins, False, count, after, first, at[1], octets, self.stream)


def packets_end(buffer: OctetArray | bytes, start: int, stop: int) -> int:
    """Return the start of the packet that does not end within [start, stop), by packet lengths; else `stop`."""
    while stop - start >= PRIMARY_HEADER_LENGTH:
        length = (int(buffer[start + 4]) << 8 | int(buffer[start + 5])) + PRIMARY_HEADER_LENGTH + 1
        if start + length > stop:
            break
        start += length
    return start


def _channels(block: FrameBlock, spacecraft_id: int) -> Iterator[tuple[Channel, OctetArray, IntArray]]:
    """Yield the channels of a spacecraft, the packet zones (m, zone) of their frames, and their indices (m,)."""
    header = block.found.header
    end = block.settings.frame_length - (CRC_LENGTH if block.settings.checksum else 0)
    secondary = block.found.octets[:, FRAME_HEADER_LENGTH] & 0x3F
    start = FRAME_HEADER_LENGTH + np.where(header.secondary_header, secondary.astype(np.int64) + 1, 0)
    stop = end - np.where(header.ocf, OCF_LENGTH, 0)
    layout = np.stack((header.virtual_channel, start, stop), axis=1)
    mine = block.of(spacecraft_id) & (start < stop)
    for channel, low, high in np.unique(layout[mine], axis=0).tolist():
        rows = np.flatnonzero(mine & (layout == (channel, low, high)).all(axis=1))
        zones = block.found.octets[rows, low:high]
        again = np.flatnonzero(np.diff(header.channel_count[rows]) == 0) + 1
        if again.size:  # the same frame twice in succession
            again = again[(zones[again] == zones[again - 1]).all(axis=1)]
            zones, rows = np.delete(zones, again, axis=0), np.delete(rows, again)
        yield (spacecraft_id, channel, low, high), zones, rows


def _not_in_packets(ranges: IntArray, cut: PacketCut) -> int:
    total: Any = (ranges[:, 1] - ranges[:, 0]).sum()
    return int(total) - int(cut.lengths.sum()) - cut.octets_idle


FRAME_REACH_OCTETS = 2 * PACKET_MAX_LENGTH
"""Octets before and after a piece that are read with it."""


class PacketReader:
    """Reader of one section of packets without frames, which carry no spacecraft id.

    Parameters
    ----------
    form
        How the packets stand in the section.

    Attributes
    ----------
    end
        End of the last packet that was read, in the run.
    """

    def __init__(
        self,
        section: Section,
        found: LinkContent,
        form: PacketForm = CHECKED,
        *,
        spacecraft_id: int | None = None,
        dictionary: Dictionary = DICTIONARY,
    ) -> None:
        self.section, self.found, self._form = section, found, form
        self._spacecraft_id = spacecraft_id
        self._dictionary = dictionary
        self._new = section.start, section.stop
        self.end = 0

    def begin_at(self, end: int) -> None:
        """Read only packets from an octet on, up to which another reader has read."""
        self._new = max(self._new[0], end), self._new[1]

    def exclude(self, before: Iterable[Known], after: Iterable[Known]) -> None:
        """Exclude the packets that the octets before and after the piece, nearest first, give by themselves."""
        start, stop = self._new
        for at, octets in before:
            cut = _cut(octets, self._form, begins=self._is_start and at == self.section.start)
            ends = np.concatenate([cut.offsets + cut.lengths, cut.idle[:, 1]])
            if ends.size:
                start = at + int(ends.max())
                break
        for at, octets in after:
            cut = _cut(octets, self._form, begins=False)
            if cut.crc_ok.any():
                stop = at + int(cut.offsets[cut.crc_ok][0])
                break
        self._new = start, stop

    def take_fragments(self) -> list[Fragment]:
        """Return no fragments: packets without frames have no count by which parts could be found."""
        return []

    def batches(self, windows: Iterable[tuple[OctetArray, bool]]) -> Iterator[PacketBatch]:
        """Yield the packets of the section; `windows` are its octets, each with whether it is the last one."""
        rest = np.empty(0, dtype=np.uint8)
        at, is_start, located = self.section.start, self._is_start, False
        for window, final in windows:
            octets = np.concatenate((rest, window)) if rest.size else window
            cut = _cut(octets, self._form, final, is_start)
            if not located and (len(cut) or final):
                located = True
                self._count_waiting(cut.skipped[:1], 0)
            if final:
                self._count_waiting(cut.skipped[-1:], octets.size)
            yield self._batch(octets, cut, at)
            rest, at, is_start = octets[cut.consumed :], at + cut.consumed, True

    @property
    def _is_start(self) -> bool:
        """Return whether a packet begins where the section begins."""
        return self.section.position + self.section.start == 0

    def _batch(self, octets: OctetArray, cut: PacketCut, at: int) -> PacketBatch:
        """Return the packets of a window that are read now."""
        starts, stops = cut.offsets + at, cut.offsets + cut.lengths + at
        prefixed = np.stack((starts - self._form.prefix_octets, stops), axis=1)
        used = np.concatenate([prefixed, cut.idle + at])
        self.found.octets_used += self.section.of_piece(used[:, 0], used[:, 1])
        new = (starts >= self._new[0]) & (stops <= self._new[1])
        mine = PacketCut(cut.offsets[new], cut.lengths[new], cut.crc_ok[new], cut.skipped, cut.idle, cut.consumed)
        self.end = int(stops[new].max(initial=self.end))
        self.found.packets += int(np.count_nonzero(mine.crc_ok))
        self.found.crc_errors += mine.crc_errors
        return batch_of_cut(octets, mine, self._dictionary, self._spacecraft_id)

    def _count_waiting(self, skipped: IntArray, edge: int) -> None:
        """Count the skipped octets at the start (0) or the end of the run, which may belong to an incomplete packet."""
        section = self.section
        if not skipped.size or not (section.ends if edge else section.begins):
            return
        start, stop = skipped[0].tolist()
        at_edge = stop == edge if edge else start == 0 and not (section.stream and self._is_start)
        if at_edge and stop - start <= PACKET_MAX_LENGTH:
            self.found.octets_waiting += stop - start


def _cut(octets: OctetArray, form: PacketForm, final: bool = True, begins: bool = True) -> PacketCut:
    """Return the packets of a window; of those that are found by headers, as many as others certainly follow."""
    if final or not form.by_headers:
        return cut_packets(octets, final=final, form=form, begins=begins)
    cut = cut_packets(octets, form=form, begins=begins)
    border = octets.size - 2 * PACKET_MAX_LENGTH
    starts = cut.offsets[cut.crc_ok & (cut.offsets <= border)]
    consumed = max(int(starts[-1]) - form.prefix_octets, 0) if starts.size else 0
    whole = cut.offsets < consumed
    return PacketCut(
        cut.offsets[whole],
        cut.lengths[whole],
        cut.crc_ok[whole],
        cut.skipped[cut.skipped[:, 1] <= consumed],
        cut.idle[cut.idle[:, 1] <= consumed],
        consumed,
    )
