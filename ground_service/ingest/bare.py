"""Packets of a section of a recording without frames.

Packets that the octets before or after a piece give by themselves were read with those pieces; the others are read now.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from ground_service.ingest.core import Found, Fragment
from ground_service.ingest.frames import Known, Section
from ground_service.ingest.packets import PacketBatch, batch_of_cut
from lunar.arrays import IntArray, OctetArray
from tmtc.dictionary.payload import DICTIONARY
from tmtc.dictionary.schema import Dictionary
from tmtc.packets.space_packets import PACKET_MAX_LENGTH
from tmtc.packets.stream import CHECKED, PacketCut, PacketForm, cut_packets

REACH_OCTETS = 2 * PACKET_MAX_LENGTH
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
        found: Found,
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
        """Whether a packet begins where the section begins."""
        return self.section.position + self.section.start == 0

    def _batch(self, octets: OctetArray, cut: PacketCut, at: int) -> PacketBatch:
        """Return the packets of a window that are read now."""
        starts, stops = cut.offsets + at, cut.offsets + cut.lengths + at
        prefixed = np.stack((starts - self._form.prefix_octets, stops), axis=1)
        used = np.concatenate([prefixed, cut.idle + at])
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
