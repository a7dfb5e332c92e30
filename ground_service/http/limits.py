"""Guards around the application: size of bodies, secure headers, entity tags."""

from __future__ import annotations

import hashlib
import logging
import math
import time
from collections import OrderedDict
from typing import Any, Protocol

from starlette.datastructures import Headers, MutableHeaders, State
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from ground_service.http.origins import refuse
from ground_service.http.problems import busy, problem
from ground_service.http.proxies import address_key

log = logging.getLogger(__name__)

JSON_LIMIT_OCTETS = 1 << 20
HELD_LIMIT_OCTETS = 64 << 20
TAGGED_LIMIT_OCTETS = 4 << 20

VERIFIED_CALLER = "verified_caller"
"""Key in the request state for the user whose token was verified; absent without a verified token."""

CALLERS_KEPT = 10_000
BURST_S = 2.0
REDIS_TIMEOUT_S = 1.0
REDIS_RETRY_S = 10.0
_WATCHED = ("/healthz", "/readyz", "/metrics")

SECURE_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-cache",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Content-Security-Policy": (
        "default-src 'none'; img-src 'self' data:; style-src 'unsafe-inline'; font-src data:; "
        "frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
    ),
}


class BodyLimit:
    """Limit of the size of request bodies, with or without Content-Length; upload paths have their own, larger limit.

    Bodies that are not uploads are kept in memory until they are complete, before the caller is authenticated.
    Therefore all of them together may use at most `HELD_LIMIT_OCTETS`.
    """

    def __init__(self, app: ASGIApp, upload_paths: tuple[str, ...], upload_limit_octets: int) -> None:
        self._app = app
        self._uploads = upload_paths
        self._upload_limit = upload_limit_octets
        self._held = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        upload = scope["path"] in self._uploads
        limit = self._upload_limit if upload else JSON_LIMIT_OCTETS
        announced = Headers(scope=scope).get("content-length", "")
        if announced and (not announced.isdigit() or int(announced) > limit):
            response = problem(
                413, "too large", f"body: expected at most {limit} octets, found {announced[:20]}"
            )
            await response(scope, receive, send)
            return
        taken = 0
        refusal: JSONResponse | None = None

        async def counted() -> Message:
            nonlocal taken, refusal
            message = await receive()
            octets = len(message.get("body", b""))
            taken += octets
            if not upload:
                self._held += octets
            if taken > limit:
                refusal = problem(413, "too large", f"body: expected at most {limit} octets")
            elif self._held > HELD_LIMIT_OCTETS and not upload:
                refusal = busy(f"bodies: expected at most {HELD_LIMIT_OCTETS} octets at once")
            return message if refusal is None else {"type": "http.disconnect"}

        started = False

        async def watched(message: Message) -> None:
            nonlocal started
            if refusal is None:
                started = started or message["type"] == "http.response.start"
                await send(message)

        try:
            await self._app(scope, counted, watched)
        except Exception:  # an application that got half of a body may fail in any way
            if refusal is None:
                raise
        finally:
            if not upload:
                self._held -= taken
        if refusal is not None and not started:
            await refusal(scope, receive, send)


class RateLimit:
    """Rate limit: each caller has a budget of requests for two seconds, refilled continuously.

    A caller is a user if the token was verified before, otherwise the address of the peer (see `proxies`). Requests
    with invalid tokens therefore use the budget of their address.
    """

    def __init__(self, app: ASGIApp, per_second: float, budgets: Budgets | None = None) -> None:
        self._app = app
        self._rate = per_second
        self._budgets = LocalBudgets(per_second) if budgets is None else budgets
        self._verified: OrderedDict[str, str] = OrderedDict()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket") or self._rate <= 0.0 or scope["path"] in _WATCHED:
            await self._app(scope, receive, send)
            return
        token = _token(scope)
        user = self._verified.get(token)
        address = address_key(str((scope.get("client") or ("",))[0]))
        wait_s = await self._budgets.take(f"address {address}" if user is None else f"user {user}")
        if wait_s > 0.0:
            response = problem(429, "too many requests", f"expected at most {self._rate:g} requests a second")
            response.headers["Retry-After"] = str(math.ceil(wait_s))
            await refuse(response, scope, receive, send)
            return
        try:
            await self._app(scope, receive, send)
        finally:
            if token:
                self._note(token, scope.get("state", {}).get(VERIFIED_CALLER))

    def _note(self, token: str, caller: str | None) -> None:
        """Remember the user of a verified token; forget a token that was not verified."""
        self._verified.pop(token, None)
        if caller is not None:
            self._verified[token] = caller
            if len(self._verified) > CALLERS_KEPT:
                self._verified.popitem(last=False)


class Budgets(Protocol):
    """Remaining requests of callers."""

    async def take(self, caller: str) -> float:
        """Take one request from a budget; return the seconds to wait if none is left."""


class LocalBudgets:
    """Budgets of the last `CALLERS_KEPT` callers of this process."""

    def __init__(self, per_second: float) -> None:
        self._rate = per_second
        self._depth = max(BURST_S * per_second, 1.0)
        self._left: OrderedDict[str, tuple[float, float]] = OrderedDict()

    async def take(self, caller: str) -> float:
        now_s = time.monotonic()
        left, since = self._left.pop(caller, (self._depth, now_s))
        left = min(left + (now_s - since) * self._rate, self._depth)
        allowed = left >= 1.0
        self._left[caller] = (left - 1.0 if allowed else left, now_s)
        if len(self._left) > CALLERS_KEPT:
            self._left.popitem(last=False)
        return 0.0 if allowed else (1.0 - left) / self._rate


_TAKE = """
local now = redis.call('TIME')
local now_us = now[1] * 1000000 + now[2]
local each_us, depth_us = tonumber(ARGV[1]), tonumber(ARGV[2])
local paid_until = math.max(tonumber(redis.call('GET', KEYS[1]) or '0'), now_us)
local wait_us = paid_until + each_us - now_us - depth_us
if wait_us > 0 then return math.ceil(wait_us) end
redis.call('SET', KEYS[1], string.format('%.0f', paid_until + each_us), 'PX', math.ceil(depth_us / 1000) + 1000)
return 0
"""
"""The generic cell rate algorithm (ATM Forum TM 4.0, 4.4.2): one value for each caller, which expires automatically."""


class SharedBudgets:
    """Budgets in Redis, shared by all API processes; each process has its own while Redis is unavailable."""

    def __init__(self, url: str, per_second: float) -> None:
        import redis.asyncio

        self._client = redis.asyncio.from_url(url, socket_timeout=REDIS_TIMEOUT_S)
        self._script = self._client.register_script(_TAKE)
        self._each_us = 1e6 / per_second
        self._depth_us = max(BURST_S * per_second, 1.0) * self._each_us
        self._local = LocalBudgets(per_second)
        self._away_until = 0.0

    async def take(self, caller: str) -> float:
        import redis.exceptions

        now_s = time.monotonic()
        if now_s >= self._away_until:
            key = "linna:budget:" + hashlib.sha256(caller.encode()).hexdigest()[:32]
            try:
                return float(await self._script(keys=[key], args=[self._each_us, self._depth_us])) / 1e6
            except (redis.exceptions.RedisError, OSError) as error:
                self._away_until = now_s + REDIS_RETRY_S
                log.warning(
                    "rate limit: the broker is unavailable (%s); each process limits on its own", error
                )
        return await self._local.take(caller)

    async def close(self) -> None:
        """Close the connections."""
        await self._client.aclose()


def _token(scope: Scope) -> str:
    """Return the hash of the token in a request; empty without one. Tokens are not stored."""
    headers = Headers(scope=scope)
    token = headers.get("authorization", "")
    if not token and scope["type"] == "websocket":
        token = headers.get("sec-websocket-protocol", "")
    token = token or headers.get("cookie", "")
    return hashlib.sha256(token.encode()).hexdigest() if token else ""


class LastRequests:
    """Closes connections after their next answer while the process drains, so that clients connect to another one."""

    def __init__(self, app: ASGIApp, state: State) -> None:
        self._app = app
        self._state = state

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def closing(message: Message) -> None:
            if message["type"] == "http.response.start" and self._state.draining:
                MutableHeaders(scope=message)["Connection"] = "close"
            await send(message)

        await self._app(scope, receive, closing if scope["type"] == "http" else send)


class HeadersAndTags:
    """Adds secure headers to every answer, and an entity tag to whole JSON answers of GET; 304 where it matches."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        wanted = Headers(scope=scope).get("if-none-match", "")
        held: dict[str, Any] = {"start": None, "body": []}

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in SECURE_HEADERS.items():
                    headers.setdefault(name, value)
                length = int(headers.get("content-length", TAGGED_LIMIT_OCTETS + 1))
                taggable = (
                    scope["method"] == "GET"
                    and message["status"] == 200
                    and headers.get("content-type", "").startswith("application/json")
                    and length <= TAGGED_LIMIT_OCTETS
                )
                if taggable:
                    held["start"] = message
                    return
                await send(message)
                return
            if held["start"] is None:
                await send(message)
                return
            held["body"].append(message.get("body", b""))
            if message.get("more_body"):
                return
            start, body = held["start"], b"".join(held["body"])
            headers = MutableHeaders(scope=start)
            tag = headers.get("etag") or f'"{hashlib.sha256(body).hexdigest()[:32]}"'
            headers["ETag"] = tag
            if tag in wanted or wanted.strip() == "*":
                start["status"] = 304
                del headers["content-length"]
                body = b""
            await send(start)
            await send({"type": "http.response.body", "body": body})

        await self._app(scope, receive, with_headers)
