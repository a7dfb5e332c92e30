"""Telecommand octets to commands: cut, checked, named; what cannot be read is refused with a reason."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from tmtc.dictionary import DICTIONARY
from tmtc.errors import ChecksumError, MalformedPacket, TmtcError, UnknownPacket

_PRIMARY_HEADER_LENGTH = 6
_SHORTEST_PACKET = 13
# Codes of the dictionary's failure table.
_UNKNOWN_PACKET, _BAD_CHECKSUM, _BAD_LENGTH, _OUT_OF_RANGE = 1, 2, 3, 4


@dataclass(frozen=True, slots=True)
class Command:
    """A telecommand that could be read; `request_id` is the first four octets of its packet."""

    name: str
    values: dict[str, Any]
    request_id: int
    acknowledgements: int


@dataclass(frozen=True, slots=True)
class Refusal:
    """Octets that are no telecommand of the dictionary, and why."""

    request_id: int
    failure_code: int


def parse_commands(octets: bytes) -> Iterator[Command | Refusal]:
    """Return the telecommand packets laid end to end in the octets; a broken length ends the reading."""
    while octets:
        padded = octets[:4].ljust(4, b"\0")
        request_id = int.from_bytes(padded, "big")
        length = 7 + int.from_bytes(octets[4:6], "big") if len(octets) >= _PRIMARY_HEADER_LENGTH else 0
        if length < _SHORTEST_PACKET or length > len(octets):
            yield Refusal(request_id, _BAD_LENGTH)
            return
        packet, octets = octets[:length], octets[length:]
        yield _read(packet, request_id)


def _read(packet: bytes, request_id: int) -> Command | Refusal:
    try:
        decoded = DICTIONARY.unpack_command(packet)
    except ChecksumError:
        return Refusal(request_id, _BAD_CHECKSUM)
    except UnknownPacket:
        return Refusal(request_id, _UNKNOWN_PACKET)
    except MalformedPacket:
        return Refusal(request_id, _BAD_LENGTH)
    except TmtcError:
        return Refusal(request_id, _OUT_OF_RANGE)
    return Command(decoded.name, decoded.values, request_id, decoded.acknowledgements)
