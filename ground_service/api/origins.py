"""Protection against requests that a web page of another origin makes in the browser of a user.

Two attacks are refused in every mode, with users and without:

- *DNS rebinding*: a name of the attacker resolves to this machine, and its page reads the API as its own origin. The
  browser names the attacker's host in the Host header, which is none of ours.
- *Cross-site requests*: a page of another origin sends a request that changes something, or opens a WebSocket. The
  browser names the page's origin (Origin) or says how the sites relate (Sec-Fetch-Site).

Programs such as curl send neither header and are let through: no page can make a browser leave out both.

References: Fetch Metadata Request Headers (W3C); RFC 6454, RFC 9110 section 15.5.20 (421), RFC 6455 section 10.2.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Iterable
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.responses import Response
from starlette.types import ASGIApp, Receive, Scope, Send

from ground_service.api.problems import problem

LOOPBACK = ("127.0.0.1", "::1", "localhost")
SAFE_METHODS = ("GET", "HEAD", "OPTIONS")
OPEN_PATHS = ("/healthz", "/readyz")
"""Answered whatever the Host header says: supervisors ask by address, name or not at all, and learn one word."""

DEFAULT_PORTS = {"http": 80, "https": 443}
FORM_TYPES = ("application/x-www-form-urlencoded", "multipart/form-data", "text/plain")
"""What a form of any page can send without asking first."""


class SameOrigin:
    """Refuse requests to another host's name, and what pages of other origins ask for."""

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
        # An address, as opposed to a name, cannot be made to point elsewhere: the one that was connected to is ours.
        local = (scope.get("server") or ("",))[0]
        return _is_address(name) and name == _plain(str(local))


def foreign(scope: Scope, headers: Headers, host: tuple[str, int | None], api_prefix: str) -> str | None:
    """Return why a request must have come from a page of another origin; None where nothing says so."""
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
        return f"Content-Type: expected one that no form of a page can send, found {media}"
    return None


async def refuse(response: Response, scope: Scope, receive: Receive, send: Send) -> None:
    """Answer a request, or the opening handshake of a WebSocket, with a refusal."""
    if scope["type"] == "websocket" and "websocket.http.response" not in scope.get("extensions", {}):
        await receive()
        await send({"type": "websocket.close", "code": 1008, "reason": ""})
        return
    await response(scope, receive, send)


def _same(origin: str, host: tuple[str, int | None]) -> bool:
    """Whether an origin has this host and port; a host without a port has the default one of the origin's scheme."""
    try:
        parts = urlsplit(origin)
        if parts.scheme not in DEFAULT_PORTS or parts.hostname is None or parts.path:
            return False
        default = DEFAULT_PORTS[parts.scheme]
        return (_plain(parts.hostname), parts.port or default) == (host[0], host[1] or default)
    except ValueError:
        return False


def _host_and_port(text: str) -> tuple[str, int | None] | None:
    """Name and port of a Host header; None where it is none."""
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


def _plain(host: str) -> str:
    """A host name as it is compared: small letters, no final dot, addresses in their one form."""
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
