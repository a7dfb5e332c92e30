"""Running the application with uvicorn."""

from __future__ import annotations

import errno
import socket
import sys

from ground_service.api.app import LOOPBACK, create_app
from ground_service.errors import ServerError
from ground_service.logs import logging_config
from ground_service.services.ground import ground_from_settings
from ground_service.services.users import has_users
from ground_service.settings import Settings


def serve(settings: Settings) -> None:
    """Serve until stopped.

    Raises
    ------
    ServerError
        If the address cannot be bound to, or may not be without users.
    """
    import uvicorn

    with ground_from_settings(settings) as ground:
        if settings.host not in LOOPBACK and not has_users(ground):
            raise ServerError(
                f"address {settings.host}: expected users before binding beyond this machine, found none; "
                "run 'linna user add NAME --role admin' first"
            )
    listener = bind(settings.host, settings.port)
    config = uvicorn.Config(
        create_app(settings),
        log_config=logging_config(settings.log_format),
        timeout_graceful_shutdown=20,
        # Longer than clients and proxies keep idle connections, so that none is closed under a request of theirs.
        timeout_keep_alive=75,
        server_header=False,
    )
    host, port = listener.getsockname()[:2]
    shown = f"[{host}]" if ":" in host else host
    print(f"LINNA ground service on http://{shown}:{port}/", file=sys.stderr, flush=True)
    with listener:
        uvicorn.Server(config).run(sockets=[listener])


def bind(host: str, port: int) -> socket.socket:
    """A socket bound to the address.

    Raises
    ------
    ServerError
        If it is taken, not this machine's, or not allowed.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # asyncio switches Nagle's algorithm off only where the protocol is named; with it on answers wait 40 ms.
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
    except OSError as error:
        listener.close()
        reason = (
            "is in use by another program"
            if error.errno == errno.EADDRINUSE
            else f"cannot be bound ({error.strerror})"
        )
        raise ServerError(f"address {host} port {port}: {reason}; choose another with --port") from None
    return listener
