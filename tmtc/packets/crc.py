"""CRC-16 of packet and frame error control (polynomial 0x1021, start 0xFFFF, no reflection, no final xor).

References
----------
ECSS-E-ST-70-41C annex B.1; CCSDS 132.0-B 4.1.6. The check value of `b"123456789"` is 0x29B1.
"""

import binascii

from tmtc.errors import ChecksumError, TruncatedPacket

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
