"""TM transfer frames: header, control field (CLCW) and its summary, error control, randomiser; many frames at once.

References
----------
CCSDS 132.0-B section 4.1. Header of six octets: version 00 (2 bits), spacecraft id (10), virtual channel
(3), OCF flag (1) | master channel count (8) | virtual channel count (8) | secondary header flag,
synchronisation flag, packet order flag (1 each), segment length id 11 (2), first header pointer (11). CCSDS
232.0-B 4.2 for the CLCW.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import numpy.typing as npt

from tmtc.arrays import BoolArray, IntArray, OctetArray
from tmtc.errors import FrameError, LinkFormatError, TruncatedPacket, ValueRefused
from tmtc.packets.space_packets import CRC_LENGTH, crc16

FRAME_HEADER_LENGTH = 6
FRAME_MAX_LENGTH = 2048
OCF_LENGTH = 4
NO_PACKET_BEGINS = 0x7FF
ONLY_IDLE_DATA = 0x7FE
IDLE_CHANNEL = 7


@dataclass(frozen=True, slots=True, eq=False)
class TmFrameHeaders:
    """Header fields of n frames as columns."""

    version: IntArray
    spacecraft_id: IntArray
    virtual_channel: IntArray
    master_count: IntArray
    channel_count: IntArray
    first_header_pointer: IntArray
    ocf: BoolArray
    secondary_header: BoolArray


@dataclass(frozen=True, slots=True)
class Clcw:
    """Command link control word: the spacecraft's view of the uplink."""

    virtual_channel: int
    report_value: int
    lockout: bool = False
    wait: bool = False
    retransmit: bool = False
    no_rf_available: bool = False
    no_bit_lock: bool = False
    farm_b_counter: int = 0
    status: int = 0


def frame_headers(frames: OctetArray) -> TmFrameHeaders:
    """Header fields of frames (n, length)."""
    head = frames[:, :FRAME_HEADER_LENGTH].astype(np.int64)
    first = head[:, 0] << 8 | head[:, 1]
    status = head[:, 4] << 8 | head[:, 5]
    return TmFrameHeaders(
        version=first >> 14,
        spacecraft_id=first >> 4 & 0x3FF,
        virtual_channel=first >> 1 & 7,
        master_count=head[:, 2],
        channel_count=head[:, 3],
        first_header_pointer=status & 0x7FF,
        ocf=(first & 1) != 0,
        secondary_header=status >> 15 != 0,
    )


def frame_checksums_hold(frames: OctetArray) -> BoolArray:
    """Return whether the last two octets of each frame (n, length) are the checksum of those before."""
    if frames.shape[1] <= CRC_LENGTH:
        return np.zeros(frames.shape[0], dtype=np.bool_)
    from tmtc.packets import _cutting

    holds = np.empty(frames.shape[0], dtype=np.bool_)
    rows = np.ascontiguousarray(frames).view()
    rows.flags.writeable = False  # one compiled variant for frames of every origin
    _cutting.checksums_hold(rows, _cutting.crc_tables(), holds)
    return holds


def append_frame_checksums(frames: OctetArray) -> None:
    """Write the checksum of each frame (n, length) into its last two octets, in place."""
    for row in frames:
        checksum = crc16(row[:-CRC_LENGTH].tobytes())
        row[-2], row[-1] = checksum >> 8, checksum & 0xFF


def pack_clcw(clcw: Clcw) -> bytes:
    """Four octets for the operational control field."""
    for name, value, limit in (
        ("virtual_channel", clcw.virtual_channel, 1 << 6),
        ("report_value", clcw.report_value, 1 << 8),
        ("farm_b_counter", clcw.farm_b_counter, 1 << 2),
        ("status", clcw.status, 1 << 3),
    ):
        if not 0 <= value < limit:
            raise ValueRefused("CLCW", name, value, f"0..{limit - 1}")
    word = clcw.status << 26 | 0b01 << 24 | clcw.virtual_channel << 18
    word |= clcw.no_rf_available << 15 | clcw.no_bit_lock << 14 | clcw.lockout << 13
    word |= clcw.wait << 12 | clcw.retransmit << 11 | clcw.farm_b_counter << 9 | clcw.report_value
    return word.to_bytes(OCF_LENGTH, "big")


def unpack_clcw(octets: bytes | memoryview) -> Clcw:
    """The CLCW in an operational control field."""
    if len(octets) < OCF_LENGTH:
        raise TruncatedPacket("CLCW", OCF_LENGTH, len(octets))
    word = int.from_bytes(octets[:OCF_LENGTH], "big")
    if word >> 31 or word >> 29 & 0b11:
        raise FrameError(f"CLCW: expected control word type 0, version 0, found 0x{word:08X}")
    return Clcw(
        virtual_channel=word >> 18 & 0x3F,
        report_value=word & 0xFF,
        lockout=bool(word >> 13 & 1),
        wait=bool(word >> 12 & 1),
        retransmit=bool(word >> 11 & 1),
        no_rf_available=bool(word >> 15 & 1),
        no_bit_lock=bool(word >> 14 & 1),
        farm_b_counter=word >> 9 & 0b11,
        status=word >> 26 & 0b111,
    )


def idle_data(length: int) -> bytes:
    """Fill for frames without packets: the sequence of 1 + D + D^2 + D^22 + D^32, all ones at the start.

    References
    ----------
    CCSDS 132.0-B-3 section 4.1.4.6 and its note on the recommended generator.
    """
    bits = [1] * 32
    for n in range(32, 8 * length):
        bits.append(bits[n - 1] ^ bits[n - 2] ^ bits[n - 22] ^ bits[n - 32])
    return np.packbits(np.array(bits[: 8 * length], dtype=np.uint8)).tobytes()


Randomiser = Literal["none", "legacy", "long", "telecommand"]

# s[n + degree] is the sum of s[n + tap] over the taps; first bits of the sequence
_REGISTERS: dict[str, tuple[int, tuple[int, ...], str]] = {
    "legacy": (8, (0, 3, 5, 7), "11111111"),
    "long": (17, (0, 14), "00011100011100011"),
    "telecommand": (8, (0, 1, 2, 3, 4, 6), "11111111"),
}


def sequence(randomiser: str, length: int) -> OctetArray:
    """The first `length` octets of the sequence; zeros for `none`."""
    if randomiser == "none":
        return np.zeros(length, dtype=np.uint8)
    period = _period(randomiser)
    return period[np.arange(length) % period.size]


def randomise(frames: OctetArray, randomiser: str) -> OctetArray:
    """`frames` (..., n) with the sequence added to each, which also takes it away again."""
    if randomiser == "none":
        return frames
    return frames ^ sequence(randomiser, frames.shape[-1])


@functools.cache
def _period(randomiser: str) -> OctetArray:
    try:
        degree, taps, start = _REGISTERS[randomiser]
    except KeyError:
        known = ", ".join(("none", *_REGISTERS))
        raise LinkFormatError(f"randomiser: expected one of {known}, found {randomiser!r}") from None
    bits = [int(digit) for digit in start]
    # a period of an odd number of bits fills whole octets after eight of them
    count = 8 * ((1 << degree) - 1)
    for n in range(len(bits), count):
        bit = 0
        for tap in taps:
            bit ^= bits[n - degree + tap]
        bits.append(bit)
    return np.packbits(np.array(bits[:count], dtype=np.uint8))


@dataclass(frozen=True, slots=True)
class UplinkSeen:
    """The telecommand channel of a spacecraft as a stretch of its frames shows it.

    The first numbers count frames: with a CLCW of the channel, and with each flag set in it; `changes` counts words
    that differ from the one before. The others are those of the newest word: `report_value` is the number of the
    sequence-controlled frame that is expected next, `farm_b_counter` counts accepted expedited frames modulo 4.
    """

    virtual_channel: int
    frames: int
    changes: int
    frames_lockout: int
    frames_wait: int
    frames_retransmit: int
    frames_no_rf: int
    report_value: int
    farm_b_counter: int
    lockout: bool
    wait: bool
    retransmit: bool
    no_rf_available: bool
    no_bit_lock: bool

    def followed_by(self, later: UplinkSeen, sign: int = 1) -> UplinkSeen:
        """Both stretches, the newest word from `later`; `sign` -1 takes the counts of `later` off, and nothing else."""
        counts = {
            name: getattr(self, name) + sign * getattr(later, name)
            for name in (
                "frames", "changes", "frames_lockout", "frames_wait", "frames_retransmit", "frames_no_rf",
            )
        }  # fmt: skip
        return replace(later if sign > 0 else self, **counts)


def uplink_seen(words: npt.NDArray[np.uint32]) -> tuple[UplinkSeen, ...]:
    """Return the state of each telecommand channel from the control fields of frames (n,); 0 where there is none.

    Fields that are no CLCW (of another control word type or version) are passed over.
    """
    distinct, which = np.unique(words, return_inverse=True)
    known = [_clcw(int(word)) for word in distinct]
    by_channel: dict[int, list[int]] = {}
    for index, clcw in enumerate(known):
        if clcw is not None:
            by_channel.setdefault(clcw.virtual_channel, []).append(index)
    return tuple(_seen(which[np.isin(which, mine)], known) for _, mine in sorted(by_channel.items()))


def _seen(which: npt.NDArray[np.intp], known: list[Clcw | None]) -> UplinkSeen:
    """The channel whose words (n,), as indices of `known`, came in this order."""
    counts = np.bincount(which, minlength=len(known)).tolist()

    def frames_with(flag: str) -> int:
        return sum(n for n, clcw in zip(counts, known, strict=True) if n and getattr(clcw, flag))

    last = known[int(which[-1])]
    assert last is not None
    return UplinkSeen(
        virtual_channel=last.virtual_channel,
        frames=which.size,
        changes=int(np.count_nonzero(np.diff(which))),
        frames_lockout=frames_with("lockout"),
        frames_wait=frames_with("wait"),
        frames_retransmit=frames_with("retransmit"),
        frames_no_rf=frames_with("no_rf_available"),
        report_value=last.report_value,
        farm_b_counter=last.farm_b_counter,
        lockout=last.lockout,
        wait=last.wait,
        retransmit=last.retransmit,
        no_rf_available=last.no_rf_available,
        no_bit_lock=last.no_bit_lock,
    )


def _clcw(word: int) -> Clcw | None:
    if word == 0:
        return None
    try:
        return unpack_clcw(word.to_bytes(OCF_LENGTH, "big"))
    except FrameError:
        return None
