"""Slow, surplus and incomplete connections: they are closed, and others are served meanwhile."""

import asyncio
import json
from collections.abc import AsyncIterator, Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from typing import Any

import pytest
import uvicorn
from uvicorn.server import ServerState

from ground_service.http.connections import ConnectionLimits, Door
from ground_service.http.proxies import TrustedProxies

QUICK = ConnectionLimits(
    head_s=0.4, reserve_head_s=0.4, body_s=0.5, body_octets=64, unread_s=0.5, discard_s=0.5, stop_s=0.4
)
GET = b"GET /x HTTP/1.1\r\nHost: a\r\n\r\n"
PATIENCE_S = 20.0


class Echo:
    """Application that responds with the length of the body and records the outcome of requests."""

    def __init__(self, answer_octets: int = 0) -> None:
        self.answer_octets = answer_octets
        self.seen: list[str] = []

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.accept"})
            await receive()
            return
        taken = 0
        while True:
            message = await receive()
            if message["type"] == "http.disconnect":
                self.seen.append("disconnected")
                return
            taken += len(message.get("body", b""))
            if not message.get("more_body"):
                break
        self.seen.append(scope["path"])
        body = b"x" * self.answer_octets or str(taken).encode()
        headers = [(b"content-length", str(len(body)).encode())]
        await send({"type": "http.response.start", "status": 200, "headers": headers})
        await send({"type": "http.response.body", "body": body})


class Guarded:
    """Server with admission control on a separate port."""

    def __init__(self, app: Any, limits: ConnectionLimits, proxies: tuple[str, ...] = ()) -> None:
        self.door = Door(limits, TrustedProxies(proxies))
        http, websocket = self.door.protocols()
        self._config = uvicorn.Config(app, http=http, ws=websocket, log_config=None, lifespan="off")
        self._config.load()
        self.state = ServerState()
        self._http = http
        self.clients: list[asyncio.StreamWriter] = []

    async def start(self) -> None:
        loop = asyncio.get_running_loop()

        def make() -> asyncio.Protocol:
            return self._http(config=self._config, server_state=self.state, app_state={}, _loop=loop)

        self.server = await loop.create_server(make, "127.0.0.1", 0)
        self.port = self.server.sockets[0].getsockname()[1]

    async def connect(self, octets: bytes = b"") -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        reader, writer = await asyncio.open_connection("127.0.0.1", self.port)
        self.clients.append(writer)
        writer.write(octets)
        return reader, writer


@asynccontextmanager
async def guarded(
    app: Any = None, limits: ConnectionLimits = QUICK, proxies: tuple[str, ...] = ()
) -> AsyncIterator[Guarded]:
    server = Guarded(app if app is not None else Echo(), limits, proxies)
    await server.start()
    try:
        yield server
    finally:
        server.server.close()
        for connection in list(server.state.connections):
            connection.transport.abort()
        for writer in server.clients:
            writer.transport.abort()
        await asyncio.gather(*(writer.wait_closed() for writer in server.clients), return_exceptions=True)
        await asyncio.gather(*server.state.tasks, return_exceptions=True)


def run(test: Callable[[], Awaitable[None]]) -> None:
    """Run a test in a separate event loop, because browser tests leave a running loop."""

    async def limited() -> None:
        async with asyncio.timeout(PATIENCE_S):
            await test()

    with ThreadPoolExecutor(1) as pool:
        pool.submit(asyncio.run, limited()).result()


async def answer(reader: asyncio.StreamReader) -> tuple[int, bytes]:
    """Return status and body of the next response; (0, b"") if the connection ends without one."""
    try:
        line = await reader.readline()
        if not line:
            return 0, b""
        length = 0
        while header := (await reader.readline()).strip():
            name, _, value = header.partition(b":")
            if name.lower() == b"content-length":
                length = int(value)
        return int(line.split()[1]), await reader.readexactly(length)
    except (ConnectionError, asyncio.IncompleteReadError):
        return 0, b""


@pytest.mark.parametrize("begin", [b"", b"G", b"GET /x HTTP/1.1\r\nHost: a\r\nX-Slow: "])
def test_a_head_that_does_not_come_ends_the_connection(begin: bytes) -> None:
    async def test() -> None:
        async with guarded() as server:
            reader, _ = await server.connect(begin)
            status, body = await answer(reader)
            assert status == 408
            assert json.loads(body)["detail"] == "the head of the request took too long"
            assert await reader.read() == b""

    run(test)


def test_a_head_that_drips_in_after_an_answered_request_ends_too() -> None:
    async def test() -> None:
        async with guarded() as server:
            reader, writer = await server.connect(GET)
            assert (await answer(reader))[0] == 200
            status = asyncio.create_task(answer(reader))
            for octet in GET[:-2] * 20:
                if status.done():
                    break
                writer.write(bytes([octet]))
                await asyncio.sleep(0.05)
            assert (await status)[0] == 408

    run(test)


def test_a_connection_that_waits_for_its_next_request_is_left_alone() -> None:
    async def test() -> None:
        async with guarded() as server:
            reader, writer = await server.connect(GET)
            assert (await answer(reader))[0] == 200
            await asyncio.sleep(2.0)
            writer.write(GET)
            assert (await answer(reader))[0] == 200

    run(test)


@pytest.mark.parametrize("drip", [b"", b"x"])
def test_a_body_that_makes_no_progress_ends_and_the_application_is_told(drip: bytes) -> None:
    async def test() -> None:
        app = Echo()
        async with guarded(app) as server:
            reader, writer = await server.connect(
                b"POST /x HTTP/1.1\r\nHost: a\r\nContent-Length: 100000\r\n\r\nx"
            )
            status = asyncio.create_task(answer(reader))
            while not status.done():
                writer.write(drip)
                await asyncio.sleep(0.05)
            assert (await status)[0] == 408
            await asyncio.sleep(0.05)
            assert app.seen == ["disconnected"]

    run(test)


def test_a_body_that_comes_slowly_but_surely_is_taken() -> None:
    async def test() -> None:
        async with guarded() as server:
            reader, writer = await server.connect(
                b"POST /x HTTP/1.1\r\nHost: a\r\nContent-Length: 4000\r\n\r\n"
            )
            for _ in range(20):
                writer.write(b"x" * 200)
                await asyncio.sleep(0.1)
            assert await answer(reader) == (200, b"4000")

    run(test)


def test_a_client_that_does_not_read_is_dropped() -> None:
    async def test() -> None:
        async with guarded(Echo(answer_octets=30_000_000)) as server:
            reader, writer = await server.connect(GET)
            reader._limit = 1 << 10
            await asyncio.sleep(0.2)
            assert len(server.state.connections) == 1
            while server.state.connections:
                await asyncio.sleep(0.1)
            writer.close()

    run(test)


def test_requests_sent_in_one_piece_are_answered_in_order() -> None:
    async def test() -> None:
        app = Echo()
        async with guarded(app) as server:
            post = b"POST /%d HTTP/1.1\r\nHost: a\r\nContent-Length: 3\r\n\r\nabc"
            reader, _ = await server.connect(b"".join(post % k for k in range(20)))
            assert [await answer(reader) for _ in range(20)] == [(200, b"3")] * 20
            assert app.seen == [f"/{k}" for k in range(20)]

    run(test)


def test_one_client_leaves_room_for_others_and_for_supervisors() -> None:
    limits = ConnectionLimits(total=8, per_client=3, reserve=2, head_s=20.0, reserve_head_s=20.0)

    async def test() -> None:
        async with guarded(limits=limits) as server:
            held = [await server.connect() for _ in range(3)]
            await asyncio.sleep(0.05)
            for _ in range(3):
                reader, _ = await server.connect(GET)
                status, body = await answer(reader)
                assert status == 503 and b"too many connections" in body
                reader, _ = await server.connect(GET.replace(b"/x", b"/readyz"))
                assert (await answer(reader))[0] == 200
            # The reserve is full of idle connections; a health check is still answered.
            idle = [await server.connect() for _ in range(6)]
            reader, _ = await server.connect(GET.replace(b"/x", b"/healthz"))
            assert (await answer(reader))[0] == 200
            assert (await answer(idle[0][0]))[0] == 503
            for _, writer in (*held, *idle):
                writer.close()
            await asyncio.sleep(0.1)
            reader, _ = await server.connect(GET)
            assert (await answer(reader))[0] == 200

    run(test)


def test_the_clients_of_a_trusted_proxy_are_limited_in_total_only() -> None:
    limits = ConnectionLimits(total=6, per_client=2, reserve=2)

    async def statuses(server: Guarded, count: int) -> list[int]:
        connections = [await server.connect(GET) for _ in range(count)]
        return [(await answer(reader))[0] for reader, _ in connections]

    async def test() -> None:
        async with guarded(limits=limits, proxies=("127.0.0.1",)) as server:
            assert await statuses(server, 8) == [200] * 6 + [503] * 2
        async with guarded(limits=limits) as server:
            assert await statuses(server, 4) == [200] * 2 + [503] * 2

    run(test)


def test_a_websocket_is_counted_until_it_ends() -> None:
    upgrade = (
        b"GET /x HTTP/1.1\r\nHost: a\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
        b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
    )
    limits = ConnectionLimits(total=8, per_client=2, reserve=2, head_s=0.4)

    async def test() -> None:
        async with guarded(limits=limits) as server:
            sockets = [await server.connect(upgrade) for _ in range(2)]
            assert [(await answer(reader))[0] for reader, _ in sockets] == [101, 101]
            await asyncio.sleep(1.5)  # beyond the deadline of a head
            assert [reader.at_eof() for reader, _ in sockets] == [False, False]
            third, _ = await server.connect(upgrade)
            assert (await answer(third))[0] == 503
            for _, writer in sockets:
                writer.transport.abort()
            await asyncio.sleep(0.2)
            again, _ = await server.connect(upgrade)
            assert (await answer(again))[0] == 101

    run(test)


def test_a_hanging_upload_does_not_hold_up_a_stop() -> None:
    async def test() -> None:
        limits = ConnectionLimits(stop_s=0.4)
        async with guarded(limits=limits) as server:
            reader, _ = await server.connect(b"POST /x HTTP/1.1\r\nHost: a\r\nContent-Length: 9\r\n\r\nx")
            idle, _ = await server.connect()
            await asyncio.sleep(0.1)
            for connection in list(server.state.connections):
                connection.shutdown()
            status, body = await answer(reader)
            assert (status, json.loads(body)["detail"]) == (503, "the service is being stopped")
            assert await idle.read() == b""
            while server.state.connections or server.state.tasks:
                await asyncio.sleep(0.05)

    run(test)


@pytest.mark.parametrize(
    "octets",
    [b"\x16\x03\x01\x02\x00" * 20, b"GET /x HTTP/1.1\r\n\r\n", b"GET /x HTTP/1.1\r\nHost: a\r\nHost: b\r\n\r\n",
     b"GET /x HTTP/1.1\r\nHost: a\r\nX: " + b"y" * 70_000, b"GET /x HTTP/1.1\r\nHost: a\r\nA: b\0c\r\n\r\n",
     b"POST /x HTTP/1.1\r\nHost: a\r\nContent-Length: 3\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n"],
)  # fmt: skip
def test_what_is_no_http_is_answered_with_a_problem_document_or_dropped(octets: bytes) -> None:
    async def test() -> None:
        async with guarded() as server:
            reader, _ = await server.connect(octets)
            status, body = await answer(reader)
            assert status in (0, 400)
            assert status == 0 or json.loads(body)["status"] == 400
            other, _ = await server.connect(GET)
            assert (await answer(other))[0] == 200

    run(test)
