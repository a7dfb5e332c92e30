"""A downlink, read window by window: packets are handed on as soon as they are whole, every octet is accounted for.

CADU streams are decoded in windows that overlap by as many frames as the longest packet can span. A packet in the
overlap is met twice and stored once, so no packet is lost at a border; the accounting of each overlap by itself is
taken off again, so the sums are those of the stream read at once.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np

from ground_service.link.packets import PacketBatch, batch_of_cut
from tmtc.cadu import ASM
from tmtc.clcw import UplinkSeen
from tmtc.dictionary import DICTIONARY
from tmtc.downlink import FRAME_FOREIGN, DownlinkDecode, LinkSettings, decode
from tmtc.packets import PACKET_MAX_LENGTH
from tmtc.schema import Dictionary
from tmtc.stream import PacketCut, cut_packets

WINDOW_OCTETS = 2 << 20
"""Octets decoded and stored at a time: large enough to spread the cost of a transaction and of the overlap, small
against memory: decoding and storing take about ten times as much."""

PROBE_OCTETS = 256 << 10
"""Octets from which the settings of a link are told; the whole window where the stream begins with noise."""

FOREIGN_FRAMES = 2
"""A spacecraft is believed to be in a stream from this many good frames on."""


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


@dataclass(frozen=True, slots=True)
class StreamEdges:
    """How a stream begins and ends: what does not belong to a whole unit there, and the counts of the frames there.

    `settings` is None for bare packets. Counts are those of the master channel, None where the frame at the edge is
    not good.
    """

    settings: LinkSettings | None
    octets: int
    head_loose: int
    tail_loose: int
    head_count: int | None = None
    tail_count: int | None = None


class DownlinkReader:
    """Reads one stream: CADUs or bare space packets, told apart by content.

    Parameters
    ----------
    spacecraft_id
        Only frames of this spacecraft are used; None: those of every spacecraft in the stream. Bare packets do not
        say whose they are.
    """

    def __init__(
        self,
        spacecraft_id: int | None = None,
        dictionary: Dictionary = DICTIONARY,
        window_octets: int = WINDOW_OCTETS,
    ) -> None:
        self.accounting = LinkAccounting()
        self.edges: StreamEdges | None = None
        self._spacecraft_id = spacecraft_id
        self._dictionary = dictionary
        self._window_octets = window_octets

    def batches(self, blocks: Iterable[bytes]) -> Iterator[PacketBatch]:
        """The packets of the stream, in batches.

        Raises
        ------
        LinkFormatError
            If frames stand in the stream whose coding is not known.
        """
        windows = _last_marked(_rebuffered(blocks, self._window_octets))
        rest = b""
        settings: LinkSettings | None = None
        bare: bool | None = None
        for block, final in windows:
            self.accounting.octets += len(block)
            window = rest + block
            if bare is None:
                settings = self._settings_of(window)
                bare = settings is None
            if settings is None:
                cut = cut_packets(window, final=final)
                self._packet_edges(cut, len(window), final)
                self.accounting.octets_skipped += cut.octets_skipped
                self._count(cut)
                rest = b"" if final else bytes(memoryview(window)[cut.consumed :])
                yield batch_of_cut(window, cut, self._dictionary, self._spacecraft_id)
                continue
            yield from self._frames(window, settings, sign=1)
            rest = b""
            if not final:
                rest = _overlap(window, settings)
                for _ in self._frames(rest, settings, sign=-1):
                    pass

    def _settings_of(self, window: bytes) -> LinkSettings | None:
        """How frames travel in the stream that begins like this; None for bare packets."""
        probe = decode(window[:PROBE_OCTETS], dictionary=self._dictionary)
        if probe.settings is None and len(window) > PROBE_OCTETS and ASM in window:
            probe = decode(window, dictionary=self._dictionary)
        return probe.settings

    def _frames(self, window: bytes, settings: LinkSettings, sign: int) -> Iterator[PacketBatch]:
        """Batches of every spacecraft in a window; `sign` -1 takes the window off the accounting again."""
        first = decode(
            window, settings=settings, spacecraft_id=self._spacecraft_id, dictionary=self._dictionary
        )
        found = [first]
        if self._spacecraft_id is None:
            found += [
                decode(window, settings=settings, spacecraft_id=other, dictionary=self._dictionary)
                for other in _other_spacecraft(first)
            ]
        own = sum(_good_frames(one) for one in found)
        frames = len(first.frames) if first.frames is not None else 0
        truncated = first.frames_bad - (frames - _good_frames(first))
        self.accounting.frames += sign * frames
        self.accounting.frames_bad += sign * (frames - own + truncated)
        self.accounting.symbols_corrected += sign * first.symbols_corrected
        self.accounting.octets_skipped += sign * first.octets["unsynchronised"]
        if sign > 0:
            self._frame_edges(first, settings, len(window))
        for one in found:
            self._uplink(one, sign)
            self.accounting.octets_skipped += sign * (one.octets["orphaned"] + one.octets["skipped"])
            self._count(one.cut, sign)
            if sign > 0:
                yield batch_of_cut(one.buffer, one.cut, self._dictionary, one.spacecraft_id)

    def _uplink(self, found: DownlinkDecode, sign: int) -> None:
        if found.spacecraft_id is None:
            return
        channels = self.accounting.uplink
        for seen in found.uplink:
            key = (found.spacecraft_id, seen.virtual_channel)
            channels[key] = channels[key].followed_by(seen, sign) if key in channels else seen

    def _packet_edges(self, cut: PacketCut, octets: int, final: bool) -> None:
        first = self.edges
        head = int(cut.skipped[0, 1]) if len(cut.skipped) and cut.skipped[0, 0] == 0 else 0
        tail = (
            octets - int(cut.skipped[-1, 0])
            if final and len(cut.skipped) and cut.skipped[-1, 1] == octets
            else 0
        )
        self.edges = StreamEdges(
            None, self.accounting.octets, head if first is None else first.head_loose, tail
        )

    def _frame_edges(self, found: DownlinkDecode, settings: LinkSettings, octets: int) -> None:
        frames = found.frames
        if frames is None or len(frames) == 0:
            return
        first = self.edges
        counts = [int(frames.master_count[i]) if frames.verdict[i] == 0 else None for i in (0, -1)]
        tail = octets - int(frames.offset[-1]) - settings.cadu_length
        if first is None:
            self.edges = StreamEdges(
                settings, self.accounting.octets, int(frames.offset[0]), tail, counts[0], counts[1]
            )
        else:
            self.edges = StreamEdges(
                settings, self.accounting.octets, first.head_loose, tail, first.head_count, counts[1]
            )

    def _count(self, cut: PacketCut, sign: int = 1) -> None:
        self.accounting.packets += sign * int(np.count_nonzero(cut.crc_ok))
        self.accounting.crc_errors += sign * cut.crc_errors


def _good_frames(result: DownlinkDecode) -> int:
    """Frames of the spacecraft that was decoded that are without fault."""
    return int(np.count_nonzero(result.frames.verdict == 0)) if result.frames is not None else 0


def _other_spacecraft(result: DownlinkDecode) -> list[int]:
    """Ids of further spacecraft in a window, by their good frames."""
    if result.frames is None:
        return []
    foreign = result.frames.spacecraft_id[result.frames.verdict == FRAME_FOREIGN]
    ids, counts = np.unique(foreign, return_counts=True)
    return [
        int(i) for i, n in zip(ids, counts, strict=True) if n >= FOREIGN_FRAMES and i != result.spacecraft_id
    ]


def _overlap(window: bytes, settings: LinkSettings) -> bytes:
    """The end of a window that the next one has to begin with: the longest packet may begin anywhere in it."""
    length = min(reach_octets(settings), len(window) // 2)
    return window[len(window) - length :]


def reach_octets(settings: LinkSettings | None) -> int:
    """Octets of a stream over which one packet can stretch; of bare packets when there are no settings."""
    if settings is None:
        return PACKET_MAX_LENGTH
    frames = PACKET_MAX_LENGTH // max(settings.frame_length - 16, 1) + 3
    return frames * settings.cadu_length


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
    """Every block, with True beside the last one."""
    previous: bytes | None = None
    for block in blocks:
        if previous is not None:
            yield previous, False
        previous = block
    if previous is not None:
        yield previous, True
