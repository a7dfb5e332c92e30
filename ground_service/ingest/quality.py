"""What a piece of a recording contains: frames, corrected errors, lock, octets and reception times."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from lunar.arrays import IntArray, OctetArray
from tmtc.link.clcw import UplinkSeen

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
class Found:
    """Counts of what a piece of a recording has completed: frames, packets, link quality, octets.

    Attributes
    ----------
    frames_bad
        Frames that cannot be used, truncated ones included.
    frames_joined
        Frames of which other pieces have a part.
    wrong_bits, checked_bits
        Corrected bits, and all bits, of the codewords that could be corrected and of the markers of good frames.
    lock_losses
        Frames that do not follow the previous one at the usual distance.
    frames_inverted
        Frames received with the wrong polarity.
    octets_frames, octets_records
        Octets of the frames with their markers, and of the station's records around them.
    octets_used
        Octets of the piece itself in frames and records, or in packets without frames.
    octets_unused
        Octets of frames in no packet.
    octets_waiting
        Octets at the ends of the recording, as far as it is known, that may belong to an incomplete frame or packet.
    first_utc_ns, last_utc_ns
        First and last reception time of the station's records; None without.
    uplink
        Telecommand channels by spacecraft and number, as the frames show them.
    """

    packets: int = 0
    crc_errors: int = 0
    frames: int = 0
    frames_good: int = 0
    frames_bad: int = 0
    frames_joined: int = 0
    codewords: int = 0
    codewords_lost: int = 0
    symbols_corrected: int = 0
    wrong_bits: int = 0
    checked_bits: int = 0
    lock_losses: int = 0
    frames_inverted: int = 0
    octets_frames: int = 0
    octets_records: int = 0
    octets_used: int = 0
    octets_unused: int = 0
    octets_waiting: int = 0
    first_utc_ns: int | None = None
    last_utc_ns: int | None = None
    uplink: dict[tuple[int, int], UplinkSeen] = field(default_factory=dict)

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
