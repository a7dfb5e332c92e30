"""Packets of a section of a recording without frames.

Packets that the octets before or after a piece give by themselves were read with those pieces; the others are read now.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from ground_service.ingest.fragments import Fragment
from ground_service.ingest.frames import Section
from ground_service.ingest.packets import PacketBatch, batch_of_cut
from ground_service.ingest.quality import Found
from lunar.arrays import IntArray, OctetArray
from tmtc.dictionary import DICTIONARY
from tmtc.packets import PACKET_MAX_LENGTH
from tmtc.schema import Dictionary
from tmtc.stream import PacketCut, cut_packets

REACH_OCTETS = 2 * PACKET_MAX_LENGTH
"""Octets before and after a piece that are read with it."""


class PacketReader:
    """Reader of one section of packets without frames, which carry no spacecraft id.

    Parameters
    ----------
    unchecked_apids
        APIDs whose packets do not end with a checksum.
    error_control
        Whether packets end with a checksum.

    Attributes
    ----------
    end
        End of the last packet that was read, in the run.
    """

    def __init__(
        self,
        section: Section,
        found: Found,
        *,
        spacecraft_id: int | None = None,
        dictionary: Dictionary = DICTIONARY,
        unchecked_apids: frozenset[int] = frozenset(),
        error_control: bool = True,
    ) -> None:
        self.section, self.found = section, found
        self._spacecraft_id = spacecraft_id
        self._dictionary = dictionary
        self._unchecked_apids = unchecked_apids
        self._error_control = error_control
        self._new = section.start, section.stop
        self.end = 0

    def begin_at(self, end: int) -> None:
        """Read only packets from an octet on, up to which another reader has read."""
        self._new = max(self._new[0], end), self._new[1]

    def exclude(self, before: OctetArray, after: OctetArray) -> None:
        """Exclude the packets that the octets before and after the piece give by themselves."""
        section = self.section
        earlier, later = self._cut(before, True, self._is_start), self._cut(after, True, begins=False)
        stops = np.concatenate([earlier.offsets + earlier.lengths, earlier.idle[:, 1]])
        starts = later.offsets[later.crc_ok]
        self._new = (
            section.start + int(stops.max(initial=0)),
            section.last + int(starts[0]) if starts.size else section.stop,
        )

    def take_fragments(self) -> list[Fragment]:
        """Return no fragments: packets without frames have no count by which parts could be found."""
        return []

    def batches(self, windows: Iterable[tuple[OctetArray, bool]]) -> Iterator[PacketBatch]:
        """Yield the packets of the section; `windows` are its octets, each with whether it is the last one."""
        rest = np.empty(0, dtype=np.uint8)
        at, is_start, located = self.section.start, self._is_start, False
        for window, final in windows:
            octets = np.concatenate((rest, window)) if rest.size else window
            cut = self._cut(octets, final, is_start)
            if not located and (len(cut) or final):
                located = True
                self._count_waiting(cut.skipped[:1], 0)
            if final:
                self._count_waiting(cut.skipped[-1:], octets.size)
            yield self._batch(octets, cut, at)
            rest, at, is_start = octets[cut.consumed :], at + cut.consumed, True

    @property
    def _is_start(self) -> bool:
        """Whether a packet begins where the section begins."""
        return self.section.position + self.section.start == 0

    def _cut(self, octets: OctetArray, final: bool, begins: bool) -> PacketCut:
        if self._error_control:
            return cut_packets(octets, final=final, unchecked_apids=self._unchecked_apids)
        return _cut_unchecked(octets, final, begins)

    def _batch(self, octets: OctetArray, cut: PacketCut, at: int) -> PacketBatch:
        """Return the packets of a window that are read now."""
        starts, stops = cut.offsets + at, cut.offsets + cut.lengths + at
        used = np.concatenate([np.stack((starts, stops), axis=1), cut.idle + at])
        self.found.octets_used += self.section.of_piece(used[:, 0], used[:, 1])
        new = (starts >= self._new[0]) & (stops <= self._new[1])
        mine = PacketCut(
            cut.offsets[new], cut.lengths[new], cut.crc_ok[new], cut.skipped, cut.idle, cut.consumed
        )
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


def _cut_unchecked(window: OctetArray, final: bool, begins: bool) -> PacketCut:
    """Return the packets without error control of a window, as far as the octets behind confirm them."""
    cut = cut_packets(window, error_control=False, begins=begins)
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
