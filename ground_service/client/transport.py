"""HTTPX transport to the operations of the ground service in this process."""

import asyncio
import sys
import threading
import weakref
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import ExitStack
from functools import cache

import httpx
from fastapi import FastAPI
from starlette.routing import Match
from starlette.types import ASGIApp, Receive, Scope, Send

from ground_service.access.service import Caller
from ground_service.client.connection import API_PREFIX
from ground_service.ground import Ground
from ground_service.http import problems
from ground_service.http.common import OPERATIONS
from ground_service.http.requests import PlainText
from ground_service.http.uploads import UploadPool
from ground_service.jobs.service import Dispatcher

LOCAL_UPLOADS = 2


def local_app(ground: Ground, actor: str, dispatcher: Dispatcher) -> ASGIApp:
    """Return the ASGI application of the API for in-process callers, who act as administrator `actor`.

    There are no network limits, and error messages are complete.
    """
    app = FastAPI()
    app.state.ground = ground
    app.state.local_caller = Caller(actor, "admin")
    app.state.dispatcher = dispatcher
    app.state.uploads = UploadPool(LOCAL_UPLOADS)
    app.state.upload_limit_octets = sys.maxsize
    app.state.operations = []
    problems.install(app)
    app.add_middleware(PlainText)
    return OperationsOnDemand(app)


class OperationsOnDemand:
    """ASGI application that includes a router on the first request for one of its operations."""

    def __init__(self, app: FastAPI) -> None:
        self._app = app
        self._missing = list(OPERATIONS)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        words = scope["path"].removeprefix(API_PREFIX).split("/")[::-1]  # reports of a pass are one of the reports
        self._missing.sort(key=lambda router: words.index(router.segment) if router.segment in words else len(words))
        while self._missing and not self._has_operation(scope):
            routes = self._missing.pop(0).load()
            self._app.include_router(routes)
            self._app.state.operations += routes.routes
        await self._app(scope, receive, send)

    def _has_operation(self, scope: Scope) -> bool:
        return any(route.matches(scope)[0] is Match.FULL for route in self._app.state.operations)


class LocalDispatcher(Dispatcher):
    """Dispatcher that finishes every job before its request returns."""

    def start(self, job_id: str) -> None:
        from ground_service.worker.jobs import run_job

        run_job(self._ground, job_id)

    def resume(self) -> None:
        """Leave unfinished jobs of other processes to the server."""

    def close(self) -> None:
        """No job runs between requests."""


def follow_on_demand(ground: Ground) -> Callable[[frozenset[str]], None]:
    """Return the follow-up work of events in this process; its code is imported on the first event."""

    @cache
    def follow_up() -> Callable[[frozenset[str]], None]:
        from ground_service.worker.follow_up import FollowUp

        return FollowUp(ground)

    return lambda kinds: follow_up()(kinds)


class LocalTransport(httpx.BaseTransport):
    """HTTPX transport to an in-process application, with streamed request bodies and response bodies in memory.

    The application runs in a daemon thread, so that a transport that is not closed does not keep Python from ending;
    it is closed then.
    """

    def __init__(self, ground: Ground, actor: str, *, background: bool = False) -> None:
        self._ground = ground
        dispatcher = _background_dispatcher(ground) if background else LocalDispatcher(ground)
        ground.database.listeners.add(follow_on_demand(ground))
        self._asgi = httpx.ASGITransport(local_app(ground, actor, dispatcher))
        self._loop = asyncio.new_event_loop()
        thread = threading.Thread(target=self._loop.run_forever, name="in-process service", daemon=True)
        thread.start()
        opened = ExitStack()
        for close in (self._loop.close, ground.close, dispatcher.close, thread.join):
            opened.callback(close)
        opened.callback(self._loop.call_soon_threadsafe, self._loop.stop)
        self._end = weakref.finalize(self, opened.close)

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        try:
            return asyncio.run_coroutine_threadsafe(self._exchange(request), self._loop).result()
        except KeyboardInterrupt:
            self._ground.stopping.set()  # a job stops between two transactions
            raise

    def close(self) -> None:
        self._end()

    async def _exchange(self, request: httpx.Request) -> httpx.Response:
        assert isinstance(request.stream, httpx.SyncByteStream)
        passed = httpx.Request(request.method, request.url, headers=request.headers, stream=_Blocks(request.stream))
        response = await self._asgi.handle_async_request(passed)
        octets = await response.aread()
        return httpx.Response(response.status_code, headers=response.headers, stream=httpx.ByteStream(octets))


def _background_dispatcher(ground: Ground) -> Dispatcher:
    from ground_service.worker.dispatch import ThreadDispatcher

    return ThreadDispatcher(ground)


class _Blocks(httpx.AsyncByteStream):
    """Blocks of a request body, read on demand."""

    def __init__(self, stream: httpx.SyncByteStream) -> None:
        self._blocks: Iterator[bytes] = iter(stream)

    async def __aiter__(self) -> AsyncIterator[bytes]:
        for block in self._blocks:
            yield block
