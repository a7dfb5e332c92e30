"""Client address of a request: the peer of the connection, or the address reported by a trusted reverse proxy.

X-Forwarded-* headers are accepted only on connections from an address of `LINNA_TRUSTED_PROXIES`. From any other peer
they are ignored, and the peer is the client.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Sequence
from functools import lru_cache

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

Network = ipaddress.IPv4Network | ipaddress.IPv6Network
SCHEMES = {"http": ("http", "ws"), "https": ("https", "wss"), "ws": ("http", "ws"), "wss": ("https", "wss")}


def parse_networks(texts: Sequence[str]) -> tuple[Network, ...]:
    """Return the networks given by texts such as ``10.0.0.7`` and ``10.0.0.0/8``.

    Raises
    ------
    ValueError
        If a text is neither an address nor a network.
    """
    return tuple(ipaddress.ip_network(text) for text in texts)


class TrustedProxies:
    """Addresses whose X-Forwarded-* headers are accepted."""

    def __init__(self, texts: Sequence[str] = ()) -> None:
        self._networks = parse_networks(texts)

    def __contains__(self, host: object) -> bool:
        address = _address(str(host)) if self._networks else None
        return address is not None and any(address in network for network in self._networks)

    def client(self, peer: str, forwarded_for: str) -> str:
        """Return the last address of the chain that is not a trusted proxy; the peer without a chain.

        Every proxy appends the address of its peer, so entries to the left of an untrusted address may be forged.
        """
        found = peer
        for text in reversed([part.strip() for part in forwarded_for.split(",")]):
            address = _address(text)
            if address is None:
                break
            found = str(address)
            if found not in self:
                break
        return found


class ForwardedHeaders:
    """Replacement of client, scheme and host by those reported by a trusted proxy."""

    def __init__(self, app: ASGIApp, proxies: TrustedProxies) -> None:
        self._app = app
        self._proxies = proxies

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] in ("http", "websocket"):
            peer = (scope.get("client") or ("",))[0]
            if peer in self._proxies:
                self._apply(scope, peer)
        await self._app(scope, receive, send)

    def _apply(self, scope: Scope, peer: str) -> None:
        headers = Headers(scope=scope)
        chain = headers.getlist("x-forwarded-for")
        if chain:
            scope["client"] = (self._proxies.client(peer, ",".join(chain)), 0)
        scheme = _last(headers.getlist("x-forwarded-proto")).lower()
        if scheme in SCHEMES:
            scope["scheme"] = SCHEMES[scheme][scope["type"] == "websocket"]
        host = _last(headers.getlist("x-forwarded-host"))
        if host:
            kept = [(name, value) for name, value in scope["headers"] if name != b"host"]
            scope["headers"] = [*kept, (b"host", host.encode("latin-1"))]


def address_key(host: str) -> str:
    """Return the key of an anonymous caller: its IPv4 address, or the /64 network of its IPv6 address.

    An IPv6 subscriber has a whole /64, so a budget for each address would not limit the caller.
    """
    address = _address(host)
    if isinstance(address, ipaddress.IPv6Address):
        return str(ipaddress.ip_network((address, 64), strict=False))
    return host if address is None else str(address)


@lru_cache(maxsize=256)
def _address(text: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    """Return the address in a text such as 10.0.0.1, 10.0.0.1:80, ::1 or [::1]:80."""
    if text.startswith("["):
        text = text[1:].partition("]")[0]
    elif text.count(":") == 1:
        text = text.partition(":")[0]
    try:
        address = ipaddress.ip_address(text.partition("%")[0])
    except ValueError:
        return None
    mapped = getattr(address, "ipv4_mapped", None)
    return mapped if mapped is not None else address


def _last(values: Sequence[str]) -> str:
    """Return the last entry of a header to which proxies append: that of the nearest proxy."""
    return values[-1].rpartition(",")[2].strip() if values else ""
