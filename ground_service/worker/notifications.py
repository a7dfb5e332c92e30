"""Notifications by webhook and e-mail.

A message has an id that is the same in every attempt, so that receivers can discard repetitions: the header
Idempotency-Key of a webhook and the Message-ID of an e-mail.
"""

import asyncio
import hashlib
import hmac
import ipaddress
import json
import smtplib
import socket
import ssl
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from email.message import EmailMessage
from pathlib import Path
from typing import Any

import httpx

from ground_service.errors import GroundError, InvalidInput, storage_error
from ground_service.missions.automation import Channel

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
            raise NotDelivered(f"{host}: expected a public address or one of LINNA_NOTIFY_NETWORKS, found {text}")
    return texts[0]


def post(url: str, body: bytes, headers: Mapping[str, str], networks: Sequence[Network], deadline_s: float) -> int:
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


ATTEMPTS = 3
FIRST_WAIT_S = 1.0
SIGNATURE_HEADER = "X-Linna-Signature"
SECRETS = "secrets"
"""Folder under the home of the service with the keys of signatures."""


def send(
    home: Path,
    channel: Channel,
    identity: str,
    subject: str,
    content: Mapping[str, Any],
    *,
    networks: Sequence[Network] = (),
    deadline_s: float = DEADLINE_S,
    wait: Callable[[float], object] = time.sleep,
) -> int:
    """Send a message over a channel; return the number of attempts.

    Parameters
    ----------
    networks
        Networks that are not public and may be connected to.

    Raises
    ------
    NotDelivered
        The receiver is not permitted, has refused it, or was not available in any attempt.
    InvalidInput
        The key of the signature is missing.
    """
    key = None if channel.signing_secret is None else key_of(home, channel.signing_secret)
    reason = ""
    for attempt in range(1, ATTEMPTS + 1):
        try:
            if channel.webhook is not None:
                _post(channel.webhook, identity, content, key, networks, deadline_s)
            else:
                send_mail(channel.smtp, _mail(channel, identity, subject, content), networks, deadline_s)
            return attempt
        except Unreachable as error:
            reason = str(error)
        if attempt < ATTEMPTS:
            wait(FIRST_WAIT_S * 2.0 ** (attempt - 1))
    raise NotDelivered(f"not delivered in {ATTEMPTS} attempts: {reason}")


def signature(key: bytes, body: bytes) -> str:
    """Return the signature of the body of a webhook: HMAC-SHA256 in hexadecimal digits."""
    return hmac.new(key, body, hashlib.sha256).hexdigest()


def _post(
    url: str,
    identity: str,
    content: Mapping[str, Any],
    key: bytes | None,
    networks: Sequence[Network],
    deadline_s: float,
) -> None:
    body = json.dumps(content, sort_keys=True).encode()
    headers = {"Content-Type": "application/json", "Idempotency-Key": identity}
    if key is not None:
        headers[SIGNATURE_HEADER] = signature(key, body)
    status = post(url, body, headers, networks, deadline_s)
    if status >= 500:
        raise Unreachable(f"status {status}")
    if status >= 300:
        raise NotDelivered(f"the webhook refuses the message: status {status}")


def _mail(channel: Channel, identity: str, subject: str, content: Mapping[str, Any]) -> EmailMessage:
    message = EmailMessage()
    message["Subject"] = subject
    message["From"] = channel.sender
    message["To"] = ", ".join(channel.email or ())
    message["Message-ID"] = f"<{identity}@linna>"
    message.set_content("\n".join(f"{name}: {value}" for name, value in content.items() if value is not None))
    return message


def key_of(home: Path, name: str) -> bytes:
    """Return the key in a file of the folder `secrets` of the service."""
    path = home / SECRETS / name
    try:
        key = path.read_bytes().strip()
    except FileNotFoundError:
        raise InvalidInput("signing_secret", name, f"a file in {SECRETS} of the service", "none") from None
    except OSError as error:
        raise storage_error(error, path) from None
    if not key:
        raise InvalidInput("signing_secret", name, "a key", "an empty file")
    return key
