"""Running the application with uvicorn."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import logging
import mmap
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import TYPE_CHECKING, Any

import ground_service
from ground_service.access.service import has_users
from ground_service.app import create_app
from ground_service.errors import ServerError
from ground_service.ground import ground_from_settings
from ground_service.http import front
from ground_service.http.connections import ConnectionLimits, Door, raise_file_limit
from ground_service.http.front import HEARTBEAT
from ground_service.http.origins import LOOPBACK
from ground_service.http.proxies import TrustedProxies
from ground_service.logs import logging_config
from ground_service.memory import limit_heaps
from ground_service.settings import Settings

if TYPE_CHECKING:
    from types import FrameType

    import uvicorn
    from starlette.datastructures import State

log = logging.getLogger(__name__)

FILES_KEPT = 320
"""Open files reserved for the connection reserve, the database, the archive and the program."""

QUEUED = 4096
TAKEN_AT_ONCE = 16
BEAT_S = 0.5
SOCKET_MESSAGE_OCTETS = 4096
FINISH_S = 5.0

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
        if settings.host not in LOOPBACK and not has_users(ground):
            raise ServerError(
                f"address {settings.host}: expected users before binding beyond this machine, found none; "
                "run 'linna user add NAME --role admin' first"
            )
    listener = bind(settings.host, settings.port)
    files = raise_file_limit()
    sys.setswitchinterval(SWITCH_S)
    limits = ConnectionLimits(
        total=max(min(settings.connections, files - FILES_KEPT - settings.uploads_at_once), 16),
        per_client=settings.connections_per_client,
        head_s=settings.request_timeout_s,
        body_s=settings.request_timeout_s,
    )
    http, websocket = Door(limits, TrustedProxies(settings.trusted_proxies)).protocols()
    app = create_app(settings)
    config = uvicorn.Config(
        app,
        http=http,
        ws=websocket,
        ws_max_size=SOCKET_MESSAGE_OCTETS,
        # Compression needs a compressor for each socket, too much memory for short messages.
        ws_per_message_deflate=False,
        log_config=logging_config(settings.log_format),
        timeout_graceful_shutdown=20,
        # Longer than clients and proxies keep idle connections, so that none is closed under a request of theirs.
        timeout_keep_alive=75,
        server_header=False,
        # `proxies` handles these headers for configured proxies; uvicorn itself would accept them from any local
        # process.
        proxy_headers=False,
    )
    host, port = listener.getsockname()[:2]
    shown = f"[{host}]" if ":" in host else host
    print(f"LINNA ground service on http://{shown}:{port}/", file=sys.stderr, flush=True)
    listener.listen(QUEUED)
    with listener:
        _server(config, listener, app.state, settings.drain_s).run(sockets=[listener])


def _server(config: uvicorn.Config, listener: socket.socket, state: State, drain_s: float) -> uvicorn.Server:
    """Return a server that receives its connections from a front process and drains after SIGTERM."""
    import uvicorn

    class Server(uvicorn.Server):
        async def startup(self, sockets: list[socket.socket] | None = None) -> None:
            self._loop = asyncio.get_running_loop()
            await super().startup([])
            self._front = FrontProcess(listener, self._serve_connection)
            self._front.start(self._loop)

        def handle_exit(self, sig: int, frame: FrameType | None) -> None:
            if sig != signal.SIGTERM or drain_s <= 0.0 or state.draining or not self.started:
                super().handle_exit(sig, frame)
                return
            state.draining = True
            end = super().handle_exit
            self._loop.call_soon_threadsafe(self._loop.call_later, drain_s, end, sig, frame)

        async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
            state.draining = True
            await self._front.finish()
            await super().shutdown(sockets)

        def _serve_connection(self, client: socket.socket) -> Coroutine[Any, Any, object]:
            loop = asyncio.get_running_loop()

            def protocol() -> asyncio.Protocol:
                make: Any = config.http_protocol_class
                made: asyncio.Protocol = make(
                    config=config,
                    server_state=self.server_state,
                    app_state=self.lifespan.state,
                    _loop=loop,
                )
                return made

            return loop.connect_accepted_socket(protocol, client)

    return Server(config)


class FrontProcess:
    """Server side of the front process: it receives connections from a channel and writes the heartbeat."""

    def __init__(
        self, listener: socket.socket, serve: Callable[[socket.socket], Coroutine[Any, Any, object]]
    ) -> None:
        self._listener = listener
        self._serve = serve
        self._tasks: set[asyncio.Task[object]] = set()
        self._finished: asyncio.Future[None] | None = None

    def start(self, loop: asyncio.AbstractEventLoop) -> None:
        """Start the process and receive connections from it; restart it if it ends."""
        self._loop = loop
        self._channel, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        self._channel.setblocking(False)
        descriptor = os.memfd_create("linna-heartbeat")
        os.ftruncate(descriptor, HEARTBEAT.size)
        self._heartbeat = mmap.mmap(descriptor, HEARTBEAT.size)
        self._beat()
        passed = [self._listener.fileno(), theirs.fileno(), descriptor]
        root = Path(ground_service.__file__).resolve().parent.parent
        self._process = subprocess.Popen(
            [sys.executable, "-m", front.__name__, *map(str, passed)],
            pass_fds=passed,
            cwd=root,
            stdin=subprocess.DEVNULL,
            env={"PYTHONPATH": str(root)},
        )
        theirs.close()
        os.close(descriptor)
        loop.add_reader(self._channel, self._take)

    async def finish(self) -> None:
        """Stop listening, receive the connections that were accepted, and stop the process."""
        self._listener.close()
        self._finished = self._loop.create_future()
        with contextlib.suppress(OSError, TimeoutError):
            self._channel.shutdown(socket.SHUT_WR)
            await asyncio.wait_for(self._finished, FINISH_S)
        self.stop()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def stop(self) -> None:
        """Stop accepting connections; the process ends when its channel is closed."""
        self._beats.cancel()
        self._loop.remove_reader(self._channel)
        self._channel.close()
        self._process.wait()

    def _beat(self) -> None:
        HEARTBEAT.pack_into(self._heartbeat, 0, time.monotonic())
        self._beats = self._loop.call_later(BEAT_S, self._beat)

    def _take(self) -> None:
        for _ in range(TAKEN_AT_ONCE):
            try:
                message, descriptors, _, _ = socket.recv_fds(self._channel, 1, 1)
            except BlockingIOError:
                return
            if not message:
                if self._finished is None:
                    self._again()
                elif not self._finished.done():
                    self._loop.remove_reader(self._channel)
                    self._finished.set_result(None)
                return
            for descriptor in descriptors:
                client = socket.socket(fileno=descriptor)
                client.setblocking(False)
                task = self._loop.create_task(self._serve(client))
                self._tasks.add(task)
                task.add_done_callback(self._tasks.discard)

    def _again(self) -> None:
        log.error("the front process has ended; restarting it")
        self.stop()
        self.start(self._loop)


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
