"""Connection limits, deadlines and scheduling of the HTTP server.

uvicorn's protocols have one timeout (keep-alive) and one limit (concurrency). The protocols here add:

- limits of connections in total and for each client address; a reserve above both answers health checks only, and a new
  connection there replaces the oldest one without a request;
- deadlines for the head of a request, for the progress of its body, and for a client that does not read the response;
- a queue of received octets that is processed in slices of `SLICE_S`, so that a thousand simultaneous requests do not
  block the event loop.
"""

from __future__ import annotations

import asyncio
import json
import resource
import time
from collections import Counter, OrderedDict, deque
from dataclasses import dataclass
from typing import Any, ClassVar, cast

import h11
from starlette.types import ASGIApp, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from ground_service.http.problems import MEDIA_TYPE, busy
from ground_service.http.proxies import TrustedProxies, address_key

SLICE_S = 0.004
SWEEP_S = 0.5
HELD_OCTETS = 1 << 16
FIRST_REQUEST_S = 1.0
"""Time that a new connection has for its first request when the server stops."""

WATCHED_PATHS = ("/healthz", "/readyz", "/metrics")


@dataclass(frozen=True, slots=True)
class ConnectionLimits:
    """Limits of the number and duration of connections.

    At least `body_octets` of a request body must arrive in every `body_s`; time during which the service does not read
    is not counted.
    """

    total: int = 4096
    per_client: int = 1024
    reserve: int = 64
    head_s: float = 20.0
    reserve_head_s: float = 3.0
    body_s: float = 20.0
    body_octets: int = 4096
    unread_s: float = 30.0
    discard_s: float = 15.0
    stop_s: float = 5.0


def raise_file_limit() -> int:
    """Raise the limit of open files of this process to the maximum that the system allows; return it."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY:
        return 1 << 20
    if hard == resource.RLIM_INFINITY or hard > soft:
        wanted = min(hard, 1 << 20) if hard != resource.RLIM_INFINITY else 1 << 20
        try:
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
            soft = wanted
        except (OSError, ValueError):
            pass  # the limit is unchanged; it also limits the connections
    return soft


class Door:
    """Admission control for the connections of one server."""

    def __init__(self, limits: ConnectionLimits, proxies: TrustedProxies | None = None) -> None:
        self.limits = limits
        self._proxies = proxies if proxies is not None else TrustedProxies()
        self._clients: Counter[str] = Counter()
        self._total = 0
        self._reserve: OrderedDict[GuardedProtocol, None] = OrderedDict()
        self._watched: set[GuardedProtocol | GuardedSocket] = set()
        self._waiting: deque[GuardedProtocol] = deque()
        self._pumping = False
        self._sweeping = False

    def protocols(self) -> tuple[type[H11Protocol], type[WebSocketsSansIOProtocol]]:
        """Return the protocol classes for HTTP and WebSocket that use this admission control."""
        http = type("BoundProtocol", (GuardedProtocol,), {"door": self})
        socket = type("BoundSocket", (GuardedSocket,), {"door": self})
        return cast(type[H11Protocol], http), cast(type[WebSocketsSansIOProtocol], socket)

    def enter(self, protocol: GuardedProtocol, host: str) -> str | None:
        """Register a new connection; return the key to unregister it, None if it is in the reserve."""
        key = address_key(host)
        # All clients of a trusted proxy have its address: only the total limit applies here.
        crowded = host not in self._proxies and self._clients[key] >= self.limits.per_client
        if self._total < self.limits.total and not crowded:
            self._total += 1
            self._clients[key] += 1
            return key
        while len(self._reserve) >= self.limits.reserve:
            oldest, _ = self._reserve.popitem(last=False)
            oldest.end(503, "too many connections")
        self._reserve[protocol] = None
        return None

    def leave(self, key: str | None) -> None:
        """Unregister a connection."""
        if key is None:
            return
        self._total -= 1
        self._clients[key] -= 1
        if self._clients[key] <= 0:
            del self._clients[key]

    def watch(self, protocol: GuardedProtocol | GuardedSocket) -> None:
        """Start to check the deadlines of a connection."""
        self._watched.add(protocol)
        if not self._sweeping:
            self._sweeping = True
            protocol.loop.call_later(SWEEP_S, self._sweep, protocol.loop)

    def forget(self, protocol: GuardedProtocol | GuardedSocket) -> None:
        """Stop checking a connection that has ended or became a WebSocket."""
        self._watched.discard(protocol)
        if isinstance(protocol, GuardedProtocol):
            self._reserve.pop(protocol, None)

    def queue(self, protocol: GuardedProtocol) -> None:
        """Queue a connection to process its received octets."""
        self._waiting.append(protocol)
        if not self._pumping:
            self._pumping = True
            protocol.loop.call_soon(self._pump, protocol.loop)

    def _pump(self, loop: asyncio.AbstractEventLoop) -> None:
        until = time.perf_counter() + SLICE_S
        while self._waiting:
            self._waiting.popleft().work_off()
            if time.perf_counter() >= until:
                break
        self._pumping = bool(self._waiting)
        if self._pumping:
            loop.call_soon(self._pump, loop)

    def _sweep(self, loop: asyncio.AbstractEventLoop) -> None:
        now = loop.time()
        for protocol in list(self._watched):
            protocol.check(now)
        self._sweeping = bool(self._watched)
        if self._sweeping:
            loop.call_later(SWEEP_S, self._sweep, loop)


class Backlog:
    """Sent octets that a client has not read."""

    def __init__(self, transport: asyncio.Transport) -> None:
        self._transport = transport
        self._octets = 0
        self._since = 0.0

    def stuck_s(self, now: float) -> float:
        """Return the time for which the client has read nothing of the waiting octets, s."""
        octets = self._transport.get_write_buffer_size()
        if octets == 0 or octets < self._octets or self._octets == 0:
            self._since = now
        self._octets = octets
        return now - self._since


class GuardedProtocol(H11Protocol):
    """HTTP connection with deadlines; see the module."""

    door: ClassVar[Door]

    def __init__(self, *arguments: Any, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self._received = bytearray()
        self._key: str | None = None
        self._in_reserve = False
        self._upgraded = False
        self._head_since: float | None = None
        self._body_since = 0.0
        self._body_octets = 0
        self._discard_since: float | None = None
        self._stop_at: float | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(cast(asyncio.Transport, transport))
        self._backlog = Backlog(self.transport)
        self._head_since = self.loop.time()
        self.door.watch(self)
        self._key = self.door.enter(self, self.client[0] if self.client else "")
        if self._key is None:
            self._in_reserve = True
            self.app = cast(Any, _Reserve(cast(ASGIApp, self.config.loaded_app)))

    def connection_lost(self, exc: Exception | None) -> None:
        self._received.clear()
        self.door.forget(self)
        self.door.leave(self._key)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        self._body_octets += len(data)
        if not self._received:
            self.door.queue(self)
        self._received += data
        if len(self._received) >= HELD_OCTETS:
            self.transport.pause_reading()

    def work_off(self) -> None:
        """Process the received octets, then resume reading."""
        data = bytes(self._received)
        self._received.clear()
        if self.transport.is_closing():
            return
        cycle = self.cycle
        if self._head_since is None and (cycle is None or cycle.response_complete):
            self._head_since = self.loop.time()
        super().data_received(data)
        if self.cycle is not cycle:
            self._head_since = None
            self._body_since, self._body_octets = self.loop.time(), 0
        if not self._upgraded and not self.flow.read_paused:
            self.transport.resume_reading()

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        self._upgraded = True
        self.door.forget(self)
        super().handle_websocket_upgrade(event)
        # The WebSocket protocol now owns the transport and unregisters the connection.
        cast(GuardedSocket, self.transport.get_protocol()).key = self._key
        self._key = None
        self.transport.resume_reading()

    def _should_upgrade(self) -> bool:
        return not self._in_reserve and super()._should_upgrade()

    def check(self, now: float) -> None:
        """Close the connection if the client exceeds a deadline."""
        limits = self.door.limits
        if self._backlog.stuck_s(now) > limits.unread_s:
            self.transport.abort()
        if self.transport.is_closing():
            return
        if self._stop_at is not None and now >= self._stop_at and not self._is_answered():
            self.end(503, "the service is being stopped")
        elif self._stop_at is not None and now >= self._stop_at and self.cycle is None:
            self.transport.close()
        elif self._head_since is not None:
            if now - self._head_since > (limits.reserve_head_s if self._in_reserve else limits.head_s):
                self.end(408, "the head of the request took too long")
        elif self.conn.their_state is h11.SEND_BODY:
            if self._is_answered():
                self._discard_since = self._discard_since or now
                if now - self._discard_since > limits.discard_s:
                    self.transport.abort()
            elif self.flow.read_paused or self._received:
                self._body_since, self._body_octets = now, 0
            elif now - self._body_since > limits.body_s:
                if self._body_octets < limits.body_octets:
                    self.end(408, "the body of the request took too long")
                self._body_since, self._body_octets = now, 0
        else:
            self._discard_since = None

    def _is_answered(self) -> bool:
        return self.cycle is None or self.cycle.response_complete

    def shutdown(self) -> None:
        limits = self.door.limits
        if self.cycle is None and not self._upgraded:
            # Its first request may be on the way; the answer closes the connection.
            self._stop_at = self.loop.time() + min(limits.stop_s, FIRST_REQUEST_S)
            return
        super().shutdown()
        self._stop_at = self.loop.time() + limits.stop_s

    def end(self, status: int, detail: str) -> None:
        """Respond to an incomplete request if possible, and close the connection."""
        if self.transport.is_closing():
            return
        cycle = self.cycle
        if cycle is None or cycle.response_complete or not cycle.response_started:
            self.transport.write(_raw_problem(status, detail))
        if cycle is not None and not cycle.response_complete:
            cycle.disconnected = True
            cycle.message_event.set()
        self.transport.close()

    def send_400_response(self, msg: str) -> None:
        self.end(400, f"{msg} Expected HTTP/1.1 with a head of at most 16 KiB")


class GuardedSocket(WebSocketsSansIOProtocol):
    """WebSocket that counts as the connection it was upgraded from; it is closed if its client does not read."""

    door: ClassVar[Door]
    key: str | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        self._backlog = Backlog(self.transport)
        self.door.watch(self)

    def check(self, now: float) -> None:
        """Close the connection of a client that does not read."""
        if self._backlog.stuck_s(now) > self.door.limits.unread_s:
            self.transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        self.door.forget(self)
        self.door.leave(self.key)
        self.key = None
        super().connection_lost(exc)


class _Reserve:
    """Application for connections of the reserve: it answers health checks and returns 503 to all other requests."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["path"] in WATCHED_PATHS:
            await self._app(scope, receive, send)
            return
        response = busy("too many connections; expected fewer at once")
        response.headers["Connection"] = "close"
        await response(scope, receive, send)


def _raw_problem(status: int, detail: str) -> bytes:
    titles = {400: "Bad Request", 408: "Request Timeout", 503: "Service Unavailable"}
    body = json.dumps(
        {"type": "about:blank", "title": titles[status].lower(), "status": status, "detail": detail}
    ).encode()
    head = f"HTTP/1.1 {status} {titles[status]}\r\ncontent-type: {MEDIA_TYPE}\r\nconnection: close\r\n"
    retry = "retry-after: 1\r\n" if status == 503 else ""
    return (head + retry + f"content-length: {len(body)}\r\n\r\n").encode() + body
