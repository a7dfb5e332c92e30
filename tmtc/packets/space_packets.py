"""Space packets: primary header, idle packets, sequence counts, CRC-16 of the packet error control.

References
----------
CCSDS 133.0-B-2 section 4.1. Octets of the primary header: version (3 bits), type (1), secondary header flag
(1), APID (11) | sequence flags (2), sequence count (14) | octets of the data field minus one (16).
"""

import binascii
import struct
from dataclasses import dataclass, field

from tmtc.errors import ChecksumError, MalformedPacket, TruncatedPacket, ValueRefused

PRIMARY_HEADER_LENGTH = 6
PACKET_MAX_LENGTH = 65_542
APID_LIMIT = 1 << 11
IDLE_APID = 0x7FF
SEQUENCE_COUNT_LIMIT = 1 << 14

TYPE_TELEMETRY = 0
TYPE_TELECOMMAND = 1

FLAGS_CONTINUATION, FLAGS_FIRST, FLAGS_LAST, FLAGS_WHOLE = range(4)

_HEADER = struct.Struct(">HHH")


@dataclass(frozen=True, slots=True)
class PrimaryHeader:
    """The six octets before every packet; `data_length` is the field as sent, octets minus one."""

    apid: int
    packet_type: int = TYPE_TELEMETRY
    secondary_header: bool = True
    sequence_count: int = 0
    data_length: int = 0

    @property
    def packet_length(self) -> int:
        """Octets of the whole packet, header included."""
        return PRIMARY_HEADER_LENGTH + self.data_length + 1


def pack_packet(
    apid: int, data: bytes, *, sequence_count: int, packet_type: int = TYPE_TELEMETRY, secondary_header: bool = True
) -> bytes:
    """A space packet with `data` as its data field (secondary header and error control included)."""
    if not 0 <= apid < APID_LIMIT:
        raise ValueRefused("space packet", "apid", apid, "0..2047")
    if not 0 <= sequence_count < SEQUENCE_COUNT_LIMIT:
        raise ValueRefused("space packet", "sequence_count", sequence_count, "0..16383")
    if not 1 <= len(data) <= 65_536:
        raise ValueRefused("space packet", "data", f"{len(data)} octets", "1..65536 octets")
    first = packet_type << 12 | secondary_header << 11 | apid
    return _HEADER.pack(first, FLAGS_WHOLE << 14 | sequence_count, len(data) - 1) + data


def unpack_primary_header(octets: bytes | memoryview) -> PrimaryHeader:
    """The primary header at the start of `octets`; the packet itself may be longer than `octets`."""
    if len(octets) < PRIMARY_HEADER_LENGTH:
        raise TruncatedPacket("space packet header", PRIMARY_HEADER_LENGTH, len(octets))
    first, second, data_length = _HEADER.unpack_from(octets)
    if first >> 13:
        raise MalformedPacket(f"space packet: expected version 0, found {first >> 13}")
    return PrimaryHeader(
        apid=first & 0x7FF,
        packet_type=first >> 12 & 1,
        secondary_header=bool(first >> 11 & 1),
        sequence_count=second & 0x3FFF,
        data_length=data_length,
    )


def idle_packet(length: int) -> bytes:
    """An idle packet of `length` octets (7 or more), filled with 0x55; its count is not to be checked."""
    if not PRIMARY_HEADER_LENGTH < length <= PACKET_MAX_LENGTH:
        raise ValueRefused("idle packet", "length", length, f"7..{PACKET_MAX_LENGTH} octets")
    fill = b"\x55" * (length - PRIMARY_HEADER_LENGTH)
    return pack_packet(IDLE_APID, fill, sequence_count=0, secondary_header=False)


@dataclass(slots=True)
class PacketSequencer:
    """The 14-bit sequence counts of one sender, one counter per APID, wrapping from 16383 to 0."""

    counts: dict[int, int] = field(default_factory=dict)

    def next(self, apid: int) -> int:
        """The count for the next packet of `apid`."""
        count = self.counts.get(apid, 0)
        self.counts[apid] = (count + 1) % SEQUENCE_COUNT_LIMIT
        return count


CRC_LENGTH = 2
CRC_START = 0xFFFF


def crc16(octets: bytes | bytearray | memoryview, start: int = CRC_START) -> int:
    """The checksum of `octets`; zero when `octets` end with their own checksum."""
    return binascii.crc_hqx(octets, start)


def append_crc(octets: bytes) -> bytes:
    """`octets` followed by their checksum."""
    return octets + crc16(octets).to_bytes(CRC_LENGTH, "big")


def check_crc(octets: bytes | bytearray | memoryview, what: str) -> None:
    """Raise when the last two octets are not the checksum of those before them."""
    if len(octets) < CRC_LENGTH:
        raise TruncatedPacket(what, CRC_LENGTH, len(octets))
    if crc16(octets):
        view = memoryview(octets)
        raise ChecksumError(what, crc16(view[:-CRC_LENGTH]), int.from_bytes(view[-CRC_LENGTH:], "big"))
