"""Protection against requests that a web page of another origin sends from the browser of a user.

Two attacks are prevented, with and without users:

- *DNS rebinding*: a host name of the attacker resolves to this machine, and its page reads the API as its own origin.
  The browser sends the attacker's host name in the Host header, which is not a name of this service.
- *Cross-site requests*: a page of another origin sends a request that changes data, or opens a WebSocket. The browser
  sends the origin of the page (Origin) or the relation of the sites (Sec-Fetch-Site).

Programs such as curl send neither header and are accepted: no page can make a browser omit both.

References: Fetch Metadata Request Headers (W3C); RFC 6454, RFC 9110 section 15.5.20 (421), RFC 6455 section 10.2.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Iterable
from functools import lru_cache
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.responses import Response
from starlette.types import ASGIApp, Receive, Scope, Send

from ground_service.http.problems import problem

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
        if (
            parts.hostname is None
            or parts.username is not None
            or parts.path
            or parts.query
            or parts.fragment
        ):
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
