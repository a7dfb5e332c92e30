"""PUS-C secondary headers, request ids, and the times in headers (CUC, CDS).

References
----------
ECSS-E-ST-70-41C sections 7.4.3.1 (telemetry) and 7.4.4.1 (telecommand).
"""

import struct
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from tmtc.arrays import IntArray, Octets, as_octets
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


_SECONDS_LIMIT = 1 << 40
_DAYS_LIMIT = 100_000
"""Limits of what a code can state as elapsed; more would not fit 64-bit numbers of ticks or nanoseconds."""

_NS_PER_MILLISECOND = 1_000_000
_SUBMILLISECOND_NS = {0: (0, 1), 2: (1_000, 1), 4: (1, 1_000)}
"""Nanoseconds of the submillisecond unit as a fraction: microseconds in 2 octets, picoseconds in 4."""


@dataclass(frozen=True, slots=True)
class TimeCode:
    """Time code at a fixed place of a packet: `whole` octets of seconds (CUC) or of days (CDS).

    `fraction` octets follow: of a second (CUC), or below the millisecond (CDS: 0, 2 or 4). `offset` is that of the
    first octet of the code, which is the P-field if `p_field` is set.
    """

    code: Literal["cuc", "cds"]
    offset: int
    whole: int
    fraction: int
    p_field: bool = False

    @property
    def p_field_octets(self) -> int:
        """Octets of the P-field; 0 if the code has none."""
        extended = self.code == "cuc" and (self.whole > 4 or self.fraction > 3)
        return self.p_field * (2 if extended else 1)

    @property
    def end(self) -> int:
        """Offset of the octet behind the code."""
        milliseconds = 0 if self.code == "cuc" else 4
        return self.offset + self.p_field_octets + self.whole + milliseconds + self.fraction


def elapsed(
    buffer: Octets, offsets: IntArray, lengths: IntArray, code: TimeCode
) -> tuple[IntArray, IntArray, npt.NDArray[np.bool_]]:
    """Return what packets state as time since the epoch of their code.

    Parameters
    ----------
    offsets, lengths
        (n,) octets at which packets begin in `buffer`, and their lengths.

    Returns
    -------
    tuple
        CUC: seconds and units of 2^-16 s (n,); CDS: days and nanoseconds of the day (n,). Then whether a packet has a
        time (n,): its code lies in the packet, its P-field states the sizes, and its numbers are possible.
    """
    octets = as_octets(buffer)
    known = lengths >= code.end
    start = np.where(known, offsets, 0) + code.offset
    whole = np.zeros(len(offsets), dtype=np.int64)
    part = whole.copy()
    if not known.any():
        return whole, part, known
    rows = np.flatnonzero(known)
    at = start[rows]
    if code.p_field:
        for place, (mask, value) in enumerate(_p_field(code)):
            known[rows] &= octets[at + place] & mask == value
        at = at + code.p_field_octets
    whole[rows] = _number(octets, at, code.whole)
    at = at + code.whole
    if code.code == "cuc":
        part[rows] = _number(octets, at, min(code.fraction, 2)) << 8 * (2 - min(code.fraction, 2))
        known &= whole < _SECONDS_LIMIT
        return whole, part, known
    milliseconds = _number(octets, at, 4)
    unit, divisor = _SUBMILLISECOND_NS[code.fraction]
    fine = _number(octets, at + 4, code.fraction) * unit // divisor
    part[rows] = milliseconds * _NS_PER_MILLISECOND + fine
    possible = (milliseconds < 86_401_000) & (fine < _NS_PER_MILLISECOND)  # a leap second included
    known[rows] &= possible & (whole[rows] < _DAYS_LIMIT)
    return whole, part, known


def _p_field(code: TimeCode) -> list[tuple[int, int]]:
    """Return mask and value of the octets of the P-field that states the sizes of a code."""
    if code.code == "cds":
        sizes = (code.whole == 3) << 2 | (code.fraction // 2)
        return [(0xF7, 0x40 | sizes)]  # the epoch is not a size
    first = (min(code.whole, 4) - 1) << 2 | min(code.fraction, 3)
    if code.p_field_octets == 1:
        return [(0x8F, first)]
    return [
        (0x8F, 0x80 | first),
        (0xFC, (code.whole - min(code.whole, 4)) << 5 | (code.fraction - min(code.fraction, 3)) << 2),
    ]


def _number(octets: npt.NDArray[np.uint8], at: IntArray, size: int) -> IntArray:
    value = np.zeros(len(at), dtype=np.int64)
    for place in range(size):
        value = value << 8 | octets[at + place]
    return value
