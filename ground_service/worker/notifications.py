"""Notifications by webhook and e-mail.

A message has an id that is the same in every attempt, so that receivers can discard repetitions: the header
Idempotency-Key of a webhook and the Message-ID of an e-mail.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import time
from collections.abc import Callable, Mapping, Sequence
from email.message import EmailMessage
from pathlib import Path
from typing import Any

from ground_service.errors import InvalidInput, storage_error
from ground_service.missions.automation import Channel
from ground_service.worker.outgoing import DEADLINE_S, Network, NotDelivered, Unreachable, post, send_mail

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
