"""Ports of one emulated ground station: received telemetry out as records, telecommands in.

A record is the time of reception (unsigned 64-bit nanoseconds since 1970-01-01 UTC, most significant octet first) and
a CADU. The station keeps records that a client has not acknowledged, if it is told to: a client acknowledges with the
number of octets of its connection that are durable there (unsigned 64 bits, most significant octet first), and a new
connection begins with the first record that is not acknowledged completely.

Such a station also confirms telecommands: a transmission is its number (unsigned 64 bits), its number of octets
(unsigned 32 bits) and the octets. The station answers with the number when it has taken the transmission, now or
before, and with 0 when it cannot send it up now. A number is sent up once.

With an exact state, it makes the inputs of a session complete: a session that was killed repeats them at their times.
"""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from payload_emulator.errors import LinkError, RecordError
from payload_emulator.session.live.live_ports import Client, Server
from payload_emulator.sim.board.link import Receiver
from tmtc.link.uplink import CLTU_START, CLTU_TAIL


@dataclass(frozen=True, slots=True)
class JournalEntry:
    """A transmission: simulated time at which a station took it, name of the station, number, octets."""

    utc_ns: int
    station: str
    number: int
    octets: bytes


RECORD_HEADER = struct.Struct(">Q")
_COUNT = struct.Struct(">Q")
_TRANSMISSION = struct.Struct(">QI")
_TRANSMISSION_LIMIT_OCTETS = 16 << 20
_REFUSED = 0
_BUFFER_LIMIT = 1 << 20
_TELECOMMAND_START = 0b00011  # version 000, type 1, secondary header flag 1

KEPT_LIMIT_OCTETS = 64 << 20
"""Largest number of octets that a station keeps for a client that is not there; the simulation waits beyond half."""


@dataclass(slots=True, eq=False)
class StationPorts:
    """Telemetry and telecommand port of one station.

    Attributes
    ----------
    receive
        Called with the number of the connection, or of the transmission, and telecommand octets; no octets: the
        connection has ended. Returns whether they are sent up.
    keeps
        Whether records are kept until they are acknowledged, and transmissions are confirmed.
    sent
        Octets of records handed to the telemetry port.
    taken
        Numbers of the transmissions that were sent up.
    """

    name: str
    host: str
    receive: Callable[[int, bytes], bool]
    telemetry_port: int = 0
    telecommand_port: int = 0
    keeps: bool = False
    sent: int = 0
    taken: set[int] = field(default_factory=set)
    telemetry: Server = field(init=False)
    telecommand: Server = field(init=False)
    _kept: bytearray = field(default_factory=bytearray)
    _begin: int = 0
    _connections: dict[int, int] = field(default_factory=dict)
    _counts: dict[int, bytes] = field(default_factory=dict)
    _partial: dict[int, bytes] = field(default_factory=dict)
    _record_octets: int = 1

    def __post_init__(self) -> None:
        self.telemetry = Server(
            f"telemetry of {self.name}",
            self.telemetry_port,
            self.host,
            self._acknowledge,
            self._ended,
            greeting=self._greet,
        )
        try:
            self.telecommand = Server(
                f"telecommand of {self.name}",
                self.telecommand_port,
                self.host,
                self._take if self.keeps else self.receive,
                self._end_uplink,
            )
        except LinkError:
            self.telemetry.close()
            raise

    @property
    def waiting(self) -> int:
        """Octets that no client has taken, or acknowledged where records are kept."""
        unsent = max((len(client.unsent) for client in self.telemetry.clients.values()), default=0)
        return max(len(self._kept), unsent)

    def send(self, received_utc_ns: int, cadus: bytes, cadu_length: int) -> None:
        """Send CADUs that were received at a time."""
        head = RECORD_HEADER.pack(received_utc_ns)
        records = b"".join(head + cadus[at : at + cadu_length] for at in range(0, len(cadus), cadu_length))
        self.sent += len(records)
        self._record_octets = len(head) + cadu_length
        if self.keeps:
            self._kept += records
            if len(self._kept) > KEPT_LIMIT_OCTETS:
                self._forget(len(self._kept) - KEPT_LIMIT_OCTETS)
        self.telemetry.send(records)

    def close(self) -> None:
        """Close both ports."""
        self.telemetry.close()
        self.telecommand.close()

    @property
    def unacknowledged(self) -> int:
        """Octets that are kept because no client has acknowledged them."""
        return len(self._kept)

    def _take(self, number: int, octets: bytes) -> None:
        """Take transmissions as they come, and answer each."""
        left = self._partial.get(number, b"") + octets
        while len(left) >= _TRANSMISSION.size:
            transmission, length = _TRANSMISSION.unpack_from(left)
            if length > _TRANSMISSION_LIMIT_OCTETS:
                self.telecommand.drop(self.telecommand.clients[number])
                return
            stop = _TRANSMISSION.size + length
            if len(left) < stop:
                break
            if transmission not in self.taken and self.receive(transmission, left[_TRANSMISSION.size : stop]):
                self.taken.add(transmission)
            answer = transmission if transmission in self.taken else _REFUSED
            left = left[stop:]
            self._partial[number] = left
            self.telecommand.reply(number, _COUNT.pack(answer))
            if number not in self.telecommand.clients:
                return
        self._partial[number] = left

    def _end_uplink(self, number: int) -> None:
        self._partial.pop(number, None)
        if not self.keeps:
            self.receive(number, b"")

    def _greet(self, client: Client) -> bytes:
        """Return what a new telemetry connection begins with: everything that is not acknowledged."""
        self._connections[client.number] = self._begin
        return bytes(self._kept)

    def _acknowledge(self, number: int, octets: bytes) -> None:
        counts = self._counts.get(number, b"") + octets
        whole = len(counts) // _COUNT.size * _COUNT.size
        self._counts[number] = counts[whole:]
        if whole and self.keeps:
            count = _COUNT.unpack_from(counts, whole - _COUNT.size)[0]
            self._forget(self._connections.get(number, self._begin) + count - self._begin)

    def _ended(self, number: int) -> None:
        self._connections.pop(number, None)
        self._counts.pop(number, None)

    def _forget(self, count: int) -> None:
        """Forget acknowledged octets, as far as they are whole records: a connection begins with a record."""
        count = min(max(count, 0), len(self._kept))
        count -= count % self._record_octets
        del self._kept[:count]
        self._begin += count


@dataclass(slots=True)
class TelecommandBuffer:
    """Telecommand packets out of octets as they come, CLTUs or bare packets; nothing on the wire stops it.

    Attributes
    ----------
    receiver
        What CLTUs are received with.
    dropped
        Octets that were neither.
    """

    receiver: Receiver
    dropped: int = 0
    _octets: bytes = b""

    def take(self, octets: bytes) -> list[bytes]:
        """The packets that these octets complete."""
        self._octets += octets
        packets: list[bytes] = []
        while self._octets:
            if self._octets[:1] == CLTU_START[:1]:
                if len(self._octets) > 1 and self._octets[:2] != CLTU_START:
                    self._drop(1)
                    continue
                end = self._octets.find(CLTU_TAIL)
                if end < 0:
                    break
                stop = end + len(CLTU_TAIL)
                decoded = self.receiver.decoder.decode(self._octets[:stop])
                self.dropped += decoded.octets_skipped
                packets += decoded.packets
                self._octets = self._octets[stop:]
            elif self._octets[0] >> 3 == _TELECOMMAND_START:
                length = 7 + int.from_bytes(self._octets[4:6], "big") if len(self._octets) >= 6 else 1 << 17
                if length > len(self._octets):
                    break
                packets.append(self._octets[:length])
                self._octets = self._octets[length:]
            else:
                self._drop(1)
        if len(self._octets) > _BUFFER_LIMIT:
            self._drop(len(self._octets))
        return packets

    def _drop(self, count: int) -> None:
        self.dropped += count
        self._octets = self._octets[count:]


def add_to_journal(path: Path, entry: JournalEntry) -> None:
    """Append an entry; it survives the end of the process."""
    line = json.dumps([entry.utc_ns, entry.station, entry.number, entry.octets.hex()])
    with path.open("ab", buffering=0) as file:
        file.write(line.encode() + b"\n")


def load_journal(path: Path) -> list[JournalEntry]:
    """Return the entries, and remove an incomplete last line, which was not confirmed.

    Raises
    ------
    RecordError
        A line is no entry.
    """
    try:
        octets = path.read_bytes()
    except FileNotFoundError:
        return []
    whole = octets.rfind(b"\n") + 1
    if whole < len(octets):
        os.truncate(path, whole)
    entries = []
    for number, line in enumerate(octets[:whole].splitlines(), start=1):
        try:
            utc_ns, station, key, text = json.loads(line)
            entries.append(JournalEntry(int(utc_ns), str(station), int(key), bytes.fromhex(text)))
        except (ValueError, TypeError):
            raise RecordError(
                f"{path}, line {number}: expected time, station, number and octets of a transmission, "
                f"found {line[:40]!r}"
            ) from None
    return entries
