"""Link quality of a reception: frames, corrected errors, lock, and reception times."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from lunar.arrays import IntArray, OctetArray

DAY_NS = 86_400_000_000_000
CDS_EPOCH_DAYS = 4383
"""Days from 1958-01-01 to 1970-01-01."""


NO_TIME = -1
"""Reception time of a CADU whose record states none."""


@dataclass(frozen=True, slots=True)
class RecordFormat:
    """Octets of a station's record around each CADU; `time_code` None: the header has no reception time."""

    header_octets: int = 0
    trailer_octets: int = 0
    time_code: str | None = None
    time_offset: int = 0

    @property
    def octets(self) -> int:
        """Octets of header and trailer."""
        return self.header_octets + self.trailer_octets

    def times_utc_ns(self, stream: OctetArray, offsets: IntArray) -> IntArray:
        """Return the reception times (n,) of the CADUs at `offsets` (n,); `NO_TIME` without a header in the stream."""
        times = np.full(offsets.size, NO_TIME, dtype=np.int64)
        if self.time_code is None:
            return times
        at = offsets - self.header_octets + self.time_offset
        known = at >= 0
        at = at[known]
        octets = 6 if self.time_code == "cds" else 8
        value = np.zeros(at.size, dtype=np.int64)
        for k in range(octets):
            value = value << 8 | stream[at + k]
        if self.time_code == "cds":
            days, milliseconds = value >> 32, value & 0xFFFFFFFF
            value = (days - CDS_EPOCH_DAYS) * DAY_NS + milliseconds * 1_000_000
        times[known] = np.where(value < 0, NO_TIME, value)
        return times


NO_RECORD = RecordFormat()


@dataclass(slots=True)
class LinkQuality:
    """Counts of a reception.

    Attributes
    ----------
    lock_losses
        Frames that do not follow the previous one at the usual distance.
    frames_inverted
        Frames received with the wrong polarity.
    wrong_bits, checked_bits
        Corrected bits, and all bits, of the codewords that could be corrected and of the markers of good frames.
    octets_frames, octets_records
        Octets of CADUs, and of the station's records around them.
    first_utc_ns, last_utc_ns
        First and last reception time of the station's records; None without.
    """

    frames: int = 0
    frames_good: int = 0
    codewords: int = 0
    codewords_lost: int = 0
    symbols_corrected: int = 0
    wrong_bits: int = 0
    checked_bits: int = 0
    lock_losses: int = 0
    frames_inverted: int = 0
    octets: int = 0
    octets_frames: int = 0
    octets_records: int = 0
    first_utc_ns: int | None = None
    last_utc_ns: int | None = None

    @property
    def bit_error_rate(self) -> float | None:
        """Estimated bit error rate of what could be corrected, which is a lower bound; None without such bits."""
        return self.wrong_bits / self.checked_bits if self.checked_bits else None

    def add_times(self, times_utc_ns: IntArray) -> None:
        """Include reception times (n,); `NO_TIME` is left out."""
        times_utc_ns = times_utc_ns[times_utc_ns != NO_TIME]
        if times_utc_ns.size:
            first, last = int(times_utc_ns.min()), int(times_utc_ns.max())
            self.first_utc_ns = first if self.first_utc_ns is None else min(self.first_utc_ns, first)
            self.last_utc_ns = last if self.last_utc_ns is None else max(self.last_utc_ns, last)

    def add(self, later: LinkQuality) -> None:
        """Add the counts of a later section."""
        for name in _COUNTS:
            setattr(self, name, getattr(self, name) + getattr(later, name))
        times = [later.first_utc_ns, later.last_utc_ns]
        self.add_times(np.array([one for one in times if one is not None], dtype=np.int64))

    def describe(self) -> dict[str, Any]:
        """Return the counts by name, for output."""
        other = self.octets - self.octets_frames - self.octets_records
        return {**asdict(self), "octets_other": other, "bit_error_rate": self.bit_error_rate}


_COUNTS = (
    "frames",
    "frames_good",
    "codewords",
    "codewords_lost",
    "symbols_corrected",
    "wrong_bits",
    "checked_bits",
    "lock_losses",
    "frames_inverted",
    "octets",
    "octets_frames",
    "octets_records",
)
