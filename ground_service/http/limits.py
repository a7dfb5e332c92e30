"""Guards around the application: origins, size of bodies, secure headers, entity tags."""

import hashlib
import ipaddress
from collections.abc import Iterable
from functools import lru_cache
from typing import Any
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders, State
from starlette.requests import ClientDisconnect
from starlette.responses import JSONResponse, Response
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
            response = problem(413, "too large", f"body: expected at most {limit} octets, found {announced[:20]}")
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


LOOPBACK = ("127.0.0.1", "::1", "localhost")
SAFE_METHODS = ("GET", "HEAD", "OPTIONS")
OPEN_PATHS = ("/healthz", "/readyz")
"""Paths that are answered for any Host header: health checks use addresses, names or no host name."""

DEFAULT_PORTS = {"http": 80, "https": 443}
FORM_TYPES = ("application/x-www-form-urlencoded", "multipart/form-data", "text/plain")
"""Media types that a form of any page can send without a preflight request."""


class SameOrigin:
    """Refusal of requests to other host names and of requests from pages of other origins."""

    def __init__(self, app: ASGIApp, hosts: Iterable[str], api_prefix: str) -> None:
        self._app = app
        self._hosts = frozenset(_plain(host) for host in (*LOOPBACK, *hosts))
        self._prefix = api_prefix

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] in ("http", "websocket") and scope["path"] not in OPEN_PATHS:
            refusal = self._refusal(scope)
            if refusal is not None:
                await refuse(refusal, scope, receive, send)
                return
        await self._app(scope, receive, send)

    def _refusal(self, scope: Scope) -> Response | None:
        headers = Headers(scope=scope)
        given = headers.getlist("host")
        host = _host_and_port(given[0]) if len(given) == 1 else None
        if host is None:
            return problem(400, "bad request", "Host: expected one host name, found none or several")
        if not self._is_ours(host[0], scope):
            return problem(
                421,
                "misdirected request",
                f"Host: expected a name of this service, found {host[0][:80]!r}; "
                "LINNA_ALLOWED_HOSTS lists further names",
            )
        found = foreign(scope, headers, host, self._prefix)
        return None if found is None else problem(403, "cross-site request", found)

    def _is_ours(self, name: str, scope: Scope) -> bool:
        if name in self._hosts:
            return True
        # Unlike a name, an address cannot be rebound: the address of the connection belongs to this service.
        local = (scope.get("server") or ("",))[0]
        return _is_address(name) and name == _plain(str(local))


def foreign(scope: Scope, headers: Headers, host: tuple[str, int | None], api_prefix: str) -> str | None:
    """Return why a request comes from a page of another origin; None if no header shows that."""
    changes = scope["type"] == "websocket" or scope["method"] not in SAFE_METHODS
    site = headers.get("sec-fetch-site", "").lower()
    origin = headers.get("origin")
    if not changes:
        reads = scope["path"].startswith(api_prefix) and headers.get("sec-fetch-mode") != "navigate"
        if reads and site in ("cross-site", "same-site"):
            return f"Sec-Fetch-Site: expected same-origin, found {site}"
        return None
    if site not in ("", "same-origin", "none"):
        return f"Sec-Fetch-Site: expected same-origin, found {site[:40]}"
    if origin is not None:
        if not _same(origin, host):
            return f"Origin: expected that of this service, found {origin[:120]!r}"
    elif not site and headers.get("cookie"):
        return "Origin: expected that of this service from a browser, found none"
    media = headers.get("content-type", "").partition(";")[0].strip().lower()
    if (origin is not None or site) and media in FORM_TYPES:
        return f"Content-Type: expected a type that an HTML form cannot send, found {media}"
    return None


async def refuse(response: Response, scope: Scope, receive: Receive, send: Send) -> None:
    """Refuse a request, or the opening handshake of a WebSocket."""
    if scope["type"] == "websocket" and "websocket.http.response" not in scope.get("extensions", {}):
        await receive()
        await send({"type": "websocket.close", "code": 1008, "reason": ""})
        return
    await response(scope, receive, send)


def _same(origin: str, host: tuple[str, int | None]) -> bool:
    """Return whether an origin has this host and port; the default port is that of the origin's scheme."""
    try:
        parts = urlsplit(origin)
        if parts.scheme not in DEFAULT_PORTS or parts.hostname is None or parts.path:
            return False
        default = DEFAULT_PORTS[parts.scheme]
        return (_plain(parts.hostname), parts.port or default) == (host[0], host[1] or default)
    except ValueError:
        return False


@lru_cache(maxsize=256)
def _host_and_port(text: str) -> tuple[str, int | None] | None:
    """Return name and port of a Host header; None if it is invalid."""
    try:
        parts = urlsplit(f"//{text}")
        if parts.hostname is None or parts.username is not None or parts.path or parts.query or parts.fragment:
            return None
        return _plain(parts.hostname), parts.port
    except ValueError:
        return None


@lru_cache(maxsize=256)
def _plain(host: str) -> str:
    """Return the normalised host name: lower case, no final dot, canonical form of addresses."""
    name = host.strip().strip("[]").rstrip(".").lower()
    try:
        return str(ipaddress.ip_address(name))
    except ValueError:
        return name


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
