"""A downlink, read block by block: packets are handed on as soon as they are whole, every octet is accounted for."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from ground_service.link.packets import PacketBatch, batch_of_cut
from tmtc.dictionary import DICTIONARY
from tmtc.schema import Dictionary
from tmtc.stream import cut_packets

BATCH_OCTETS = 4 << 20
"""Octets decoded and stored at a time: large enough to spread the cost of a transaction, small against memory."""


@dataclass(slots=True)
class LinkAccounting:
    """What was met on the way so far."""

    octets: int = 0
    crc_errors: int = 0
    octets_skipped: int = 0
    frames: int = 0
    frames_bad: int = 0
    symbols_corrected: int = 0


class DownlinkReader:
    """Reads one stream: CADUs or bare space packets, told apart by content."""

    def __init__(self, dictionary: Dictionary = DICTIONARY) -> None:
        self.accounting = LinkAccounting()
        self._dictionary = dictionary

    def batches(self, blocks: Iterable[bytes]) -> Iterator[PacketBatch]:
        """The packets of the stream, in batches."""
        rest = b""
        for block, final in _last_marked(_rebuffered(blocks, BATCH_OCTETS)):
            self.accounting.octets += len(block)
            buffer = rest + block
            cut = cut_packets(buffer, final=final)
            self.accounting.crc_errors += cut.crc_errors
            self.accounting.octets_skipped += cut.octets_skipped
            rest = b"" if final else bytes(memoryview(buffer)[cut.consumed :])
            yield batch_of_cut(buffer, cut, self._dictionary)


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
