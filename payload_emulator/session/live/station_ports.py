"""Ports of one emulated ground station: received telemetry out as records, telecommands in.

A record is the time of reception (unsigned 64-bit nanoseconds since 1970-01-01 UTC, most significant octet first) and
a CADU. The station keeps records that a client has not acknowledged, if `keeps` is set: a client acknowledges with the
number of octets of its connection that are durable there (unsigned 64 bits, most significant octet first), and a new
connection begins with the first record that is not acknowledged completely.

Such a station also confirms telecommands: a transmission is its number (unsigned 64 bits), its number of octets
(unsigned 32 bits) and the octets. The station answers with the number when it has taken the transmission, now or
before, and with 0 when it cannot send it up now. A number is sent up once.

With an exact state, it makes the inputs of a session complete: a session that was killed repeats them at their times.
"""

import contextlib
import json
import os
import selectors
import socket
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from payload_emulator.errors import LinkError, RecordError
from payload_emulator.sim.board.link import Receiver
from tmtc.link.uplink import CLTU_START, CLTU_TAIL

CLIENT_LIMIT = 64
"""Largest number of connections of one port; further ones are closed at once, to limit descriptors."""

UNSENT_LIMIT_OCTETS = 8 << 20
"""Largest number of unsent octets for a client; a client that reads more slowly is disconnected."""

_CHUNK_OCTETS = 65_536
_CLOSE_S = 2.0


@dataclass(slots=True, eq=False)
class Client:
    """One connection.

    Attributes
    ----------
    number
        Consecutive number of the connection; unlike a descriptor, it is never reused.
    unsent
        Octets that are not sent yet.
    """

    number: int
    connection: socket.socket
    unsent: bytearray = field(default_factory=bytearray)
    events: int = selectors.EVENT_READ


@dataclass(slots=True, eq=False)
class Server:
    """Clients of one TCP port.

    Attributes
    ----------
    receive
        Called with the number of the client and the received octets.
    ended
        Called with the number of a client that has disconnected.
    document
        Octets that are sent to each client, whose connection is then closed; None: connections stay open.
    greeting
        Returns the octets that a new connection begins with.
    """

    name: str
    port: int
    host: str
    receive: Callable[[int, bytes], object]
    ended: Callable[[int], object] = lambda number: None
    document: bytes | None = None
    greeting: Callable[[Client], bytes] = lambda client: b""
    listener: socket.socket = field(init=False)
    clients: dict[int, Client] = field(default_factory=dict)
    _selector: selectors.BaseSelector | None = None
    _accepted: int = 0

    def __post_init__(self) -> None:
        try:
            self.listener = socket.create_server((self.host, self.port))
        except OSError as error:
            raise LinkError(
                f"{self.name} port {self.port}: expected a free port on {self.host}, found {error.strerror}"
            ) from None
        self.listener.setblocking(False)
        self.port = int(self.listener.getsockname()[1])

    def attach(self, selector: selectors.BaseSelector) -> None:
        """Register the port with a selector, whose events are passed to `serve`."""
        self._selector = selector
        selector.register(self.listener, selectors.EVENT_READ, (self, None))

    def detach(self) -> None:
        """Unregister from the selector; data sent after this are delivered by `close`."""
        if self._selector is not None:
            for connection in (self.listener, *(client.connection for client in self.clients.values())):
                self._selector.unregister(connection)
            self._selector = None

    def serve(self, client: Client | None, events: int) -> None:
        """Handle an event of the listener (None) or of a client, which may already have been dropped."""
        if client is None:
            self._accept()
            return
        if events & selectors.EVENT_WRITE and client.number in self.clients:
            self._flush(client)
        if events & selectors.EVENT_READ and client.number in self.clients:
            self._read(client)

    def send(self, octets: bytes) -> None:
        """Send octets to every client without blocking; disconnect clients with too many unsent octets."""
        for client in list(self.clients.values()):
            client.unsent += octets
            self._flush(client)

    def reply(self, number: int, octets: bytes) -> None:
        """Send octets to one client, if it is still connected."""
        client = self.clients.get(number)
        if client is not None:
            client.unsent += octets
            self._flush(client)

    def drop(self, client: Client) -> None:
        """Close a connection and stop serving it."""
        if self.clients.pop(client.number, None) is None:
            return
        if self._selector is not None:
            self._selector.unregister(client.connection)
        client.connection.close()
        self.ended(client.number)

    def close(self) -> None:
        """Close the port and all connections, after a final attempt to deliver unsent octets."""
        self.detach()
        due = time.monotonic() + _CLOSE_S
        for client in list(self.clients.values()):
            if client.unsent:
                with contextlib.suppress(OSError):
                    client.connection.settimeout(max(due - time.monotonic(), 0.001))
                    client.connection.sendall(client.unsent)
            self.drop(client)
        self.listener.close()

    def _accept(self) -> None:
        try:
            connection, _ = self.listener.accept()
        except OSError:
            return  # the client has disconnected, or no descriptor is free: retry on the next event
        assert self._selector is not None
        if len(self.clients) >= CLIENT_LIMIT:
            connection.close()
            return
        connection.setblocking(False)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        self._accepted += 1
        client = Client(self._accepted, connection)
        self._selector.register(connection, selectors.EVENT_READ, (self, client))
        self.clients[client.number] = client
        client.unsent += self.greeting(client) if self.document is None else self.document
        if client.unsent:
            self._flush(client)

    def _read(self, client: Client) -> None:
        try:
            octets = client.connection.recv(_CHUNK_OCTETS)
        except BlockingIOError:
            return
        except OSError:
            octets = b""
        if octets:
            self.receive(client.number, octets)
        else:
            self.drop(client)

    def _flush(self, client: Client) -> None:
        try:
            while client.unsent:
                del client.unsent[: client.connection.send(client.unsent[:_CHUNK_OCTETS])]
        except BlockingIOError:
            pass
        except OSError:
            self._stop_sending(client)
            return
        if len(client.unsent) > UNSENT_LIMIT_OCTETS:
            self._stop_sending(client)
            return
        if self.document is not None and not client.unsent:
            self.drop(client)
            return
        self._select(client, selectors.EVENT_READ | (selectors.EVENT_WRITE if client.unsent else 0))

    def _stop_sending(self, client: Client) -> None:
        """Give up sending to a client; it is dropped when what it has sent so far is read."""
        client.unsent.clear()
        with contextlib.suppress(OSError):  # the client may have closed the connection
            client.connection.shutdown(socket.SHUT_RDWR)
        if self._selector is None:
            self.drop(client)
        else:
            self._select(client, selectors.EVENT_READ)

    def _select(self, client: Client, wanted: int) -> None:
        if wanted != client.events and self._selector is not None:
            client.events = wanted
            self._selector.modify(client.connection, wanted, (self, client))


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
        """Return the packets that these octets complete."""
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
