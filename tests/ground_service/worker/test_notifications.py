"""Notifications by webhook and e-mail, received by small servers; processes of a deployment that disagree."""

import contextlib
import json
import os
import socket
import socketserver
import ssl
import subprocess
import threading
import time
from contextlib import ExitStack
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from ipaddress import ip_network
from types import SimpleNamespace

from pytest import fixture, mark, raises

from ground_service.access.store import audit_head
from ground_service.errors import InvalidInput, ServerError
from ground_service.ground import ground_from_settings, open_ground
from ground_service.ingest.service import ingest_file
from ground_service.jobs.service import JobFilter, get_job, list_jobs
from ground_service.missions.automation import Channel
from ground_service.missions.service import add_mission
from ground_service.settings import Settings, load_settings
from ground_service.store import leases
from ground_service.store.audit import Head
from ground_service.store.event_kinds import (
    AlarmChanged,
    LimitsBroken,
    PassEvaluated,
    RegressionJudged,
    WindowChanged,
    publish,
)
from ground_service.store.files import file_names
from ground_service.store.models import METADATA
from ground_service.worker import actions, condition
from ground_service.worker import notifications as outgoing
from ground_service.worker.actions import send_messages
from ground_service.worker.condition import (
    all_disagreements,
    complaints,
    present,
    read_condition,
    running_processes,
    statement_of,
)
from ground_service.worker.dispatch import ThreadDispatcher
from ground_service.worker.doctor import examine
from ground_service.worker.follow_up import follow_in_process
from ground_service.worker.notifications import ATTEMPTS, NotDelivered, permitted_address, signature
from ground_service.worker.notifications import send as send_to
from ground_service.worker.upkeep import kept_heads, nightly
from linna import cli
from tests.ground_service.access.openid import running_provider
from tests.ground_service.access.test_missions_of_callers import row_of
from tests.ground_service.conftest import wait_for

HERE = (ip_network("127.0.0.1"),)


def send(folder, channel, key="id", document=None, networks=HERE, **how):
    """Send over a channel without waits; the receivers of these tests are on this machine."""
    waits = {"wait": lambda _seconds: None} | how
    return send_to(folder, channel, key, "subject", document or {}, networks=networks, **waits)


class Webhook:
    """Receiver that answers with the given statuses, then 200, and keeps what it was sent."""

    def __init__(self):
        self.statuses, self.received = [], []
        self.answered = lambda: None
        receiver = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self):
                body = self.rfile.read(int(self.headers["Content-Length"]))
                receiver.received.append((dict(self.headers), body))
                receiver.answered()
                self.send_response(receiver.statuses.pop(0) if receiver.statuses else 200)
                self.end_headers()

            def log_message(self, *_):
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_address[1]}/hook"


class Mailbox:
    """SMTP server (RFC 5321) that keeps the envelopes and messages; `refusal` is its answer to recipients."""

    def __init__(self):
        self.received = []
        self.refusal = ""
        self.tls = None
        mailbox = self

        class Handler(socketserver.StreamRequestHandler):
            def handle(self):
                self.say("220 mailbox")
                recipients = []
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
                    elif verb == "EHLO" and mailbox.tls is not None:
                        self.say("250-mailbox")
                        self.say("250 STARTTLS")
                    elif verb == "STARTTLS" and mailbox.tls is not None:
                        self.say("220 go on")
                        with contextlib.suppress(ssl.SSLError):
                            mailbox.tls.wrap_socket(self.request, server_side=True)
                        return
                    else:
                        self.say("250 ok")

            def say(self, text):
                self.wfile.write(f"{text}\r\n".encode())

        self.server = socketserver.ThreadingTCPServer(("127.0.0.1", 0), Handler)
        self.address = f"127.0.0.1:{self.server.server_address[1]}"


@contextlib.contextmanager
def running(server):
    """Serve in a thread; give the address."""
    server.daemon_threads = True
    with server:
        threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}).start()
        yield "{}:{}".format(*server.server_address)
        server.shutdown()


@fixture
def webhook():
    receiver = Webhook()
    with running(receiver.server):
        yield receiver


@fixture
def mailbox():
    receiver = Mailbox()
    with running(receiver.server):
        yield receiver


def test_a_webhook_gets_a_signed_document_with_its_id(webhook, tmp_path):
    (tmp_path / "secrets").mkdir()
    (tmp_path / "secrets/hook").write_text("key\n")
    channel = Channel(webhook=webhook.url, signing_secret="hook")
    assert send(tmp_path, channel, "id-1", {"event": 3}) == 1
    [(headers, body)] = webhook.received
    assert json.loads(body) == {"event": 3}
    assert headers["Idempotency-Key"] == "id-1" and headers["X-Linna-Signature"] == signature(b"key", body)
    assert signature(b"key", b"The quick brown fox jumps over the lazy dog") == (
        "f7bc83f430538424b13298e6aa6fb143ef4d59a14946175997479dbc2d1a3cd8"  # Wikipedia, HMAC, examples
    )


def test_a_webhook_that_is_out_of_order_is_tried_again_with_the_same_id(webhook, tmp_path):
    webhook.statuses = [503, 500]
    assert send(tmp_path, Channel(webhook=webhook.url), "id-2") == ATTEMPTS
    assert {headers["Idempotency-Key"] for headers, _ in webhook.received} == {"id-2"}


def test_a_refused_message_is_not_tried_again(webhook, tmp_path):
    webhook.statuses = [404]
    with raises(NotDelivered, match="status 404"):
        send(tmp_path, Channel(webhook=webhook.url))
    assert len(webhook.received) == 1


def test_a_receiver_that_is_away_and_a_missing_key_are_stated(tmp_path):
    waited = []
    with raises(NotDelivered, match=f"not delivered in {ATTEMPTS} attempts: ConnectError"):
        send(tmp_path, Channel(webhook="http://127.0.0.1:9/"), wait=waited.append)
    assert waited == [1.0, 2.0]
    channel = Channel(webhook="http://127.0.0.1:9/", signing_secret="hook")
    with raises(InvalidInput, match="signing_secret, hook: expected a file in secrets of the service"):
        send(tmp_path, channel)


def test_an_e_mail_reaches_all_recipients(mailbox, tmp_path):
    channel = Channel(email=("a@b.example", "c@d.example"), smtp=mailbox.address, sender="ground@x.example")
    assert send(tmp_path, channel, "id-3", {"event": 3, "pass": None}) == 1
    [(recipients, message)] = mailbox.received
    assert recipients == ["<a@b.example>", "<c@d.example>"]
    assert "Subject: subject" in message and "Message-ID: <id-3@linna>" in message
    assert "event: 3" in message and "pass" not in message.partition("\r\n\r\n")[2]


def test_a_mail_server_that_refuses_every_recipient_is_stated(mailbox, tmp_path):
    mailbox.refusal = "550 unknown"
    channel = Channel(email=("a@b.example",), smtp=mailbox.address)
    with raises(NotDelivered, match="SMTPRecipientsRefused"):
        send(tmp_path, channel)


@fixture
def local(tmp_path):
    """A service that may send to this machine."""
    with open_ground(tmp_path / "home") as opened:
        yield replace(opened, networks=HERE)


@mark.parametrize("offers_tls", [False, True])
def test_a_public_mail_server_needs_tls_with_its_certificate(mailbox, monkeypatch, tmp_path, offers_tls):
    """A message to the internet is neither readable on the way nor given to another server."""
    if offers_tls:
        environment = {"PATH": os.environ["PATH"], "LINNA_SECRETS_DIR": str(tmp_path)}
        subprocess.run(["sh", "deploy/secrets.sh"], check=True, env=environment, capture_output=True)
        mailbox.tls = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        mailbox.tls.load_cert_chain(tmp_path / "tls/certificate", tmp_path / "tls/key")
    monkeypatch.setattr(outgoing.ipaddress.IPv4Address, "is_global", property(lambda _: True))
    channel = Channel(email=("a@b.example",), smtp=mailbox.address)
    message = "SSLCertVerificationError" if offers_tls else "expected a mail server with STARTTLS"
    with raises(NotDelivered, match=message):
        send(tmp_path, channel)
    assert mailbox.received == []


class Dripping(socketserver.StreamRequestHandler):
    """A receiver that sends an octet now and then, so that no read of the sender times out."""

    octets = b"HTTP/1.1 200 OK\r\nX: "

    def handle(self):
        with contextlib.suppress(OSError):
            self.wfile.write(self.octets)
            for _ in range(200):
                time.sleep(0.05)
                self.wfile.write(b"x")


class DrippingMail(Dripping):
    octets = b"220 "


@mark.parametrize("handler", [Dripping, DrippingMail])
def test_a_receiver_that_drips_is_left_after_the_deadline(handler, tmp_path):
    with running(socketserver.ThreadingTCPServer(("127.0.0.1", 0), handler)) as place:
        mail = Channel(email=("a@b.example",), smtp=place)
        channel = Channel(webhook=f"http://{place}/") if handler is Dripping else mail
        with raises(NotDelivered, match="not delivered in 3 attempts"):
            send(tmp_path, channel, deadline_s=0.3)


def test_the_body_of_an_answer_is_not_read(tmp_path):
    sent = 0

    class Endless(socketserver.StreamRequestHandler):
        def handle(self):
            nonlocal sent
            self.rfile.readline()
            self.wfile.write(b"HTTP/1.1 200 OK\r\nContent-Length: 1000000000\r\n\r\n")
            with contextlib.suppress(OSError):
                while sent < 1_000_000_000:
                    sent += self.connection.send(bytes(1 << 16))

    with running(socketserver.ThreadingTCPServer(("127.0.0.1", 0), Endless)) as place:
        assert send(tmp_path, Channel(webhook=f"http://{place}/")) == 1
    assert sent < 50_000_000  # what the buffers of the connection hold


@mark.parametrize(
    "host", ["127.0.0.1", "localhost", "::1", "::ffff:10.0.0.1", "10.1.2.3", "169.254.169.254", "0.0.0.0", "224.0.0.1"]
)
def test_an_address_that_is_not_public_is_refused(host):
    with raises(NotDelivered, match="expected a public address or one of LINNA_NOTIFY_NETWORKS"):
        permitted_address(host, 80, ())


def test_a_public_address_and_a_listed_network_are_permitted():
    assert permitted_address("1.1.1.1", 443, ()) == "1.1.1.1"
    assert permitted_address("10.1.2.3", 443, (ip_network("10.0.0.0/8"),)) == "10.1.2.3"


def test_one_private_address_of_several_refuses_a_name_and_the_checked_address_is_used(webhook, tmp_path, monkeypatch):
    """A name server could answer the second question with another address."""
    asked = []
    answers = [["1.1.1.1", "10.0.0.1"], ["127.0.0.1"]]
    resolve = socket.getaddrinfo

    def found(host, port, *given, **how):
        if host != "ops.example":
            return resolve(host, port, *given, **how)
        asked.append(host)
        return [(socket.AF_INET, socket.SOCK_STREAM, 6, "", (one, port)) for one in answers.pop(0)]

    monkeypatch.setattr(outgoing.socket, "getaddrinfo", found)
    url = webhook.url.replace("127.0.0.1", "ops.example")
    with raises(NotDelivered, match=r"found 10\.0\.0\.1"):
        send(tmp_path, Channel(webhook=url), networks=())
    assert send(tmp_path, Channel(webhook=url)) == 1
    assert asked == ["ops.example"] * 2 and webhook.received[0][0]["Host"].startswith("ops.example:")


def test_the_networks_are_a_setting(monkeypatch):
    monkeypatch.setenv("LINNA_NOTIFY_NETWORKS", "127.0.0.1, 10.0.0.0/8")
    assert load_settings().notify_networks == ("127.0.0.1", "10.0.0.0/8")
    monkeypatch.delenv("LINNA_NOTIFY_NETWORKS")
    assert load_settings().notify_networks == ()


def add_hook(ground, webhook, more=""):
    text = f'name = "m"\n[spacecraft]\nid = 76\n[notify.hook]\nwebhook = "{webhook.url}"\n{more}'
    add_mission(ground, text.encode())


def add_channels(ground, webhook, mailbox):
    add_hook(ground, webhook, f'[notify.people]\nemail = ["a@b.example"]\nsmtp = "{mailbox.address}"\n')


def test_signed_heads_that_a_webhook_and_an_e_mail_got_are_checked(webhook, mailbox, local, tmp_path):
    add_channels(local, webhook, mailbox)
    (local.home / "secrets").mkdir()
    (local.home / "secrets/audit").write_text("key")
    for name in "hook", "people":
        nightly(local, {"audit_heads": f"channel:{name}"})
    heads = tmp_path / "heads"
    heads.mkdir()
    (heads / "hook.json").write_bytes(webhook.received[0][1])
    (heads / "mail.eml").write_text(mailbox.received[0][1])
    now = audit_head(local)
    assert kept_heads(local, str(heads)) == [Head(now.number, now.sha256)] * 2
    with raises(InvalidInput, match="expected a channel of a mission description in force, found none"):
        nightly(local, {"audit_heads": "channel:none"})


def notifications(ground):
    """Jobs of notifications, newest first."""
    return list(ground.read(list_jobs, JobFilter(kind="notification")).items)


def test_every_receiver_is_notified_also_if_another_one_fails(webhook, mailbox, local):
    follow_in_process(local)
    add_channels(local, webhook, mailbox)
    local.write(publish, RegressionJudged(id="1" * 32, verdict="fail"))
    [sent] = notifications(local)
    number = sent.arguments["event"]
    receivers = {"hook of spacecraft 76": "delivered", "people of spacecraft 76": "delivered"}
    assert (sent.state, sent.result) == ("done", {"event": number, **receivers})
    [(headers, body)] = webhook.received
    document = json.loads(body)
    assert document.pop("created").startswith("20")
    assert document == {
        "event": number, "trigger": "gate done", "text": f"regression {'1' * 32}: fail", "spacecraft_id": 76,
        "pass_id": None, "window_id": None,
    }  # fmt: skip
    assert len(mailbox.received) == 1
    send_messages(local, number)
    assert webhook.received[1][0]["Idempotency-Key"] == headers["Idempotency-Key"]
    webhook.statuses = [404]
    local.write(publish, RegressionJudged(id="2" * 32, verdict="fail"))
    failed = notifications(local)[0]
    assert failed.state == "failed" and len(mailbox.received) == 3
    assert (failed.error or "").startswith("hook of spacecraft 76: the webhook refuses the message")


def broken(spacecraft):
    return {"spacecraft_id": spacecraft, "instance": "flight", "parameter": "voltage", "limit_state": "low"}


def raised(vehicle=1, state="raised"):
    return AlarmChanged(id=1, vehicle_id=vehicle, name="voltage", severity="alarm", state=state)


@mark.parametrize(
    "event, texts",
    [
        (LimitsBroken(broken=[broken(76), broken(76), broken(77)]), ["voltage low; voltage low"]),
        (LimitsBroken(broken=[broken(77)]), []),
        (raised(), ["voltage (alarm)"]), (raised(state="cleared"), []), (raised(2), []),
        (PassEvaluated(report_id="r", pass_id=1, vehicle_id=1), ["report of pass 1: requirements met"]),
        (WindowChanged(id=1, state="failed"), ["window 1 (mare) failed: too late"]),
        (WindowChanged(id=1, state="executed"), []), (WindowChanged(id=9, state="failed"), []),
    ],
)  # fmt: skip
def test_receivers_get_the_events_of_their_spacecraft_that_a_person_needs(webhook, local, monkeypatch, event, texts):
    follow_in_process(local)
    add_hook(local, webhook)
    with local.database.writing() as connection:
        for key, spacecraft in (1, 76), (2, 77):
            row_of(connection, METADATA.tables["vehicles"], id=key, ccsds_id=spacecraft, instance="flight")
        row_of(connection, METADATA.tables["passes"], id=1, vehicle_id=1)
        row_of(connection, METADATA.tables["files"], sha256="0" * 64)
        files = {"html_sha256": "0" * 64, "json_sha256": "0" * 64}
        summary = {"verdict": "requirements met"}
        row_of(connection, METADATA.tables["reports"], id="r", pass_id=1, summary=summary, **files)
    window = SimpleNamespace(id=1, name="mare", reason="too late", vehicle_id=1, pass_id=None)
    monkeypatch.setattr(actions, "_window_of", lambda _, key: window if key == 1 else None)
    local.write(publish, event)
    assert [json.loads(body)["text"] for _, body in webhook.received] == texts


def test_a_slow_receiver_does_not_hold_up_other_jobs(local, webhook):
    """The embedded service does notifications in a thread of their own."""
    held = threading.Event()
    webhook.answered = held.wait
    dispatcher = ThreadDispatcher(local)
    follow_in_process(local, dispatcher.start)
    try:
        add_hook(local, webhook)
        local.write(publish, RegressionJudged(id="1" * 32, verdict="fail"))

        def kinds(state):
            return [one.kind for one in local.read(list_jobs, JobFilter()).items if one.state == state]

        wait_for(lambda: "notification" in kinds("running"), "the notification")
        job = dispatcher.submit("plan", {})
        wait_for(lambda: local.read(get_job, job).state == "done", "another job")
        assert kinds("running") == ["notification"]
        held.set()
        wait_for(lambda: kinds("running") == [], "the end of the notification")
        [sent] = notifications(local)
        assert (sent.state, sent.result) == ("done", {"event": 2, "hook of spacecraft 76": "delivered"})
    finally:
        held.set()
        dispatcher.close()


@fixture
def settings(tmp_path, migrated_postgres):
    return Settings(home=tmp_path / "home", database_url=migrated_postgres(), allow_database_owner=True)


@fixture
def opened(settings):
    with ground_from_settings(settings) as ground:
        yield ground


def changed(settings, **fields):
    return Settings(**settings.model_dump() | fields)


def test_a_process_is_known_while_it_runs(opened, settings, monkeypatch):
    monkeypatch.setattr(condition, "BEAT_S", 0.05)
    assert not running_processes(opened.database)
    with present(opened, settings, "worker"):
        [one] = running_processes(opened.database)
        assert one.kind == "worker" and one.statement
        assert replace(one.statement, clock_ms=0) == statement_of(opened, settings)
        assert abs(one.statement.clock_ms) < condition.CLOCK_LIMIT_MS
        assert read_condition(opened, None).processes == {"worker": 1}
        with opened.database.writing() as connection:  # of a process that was killed
            leases.state(connection, f"{condition.PREFIX}api gone:1", one.statement.text(), 0)
        time.sleep(0.2)
        assert str(*running_processes(opened.database)) == str(one)
    assert not running_processes(opened.database)
    assert complaints(read_condition(opened, None, "redis://127.0.0.1:1/0"))[:2] == [
        "No process does the recurring work.",
        "The broker does not answer.",
    ]


@mark.parametrize(
    "change, group",
    [
        ({"objects": "s3://linna/operations"}, "files"),
        ({"broker_url": "redis://elsewhere:6379/0"}, "broker"),
        ({"oidc_issuer": "https://login.example", "oidc_client_id": "linna"}, "provider"),
        ({"retention_days": 7}, "settings"),
    ],
)
def test_a_start_with_disagreeing_peers_fails(opened, settings, change, group):
    """An upload acknowledged by one process must not be invisible to the other."""
    other = changed(settings, **change)
    with present(opened, settings, "api"):
        with present(opened, changed(settings, port=9, host="0.0.0.0"), "worker"):
            pass  # what one process has for itself
        refused = raises(ServerError, match=f"expected the same .*: other {group} than here")
        with refused, present(opened, other, "worker"):
            raise AssertionError
        assert len(running_processes(opened.database)) == 1


def test_another_home_folder_and_other_data_are_noticed(opened, settings, tmp_path):
    mine = statement_of(opened, settings)
    (tmp_path / "elsewhere").mkdir()
    other = replace(opened, home=tmp_path / "elsewhere")
    assert [a == b for a, b in zip(mine.digests, statement_of(other, settings).digests, strict=True)] == [
        group != "files" for group in condition.GROUPS
    ]
    processes = [
        condition.Process("api", "a:1", mine),
        condition.Process("worker", "b:2", statement_of(other, settings)),
        condition.Process("worker", "c:3", None),
    ]
    assert all_disagreements(processes) == ["worker b:2: other files than api a:1"]


def faults(ground, settings):
    return {one.name: one.found for one in examine(ground, settings) if not one.ok}


def test_the_doctor_finds_a_healthy_deployment_and_names_each_fault(
    opened, settings, redis_url, synthetic_pass, tmp_path
):
    given = changed(settings, broker_url=redis_url)
    ingest_file(opened, synthetic_pass.folder / "downlink.cadu")
    with opened.database.writing() as connection:
        leases.acquire(connection, "scheduler", "somebody", 60_000_000_000)
    with ExitStack() as running:
        for kind in "api", "worker":
            running.enter_context(present(opened, given, kind))
        assert faults(opened, given) == {}
        names = {one.name for one in examine(opened, given)}
        assert names == {*("schema", "processes", "clocks", "recurring work", "broker", "archive", "files")}

        # 1. A file that a row names is missing, another one cannot be read.
        with opened.database.reading() as connection:
            [sha256] = file_names(connection)
        place = opened.files.place(sha256)
        place.rename(tmp_path / "moved")
        assert faults(opened, given) == {"files": f"{sha256[:16]}: expected the file, found none"}
        (tmp_path / "moved").rename(place)

        # 2. This process has another broker, which does not answer.
        found = faults(opened, changed(given, broker_url="redis://127.0.0.1:1/0"))
        assert set(found) == {"processes", "broker"} and "other broker than here" in found["processes"]

        # 3. The provider is down.
        with running_provider() as provider:
            oidc = {"oidc_issuer": provider.issuer, "oidc_client_id": "linna", "oidc_roles": ("admin=a",)}
            signed = given.model_copy(update=oidc)
            assert "provider" not in faults(opened, signed)
        assert "provider" in faults(opened, signed)

        # 4. A clock is wrong, and a worker sees no runner.
        [api, _] = running_processes(opened.database)
        with opened.database.writing() as connection:
            late = replace(api.statement, clock_ms=90_000, runner="no")
            leases.state(connection, f"{condition.PREFIX}worker late:1", late.text(), 60_000_000_000)
        found = faults(opened, given)
        assert found["clocks"] == "worker late:1: expected within 2000 ms of the database, found 90000 ms"
        assert "expected a runner" in found["processes"]
        with opened.database.writing() as connection:
            leases.remove(connection, f"{condition.PREFIX}worker late:1")

        # 5. A channel leads to an address that is not permitted.
        text = 'name = "m"\n[spacecraft]\nid = 76\n[notify.people]\nemail = ["a@b.example"]\n'
        add_mission(opened, text.encode())
        assert (
            "channel people of spacecraft 76: localhost: expected a public address"
            in (faults(opened, given)["notifications"])
        )
        opened_to_people = given.model_copy(update={"audit_heads": "channel:people"})
        assert "audit heads" not in faults(opened, opened_to_people)

        # 6. Audit heads go to a channel that no mission description has, or to a folder that does not exist.
        for target, fault in ("channel:nobody", "found nobody"), (str(tmp_path / "none"), "a folder that can"):
            given_heads = given.model_copy(update={"audit_heads": target})
            assert fault in faults(opened, given_heads)["audit heads"]
    found = faults(opened, given)
    assert "expected a running api, found none; expected a running worker" in found["processes"]


def test_the_command_has_an_exit_status_and_json(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("LINNA_HOME", str(tmp_path / "home"))
    assert cli.run(["doctor", "--json"]) == 1
    report = json.loads(capsys.readouterr().out)
    assert report["verdict"] == "broken"
    assert [one["name"] for one in report["checks"] if not one["ok"]] == ["recurring work"]


def test_the_statement_fits_into_its_column():
    digests = tuple("f" * condition.DIGITS for _ in condition.GROUPS)
    text = condition.Statement("10.10.10.dev1000", digests, -86_400_000, "yes").text()
    assert len(text) <= 96 and condition.Statement.of_text(text).digests == digests
    assert condition.Statement.of_text("1.0 aa bb 0 -") is None
