"""TCP ports of the live payload: non-blocking, with bounded buffers, in one selector.

A client can connect and leave at any moment, reset its connection, vanish without a word or never read. None of
these may stop or delay the flight: nothing here blocks, and `Server.drop` is the only place where a client's socket
is closed. It takes the socket out of the selector first, so that a new connection can have the same descriptor.
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
"""Connections of one port at a time; more are closed at once, so that descriptors cannot run out."""

UNSENT_LIMIT_OCTETS = 8 << 20
"""What waits for a client that reads slowly; a client that is further behind is disconnected."""

_CHUNK_OCTETS = 65_536
_CLOSE_S = 2.0


@dataclass(slots=True, eq=False)
class Client:
    """One connection.

    Attributes
    ----------
    number
        Counts the connections of a port; it is never used again, unlike a descriptor.
    unsent
        Octets that the client has not taken yet.
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
        Called with the number of the client and what it sent.
    ended
        Called with the number of a client that has gone.
    """

    name: str
    port: int
    host: str
    receive: Callable[[int, bytes], None]
    ended: Callable[[int], None] = lambda number: None
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
        """Serve this port from a selector; `serve` is to be called with the events of its keys."""
        self._selector = selector
        selector.register(self.listener, selectors.EVENT_READ, (self, None))

    def detach(self) -> None:
        """Leave the selector; what is sent from here on goes out by `close`."""
        if self._selector is not None:
            for connection in (self.listener, *(client.connection for client in self.clients.values())):
                self._selector.unregister(connection)
            self._selector = None

    def serve(self, client: Client | None, events: int) -> None:
        """Handle an event of the listener (None) or of a client, which may have been dropped since."""
        if client is None:
            self._accept()
            return
        if events & selectors.EVENT_WRITE and client.number in self.clients:
            self._flush(client)
        if events & selectors.EVENT_READ and client.number in self.clients:
            self._read(client)

    def send(self, octets: bytes) -> None:
        """Give octets to every client without waiting; a client that is too far behind is disconnected."""
        for client in list(self.clients.values()):
            client.unsent += octets
            self._flush(client)

    def drop(self, client: Client) -> None:
        """Close a connection; it is not served any more."""
        if self.clients.pop(client.number, None) is None:
            return
        if self._selector is not None:
            self._selector.unregister(client.connection)
        client.connection.close()
        self.ended(client.number)

    def close(self) -> None:
        """Close the port and all connections, after a last attempt to deliver what waits."""
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
            return  # It has gone already, or descriptors are scarce: the next turn tries again.
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
            self.drop(client)
            return
        if len(client.unsent) > UNSENT_LIMIT_OCTETS:
            self.drop(client)
            return
        wanted = selectors.EVENT_READ | (selectors.EVENT_WRITE if client.unsent else 0)
        if wanted != client.events and self._selector is not None:
            client.events = wanted
            self._selector.modify(client.connection, wanted, (self, client))
