"""The application and its server: `create_app` joins the service, its dispatcher and the routes; `serve` runs it."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import json
import logging
import re
import resource
import signal
import socket
import sys
from collections.abc import AsyncIterator
from contextlib import ExitStack, asynccontextmanager
from typing import TYPE_CHECKING, Any

from anyio import to_thread
from fastapi import FastAPI
from starlette.routing import Route
from uvicorn.middleware.proxy_headers import ProxyHeadersMiddleware

from ground_service.access.provider import provider_of
from ground_service.access.store import has_users
from ground_service.contacts.links.supervisor import LinkSupervisor
from ground_service.errors import ServerError
from ground_service.ground import ground_from_settings
from ground_service.http import problems
from ground_service.http.common import API_PREFIX, OPERATIONS
from ground_service.http.limits import LOOPBACK, BodyLimit, HeadersAndTags, LastRequests, SameOrigin
from ground_service.http.model import Problem
from ground_service.http.requests import PlainText
from ground_service.http.uploads import UPLOADS_AT_ONCE, UploadPool
from ground_service.logs import logging_config
from ground_service.missions.clocks import mission_clock
from ground_service.settings import Settings, start_tracing
from ground_service.web.pages import FOLDER, displays, documentation, pages
from ground_service.web.payload_console import payload_console
from ground_service.web.sign_in import sign_in
from ground_service.web.sockets import Sockets, live
from ground_service.worker.condition import present
from ground_service.worker.dispatch import dispatcher_for
from ground_service.worker.follow_up import follow_in_process
from ground_service.worker.jobs import enter_redecoding
from ground_service.worker.metrics import Metrics, Watch, probes
from ground_service.worker.scheduler import Scheduler
from kernels.memory import limit_heaps

if TYPE_CHECKING:
    from types import FrameType

    import uvicorn
    from starlette.datastructures import State


_PAGE = re.compile(r"PageOf_(\w+?)_(?=\")")


class DescribedApi(FastAPI):
    """Application whose OpenAPI document has problem documents as errors and pages named after their entity."""

    def openapi(self) -> dict[str, Any]:
        if self.openapi_schema is None:
            document: dict[str, Any] = super().openapi()
            document["components"]["schemas"]["Problem"] = Problem.model_json_schema()
            self.openapi_schema = json.loads(_PAGE.sub(r"\1Page", json.dumps(document)))
        return self.openapi_schema


log = logging.getLogger(__name__)

SQLITE_THREADS = 4
SERVER_THREADS = 20


def create_app(settings: Settings, *, inline_jobs: bool = False) -> FastAPI:
    """The HTTP application of a deployment.

    Parameters
    ----------
    inline_jobs
        Do jobs before the answer is sent (without a broker only), for tests and scripts.
    """

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        ground = ground_from_settings(settings)
        app.state.ground = ground
        app.state.uploads = UploadPool()
        # Together with the threads of uploads, jobs and the feed, not more than the connections to the database.
        threads = SQLITE_THREADS if ground.database.dialect == "sqlite" else SERVER_THREADS
        to_thread.current_default_thread_limiter().total_tokens = threads
        app.state.dispatcher = dispatcher_for(ground, settings, inline=inline_jobs)
        app.state.follow_up = follow_in_process(ground, app.state.dispatcher.start)
        for job in enter_redecoding(ground):
            log.warning("decoding the archive again with a newer dictionary: job %s", job)
            app.state.dispatcher.start(job)
        if inline_jobs or settings.resolved_broker_url() is None:
            app.state.dispatcher.resume()
        if inline_jobs or ground.database.dialect == "sqlite":
            app.state.follow_up.drain()  # otherwise the scheduler does: no start waits for the backlog of others
        clock = ExitStack()
        clock.enter_context(mission_clock(ground))
        supervisor = LinkSupervisor(ground) if settings.links else None
        if supervisor is not None:
            supervisor.start()
        app.state.sockets = Sockets(
            ground,
            open_without_users=app.state.open_without_users,
            per_user=settings.sockets_per_user,
            total=settings.sockets,
            redis_url=settings.redis_url,
        )
        sockets = asyncio.create_task(app.state.sockets.run())
        scheduler = Scheduler(
            ground, app.state.dispatcher, app.state.follow_up.drain, settings.kept, plan_hourly=settings.plan_hourly
        )
        scheduler.start()
        try:
            yield
        finally:
            sockets.cancel()
            await asyncio.gather(sockets, return_exceptions=True)
            await asyncio.to_thread(scheduler.stop)
            if supervisor is not None:
                await asyncio.to_thread(supervisor.stop)
            await asyncio.to_thread(app.state.uploads.close)
            app.state.dispatcher.close()
            clock.close()
            ground.close()

    app = DescribedApi(
        title="LINNA ground service",
        version="1",
        summary="Ingest, archive and evaluation of crater-based navigation",
        openapi_url=f"{API_PREFIX}/openapi.json",
        docs_url=None,
        redoc_url=None,
        lifespan=lifespan,
    )
    _set_state(app, settings)
    routers = (*(one.load() for one in OPERATIONS), probes, pages, sign_in, displays, documentation)
    for one in (*routers, live, payload_console):
        app.include_router(one)
    app.state.operations = [route for one in routers for route in one.routes if isinstance(route, Route)]
    start_tracing(settings)
    problems.install(app)
    _add_middleware(app, settings)
    return app


def _set_state(app: FastAPI, settings: Settings) -> None:
    """Set what requests read before the ground service is open."""
    app.state.draining = False
    app.state.provider = provider_of(settings)
    app.state.open_without_users = settings.host in LOOPBACK and app.state.provider is None
    app.state.live_console = settings.resolved_live_console()
    app.state.openmct = settings.openmct or FOLDER
    app.state.upload_limit_octets = settings.upload_limit_mib << 20
    app.state.backups = settings.backups
    app.state.broker = settings.resolved_broker_url()
    app.state.metrics = Metrics(settings.backups, app.state.broker)


def _add_middleware(app: FastAPI, settings: Settings) -> None:
    """Add what runs around each request; the last one added runs first."""
    app.add_middleware(
        BodyLimit,
        upload_paths=tuple(path for one in OPERATIONS for path in getattr(one.imported(), "UPLOAD_PATHS", ())),
        upload_limit_octets=settings.upload_limit_mib << 20,
    )
    app.add_middleware(PlainText)
    app.add_middleware(SameOrigin, hosts=(settings.host, *settings.allowed_hosts), api_prefix=API_PREFIX)
    app.add_middleware(HeadersAndTags)
    app.add_middleware(LastRequests, state=app.state)
    app.add_middleware(Watch, metrics=app.state.metrics)
    app.add_middleware(ProxyHeadersMiddleware, trusted_hosts=[*settings.trusted_proxies])


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
            "is in use by another program" if error.errno == errno.EADDRINUSE else f"cannot be bound ({error.strerror})"
        )
        raise ServerError(f"address {host} port {port}: {reason}; choose another with --port") from None
    return listener
