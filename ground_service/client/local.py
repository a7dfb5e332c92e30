"""Client of a ground service in this process: the same application and operations, without a server."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterator
from contextlib import ExitStack

import httpx
from anyio.from_thread import start_blocking_portal

from ground_service.app import create_local_app
from ground_service.client.operations import Client
from ground_service.ground import Ground

LOCAL_URL = "http://localhost"


def local_client(ground: Ground, actor: str) -> Client:
    """Return a client of an opened ground service, which it closes at the end.

    It acts as administrator `actor`: who may open the database of this machine may do everything. Jobs are finished
    when their request returns.
    """
    return Client(LOCAL_URL, transport=LocalTransport(ground, actor))


class LocalTransport(httpx.BaseTransport):
    """Requests to an application in this process. Request bodies are streamed, response bodies are held in memory."""

    def __init__(self, ground: Ground, actor: str) -> None:
        self._ground = ground
        self._asgi = httpx.ASGITransport(create_local_app(ground, actor))
        self._opened = ExitStack()
        self._opened.callback(ground.close)
        self._portal = self._opened.enter_context(start_blocking_portal())

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        try:
            return self._portal.call(self._exchange, request)
        except KeyboardInterrupt:
            self._ground.stopping.set()  # a job ends between two transactions
            raise

    def close(self) -> None:
        self._opened.close()

    async def _exchange(self, request: httpx.Request) -> httpx.Response:
        assert isinstance(request.stream, httpx.SyncByteStream)
        passed = httpx.Request(
            request.method, request.url, headers=request.headers, stream=_Blocks(request.stream)
        )
        response = await self._asgi.handle_async_request(passed)
        octets = await response.aread()
        return httpx.Response(response.status_code, headers=response.headers, stream=httpx.ByteStream(octets))


class _Blocks(httpx.AsyncByteStream):
    """Blocks of a request body, each read when the application asks for it."""

    def __init__(self, stream: httpx.SyncByteStream) -> None:
        self._blocks: Iterator[bytes] = iter(stream)

    async def __aiter__(self) -> AsyncIterator[bytes]:
        for block in self._blocks:
            yield block
