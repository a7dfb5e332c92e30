"""Notifications by webhook and e-mail.

A message has an id that is the same in every attempt, so that receivers can discard repetitions: the header
Idempotency-Key of a webhook and the Message-ID of an e-mail.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import smtplib
import time
from collections.abc import Callable, Mapping
from email.message import EmailMessage
from pathlib import Path
from typing import Any

import httpx

from ground_service.errors import GroundError, InvalidInput, storage_error
from ground_service.missions.rules import Channel

ATTEMPTS = 3
FIRST_WAIT_S = 1.0
TIMEOUT_S = 10.0
SIGNATURE_HEADER = "X-Linna-Signature"
SECRETS = "secrets"
"""Folder under the home of the service with the keys of signatures."""


class NotDelivered(GroundError):
    """A receiver did not accept a message."""


def send(
    home: Path,
    channel: Channel,
    identity: str,
    subject: str,
    content: Mapping[str, Any],
    *,
    wait: Callable[[float], object] = time.sleep,
) -> int:
    """Send a message over a channel; return the number of attempts.

    Raises
    ------
    NotDelivered
        The receiver has refused it, or was not available in any attempt.
    InvalidInput
        The key of the signature is missing.
    """
    key = None if channel.signing_secret is None else _key(home, channel.signing_secret)
    reason = ""
    for attempt in range(1, ATTEMPTS + 1):
        try:
            if channel.webhook is not None:
                _post(channel.webhook, identity, content, key)
            else:
                _mail(channel, identity, subject, content)
            return attempt
        except (httpx.TransportError, smtplib.SMTPException, OSError) as error:
            if isinstance(error, smtplib.SMTPResponseException) and error.smtp_code >= 500:
                raise NotDelivered(f"the mail server refuses the message: status {error.smtp_code}") from None
            reason = f"{type(error).__name__}: {error}"
        if attempt < ATTEMPTS:
            wait(FIRST_WAIT_S * 2.0 ** (attempt - 1))
    raise NotDelivered(f"not delivered in {ATTEMPTS} attempts: {reason}")


def signature(key: bytes, body: bytes) -> str:
    """Return the signature of the body of a webhook: HMAC-SHA256 in hexadecimal digits."""
    return hmac.new(key, body, hashlib.sha256).hexdigest()


def _post(url: str, identity: str, content: Mapping[str, Any], key: bytes | None) -> None:
    body = json.dumps(content, sort_keys=True).encode()
    headers = {"Content-Type": "application/json", "Idempotency-Key": identity}
    if key is not None:
        headers[SIGNATURE_HEADER] = signature(key, body)
    try:
        response = httpx.post(url, content=body, headers=headers, timeout=TIMEOUT_S)
    except httpx.InvalidURL as error:
        raise NotDelivered(str(error)) from None
    if response.status_code >= 500:
        raise httpx.TransportError(f"status {response.status_code}")
    if response.status_code >= 300:
        raise NotDelivered(f"the webhook refuses the message: status {response.status_code}")


def _mail(channel: Channel, identity: str, subject: str, content: Mapping[str, Any]) -> None:
    message = EmailMessage()
    message["Subject"] = subject
    message["From"] = channel.sender
    message["To"] = ", ".join(channel.email or ())
    message["Message-ID"] = f"<{identity}@linna>"
    message.set_content("\n".join(f"{name}: {value}" for name, value in content.items() if value is not None))
    host, _, port = channel.smtp.rpartition(":")
    with smtplib.SMTP(host, int(port), timeout=TIMEOUT_S) as server:
        server.send_message(message)


def _key(home: Path, name: str) -> bytes:
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
