"""TCP connections of a link: telemetry in without blocking for long, telecommands out."""

from __future__ import annotations

import contextlib
import select
import socket
import struct
import time
from dataclasses import dataclass, field

from ground_service.contacts.links.core import next_wait_s

CONNECT_S = 3.0
SEND_S = 4.0
BLOCK_OCTETS = 1 << 16
NOT_YET = "not connected yet"
DISCARDED_BLOCKS = 64
"""Limit for one call: a station that sends on the uplink without end must not stop the link."""

CONFIRM_S = 4.0
ACKNOWLEDGEMENT = struct.Struct(">Q")
TRANSMISSION = struct.Struct(">QI")
"""Header of telecommand octets for a station that confirms: number of the transmission, number of octets."""

REFUSED = 0
"""Answer of a station that cannot send the transmission now."""


@dataclass(slots=True)
class Connector:
    """A TCP connection that is opened again, with growing waits, after it was lost.

    Attributes
    ----------
    fault
        Why there is no connection; None while it is open.
    """

    address: tuple[str, int]
    reconnect: bool = True
    fault: str | None = NOT_YET
    over: bool = False
    _socket: socket.socket | None = None
    _wait_s: float = 0.0
    _next_s: float = field(default=0.0)

    @property
    def connected(self) -> bool:
        """Whether the connection is open."""
        return self._socket is not None

    def connect(self) -> bool:
        """Open the connection if it is time for an attempt; return whether it is open."""
        if self._socket is not None:
            return True
        if self.over or time.monotonic() < self._next_s:
            return False
        try:
            self._socket = socket.create_connection(self.address, timeout=CONNECT_S)
        except OSError as error:
            self._lost(error.strerror or str(error))
            return False
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        self.fault = None
        return True

    def receive(self, timeout_s: float) -> bytes | None:
        """Return received octets; None if nothing came within the time, or the connection was lost."""
        if self._socket is None:
            return None
        try:
            if not select.select([self._socket], [], [], timeout_s)[0]:
                return None
            octets = self._socket.recv(BLOCK_OCTETS)
        except (OSError, ValueError) as error:
            self._lost(str(error))
            return None
        if not octets:
            self._lost("closed by the station")
            self.over = not self.reconnect
            return None
        self._wait_s = 0.0
        return octets

    def send(self, octets: bytes) -> bool:
        """Send octets completely; return whether that succeeded."""
        if self._socket is None:
            return False
        try:
            self._socket.settimeout(SEND_S)
            self._socket.sendall(octets)
        except OSError as error:
            self._lost(str(error))
            return False
        self._wait_s = 0.0
        return True

    def confirmed(self, number: int) -> bool:
        """Return whether the station confirms a transmission, and not that it cannot send it now."""
        answer, until = b"", time.monotonic() + CONFIRM_S
        while len(answer) < ACKNOWLEDGEMENT.size:
            left = until - time.monotonic()
            octets = self.receive(left) if left > 0.0 else None
            if octets is None:
                if self.connected:
                    self._lost("no confirmation of a transmission")
                return False
            answer += octets
        (found,) = ACKNOWLEDGEMENT.unpack(answer[: ACKNOWLEDGEMENT.size])
        if found not in (number, REFUSED) or len(answer) > ACKNOWLEDGEMENT.size:
            self._lost(f"expected the confirmation of transmission {number}, found {answer[:16].hex()}")
        return bool(found == number)

    def discard_input(self) -> bool:
        """Read what the other side sends without use; return whether the connection is still open."""
        for _ in range(DISCARDED_BLOCKS):
            if self.receive(0.0) is None:
                break
        return self.connected

    def close(self) -> None:
        """Close the connection."""
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.close()
            self._socket = None

    def _lost(self, reason: str) -> None:
        self.close()
        self._wait_s = next_wait_s(self._wait_s)
        self._next_s = time.monotonic() + self._wait_s
        self.fault = reason


def address_of(text: str) -> tuple[str, int]:
    """Return host and port of ``HOST:PORT``."""
    host, _, port = text.rpartition(":")
    return host.strip("[]"), int(port)
