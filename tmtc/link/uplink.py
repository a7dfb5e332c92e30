"""Telecommand packets to CLTUs and back: segments, TC transfer frames, BCH code, and the receiver's acceptance rules.

References
----------
CCSDS 231.0-B (CLTU: start EB90, BCH(63,56) with x^7 + x^6 + x^2 + 1 and inverted parity, tail C5C5C5C5C5C5C579),
232.0-B (frames of at most 1024 octets, segment header), 232.1-B (FARM-1).
"""

import functools
import struct
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from tmtc.arrays import Octets
from tmtc.errors import ChecksumError, FrameError, TruncatedPacket, ValueRefused
from tmtc.link.frames import Clcw, sequence
from tmtc.packets.space_packets import CRC_LENGTH, PRIMARY_HEADER_LENGTH, append_crc, crc16

CLTU_START = bytes.fromhex("EB90")
CLTU_TAIL = bytes.fromhex("C5C5C5C5C5C5C579")
TC_FRAME_HEADER_LENGTH = 5
TC_FRAME_MAX_LENGTH = 1024
SEGMENT_MAX_LENGTH = TC_FRAME_MAX_LENGTH - TC_FRAME_HEADER_LENGTH - 1 - CRC_LENGTH

SEGMENT_CONTINUATION, SEGMENT_FIRST, SEGMENT_LAST, SEGMENT_WHOLE = 0b00, 0b01, 0b10, 0b11

CONTROL_UNLOCK = b"\x00"
CONTROL_SET_COUNT = b"\x82\x00"

_FILL = 0x55
_BLOCK = 8
_INFORMATION = 7
_HEADER = struct.Struct(">HHB")


@dataclass(frozen=True, slots=True)
class TcFrame:
    """A TC transfer frame. `data` is a segment (its header first), or a control command when `control` is set."""

    spacecraft_id: int
    virtual_channel: int
    sequence_number: int
    data: bytes
    bypass: bool = False
    control: bool = False


def pack_tc_frame(frame: TcFrame) -> bytes:
    """The frame with its checksum."""
    for name, value, limit in (
        ("spacecraft_id", frame.spacecraft_id, 1 << 10),
        ("virtual_channel", frame.virtual_channel, 1 << 6),
        ("sequence_number", frame.sequence_number, 1 << 8),
    ):
        if not 0 <= value < limit:
            raise ValueRefused("telecommand frame", name, value, f"0..{limit - 1}")
    length = TC_FRAME_HEADER_LENGTH + len(frame.data) + CRC_LENGTH
    if not frame.data or length > TC_FRAME_MAX_LENGTH:
        raise ValueRefused("telecommand frame", "data", f"{len(frame.data)} octets", "1..1017 octets")
    first = frame.bypass << 13 | frame.control << 12 | frame.spacecraft_id
    second = frame.virtual_channel << 10 | (length - 1)
    return append_crc(_HEADER.pack(first, second, frame.sequence_number) + frame.data)


def unpack_tc_frame(octets: bytes) -> TcFrame:
    """The frame at the start of `octets`; fill behind it is ignored.

    Raises
    ------
    TruncatedPacket, FrameError, ChecksumError
    """
    if len(octets) < TC_FRAME_HEADER_LENGTH + 1 + CRC_LENGTH:
        raise TruncatedPacket("telecommand frame", TC_FRAME_HEADER_LENGTH + 1 + CRC_LENGTH, len(octets))
    first, second, number = _HEADER.unpack_from(octets)
    if first >> 14 or first >> 10 & 0b11:
        raise FrameError(f"telecommand frame: expected version 0 and spare bits 0, found 0x{first:04X}")
    length = (second & 0x3FF) + 1
    if length < TC_FRAME_HEADER_LENGTH + 1 + CRC_LENGTH:
        raise FrameError(f"telecommand frame: expected 8 octets or more by its length field, found {length}")
    if len(octets) < length:
        raise TruncatedPacket("telecommand frame", length, len(octets))
    frame = octets[:length]
    if crc16(frame):
        expected, found = crc16(frame[:-CRC_LENGTH]), int.from_bytes(frame[-CRC_LENGTH:], "big")
        raise ChecksumError("telecommand frame", expected, found)
    return TcFrame(
        spacecraft_id=first & 0x3FF,
        virtual_channel=second >> 10,
        sequence_number=number,
        data=bytes(frame[TC_FRAME_HEADER_LENGTH:-CRC_LENGTH]),
        bypass=bool(first >> 13 & 1),
        control=bool(first >> 12 & 1),
    )


def encode_cltu(frame: bytes, *, randomised: bool = False) -> bytes:
    """A CLTU that carries one frame."""
    if randomised:
        frame = _randomise(frame)
    padded = frame + bytes((_FILL,)) * (-len(frame) % _INFORMATION)
    blocks = (padded[at : at + _INFORMATION] for at in range(0, len(padded), _INFORMATION))
    return CLTU_START + b"".join(block + bytes((bch_parity(block),)) for block in blocks) + CLTU_TAIL


def bch_parity(information: bytes) -> int:
    """The eighth octet of a code block: seven inverted check bits, then a zero."""
    return (_remainder(information) ^ 0x7F) << 1


@dataclass(slots=True)
class UplinkEncoder:
    """The sending end: keeps the frame sequence number from one call to the next.

    `bypass` sends expedited frames (type BD, accepted without regard to their number), else sequence-controlled
    ones (AD).
    """

    spacecraft_id: int
    virtual_channel: int = 0
    map_id: int = 0
    bypass: bool = True
    randomised: bool = True
    sequence_number: int = 0

    def encode(self, packets: Iterable[bytes]) -> bytes:
        """CLTUs that carry `packets`, each packet in a segment of its own or in several when it is long."""
        return b"".join(
            encode_cltu(frame, randomised=self.randomised) for packet in packets for frame in self.frames(packet)
        )

    def frames(self, packet: bytes) -> list[bytes]:
        """TC transfer frames of one packet."""
        if not 0 <= self.map_id < 64:
            raise ValueRefused("segment", "map_id", self.map_id, "0..63")
        pieces = [packet[at : at + SEGMENT_MAX_LENGTH] for at in range(0, len(packet), SEGMENT_MAX_LENGTH)]
        frames = []
        for k, piece in enumerate(pieces):
            flags = (SEGMENT_FIRST if k == 0 else 0) | (SEGMENT_LAST if k == len(pieces) - 1 else 0)
            segment = bytes((flags << 6 | self.map_id,)) + piece
            number = 0 if self.bypass else self.sequence_number
            frames.append(
                pack_tc_frame(TcFrame(self.spacecraft_id, self.virtual_channel, number, segment, bypass=self.bypass))
            )
            if not self.bypass:
                self.sequence_number = (self.sequence_number + 1) & 0xFF
        return frames


@dataclass(slots=True)
class Farm:
    """The receiver's acceptance of frames (FARM-1) of one virtual channel, and what it reports in the CLCW."""

    virtual_channel: int = 0
    window: int = 10
    expected: int = 0
    lockout: bool = False
    retransmit: bool = False
    farm_b_counter: int = 0

    def accept(self, frame: TcFrame) -> bool:
        """Return whether the frame's data are to be used; control commands are executed here and give False."""
        if frame.control:
            sets_count = frame.data[:2] == CONTROL_SET_COUNT and len(frame.data) == 3
            # any other control command makes the frame invalid; it is not counted (232.1-B, event E9)
            if not frame.bypass or not (sets_count or frame.data == CONTROL_UNLOCK):
                return False
            self.farm_b_counter = (self.farm_b_counter + 1) & 0b11
            if frame.data == CONTROL_UNLOCK:
                self.lockout = self.retransmit = False
            elif not self.lockout:
                self.expected, self.retransmit = frame.data[2], False
            return False
        if frame.bypass:
            self.farm_b_counter = (self.farm_b_counter + 1) & 0b11
            return True
        if self.lockout:
            return False
        ahead = (frame.sequence_number - self.expected) & 0xFF
        if ahead == 0:
            self.expected = (self.expected + 1) & 0xFF
            self.retransmit = False
            return True
        if ahead < self.window:
            self.retransmit = True
        elif ahead <= 0xFF - self.window:
            self.lockout = True
        return False

    @property
    def clcw(self) -> Clcw:
        """Return the command link control word."""
        return Clcw(
            virtual_channel=self.virtual_channel,
            report_value=self.expected,
            lockout=self.lockout,
            retransmit=self.retransmit,
            farm_b_counter=self.farm_b_counter,
        )


@dataclass(frozen=True, slots=True, eq=False)
class UplinkDecode:
    """Decoded uplink stream; `faults` lists each frame that could not be used."""

    packets: tuple[bytes, ...]
    frames: int
    octets_skipped: int
    faults: tuple[str, ...]


@dataclass(slots=True)
class UplinkDecoder:
    """The receiving end; keeps the acceptance state and unfinished packets from one call to the next.

    `parts` are the octets of unfinished packets by virtual channel and MAP.
    """

    spacecraft_id: int
    randomised: bool = True
    farms: dict[int, Farm] = field(default_factory=dict)
    parts: dict[tuple[int, int], bytes] = field(default_factory=dict)

    def decode(self, octets: Octets) -> UplinkDecode:
        """Packets in a stream of whole CLTUs with anything between them; nothing on the wire makes it fail."""
        stream = octets.tobytes() if isinstance(octets, np.ndarray) else bytes(octets)
        packets: list[bytes] = []
        faults: list[str] = []
        frames = used = at = 0
        while (start := stream.find(CLTU_START, at)) >= 0:
            information, end = _read_blocks(stream, start + len(CLTU_START))
            # should the start be a false one, the true one may follow at once
            at = start + len(CLTU_START)
            if not information:
                faults.append("CLTU: expected a code block behind the start sequence, found none that can be repaired")
                continue
            try:
                frame = unpack_tc_frame(_randomise(information) if self.randomised else information)
            except (TruncatedPacket, FrameError, ChecksumError) as error:
                faults.append(str(error))
                continue
            at = end + (len(CLTU_TAIL) if stream[end : end + len(CLTU_TAIL)] == CLTU_TAIL else 0)
            used += at - start
            if frame.spacecraft_id != self.spacecraft_id:
                faults.append(
                    f"telecommand frame: expected spacecraft {self.spacecraft_id}, found {frame.spacecraft_id}"
                )
                continue
            frames += 1
            farm = self.farms.setdefault(frame.virtual_channel, Farm(frame.virtual_channel))
            if farm.accept(frame):
                found, fault = self._segment(frame)
                packets += found
                faults += fault
            elif not frame.control:
                faults.append(
                    f"telecommand frame: expected sequence number {farm.expected}, found {frame.sequence_number}"
                )
        return UplinkDecode(tuple(packets), frames, len(stream) - used, tuple(faults))

    def _segment(self, frame: TcFrame) -> tuple[list[bytes], list[str]]:
        """(packets, faults) that the frame's segment completes."""
        flags, key = frame.data[0] >> 6, (frame.virtual_channel, frame.data[0] & 0x3F)
        piece = frame.data[1:]
        faults = []
        open_part = self.parts.pop(key, None)
        if flags in (SEGMENT_FIRST, SEGMENT_WHOLE):
            if open_part is not None:
                faults.append("segment: expected a continuation, found the beginning of another packet")
            whole = piece
        elif open_part is None:
            return [], ["segment: expected the beginning of a packet, found a continuation"]
        else:
            whole = open_part + piece
        if flags in (SEGMENT_FIRST, SEGMENT_CONTINUATION):
            if len(whole) > PRIMARY_HEADER_LENGTH + 65_536:
                return [], [*faults, "segment: expected a packet of at most 65542 octets, found more"]
            self.parts[key] = whole
            return [], faults
        return [*self._packets(whole, faults)], faults

    def _packets(self, data: bytes, faults: list[str]) -> list[bytes]:
        """Telecommand packets in a segment; several may share one. Checksums are the application's to judge."""
        packets, at = [], 0
        while at < len(data):
            if len(data) - at <= PRIMARY_HEADER_LENGTH:
                faults.append(f"segment: expected a packet, found {len(data) - at} octets")
                break
            length = int.from_bytes(data[at + 4 : at + 6], "big") + PRIMARY_HEADER_LENGTH + 1
            if at + length > len(data):
                faults.append(f"segment: expected a packet of {length} octets, found {len(data) - at}")
                break
            packets.append(data[at : at + length])
            at += length
        return packets


def _read_blocks(stream: bytes, at: int) -> tuple[bytes, int]:
    """(information, position behind the last good block) of the code blocks from `at` on."""
    information = bytearray()
    while at + _BLOCK <= len(stream) and len(information) < TC_FRAME_MAX_LENGTH:
        block = bytearray(stream[at : at + _BLOCK])
        syndrome = _remainder(block[:_INFORMATION]) ^ (block[_INFORMATION] >> 1 ^ 0x7F)
        if syndrome:
            # the tail is no codeword, and no single wrong bit makes it one
            bit = _single_errors().get(syndrome)
            if bit is None:
                break
            block[bit >> 3] ^= 0x80 >> (bit & 7)
        information += block[:_INFORMATION]
        at += _BLOCK
    return bytes(information), at


def _randomise(octets: bytes) -> bytes:
    data = np.frombuffer(octets, dtype=np.uint8)
    return (data ^ sequence("telecommand", data.size)).tobytes()


def _remainder(octets: bytes | bytearray) -> int:
    """Seven check bits before inversion."""
    register = 0
    table = _bch_table()
    for octet in octets:
        register = table[register << 1 ^ octet]
    return register


@functools.cache
def _bch_table() -> tuple[int, ...]:
    """Register (7 bits) after eight more bits, by those bits with the register before added to the first seven."""
    rows = []
    for bits in range(256):
        register = 0
        for k in range(7, -1, -1):
            feedback = (register >> 6 ^ bits >> k) & 1
            register = (register << 1 & 0x7F) ^ (0b1000101 if feedback else 0)
        rows.append(register)
    return tuple(rows)


@functools.cache
def _single_errors() -> dict[int, int]:
    """Syndrome of every single wrong bit of a code block, bits counted from the first one sent."""
    errors = {}
    for bit in range(8 * _INFORMATION):
        block = bytearray(_INFORMATION)
        block[bit >> 3] = 0x80 >> (bit & 7)
        errors[_remainder(block)] = bit
    for bit in range(7):
        errors[0x40 >> bit] = 8 * _INFORMATION + bit
    return errors
