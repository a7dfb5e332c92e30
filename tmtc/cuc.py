"""On-board time as octets: CCSDS unsegmented (CUC) and day segmented (CDS) time codes.

Inside the project on-board time is `ticks`, an integer count of 2**-16 s since the on-board epoch
2000-01-01T00:00:00 TAI. On the link it is CUC with an agency epoch, four octets of seconds and two of
fraction, preceded by its P-field 0x2E.

References
----------
CCSDS 301.0-B-4 sections 3.2 (CUC) and 3.3 (CDS).
"""

from __future__ import annotations

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

EPOCH_1958_TAI = 0b001
EPOCH_AGENCY = 0b010

_CDS_CODE = 0b100
_CDS_LENGTH = 7
_MILLISECONDS_PER_DAY = 86_400_000


@dataclass(frozen=True, slots=True)
class CucTime:
    """A CUC time code of any width: `coarse` seconds and `fine` units of 256**-fine_octets s."""

    coarse: int
    fine: int
    coarse_octets: int = 4
    fine_octets: int = 2
    epoch: int = EPOCH_AGENCY

    @property
    def ticks(self) -> int:
        """Units of 2**-16 s, further fraction bits dropped."""
        return ((self.coarse << (8 * self.fine_octets)) | self.fine) << 16 >> (8 * self.fine_octets)


def pack_cuc(ticks: int) -> bytes:
    """Seven octets: P-field 0x2E, seconds (4), fraction (2)."""
    if not 0 <= ticks < TICKS_LIMIT:
        raise ValueRefused("time code", "ticks", ticks, f"an integer from 0 to {TICKS_LIMIT - 1}")
    return bytes((P_FIELD,)) + int(ticks).to_bytes(6, "big")


def unpack_cuc(octets: bytes | memoryview) -> int:
    """Ticks of a time code as written by `pack_cuc`; other P-fields are refused."""
    if len(octets) < CUC_LENGTH:
        raise TruncatedPacket("CUC time code", CUC_LENGTH, len(octets))
    if octets[0] != P_FIELD:
        raise MalformedPacket(f"CUC time code: expected P-field 0x{P_FIELD:02X}, found 0x{octets[0]:02X}")
    return int.from_bytes(octets[1:CUC_LENGTH], "big")


def onboard_ticks(values: npt.NDArray[Any]) -> IntArray:
    """Return on-board times (n,) given as u64 in signed integers; `NO_TICKS` for those beyond 48 bits."""
    ticks = values.astype(np.int64)
    ticks[values >= TICKS_LIMIT] = NO_TICKS
    return ticks


def pack_cuc_time(time: CucTime) -> bytes:
    """A CUC time code with the P-field that its widths ask for (second P-field octet when they need it)."""
    if not (1 <= time.coarse_octets <= 7 and 0 <= time.fine_octets <= 10):
        raise MalformedPacket(
            f"CUC time code: expected 1..7 octets of seconds and 0..10 of fraction, "
            f"found {time.coarse_octets} and {time.fine_octets}"
        )
    if not 0 <= time.coarse < 1 << (8 * time.coarse_octets):
        raise ValueRefused("time code", "coarse", time.coarse, f"{time.coarse_octets} octets, unsigned")
    if not 0 <= time.fine < 1 << (8 * time.fine_octets):
        raise ValueRefused("time code", "fine", time.fine, f"{time.fine_octets} octets, unsigned")
    coarse_first, fine_first = min(time.coarse_octets, 4), min(time.fine_octets, 3)
    coarse_more, fine_more = time.coarse_octets - coarse_first, time.fine_octets - fine_first
    p_field = bytes((time.epoch << 4 | (coarse_first - 1) << 2 | fine_first,))
    if coarse_more or fine_more:
        p_field = bytes((p_field[0] | 0x80, coarse_more << 5 | fine_more << 2))
    return (
        p_field
        + time.coarse.to_bytes(time.coarse_octets, "big")
        + time.fine.to_bytes(time.fine_octets, "big")
    )


def unpack_cuc_time(octets: bytes | memoryview) -> tuple[CucTime, int]:
    """A CUC time code of any width with its P-field, and the number of octets it took."""
    if len(octets) < 1:
        raise TruncatedPacket("CUC time code", 2, len(octets))
    first = octets[0]
    epoch = first >> 4 & 0b111
    if epoch not in (EPOCH_1958_TAI, EPOCH_AGENCY):
        raise MalformedPacket(f"CUC time code: expected time code id 1 or 2, found {epoch}")
    coarse_octets, fine_octets, start = (first >> 2 & 0b11) + 1, first & 0b11, 1
    if first & 0x80:
        if len(octets) < 2:
            raise TruncatedPacket("CUC P-field", 2, len(octets))
        second = octets[1]
        if second & 0x80:
            raise MalformedPacket("CUC time code: a third P-field octet is not defined by the standard")
        coarse_octets += second >> 5 & 0b11
        fine_octets += second >> 2 & 0b111
        start = 2
    stop = start + coarse_octets + fine_octets
    if len(octets) < stop:
        raise TruncatedPacket("CUC time code", stop, len(octets))
    middle = start + coarse_octets
    coarse = int.from_bytes(octets[start:middle], "big")
    fine = int.from_bytes(octets[middle:stop], "big")
    return CucTime(coarse, fine, coarse_octets, fine_octets, epoch), stop


def pack_cds(day: int, millisecond: int) -> bytes:
    """Seven octets of CDS short: P-field 0x40, UTC days since 1958-01-01 (2), milliseconds of the day (4)."""
    if not 0 <= day < 1 << 16:
        raise ValueRefused("CDS time code", "day", day, "0..65535")
    if not 0 <= millisecond < _MILLISECONDS_PER_DAY + 1000:
        raise ValueRefused(
            "CDS time code", "millisecond", millisecond, "0..86400999 (a leap second included)"
        )
    return bytes((_CDS_CODE << 4,)) + day.to_bytes(2, "big") + millisecond.to_bytes(4, "big")


def unpack_cds(octets: bytes | memoryview) -> tuple[int, int]:
    """(UTC days since 1958-01-01, milliseconds of the day) of a CDS short time code with its P-field."""
    if len(octets) < _CDS_LENGTH:
        raise TruncatedPacket("CDS time code", _CDS_LENGTH, len(octets))
    if octets[0] != _CDS_CODE << 4:
        raise MalformedPacket(f"CDS time code: expected P-field 0x40, found 0x{octets[0]:02X}")
    return int.from_bytes(octets[1:3], "big"), int.from_bytes(octets[3:7], "big")
