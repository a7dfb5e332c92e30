"""Guards around the application: size of bodies, secure headers, entity tags."""

from __future__ import annotations

import hashlib
import math
import time
from collections import OrderedDict
from typing import Any

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from ground_service.api.problems import problem

JSON_LIMIT_OCTETS = 1 << 20
TAGGED_LIMIT_OCTETS = 4 << 20

CALLERS_KEPT = 10_000
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
    """Refuses bodies over a limit, announced or not; paths of uploads have their own, larger one."""

    def __init__(self, app: ASGIApp, upload_paths: tuple[str, ...], upload_limit_octets: int) -> None:
        self._app = app
        self._uploads = upload_paths
        self._upload_limit = upload_limit_octets

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        limit = self._upload_limit if scope["path"] in self._uploads else JSON_LIMIT_OCTETS
        announced = Headers(scope=scope).get("content-length", "")
        if announced and (not announced.isdigit() or int(announced) > limit):
            response = problem(
                413, "too large", f"body: expected at most {limit} octets, found {announced[:20]}"
            )
            await response(scope, receive, send)
            return
        taken = 0
        over = False

        async def counted() -> Message:
            nonlocal taken, over
            message = await receive()
            taken += len(message.get("body", b""))
            if taken > limit:
                over = True
                return {"type": "http.disconnect"}
            return message

        started = False

        async def watched(message: Message) -> None:
            nonlocal started
            started = started or message["type"] == "http.response.start"
            if not over:
                await send(message)

        try:
            await self._app(scope, counted, watched)
        except Exception:
            if not over:
                raise
        if over and not started:
            response = problem(413, "too large", f"body: expected at most {limit} octets")
            await response(scope, receive, send)


class RateLimit:
    """Refuses callers that ask more often than they may: a bucket of two seconds' worth for each, refilled evenly.

    A caller is known by its token (its hash: tokens are not kept) once that was accepted, before that and without one
    by its address: tokens made up one after the other earn nothing.
    """

    def __init__(self, app: ASGIApp, per_second: float) -> None:
        self._app = app
        self._rate = per_second
        self._depth = max(2.0 * per_second, 1.0)
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()
        self._accepted: OrderedDict[str, None] = OrderedDict()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or self._rate <= 0.0 or scope["path"] in _WATCHED:
            await self._app(scope, receive, send)
            return
        token = _token(scope)
        known = token in self._accepted
        address = str((scope.get("client") or ("",))[0])
        wait_s = self._wait_s(token if known else address, time.monotonic())
        if wait_s <= 0.0:

            async def watched(message: Message) -> None:
                if message["type"] == "http.response.start":
                    self._note(token, accepted=message["status"] != 401)
                await send(message)

            await self._app(scope, receive, watched if token else send)
            return
        response = problem(429, "too many requests", f"expected at most {self._rate:g} requests a second")
        response.headers["Retry-After"] = str(math.ceil(wait_s))
        await response(scope, receive, send)

    def _note(self, token: str, *, accepted: bool) -> None:
        self._accepted.pop(token, None)
        if accepted:
            self._accepted[token] = None
            if len(self._accepted) > CALLERS_KEPT:
                self._accepted.popitem(last=False)

    def _wait_s(self, caller: str, now_s: float) -> float:
        """Take one from the caller's bucket; how long it has to wait where that is empty."""
        left, since = self._buckets.pop(caller, (self._depth, now_s))
        left = min(left + (now_s - since) * self._rate, self._depth)
        allowed = left >= 1.0
        self._buckets[caller] = (left - 1.0 if allowed else left, now_s)
        if len(self._buckets) > CALLERS_KEPT:
            self._buckets.popitem(last=False)
        return 0.0 if allowed else (1.0 - left) / self._rate


def _token(scope: Scope) -> str:
    """The hash of the token that a request carries; empty without one."""
    token = Headers(scope=scope).get("authorization", "")
    return hashlib.sha256(token.encode()).hexdigest() if token else ""


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

        async def dressed(message: Message) -> None:
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

        await self._app(scope, receive, dressed)
