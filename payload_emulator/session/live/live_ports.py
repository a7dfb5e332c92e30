"""TCP ports of the live payload: non-blocking, with bounded buffers, in one selector.

A client can connect and disconnect at any time, reset its connection, disappear without closing it, or never read.
This must not stop or delay the simulation: nothing here blocks, and `Server.drop` is the only place where a client's
socket is closed. It takes the socket out of the selector first, so that a new connection can have the same descriptor.
A client that no longer takes data is read to its end first: what it sent before it left has arrived and counts.
"""

from __future__ import annotations

import contextlib
import selectors
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from payload_emulator.errors import LinkError

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
