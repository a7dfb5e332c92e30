"""The WebSocket `payload`: the console of a payload that is flown live, handed on to a browser.

The console is another program's (`linna emulate --live`): one JSON object a line comes from it, one word a line goes to
it. Viewers may look, operators may also pause, run, step and set the rate. The payload cannot be stopped from here.
"""

import asyncio
import contextlib
import json
import re
from collections import deque

from fastapi import APIRouter, WebSocket, WebSocketDisconnect

from ground_service.http.common import API_PREFIX
from ground_service.http.requests import query_is_known
from ground_service.web.sockets import POLICY_VIOLATION, TRY_AGAIN_LATER, Session, Sockets, until_over

LINE_LIMIT_OCTETS = 8 << 20
WAITING_LIMIT = 4
"""Messages kept for a browser that cannot keep up; the oldest go first, as newer ones tell more."""

CONNECT_TIMEOUT_S = 3.0

_WORDS = re.compile(r"pause|run|step|rate [0-9]{1,6}(\.[0-9]{1,3})?")

payload_console = APIRouter()


@payload_console.websocket(f"{API_PREFIX}/payload")
async def watch_payload(socket: WebSocket) -> None:
    """Messages of the payload's console as they come; words `pause`, `run`, `step` and `rate X` from operators."""
    if not await query_is_known(socket):
        return
    sockets: Sockets = socket.app.state.sockets
    async with sockets.admitted(socket) as session:
        if session is None:
            return
        if session.caller.missions is not None:  # the console is of no mission
            await socket.close(POLICY_VIOLATION)
        else:
            await until_over(session, _watched(session))


async def _watched(session: Session) -> None:
    socket = session.socket
    await session.accept()
    address: tuple[str, int] | None = socket.app.state.live_console
    if address is None:
        await _refuse(socket, "no payload to watch: serve with LINNA_LIVE_CONSOLE=HOST:PORT")
        return
    try:
        async with asyncio.timeout(CONNECT_TIMEOUT_S):
            reader, writer = await asyncio.open_connection(*address, limit=LINE_LIMIT_OCTETS)
    except (OSError, TimeoutError):
        await _refuse(socket, f"no payload answers at {address[0]}:{address[1]}; start it with linna emulate --live")
        return
    writer.write(b"watch\n")
    await socket.send_json({"kind": "connected"})
    try:
        await _relay(session, reader, writer)
    finally:
        writer.close()
        with contextlib.suppress(OSError):
            await writer.wait_closed()


async def _relay(session: Session, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    socket = session.socket
    waiting: deque[str] = deque(maxlen=WAITING_LIMIT)
    arrived = asyncio.Event()
    tasks = [
        asyncio.create_task(task)
        for task in (
            _listen(reader, waiting, arrived),
            _show(socket, waiting, arrived),
            _steer(session, writer, waiting, arrived),
        )
    ]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        results = await asyncio.gather(*tasks, return_exceptions=True)
    gone = any(isinstance(result, WebSocketDisconnect | RuntimeError) for result in results)
    if not gone:
        await _refuse(socket, "the payload has ended")


async def _listen(reader: asyncio.StreamReader, waiting: deque[str], arrived: asyncio.Event) -> None:
    with contextlib.suppress(OSError, ValueError):  # a line over the limit ends the relay
        while line := await reader.readline():
            waiting.append(line.decode("utf-8", "replace").strip())
            arrived.set()


async def _show(socket: WebSocket, waiting: deque[str], arrived: asyncio.Event) -> None:
    while True:
        await arrived.wait()
        arrived.clear()
        while waiting:
            await socket.send_text(waiting.popleft())


async def _steer(session: Session, writer: asyncio.StreamWriter, waiting: deque[str], arrived: asyncio.Event) -> None:
    while True:
        words = (await session.socket.receive_text()).strip()
        if not session.caller.may("operator"):
            trouble = "expected the role operator or higher to steer the payload"
        elif not _WORDS.fullmatch(words):
            trouble = f"expected pause, run, step or rate X, found {words[:40]!r}"
        else:
            writer.write(words.encode() + b"\n")
            await writer.drain()
            continue
        waiting.append(json.dumps({"kind": "error", "text": trouble}))
        arrived.set()


async def _refuse(socket: WebSocket, text: str) -> None:
    with contextlib.suppress(WebSocketDisconnect, RuntimeError):
        await socket.send_json({"kind": "error", "text": text})
        await socket.close(TRY_AGAIN_LATER)
