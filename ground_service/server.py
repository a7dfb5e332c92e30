"""Running the application with uvicorn."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import resource
import signal
import socket
import sys
from typing import TYPE_CHECKING

from ground_service.access.store import has_users
from ground_service.app import create_app
from ground_service.errors import ServerError
from ground_service.ground import ground_from_settings
from ground_service.http.limits import LOOPBACK
from ground_service.http.uploads import UPLOADS_AT_ONCE
from ground_service.logs import logging_config
from ground_service.settings import Settings
from ground_service.worker.condition import present
from kernels.memory import limit_heaps

if TYPE_CHECKING:
    from types import FrameType

    import uvicorn
    from starlette.datastructures import State

FILES_KEPT = 320
"""Open files reserved for the database, the archive and the program."""

MOST_CONNECTIONS = 4096
"""Simultaneous connections, as far as the limit of open files permits; a proxy limits those of each address."""

SOCKET_MESSAGE_OCTETS = 4096
FIRST_REQUEST_S = 1.0

UNLIMITED = (
    "this address is reached from other machines: a reverse proxy must limit their requests, connections and "
    "slow clients, as deploy/nginx.conf does"
)

SWITCH_S = 0.0005
"""Interval after which computing Python threads yield to the event loop (default of Python: 5 ms)."""


def serve(settings: Settings) -> None:
    """Serve until stopped.

    Raises
    ------
    ServerError
        If the address cannot be bound to, or may not be without users.
    """
    import uvicorn

    limit_heaps()
    with ground_from_settings(settings) as ground:
        if settings.host not in LOOPBACK and not ground.read(has_users):
            raise ServerError(
                f"address {settings.host}: expected users before binding beyond this machine, found none; "
                "run 'linna user add NAME --role admin' first"
            )
    listener = bind(settings.host, settings.port)
    files = _raise_file_limit()
    sys.setswitchinterval(SWITCH_S)
    app = create_app(settings)
    config = uvicorn.Config(
        app,
        http="h11",
        ws="websockets-sansio",
        limit_concurrency=max(min(MOST_CONNECTIONS, files - FILES_KEPT - UPLOADS_AT_ONCE), 16),
        ws_max_size=SOCKET_MESSAGE_OCTETS,
        # Compression needs a compressor for each socket, too much memory for short messages.
        ws_per_message_deflate=False,
        log_config=logging_config(settings.log_format),
        timeout_graceful_shutdown=20,
        # Longer than clients and proxies keep idle connections, so that none is closed under a request of theirs.
        timeout_keep_alive=75,
        server_header=False,
        # The application accepts these headers from configured proxies; the server would from any local process.
        proxy_headers=False,
    )
    host, port = listener.getsockname()[:2]
    shown = f"[{host}]" if ":" in host else host
    print(f"LINNA ground service on http://{shown}:{port}/", file=sys.stderr, flush=True)
    if settings.host not in LOOPBACK:
        print(UNLIMITED, file=sys.stderr, flush=True)
    with ground_from_settings(settings) as ground, present(ground, settings, "api"), listener:
        _server(config, app.state, settings.drain_s).run(sockets=[listener])


def _server(config: uvicorn.Config, state: State, drain_s: float) -> uvicorn.Server:
    """Return a server that drains after SIGTERM."""
    import uvicorn

    class Server(uvicorn.Server):
        async def startup(self, sockets: list[socket.socket] | None = None) -> None:
            self._loop = asyncio.get_running_loop()
            await super().startup(sockets)

        def handle_exit(self, sig: int, frame: FrameType | None) -> None:
            if sig != signal.SIGTERM or drain_s <= 0.0 or state.draining or not self.started:
                super().handle_exit(sig, frame)
                return
            state.draining = True
            end = super().handle_exit
            self._loop.call_soon_threadsafe(self._loop.call_later, drain_s, end, sig, frame)

        async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
            state.draining = True
            for server in self.servers:
                server.close()
            if drain_s > 0.0:
                # The first request of a connection that was just accepted may be on the way.
                await asyncio.sleep(FIRST_REQUEST_S)
            await super().shutdown(sockets)

    return Server(config)


def _raise_file_limit() -> int:
    """Raise the limit of open files of this process to the maximum that the system allows; return it."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    return resource.getrlimit(resource.RLIMIT_NOFILE)[0]


def bind(host: str, port: int) -> socket.socket:
    """A socket bound to the address.

    Raises
    ------
    ServerError
        If it is taken, not this machine's, or not allowed.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # asyncio switches Nagle's algorithm off only where the protocol is named; with it on answers wait 40 ms.
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
    except OSError as error:
        listener.close()
        reason = (
            "is in use by another program"
            if error.errno == errno.EADDRINUSE
            else f"cannot be bound ({error.strerror})"
        )
        raise ServerError(f"address {host} port {port}: {reason}; choose another with --port") from None
    return listener
