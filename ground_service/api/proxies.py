"""Who is at the other end: the peer of the connection, or whom a trusted reverse proxy names.

Headers of the family X-Forwarded-* are believed only where the connection comes from an address of
`LINNA_TRUSTED_PROXIES`. From any other peer they are ignored, and the service works with the peer itself.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Sequence

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

Network = ipaddress.IPv4Network | ipaddress.IPv6Network
SCHEMES = {"http": ("http", "ws"), "https": ("https", "wss"), "ws": ("http", "ws"), "wss": ("https", "wss")}


def parse_networks(texts: Sequence[str]) -> tuple[Network, ...]:
    """Return the networks that texts such as ``10.0.0.7`` and ``10.0.0.0/8`` name.

    Raises
    ------
    ValueError
        If one of them is no address and no network.
    """
    return tuple(ipaddress.ip_network(text) for text in texts)


class TrustedProxies:
    """The addresses whose X-Forwarded-* headers are believed."""

    def __init__(self, texts: Sequence[str] = ()) -> None:
        self._networks = parse_networks(texts)

    def __contains__(self, host: object) -> bool:
        address = _address(str(host))
        return address is not None and any(address in network for network in self._networks)

    def client(self, peer: str, forwarded_for: str) -> str:
        """Return the last address of the chain that no trusted proxy has; the peer where the chain says nothing.

        Every proxy appends the address it was asked from, so entries to the left of an untrusted one are the
        untrusted one's own words.
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
    """Put the client, scheme and host that a trusted proxy names in place of the proxy's own."""

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
    """Return what callers without a name are told apart by: an IPv4 address, or the /64 of an IPv6 address.

    One IPv6 subscriber holds a whole /64, so single addresses would earn as many budgets as anybody likes.
    """
    address = _address(host)
    if isinstance(address, ipaddress.IPv6Address):
        return str(ipaddress.ip_network((address, 64), strict=False))
    return host if address is None else str(address)


def _address(text: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    """The address that a text such as 10.0.0.1, 10.0.0.1:80, ::1 or [::1]:80 holds."""
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
    """The last entry of a header that proxies append to: that of the proxy nearest to this service."""
    return values[-1].rpartition(",")[2].strip() if values else ""
