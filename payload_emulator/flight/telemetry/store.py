"""The packet store: every telemetry packet is kept until its class is full, sent by priority, sent again on request.

The memory is divided among classes, so that a flood of one kind can never push out a more important one. In a class the
records lie one after another in a ring: magic (u16), packet length (u16), serial (u32), CRC-32 of length, serial and
packet (u32), sent mark (u8), packet; big-endian. There is no index in the memory: after a reset the records are found
by their magic and believed for their checksum, so that no single flipped bit loses more than one packet.
"""

import itertools
import struct
import zlib
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np

from payload_emulator.flight.ports import Memory

_MAGIC = 0x5AC3
_MAGIC_OCTETS = _MAGIC.to_bytes(2, "big")
_HEADER = struct.Struct(">HHIIB")
_CHECKED = struct.Struct(">HI")
_SENT_AT = _HEADER.size - 1
_UNSENT, _SENT = 0x00, 0xFF
# Shortest telemetry packet, and where its time stands.
_SHORTEST_PACKET = 22
_TIME = slice(14, 20)
_SERIAL_LIMIT = 1 << 32


class StoreClass(IntEnum):
    """Classes of packets in the order in which they are sent."""

    critical = 0
    housekeeping = 1
    navigation = 2
    detections = 3
    bulk = 4


# Shares of the memory. A day of events, of housekeeping each minute, and some passes of the rest.
SHARES = (0.10, 0.15, 0.35, 0.30, 0.10)


@dataclass(slots=True, eq=False)
class _Record:
    offset: int
    length: int
    serial: int
    ticks: int
    waiting: bool
    alive: bool = True
    again: bool = False


@dataclass(frozen=True, slots=True)
class ClassReport:
    """Contents of one class; times are 0 where it is empty."""

    store_class: StoreClass
    packets: int
    unsent: int
    octets: int
    capacity: int
    oldest_ticks: int
    newest_ticks: int


@dataclass(slots=True, eq=False)
class _Ring:
    memory: Memory
    records: deque[_Record] = field(default_factory=deque)
    queue: deque[_Record] = field(default_factory=deque)
    head: int = 0
    octets: int = 0
    unsent: int = 0
    packets: int = 0

    def room_for(self, need: int) -> list[_Record]:
        """The records that must go for `need` octets to be written next; may move the head to the beginning."""
        wraps = self.head + need > self.memory.size
        behind = self.head if wraps else self.memory.size
        if wraps:
            self.head = 0
        going = []
        for record in self.records:
            # The oldest stand behind the head, then those from the beginning on.
            if record.offset < behind and not self.head <= record.offset < self.head + need:
                break
            going.append(record)
        return going

    def drop(self, record: _Record) -> None:
        if not record.alive:
            return
        record.alive = False
        self.octets -= record.length + _HEADER.size
        self.packets -= 1
        if record.waiting:
            self.unsent -= 1
        self.memory[record.offset] = 0
        for line in (self.records, self.queue):
            while line and not line[0].alive:
                line.popleft()

    def take_in(self, record: _Record) -> None:
        self.records.append(record)
        self.octets += record.length + _HEADER.size
        self.packets += 1
        if record.waiting:
            self.queue.append(record)
            self.unsent += 1


@dataclass(slots=True, eq=False)
class PacketStore:
    """The store in a board's memory; what that holds from before is found by `recover`.

    Attributes
    ----------
    overwrite
        What a full class does with a new packet: overwrite the oldest, or refuse it.
    overwritten, refused, damaged
        Packets lost before they were sent, not taken, and found with a wrong checksum.
    """

    memory: Memory
    overwrite: bool = True
    overwritten: int = 0
    refused: int = 0
    damaged: int = 0
    _rings: list[_Ring] = field(default_factory=list)
    _again: deque[tuple[_Ring, _Record]] = field(default_factory=deque)
    _serial: int = 0
    _scrub_at: int = 0

    def __post_init__(self) -> None:
        edges = np.rint(np.cumsum([0.0, *SHARES]) * self.memory.size).astype(int)
        self._rings = [_Ring(self.memory[start:stop]) for start, stop in itertools.pairwise(edges.tolist())]

    @property
    def waiting(self) -> int:
        """Packets that wait for downlink, those to be sent again included."""
        return sum(ring.unsent for ring in self._rings) + len(self._again)

    @property
    def used_permille(self) -> int:
        """Share of the memory in use."""
        return round(1000 * sum(ring.octets for ring in self._rings) / max(self.memory.size, 1))

    def append(self, packet: bytes, kind: StoreClass) -> bool:
        """Keep a packet; False where its class is full and nothing may be overwritten, or it can never fit."""
        ring = self._rings[kind]
        need = _HEADER.size + len(packet)
        if need > ring.memory.size:
            self.refused += 1
            return False
        head = ring.head
        going = ring.room_for(need)
        if not self.overwrite and any(record.waiting and record.alive for record in going):
            ring.head = head
            self.refused += 1
            return False
        for record in going:
            self.overwritten += record.waiting and record.alive
            ring.drop(record)
        checksum = zlib.crc32(packet, zlib.crc32(_CHECKED.pack(len(packet), self._serial)))
        block = _HEADER.pack(_MAGIC, len(packet), self._serial, checksum, _UNSENT) + packet
        ring.memory[ring.head : ring.head + need] = np.frombuffer(block, dtype=np.uint8)
        ticks = int.from_bytes(packet[_TIME], "big")
        ring.take_in(_Record(ring.head, len(packet), self._serial, ticks, True))
        ring.head += need
        self._serial = (self._serial + 1) % _SERIAL_LIMIT
        return True

    def take(self, octets: int, kinds: Iterable[StoreClass] = StoreClass) -> list[bytes]:
        """Packets of some classes for downlink, up to a number of octets, in the order in which they were made.

        Chosen by class, then by age; what is asked for again comes after all that was never sent. A packet that does
        not fit ends the choice, so that none overtakes another of its class.
        """
        chosen: list[tuple[int, bytes]] = []
        for ring in (self._rings[kind] for kind in kinds):
            while ring.queue:
                record = ring.queue[0]
                if not record.alive or not record.waiting:
                    ring.queue.popleft()
                    continue
                if record.length > octets:
                    octets = 0
                    break
                ring.queue.popleft()
                packet = self._read(ring, record)
                if packet is None:
                    continue
                octets -= record.length
                record.waiting = False
                ring.unsent -= 1
                ring.memory[record.offset + _SENT_AT] = _SENT
                chosen.append((record.serial, packet))
            if octets == 0:
                break
        chosen.sort()
        packets = [packet for _, packet in chosen]
        while self._again and self._again[0][1].length <= octets:
            ring, record = self._again.popleft()
            record.again = False
            again = self._read(ring, record) if record.alive else None
            if again is not None:
                packets.append(again)
                octets -= len(again)
        return packets

    def replay(self, start_ticks: int, stop_ticks: int) -> int:
        """Send again what was made from `start_ticks` to before `stop_ticks`; how many packets that is."""
        wanted = [
            (record.serial, ring, record)
            for ring in self._rings
            for record in ring.records
            if not (record.waiting or record.again) and start_ticks <= record.ticks < stop_ticks and record.alive
        ]
        wanted.sort(key=lambda item: item[0])
        for _, ring, record in wanted:
            record.again = True
            self._again.append((ring, record))
        return len(wanted)

    def delete(self, stop_ticks: int) -> int:
        """Drop what was made before `stop_ticks`, sent or not; how many packets that was."""
        old = [(ring, record) for ring in self._rings for record in ring.records if record.ticks < stop_ticks]
        gone = 0
        for ring, record in old:
            gone += record.alive
            ring.drop(record)
        return gone

    def scrub(self, records: int) -> int:
        """Check a number of records; return how many were damaged and removed."""
        before = self.damaged
        every = [(ring, record) for ring in self._rings for record in ring.records if record.alive]
        for k in range(min(records, len(every))):
            self._read(*every[(self._scrub_at + k) % len(every)])
        self._scrub_at = (self._scrub_at + records) % max(len(every), 1)
        return self.damaged - before

    def recover(self) -> int:
        """Find what the memory holds from before a reset; how many packets that is."""
        newest = -1
        for ring in self._rings:
            found = sorted(_find(ring.memory), key=lambda record: record.serial)
            ring.records, ring.queue = deque(), deque()
            ring.octets = ring.unsent = ring.packets = ring.head = 0
            for record in found:
                ring.take_in(record)
            if found:
                ring.head = found[-1].offset + _HEADER.size + found[-1].length
                newest = max(newest, found[-1].serial)
        self._serial = newest + 1
        return sum(ring.packets for ring in self._rings)

    def newest(self) -> Iterator[bytes]:
        """The packets of the store, the newest first."""
        every = sorted(
            ((record.serial, ring, record) for ring in self._rings for record in ring.records),
            key=lambda item: -item[0],
        )
        for _, ring, record in every:
            packet = self._read(ring, record)
            if packet is not None:
                yield packet

    def report(self) -> tuple[ClassReport, ...]:
        """The contents class by class."""
        return tuple(
            ClassReport(
                kind,
                ring.packets,
                ring.unsent,
                ring.octets,
                ring.memory.size,
                min((record.ticks for record in _alive(ring.records)), default=0),
                max((record.ticks for record in _alive(ring.records)), default=0),
            )
            for kind, ring in zip(StoreClass, self._rings, strict=True)
        )

    def levels(self) -> tuple[tuple[int, int], ...]:
        """Packets waiting and use in 1/1000 of each class."""
        return tuple((ring.unsent, round(1000 * ring.octets / max(ring.memory.size, 1))) for ring in self._rings)

    def _read(self, ring: _Ring, record: _Record) -> bytes | None:
        """The packet of a record; None, the record dropped and counted, where it is damaged."""
        if not record.alive:
            return None
        start = record.offset
        block = ring.memory[start : start + _HEADER.size + record.length].tobytes()
        if _valid(block) != record.length:
            self.damaged += 1
            ring.drop(record)
            return None
        return block[_HEADER.size :]


def _alive(records: Iterable[_Record]) -> Iterator[_Record]:
    return (record for record in records if record.alive)


def _valid(block: bytes) -> int:
    """Length of the packet of the record at the beginning of `block`, -1 where there is no whole one."""
    if len(block) < _HEADER.size:
        return -1
    magic, length, serial, checksum, _ = _HEADER.unpack_from(block)
    if magic != _MAGIC or not _SHORTEST_PACKET <= length <= len(block) - _HEADER.size:
        return -1
    packet = block[_HEADER.size : _HEADER.size + length]
    return length if zlib.crc32(packet, zlib.crc32(_CHECKED.pack(length, serial))) == checksum else -1


def _find(memory: Memory) -> Iterator[_Record]:
    octets = memory.tobytes()
    at = octets.find(_MAGIC_OCTETS)
    while at >= 0:
        length = _valid(octets[at : at + _HEADER.size + 65_542])
        if length < 0:
            at = octets.find(_MAGIC_OCTETS, at + 1)
            continue
        serial = int.from_bytes(octets[at + 4 : at + 8], "big")
        start = at + _HEADER.size
        ticks = int.from_bytes(octets[start + _TIME.start : start + _TIME.stop], "big")
        yield _Record(at, length, serial, ticks, octets[at + _SENT_AT] == _UNSENT)
        at = octets.find(_MAGIC_OCTETS, start + length)
