"""The WebSocket `live`: what happens, as it happens, each message with a sequence number.

A client that lost the connection asks for what came after the last number it saw and misses nothing.
"""

from __future__ import annotations

import asyncio
import contextlib
from typing import Annotated

from fastapi import APIRouter, Query, WebSocket, WebSocketDisconnect
from starlette.concurrency import run_in_threadpool

from ground_service.api.common import API_PREFIX
from ground_service.errors import NotAuthorised
from ground_service.services.feed import last_number, read_feed
from ground_service.services.ground import Ground
from ground_service.services.users import LOCAL_CALLER, Caller, authenticate, has_users
from ground_service.services.views import time_text

POLL_S = 0.5
POLICY_VIOLATION = 1008

live = APIRouter()


@live.websocket(f"{API_PREFIX}/live")
async def watch(
    socket: WebSocket,
    after: Annotated[int | None, Query(ge=0, description="Send what came after this number first")] = None,
) -> None:
    """Messages ``{sequence, time, kind, ...}`` about jobs and passes.

    The token is expected in the Authorization header, or as the second value of the sub-protocol ``bearer`` (which
    is all that a browser can send).
    """
    ground: Ground = socket.app.state.ground
    caller = await run_in_threadpool(caller_of_socket, socket)
    if caller is None or not caller.may("viewer"):
        await socket.close(POLICY_VIOLATION)
        return
    await socket.accept(subprotocol="bearer" if "sec-websocket-protocol" in socket.headers else None)
    number = await run_in_threadpool(last_number, ground) if after is None else after
    gone = asyncio.create_task(_until_gone(socket))
    try:
        while not gone.done():
            for item in await run_in_threadpool(read_feed, ground, number):
                number = item["id"]
                await socket.send_json(
                    {
                        "sequence": number,
                        "time": time_text(item["utc_ns"]),
                        "kind": item["kind"],
                        "payload": item["payload"],
                    }
                )
            await asyncio.wait([gone], timeout=POLL_S)
    except WebSocketDisconnect:
        pass
    finally:
        gone.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await gone


async def _until_gone(socket: WebSocket) -> None:
    """Read and drop what the client sends, until it goes."""
    with contextlib.suppress(WebSocketDisconnect, RuntimeError):
        while True:
            message = await socket.receive()
            if message["type"] == "websocket.disconnect":
                return


def caller_of_socket(socket: WebSocket) -> Caller | None:
    """Who opened a WebSocket: by the Authorization header or the second value of the sub-protocol ``bearer``."""
    ground: Ground = socket.app.state.ground
    protocols = [value.strip() for value in socket.headers.get("sec-websocket-protocol", "").split(",")]
    scheme, _, token = socket.headers.get("authorization", "").partition(" ")
    if scheme.lower() != "bearer" and len(protocols) == 2 and protocols[0] == "bearer":
        scheme, token = "bearer", protocols[1]
    if scheme.lower() != "bearer":
        return LOCAL_CALLER if socket.app.state.open_without_users and not has_users(ground) else None
    try:
        return authenticate(ground, token.strip())
    except NotAuthorised:
        return None
