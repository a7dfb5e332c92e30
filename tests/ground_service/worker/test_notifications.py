"""Notifications by webhook and e-mail, received by small servers on this machine."""

from __future__ import annotations

import json
import socketserver
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from ground_service.automation.model import ActionFilter
from ground_service.automation.store import list_actions
from ground_service.errors import InvalidInput
from ground_service.events import RegressionJudged, publish
from ground_service.ground import Ground
from ground_service.missions.rules import Channel
from ground_service.missions.service import add_mission
from ground_service.worker.notifications import ATTEMPTS, NotDelivered, send, signature


class Webhook:
    """Receiver that answers with the given statuses, then 200, and keeps what it was sent."""

    def __init__(self) -> None:
        self.statuses: list[int] = []
        self.received: list[tuple[dict[str, str], bytes]] = []
        receiver = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"]))
                receiver.received.append((dict(self.headers), body))
                self.send_response(receiver.statuses.pop(0) if receiver.statuses else 200)
                self.end_headers()

            def log_message(self, *_: Any) -> None:
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_address[1]}/hook"


class Mailbox:
    """SMTP server (RFC 5321) that keeps the envelopes and messages; `refusal` is its answer to recipients."""

    def __init__(self) -> None:
        self.received: list[tuple[list[str], str]] = []
        self.refusal = ""
        mailbox = self

        class Handler(socketserver.StreamRequestHandler):
            def handle(self) -> None:
                self.say("220 mailbox")
                recipients: list[str] = []
                while line := self.rfile.readline().decode().strip():
                    verb = line.split(":")[0].split()[0].upper()
                    if verb == "RCPT":
                        recipients.append(line.partition(":")[2])
                        self.say(mailbox.refusal or "250 ok")
                    elif verb == "DATA":
                        self.say("354 go on")
                        lines = []
                        while (text := self.rfile.readline().decode()) != ".\r\n":
                            lines.append(text)
                        mailbox.received.append((recipients, "".join(lines)))
                        self.say("250 ok")
                    elif verb == "QUIT":
                        self.say("221 bye")
                        return
                    else:
                        self.say("250 ok")

            def say(self, text: str) -> None:
                self.wfile.write(f"{text}\r\n".encode())

        self.server = socketserver.ThreadingTCPServer(("127.0.0.1", 0), Handler)
        self.address = f"127.0.0.1:{self.server.server_address[1]}"


@pytest.fixture
def webhook() -> Iterator[Webhook]:
    receiver = Webhook()
    yield from running(receiver)


@pytest.fixture
def mailbox() -> Iterator[Mailbox]:
    receiver = Mailbox()
    yield from running(receiver)


def running(receiver: Any) -> Iterator[Any]:
    thread = threading.Thread(target=receiver.server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield receiver
    receiver.server.shutdown()
    thread.join()
    receiver.server.server_close()


def no_wait(_seconds: float) -> None:
    pass


def test_a_webhook_gets_a_signed_document_with_its_id(webhook: Webhook, tmp_path: Path) -> None:
    (tmp_path / "secrets").mkdir()
    (tmp_path / "secrets" / "hook").write_text("key\n")
    channel = Channel(webhook=webhook.url, signing_secret="hook")
    assert send(tmp_path, channel, "id-1", "subject", {"event": 3}) == 1
    [(headers, body)] = webhook.received
    assert json.loads(body) == {"event": 3}
    assert headers["Idempotency-Key"] == "id-1" and headers["X-Linna-Signature"] == signature(b"key", body)
    assert signature(b"key", b"The quick brown fox jumps over the lazy dog") == (
        "f7bc83f430538424b13298e6aa6fb143ef4d59a14946175997479dbc2d1a3cd8"  # Wikipedia, HMAC, examples
    )


def test_a_webhook_that_is_out_of_order_is_tried_again_with_the_same_id(
    webhook: Webhook, tmp_path: Path
) -> None:
    webhook.statuses = [503, 500]
    assert send(tmp_path, Channel(webhook=webhook.url), "id-2", "s", {}, wait=no_wait) == ATTEMPTS
    assert {headers["Idempotency-Key"] for headers, _ in webhook.received} == {"id-2"}


def test_a_refused_message_is_not_tried_again(webhook: Webhook, tmp_path: Path) -> None:
    webhook.statuses = [404]
    with pytest.raises(NotDelivered, match="status 404"):
        send(tmp_path, Channel(webhook=webhook.url), "id", "s", {}, wait=no_wait)
    assert len(webhook.received) == 1


def test_a_receiver_that_is_away_is_named_after_all_attempts(tmp_path: Path) -> None:
    waited: list[float] = []
    with pytest.raises(NotDelivered, match=f"not delivered in {ATTEMPTS} attempts: ConnectError"):
        send(tmp_path, Channel(webhook="http://127.0.0.1:9/"), "id", "s", {}, wait=waited.append)
    assert waited == [1.0, 2.0]


def test_a_missing_key_is_stated(tmp_path: Path) -> None:
    channel = Channel(webhook="http://127.0.0.1:9/", signing_secret="hook")
    with pytest.raises(InvalidInput, match="signing_secret, hook: expected a file in secrets of the service"):
        send(tmp_path, channel, "id", "s", {})


def test_an_e_mail_reaches_all_recipients(mailbox: Mailbox, tmp_path: Path) -> None:
    channel = Channel(email=("a@b.example", "c@d.example"), smtp=mailbox.address, sender="ground@x.example")
    assert send(tmp_path, channel, "id-3", "a window failed", {"event": 3, "pass": None}) == 1
    [(recipients, message)] = mailbox.received
    assert recipients == ["<a@b.example>", "<c@d.example>"]
    assert "Subject: a window failed" in message and "Message-ID: <id-3@linna>" in message
    assert "event: 3" in message and "pass" not in message.partition("\r\n\r\n")[2]


def test_a_mail_server_that_refuses_every_recipient_is_stated(mailbox: Mailbox, tmp_path: Path) -> None:
    mailbox.refusal = "550 unknown"
    channel = Channel(email=("a@b.example",), smtp=mailbox.address)
    with pytest.raises(NotDelivered, match="SMTPRecipientsRefused"):
        send(tmp_path, channel, "id", "s", {}, wait=no_wait)


def test_a_rule_notifies_its_channels(webhook: Webhook, mailbox: Mailbox, ground: Ground) -> None:
    text = f"""
name = "m"
[spacecraft]
id = 76
[[automation.rules]]
name = "gate failed"
on = "gate done"
when = {{ verdict = ["fail"] }}
do = ["notify"]
notify = ["hook", "people"]
[automation.channels.hook]
webhook = "{webhook.url}"
[automation.channels.people]
email = ["a@b.example"]
smtp = "{mailbox.address}"
"""
    add_mission(ground, text.encode())
    with ground.database.writing() as connection:
        publish(connection, RegressionJudged(id="1" * 32, verdict="fail"))
    [action] = ground.read(list_actions, ActionFilter()).items
    assert (action.state, action.result) == ("done", {"hook": "delivered", "people": "delivered"})
    [(_, body)] = webhook.received
    document = json.loads(body)
    assert document["rule"] == "gate failed" and document["event"] == action.event
    assert document["text"] == f"regression {'1' * 32}: fail" and len(mailbox.received) == 1


def test_a_channel_that_fails_does_not_keep_others_from_the_message(
    webhook: Webhook, mailbox: Mailbox, ground: Ground
) -> None:
    webhook.statuses = [404]
    text = f"""
name = "m"
[spacecraft]
id = 76
[[automation.rules]]
name = "gate"
on = "gate done"
do = ["notify"]
notify = ["hook", "people"]
[automation.channels.hook]
webhook = "{webhook.url}"
[automation.channels.people]
email = ["a@b.example"]
smtp = "{mailbox.address}"
"""
    add_mission(ground, text.encode())
    with ground.database.writing() as connection:
        publish(connection, RegressionJudged(id="1" * 32, verdict="pass"))
    [action] = ground.read(list_actions, ActionFilter()).items
    assert action.state == "failed" and "hook: the webhook refuses the message" in (action.error or "")
    assert len(mailbox.received) == 1
