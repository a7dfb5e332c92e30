"""Open WebSockets and the live feed: callers and limits, periodic authorisation, and the event log.

The event log is read once for all sockets of a process, as soon as events were committed: by this process, or by
another one that sends a wake-up over Redis. Without Redis the events of other processes are found by polling. Newest
values are sent to the sockets that request them. A socket that is too slow for them skips intermediate values, and only
those. Callers are verified again every `VERIFY_S`: a socket is
closed if its token was revoked or has expired, or if its user was disabled.
"""

import asyncio
import contextlib
import json
import logging
from collections import Counter, deque
from collections.abc import AsyncIterator, Iterable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import Annotated, Any

from fastapi import APIRouter, Query, WebSocket, WebSocketDisconnect
from starlette.concurrency import run_in_threadpool

from ground_service.access.scopes import ROWS, SPACECRAFT
from ground_service.access.security import SESSION_COOKIE
from ground_service.access.service import LOCAL_CALLER, Caller, authenticate
from ground_service.access.store import has_users, owner_of
from ground_service.clock import utc_now_ns
from ground_service.errors import GroundError, NotAuthorised, NotFound
from ground_service.ground import Ground
from ground_service.http.common import API_PREFIX
from ground_service.http.model import time_text
from ground_service.http.problems import problem
from ground_service.http.requests import query_is_known
from ground_service.passes.live import newest_packets
from ground_service.store.event_kinds import (
    CommandStateChanged,
    LinkChanged,
    PlanChanged,
    RequestChanged,
    TelemetryReceived,
    WindowChanged,
    last_number,
    read_events,
)
from ground_service.store.events import LoggedEvent
from ground_service.store.leases import listen
from ground_service.store.vehicles import all_vehicles

Source = tuple[int, str]
"""Vehicle and kind of packet: a message replaces an older one of the same source that was not sent yet."""


class NewestValues:
    """Newest packets of the vehicles as they were last sent."""

    def __init__(self, ground: Ground) -> None:
        self._ground = ground
        self._sent: dict[Source, str] = {}

    def changed(self, vehicles: Iterable[int]) -> list[tuple[Source, str]]:
        """Return the newest packets of vehicles that were not returned before, as JSON."""
        found = []
        for vehicle in sorted(vehicles):
            try:
                packets = newest_packets(self._ground, vehicle)
            except NotFound:
                continue
            for packet in packets:
                source = (vehicle, packet.packet)
                known = packet.model_dump_json(exclude={"age_s"})
                if self._sent.get(source) != known:
                    self._sent[source] = known
                    found.append((source, packet.model_dump_json()))
        return found


log = logging.getLogger(__name__)

OWNED = {
    WindowChanged.event_kind: ("window_id", "id"),
    CommandStateChanged.event_kind: ("command_id", "id"),
    LinkChanged.event_kind: ("name", "link"),
    RequestChanged.event_kind: ("request_id", "id"),
    PlanChanged.event_kind: ("request_id", "request_id"),
}
"""Events of rows that belong to a spacecraft: parameter of `scopes.ROWS`, and key of the row in the payload."""

VERIFY_S = 2.0
POLL_S = 0.5
CLOSE_S = 2.0
BATCH = 200
QUEUED_LIMIT = 1000
"""Largest number of queued messages of a socket; a socket with more is closed, and its client can reconnect."""

REPLAYS_AT_ONCE = 2
POLICY_VIOLATION = 1008
TRY_AGAIN_LATER = 1013


@dataclass(eq=False, slots=True)
class Session:
    """Socket and its caller, as last verified; `ended` holds the close code.

    `messages` are queued events with their numbers, `values` the newest values that were not sent yet (None: not
    requested), `vehicles` those of a caller who is limited to missions.
    """

    socket: WebSocket
    caller: Caller
    token: str | None
    ended: asyncio.Future[int]
    messages: deque[tuple[int, str]] = field(default_factory=deque)
    values: dict[Source, str] | None = None
    vehicles: frozenset[int] = frozenset()
    ready: asyncio.Event = field(default_factory=asyncio.Event)

    async def accept(self) -> None:
        """Accept the socket; a client that sent its token as a sub-protocol receives the sub-protocol name back."""
        protocol = "bearer" if "sec-websocket-protocol" in self.socket.headers else None
        await self.socket.accept(subprotocol=protocol)

    def end(self, code: int) -> None:
        """Request that the socket is closed."""
        if not self.ended.done():
            self.ended.set_result(code)

    def permits(self, vehicle: int | None, spacecraft: int | None = None) -> bool:
        """Return whether the caller may see messages of a vehicle or a spacecraft; None: of none or an unknown one."""
        return (
            self.caller.missions is None
            or vehicle in self.vehicles
            or (spacecraft is not None and self.caller.may_use(spacecraft))
        )

    def offer(self, number: int, text: str) -> None:
        """Queue an event."""
        if len(self.messages) >= QUEUED_LIMIT:
            self.end(TRY_AGAIN_LATER)
            return
        self.messages.append((number, text))
        self.ready.set()

    def offer_values(self, source: Source, text: str) -> None:
        """Keep the newest values of a source until they are sent."""
        if self.values is not None:
            self.values[source] = text
            self.ready.set()

    async def send_offered(self, after: int) -> None:
        """Send what is offered, events with numbers above `after` first, until cancelled."""
        while True:
            await self.ready.wait()
            self.ready.clear()
            while self.messages or self.values:
                if self.messages:
                    number, text = self.messages.popleft()
                    if number > after:
                        await self.socket.send_text(text)
                elif self.values:  # after the events that they have the number of
                    await self.socket.send_text(self.values.pop(next(iter(self.values))))


class Sockets:
    """WebSockets of one process."""

    def __init__(
        self, ground: Ground, *, open_without_users: bool, per_user: int, total: int, redis_url: str | None
    ) -> None:
        self._ground = ground
        self._redis_url = redis_url
        self._newest = NewestValues(ground)
        self._open_without_users = open_without_users
        self._per_user, self._total = per_user, total
        self._sessions: set[Session] = set()
        self._holders: Counter[str] = Counter()
        self._readers: set[Session] = set()
        self._number = 0
        self._replays = asyncio.Semaphore(REPLAYS_AT_ONCE)
        self._committed = asyncio.Event()

    @asynccontextmanager
    async def admitted(self, socket: WebSocket) -> AsyncIterator[Session | None]:
        """Yield the session of a socket whose caller is authorised, to be accepted; None if it was refused."""
        token = token_of(socket)
        caller = await run_in_threadpool(self._verified, token)
        if caller is None or not caller.may("viewer"):
            await socket.close(POLICY_VIOLATION)
            yield None
            return
        client = socket.client.host if socket.client is not None else ""
        holder = f"user {caller.name}" if token is not None else f"address {client}"
        if self._holders[holder] >= self._per_user or len(self._sessions) >= self._total:
            limit = f"{self._per_user} of one user and {self._total} in all"
            refusal = problem(429, "too many sockets", f"WebSockets: expected at most {limit}")
            with contextlib.suppress(RuntimeError):  # a server without denial responses has closed the socket
                await socket.send_denial_response(refusal)
            yield None
            return
        session = Session(socket, caller, token, asyncio.get_running_loop().create_future())
        session.vehicles = await run_in_threadpool(self._vehicles, caller)
        self._sessions.add(session)
        self._holders[holder] += 1
        try:
            yield session
        finally:
            self._sessions.discard(session)
            self._readers.discard(session)
            self._holders[holder] -= 1
            if self._holders[holder] <= 0:
                del self._holders[holder]
            session.end(POLICY_VIOLATION)

    async def open(self, session: Session, *, values: bool = False) -> int:
        """Accept a socket, queue new events for it, and return the number of the newest event before them."""
        session.values = {} if values else None
        newest = await run_in_threadpool(last_number, self._ground.database)
        if not self._readers:
            self._number = newest
        self._readers.add(session)
        await session.accept()
        return newest

    async def follow(self, session: Session, number: int) -> None:
        """Send an open socket the events after a number, until cancelled."""
        known = self._number  # later messages are queued for the session
        at = number
        while at < known:
            async with self._replays:
                items = await run_in_threadpool(read_events, self._ground.database, at, BATCH)
            owners = await run_in_threadpool(self._owners, items, [session])
            for item in items:
                owner = owners.get(item.number)
                if item.number <= known and session.permits(item.payload.get("vehicle_id"), owner):
                    await session.socket.send_text(text_of(item))
            at = items[-1].number if items else known
        await session.send_offered(max(number, known))

    async def run(self) -> None:
        """Read the event log for all sockets and verify their callers until cancelled."""
        loop = asyncio.get_running_loop()

        def wake(_kinds: frozenset[str]) -> None:
            with contextlib.suppress(RuntimeError):  # the loop is closed
                loop.call_soon_threadsafe(self._committed.set)

        self._ground.database.listeners.add(wake)
        work = [self._read(), self._verify()]
        if self._redis_url is not None:
            work.append(listen(self._redis_url, self._committed.set))
        await asyncio.gather(*work)

    async def _read(self) -> None:
        while True:
            # Without a wake-up, events of other processes are read after POLL_S.
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._committed.wait(), POLL_S)
            self._committed.clear()
            if not self._readers:
                continue
            try:
                items = await run_in_threadpool(read_events, self._ground.database, self._number, BATCH)
                owners = await run_in_threadpool(self._owners, items, list(self._readers))
            except GroundError as error:
                log.warning("the event log cannot be read: %s", error)
                continue
            for item in items:
                text = text_of(item)
                for session in self._readers:
                    if session.permits(item.payload.get("vehicle_id"), owners.get(item.number)):
                        session.offer(item.number, text)
                self._number = item.number
            if len(items) == BATCH:
                self._committed.set()
            await self._offer_values(items)

    async def _offer_values(self, items: list[LoggedEvent]) -> None:
        vehicles = {
            TelemetryReceived.of(item).vehicle_id for item in items if item.kind == TelemetryReceived.event_kind
        }
        if not vehicles or all(session.values is None for session in self._readers):
            return
        try:
            found = await run_in_threadpool(self._newest.changed, vehicles)
        except GroundError as error:
            log.warning("newest values cannot be read: %s", error)
            return
        time = time_text(utc_now_ns())
        for source, payload in found:
            text = f'{{"sequence":{self._number},"time":"{time}","kind":"values","payload":{payload}}}'
            for session in self._readers:
                if session.permits(source[0]):
                    session.offer_values(source, text)

    async def _verify(self) -> None:
        while True:
            await asyncio.sleep(VERIFY_S)
            for token in {session.token for session in self._sessions}:
                holders = [session for session in self._sessions if session.token == token]
                try:
                    caller = await run_in_threadpool(self._verified, token)
                except GroundError as error:
                    log.warning("callers of open sockets cannot be verified: %s", error)
                    for session in holders:
                        session.end(TRY_AGAIN_LATER)
                    continue
                for session in holders:
                    if caller is None or not caller.may("viewer"):
                        session.end(POLICY_VIOLATION)
                    else:
                        session.caller = caller
                        session.vehicles = await run_in_threadpool(self._vehicles, caller)

    def _owners(self, items: list[LoggedEvent], readers: list[Session]) -> dict[int, int | None]:
        """Return the spacecraft of events by number, if a reader is limited to missions."""
        if all(one.caller.missions is None for one in readers):
            return {}
        return {item.number: event_owner(self._ground, item) for item in items}

    def _vehicles(self, caller: Caller) -> frozenset[int]:
        """Return the vehicles of a caller who is limited to missions; none for others."""
        if caller.spacecraft is None:
            return frozenset()
        known = self._ground.read(all_vehicles)
        return frozenset(one.id for one in known if one.ccsds_id in caller.spacecraft)

    def _verified(self, token: str | None) -> Caller | None:
        """Return the caller of a token; the local user if there are no users."""
        if token is None:
            return LOCAL_CALLER if self._open_without_users and not self._ground.read(has_users) else None
        try:
            return authenticate(self._ground, token)
        except NotAuthorised:
            return None


async def until_over(session: Session, *work: Any) -> None:
    """Run tasks concurrently until the first one ends, the client disconnects, or the session is ended."""
    tasks = [asyncio.ensure_future(one) for one in work]
    try:
        await asyncio.wait([*tasks, session.ended], return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.wait(tasks)
    for task in tasks:
        error = None if task.cancelled() else task.exception()
        if error is not None and not isinstance(error, WebSocketDisconnect | RuntimeError):
            raise error
    if session.ended.done():
        with contextlib.suppress(WebSocketDisconnect, RuntimeError, TimeoutError):
            async with asyncio.timeout(CLOSE_S):
                await session.socket.close(session.ended.result())


async def until_gone(socket: WebSocket) -> None:
    """Discard the messages of the client until it disconnects."""
    with contextlib.suppress(WebSocketDisconnect, RuntimeError):
        while (await socket.receive())["type"] != "websocket.disconnect":
            pass


def event_owner(ground: Ground, item: LoggedEvent) -> int | None:
    """Return the spacecraft that an event states, or that of the row it names; None for events of all missions."""
    parameter, key = OWNED.get(item.kind, ("", ""))
    if parameter:
        return ground.read(owner_of, ROWS[parameter], item.payload[key])
    stated = item.payload.get(SPACECRAFT)
    return None if stated is None else int(stated)


def token_of(socket: WebSocket) -> str | None:
    """Return the token of the Authorization header, the sub-protocol ``bearer`` or the session cookie; else None."""
    protocols = [value.strip() for value in socket.headers.get("sec-websocket-protocol", "").split(",")]
    scheme, _, token = socket.headers.get("authorization", "").partition(" ")
    if scheme.lower() == "bearer":
        return token.strip()
    if len(protocols) == 2 and protocols[0] == "bearer":
        return protocols[1]
    return socket.cookies.get(SESSION_COOKIE)


def text_of(item: LoggedEvent) -> str:
    """Return the message of an event."""
    message = {"sequence": item.number, "time": time_text(item.utc_ns), "kind": item.kind, "payload": item.payload}
    return json.dumps(message, separators=(",", ":"), ensure_ascii=False)


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
