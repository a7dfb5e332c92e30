"""Outgoing requests to addresses that mission descriptions name: address policy, deadlines, and size of answers.

A name is resolved once and the connection is made to the address that was checked, so that a second answer of the name
server cannot lead to another address.
"""

from __future__ import annotations

import asyncio
import ipaddress
import smtplib
import socket
import ssl
import threading
from collections.abc import Mapping, Sequence
from email.message import EmailMessage

import httpx

from ground_service.errors import GroundError

DEADLINE_S = 15.0
"""Time for one attempt, from the connection to the end of the answer."""

Network = ipaddress.IPv4Network | ipaddress.IPv6Network


class NotDelivered(GroundError):
    """A receiver did not accept a message."""


class Unreachable(GroundError):
    """A receiver was not available; a later attempt may succeed."""


def permitted_address(host: str, port: int, networks: Sequence[Network]) -> str:
    """Return an address of a host that may be connected to.

    Raises
    ------
    NotDelivered
        If the host has an address that is neither public nor in `networks`.
    Unreachable
        If the host has no address now.
    """
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError) as error:
        raise Unreachable(f"{host}: {error}") from None
    texts = list(dict.fromkeys(str(one[4][0]).partition("%")[0] for one in found))
    for text in texts:
        address = ipaddress.ip_address(text)
        mapped = getattr(address, "ipv4_mapped", None)
        plain = address if mapped is None else mapped
        if (not plain.is_global or plain.is_multicast) and not any(plain in one for one in networks):
            raise NotDelivered(
                f"{host}: expected a public address or one of LINNA_NOTIFY_NETWORKS, found {text}"
            )
    return texts[0]


def post(
    url: str, body: bytes, headers: Mapping[str, str], networks: Sequence[Network], deadline_s: float
) -> int:
    """Post a body and return the status; redirects are not followed, and the body of the answer is not read.

    Raises
    ------
    NotDelivered
        If the address is not valid or not permitted.
    Unreachable
        If there is no answer in time.
    """
    try:
        place = httpx.URL(url)
    except httpx.InvalidURL as error:
        raise NotDelivered(str(error)) from None
    port = place.port or {"http": 80, "https": 443}[place.scheme]
    address = permitted_address(place.host, port, networks)

    async def ask() -> int:
        async with (
            asyncio.timeout(deadline_s),
            httpx.AsyncClient(timeout=deadline_s, trust_env=False) as client,
            client.stream(
                "POST",
                place.copy_with(host=address),
                content=body,
                headers={**headers, "Host": place.netloc.decode("ascii")},
                extensions={"sni_hostname": place.host},
            ) as answer,
        ):
            return answer.status_code

    try:
        return asyncio.run(ask())
    except TimeoutError:
        raise Unreachable(f"no answer within {deadline_s:.0f} s") from None
    except (httpx.HTTPError, OSError) as error:
        raise Unreachable(f"{type(error).__name__}: {error}") from None


def send_mail(server: str, message: EmailMessage, networks: Sequence[Network], deadline_s: float) -> None:
    """Send a message over a mail server HOST:PORT, encrypted if the server offers it (STARTTLS).

    Raises
    ------
    NotDelivered
        If the address is not permitted, is public and offers no encryption, or the server refuses the message.
    Unreachable
        If the server does not take it in time.
    """
    host, _, port = server.rpartition(":")
    address = permitted_address(host, int(port), networks)
    client = smtplib.SMTP(timeout=deadline_s)

    def break_off() -> None:
        if client.sock is not None:
            client.sock.shutdown(socket.SHUT_RDWR)

    # The timeout of the client applies to each read, which an octet now and then would renew.
    clock = threading.Timer(deadline_s, break_off)
    clock.start()
    try:
        client.connect(address, int(port))
        client.ehlo()
        if client.has_extn("starttls"):
            client._host = host  # type: ignore[attr-defined]  # the name in its certificate
            client.starttls(context=ssl.create_default_context())
        elif ipaddress.ip_address(address).is_global:
            raise NotDelivered(f"{host}: expected a mail server with STARTTLS, found one without")
        client.send_message(message)
        client.quit()
    except smtplib.SMTPResponseException as error:
        kind = NotDelivered if error.smtp_code >= 500 else Unreachable
        raise kind(f"the mail server refuses the message: status {error.smtp_code}") from None
    except (smtplib.SMTPException, OSError) as error:
        raise Unreachable(f"{type(error).__name__}: {error}") from None
    finally:
        clock.cancel()
        client.close()
