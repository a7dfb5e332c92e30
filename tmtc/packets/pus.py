"""PUS-C secondary headers of telemetry and telecommand packets, and request ids.

References
----------
ECSS-E-ST-70-41C sections 7.4.3.1 (telemetry) and 7.4.4.1 (telecommand).
"""

import struct
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from tmtc.arrays import IntArray
from tmtc.errors import MalformedPacket, TruncatedPacket, ValueRefused

P_FIELD = 0x2E
TICKS_PER_SECOND = 1 << 16
TICKS_LIMIT = 1 << 48
CUC_LENGTH = 7

NO_TICKS = -1
"""On-board time of a packet that carries none, or none that is possible."""


def onboard_ticks(values: npt.NDArray[Any]) -> IntArray:
    """Return on-board times (n,) given as u64 in signed integers; `NO_TICKS` for those beyond 48 bits."""
    ticks = values.astype(np.int64)
    ticks[values >= TICKS_LIMIT] = NO_TICKS
    return ticks


PUS_VERSION = 2
TM_HEADER_LENGTH = 7 + CUC_LENGTH
TC_HEADER_LENGTH = 5

ACK_ACCEPTANCE = 0b0001
ACK_START = 0b0010
ACK_COMPLETION = 0b1000
ACK_ALL = 0b1111

_TM = struct.Struct(">BBBHHBIH")
_TC = struct.Struct(">BBBH")


@dataclass(frozen=True, slots=True)
class TmSecondaryHeader:
    """Service type and subtype, message counter, destination and on-board time of a telemetry packet."""

    service: int
    subtype: int
    ticks: int
    message_counter: int = 0
    destination: int = 0
    time_status: int = 0


@dataclass(frozen=True, slots=True)
class TcSecondaryHeader:
    """Service type and subtype, wanted acknowledgements and source of a telecommand packet."""

    service: int
    subtype: int
    acknowledgements: int = ACK_ALL
    source: int = 0


def pack_tm_header(header: TmSecondaryHeader) -> bytes:
    """Fourteen octets."""
    for name, limit in (("ticks", TICKS_LIMIT), ("message_counter", 1 << 16), ("destination", 1 << 16)):
        if not 0 <= getattr(header, name) < limit:
            raise ValueRefused("telemetry header", name, getattr(header, name), f"0..{limit - 1}")
    return _TM.pack(
        PUS_VERSION << 4 | header.time_status,
        header.service,
        header.subtype,
        header.message_counter,
        header.destination,
        P_FIELD,
        int(header.ticks) >> 16,
        int(header.ticks) & 0xFFFF,
    )


def unpack_tm_header(octets: bytes | memoryview) -> TmSecondaryHeader:
    """The telemetry secondary header at the start of `octets` (right after the primary header)."""
    if len(octets) < TM_HEADER_LENGTH:
        raise TruncatedPacket("telemetry secondary header", TM_HEADER_LENGTH, len(octets))
    first, service, subtype, counter, destination, p_field, coarse, fine = _TM.unpack_from(octets)
    if first >> 4 != PUS_VERSION:
        raise MalformedPacket(f"telemetry secondary header: expected PUS version 2, found {first >> 4}")
    if p_field != P_FIELD:
        raise MalformedPacket(f"telemetry time: expected P-field 0x{P_FIELD:02X}, found 0x{p_field:02X}")
    return TmSecondaryHeader(
        service=service,
        subtype=subtype,
        ticks=coarse << 16 | fine,
        message_counter=counter,
        destination=destination,
        time_status=first & 0xF,
    )


def pack_tc_header(header: TcSecondaryHeader) -> bytes:
    """Five octets."""
    return _TC.pack(PUS_VERSION << 4 | header.acknowledgements, header.service, header.subtype, header.source)


def unpack_tc_header(octets: bytes | memoryview) -> TcSecondaryHeader:
    """The telecommand secondary header at the start of `octets` (right after the primary header)."""
    if len(octets) < TC_HEADER_LENGTH:
        raise TruncatedPacket("telecommand secondary header", TC_HEADER_LENGTH, len(octets))
    first, service, subtype, source = _TC.unpack_from(octets)
    if first >> 4 != PUS_VERSION:
        raise MalformedPacket(f"telecommand secondary header: expected PUS version 2, found {first >> 4}")
    return TcSecondaryHeader(service, subtype, first & 0xF, source)


def request_id(packet: bytes | memoryview) -> int:
    """The 32-bit request id of a telecommand packet: its first four octets (packet id, sequence control)."""
    if len(packet) < 4:
        raise TruncatedPacket("telecommand packet", 4, len(packet))
    return int.from_bytes(packet[:4], "big")
