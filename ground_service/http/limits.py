"""Guards around the application: size of bodies, secure headers, entity tags."""

from __future__ import annotations

import hashlib
from typing import Any

from starlette.datastructures import Headers, MutableHeaders, State
from starlette.requests import ClientDisconnect
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from ground_service.http.problems import busy, problem

JSON_LIMIT_OCTETS = 1 << 20
HELD_LIMIT_OCTETS = 64 << 20
TAGGED_LIMIT_OCTETS = 4 << 20

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
        except ClientDisconnect:  # of an application that was refused the rest of the body
            if refusal is None:
                raise
        finally:
            if not upload:
                self._held -= taken
        if refusal is not None and not started:
            await refusal(scope, receive, send)


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
