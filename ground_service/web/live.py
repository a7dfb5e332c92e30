"""The WebSocket `live`: what happens, as it happens, each message with a sequence number; newest values on request.

A client that lost the connection asks for what came after the last number it saw and misses nothing.
"""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, WebSocket

from ground_service.http.common import API_PREFIX
from ground_service.http.requests import query_is_known
from ground_service.web.sockets import Sockets, until_gone, until_over

live = APIRouter()


@live.websocket(f"{API_PREFIX}/live")
async def watch(
    socket: WebSocket,
    after: Annotated[
        int | None, Query(ge=0, le=2**63 - 1, description="First send the messages after this number")
    ] = None,
    values: Annotated[
        bool, Query(description="Send the newest values of all spacecraft as well, as messages `values`")
    ] = False,
) -> None:
    """Messages ``{sequence, time, kind, payload}``: the events of the log, each with the next number.

    Messages ``values`` (`NewestPacket`) have the number of the event before them. If packets arrive faster than the
    client reads, it gets the newest values only.

    The token is expected in the Authorization header, or as the second value of the sub-protocol ``bearer`` (which
    is all that a browser can send).
    """
    if not await query_is_known(socket, "after", "values"):
        return
    sockets: Sockets = socket.app.state.sockets
    async with sockets.admitted(socket) as session:
        if session is not None:
            newest = await sockets.open(
                session, values=values
            )  # before `until_gone`, so that one task at a time receives
            number = newest if after is None else after
            await until_over(session, sockets.follow(session, number), until_gone(socket))
