"""Telecommand octets to commands: cut, checked, named, never twice; others are refused with a reason."""

import zlib
from collections import OrderedDict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

from tmtc.dictionary.payload import DICTIONARY
from tmtc.errors import ChecksumError, MalformedPacket, TmtcError, UnknownPacket
from tmtc.packets.space_packets import SEQUENCE_COUNT_LIMIT

_PRIMARY_HEADER_LENGTH = 6
_SHORTEST_PACKET = 13
# Codes of the dictionary's failure table.
_CODES = {name: code for code, name in DICTIONARY.labels("verification_not_accepted", "failure_code").items()}
# Commands remembered, so that none is carried out twice; older ones are out of sequence in any case.
_REMEMBERED = 256
# Sources whose counts are kept apart.
_SOURCES = 16


@dataclass(frozen=True, slots=True)
class Command:
    """A telecommand that could be read; `request_id` is the first four octets of its packet."""

    name: str
    values: dict[str, Any]
    request_id: int
    acknowledgements: int
    packet: bytes

    @property
    def sequence_count(self) -> int:
        return self.request_id & (SEQUENCE_COUNT_LIMIT - 1)


@dataclass(frozen=True, slots=True)
class Refusal:
    """Octets that are no telecommand of the dictionary, and why."""

    request_id: int
    failure_code: int


def failure(name: str) -> int:
    """The code of a reason in the dictionary's failure table."""
    return _CODES[name]


def parse_commands(octets: bytes) -> Iterator[Command | Refusal]:
    """Return the telecommand packets laid end to end in the octets; a broken length ends the reading."""
    while octets:
        request_id = int.from_bytes(octets[:4].ljust(4, b"\0"), "big")
        length = 7 + int.from_bytes(octets[4:6], "big") if len(octets) >= _PRIMARY_HEADER_LENGTH else 0
        if length < _SHORTEST_PACKET or length > len(octets):
            yield Refusal(request_id, failure("bad_length"))
            return
        packet, octets = octets[:length], octets[length:]
        yield _read(packet, request_id)


@dataclass(slots=True)
class CommandHistory:
    """Record of earlier commands: a repeated packet is a duplicate, an older count of its source is out of sequence.

    Counts may jump forward (commands lost on the way), by less than half of their range. A packet is known by its
    request id and CRC-32.
    """

    newest_count: int = -1
    _by_source: OrderedDict[int, int] = field(default_factory=OrderedDict)
    _seen: OrderedDict[tuple[int, int], None] = field(default_factory=OrderedDict)

    def judge(self, packet: bytes, *, in_sequence: bool = True) -> int:
        """0 for a new command in sequence, else the code of what is wrong."""
        if _key(packet) in self._seen:
            return failure("duplicate")
        newest = self._by_source.get(_source(packet)) if in_sequence else None
        if newest is not None:
            ahead = (_count(packet) - newest) % SEQUENCE_COUNT_LIMIT
            if not 0 < ahead < SEQUENCE_COUNT_LIMIT // 2:
                return failure("out_of_sequence")
        return 0

    def note(self, packet: bytes, *, in_sequence: bool = True) -> None:
        """Remember a command as taken; `in_sequence` ones move the newest count of their source."""
        self._seen[_key(packet)] = None
        if in_sequence:
            self.newest_count = self._by_source[_source(packet)] = _count(packet)
            self._by_source.move_to_end(_source(packet))
        while len(self._seen) > _REMEMBERED:
            self._seen.popitem(last=False)
        while len(self._by_source) > _SOURCES:
            self._by_source.popitem(last=False)

    def to_plain(self) -> list[Any]:
        """The history as numbers, for non-volatile memory."""
        return [self.newest_count, list(self._by_source.items()), [list(key) for key in self._seen]]

    def restore(self, plain: Iterable[Any]) -> None:
        """Take what `to_plain` gave."""
        self.newest_count, by_source, seen = plain
        self._by_source = OrderedDict((int(source), int(count)) for source, count in by_source)
        self._seen = OrderedDict(((int(request), int(crc)), None) for request, crc in seen)


def _key(packet: bytes) -> tuple[int, int]:
    return int.from_bytes(packet[:4], "big"), zlib.crc32(packet)


def _count(packet: bytes) -> int:
    return int.from_bytes(packet[2:4], "big") & (SEQUENCE_COUNT_LIMIT - 1)


def _source(packet: bytes) -> int:
    return int.from_bytes(packet[9:11], "big")


def _read(packet: bytes, request_id: int) -> Command | Refusal:
    try:
        decoded = DICTIONARY.unpack_command(packet)
    except ChecksumError:
        return Refusal(request_id, failure("bad_checksum"))
    except UnknownPacket:
        return Refusal(request_id, failure("unknown_packet"))
    except MalformedPacket:
        return Refusal(request_id, failure("bad_length"))
    except TmtcError:
        return Refusal(request_id, failure("value_out_of_range"))
    return Command(decoded.name, decoded.values, request_id, decoded.acknowledgements, packet)
