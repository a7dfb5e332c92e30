"""WebSockets: closed after loss of authorisation, limited in number, and served from one feed."""

import asyncio
from concurrent.futures import ThreadPoolExecutor

from pytest import fixture, mark, raises
from starlette.websockets import WebSocketDisconnect

from ground_service.access import service as users
from ground_service.app import create_app
from ground_service.ingest.service import ingest_file
from ground_service.settings import Settings
from ground_service.store.events import publish
from ground_service.web import sockets
from tests.serving import TestClient, WebSocketDenialResponse, wait_for
from tmtc.dictionary.payload import DICTIONARY
from tmtc.downlink import encode_cadus

LIVE = "/api/v1/live"
TICKS = 900_000_000 * 65_536


@fixture
def client(tmp_path, monkeypatch):
    """Service with limits of three sockets per caller and five in total, which verifies callers immediately."""
    monkeypatch.setattr(sockets, "VERIFY_S", 0.05)
    monkeypatch.setattr(sockets, "POLL_S", 0.05)
    settings = Settings(home=tmp_path, sockets_per_user=3, sockets=5)
    with TestClient(create_app(settings, inline_jobs=True)) as opened:
        yield opened


def ground_of(client):
    return client.app.state.ground


def bearer(token):
    return {"Authorization": f"Bearer {token}"}


def say(ground, number):
    with ground.database.writing() as connection:
        publish(connection, "test", {"number": number})


def closing_code(socket):
    """Return the close code of a socket; skip earlier messages."""
    with raises(WebSocketDisconnect) as closed:
        while True:
            socket.receive_text()
    return int(closed.value.code)


def disable(ground, name):
    users.change_user(ground, name, state="disabled")


def revoke(ground, name):
    (token,) = users.list_tokens(ground, name)
    users.revoke_token(ground, token.id)


def renew(ground, name):
    users.add_token(ground, name, revoke_others=True)


@mark.parametrize("path", [LIVE, "/api/v1/payload"])
@mark.parametrize("end", [disable, revoke, renew])
def test_a_socket_ends_with_the_right_to_hold_it(client, end, path, monkeypatch):
    async def hold(session):
        await session.accept()
        await asyncio.sleep(60.0)

    monkeypatch.setattr("ground_service.web.payload_console._watched", hold)
    ground = ground_of(client)
    token, other = users.add_user(ground, "vera", "viewer"), users.add_user(ground, "otto", "admin")
    with (
        client.websocket_connect(path, headers=bearer(token)) as socket,
        client.websocket_connect(LIVE, headers=bearer(other)) as kept,
    ):
        end(ground, "vera")
        assert closing_code(socket) == sockets.POLICY_VIOLATION
        say(ground, 7)
        assert kept.receive_json()["payload"] == {"number": 7}
    with raises(WebSocketDisconnect), client.websocket_connect(path, headers=bearer(token)):
        pass


def test_a_socket_without_a_token_ends_when_the_service_gets_users(client):
    with client.websocket_connect(LIVE) as socket:
        users.add_user(ground_of(client), "ada", "admin")
        assert closing_code(socket) == sockets.POLICY_VIOLATION


def test_a_token_that_expires_ends_its_socket(client, monkeypatch):
    token = users.add_user(ground_of(client), "vera", "viewer", days_valid=1.0)
    with client.websocket_connect(LIVE, headers=bearer(token)) as socket:
        later = users.utc_now_ns() + 2 * 86_400 * 10**9
        monkeypatch.setattr(users, "utc_now_ns", lambda: later)
        assert closing_code(socket) == sockets.POLICY_VIOLATION


def test_an_operator_who_becomes_a_viewer_may_no_longer_steer(client, monkeypatch):
    roles = []

    async def watch_role(session):
        await session.accept()
        while True:
            await asyncio.sleep(0.02)
            if not roles or roles[-1] != session.caller.role:
                roles.append(session.caller.role)
                await session.socket.send_text(session.caller.role)

    monkeypatch.setattr("ground_service.web.payload_console._watched", watch_role)
    ground = ground_of(client)
    token = users.add_user(ground, "olga", "operator")
    with client.websocket_connect("/api/v1/payload", headers=bearer(token)) as socket:
        assert socket.receive_text() == "operator"
        users.change_user(ground, "olga", role="viewer")
        assert socket.receive_text() == "viewer"


def refused(client, token):
    headers = bearer(token) if token else {}
    try:
        with client.websocket_connect(LIVE, headers=headers):
            return False
    except WebSocketDenialResponse as refusal:
        assert refusal.status_code == 429 and refusal.json()["title"] == "too many sockets"
        return True


def test_sockets_are_limited_for_a_user_and_in_all(client):
    ground = ground_of(client)
    tokens = {name: users.add_user(ground, name, "viewer") for name in ("ann", "bob", "cleo")}
    second = users.add_token(ground, "ann")
    held = []
    for token in (tokens["ann"], tokens["ann"], second):
        held.append(client.websocket_connect(LIVE, headers=bearer(token)))
        held[-1].__enter__()
    assert refused(client, tokens["ann"]) and refused(client, second)
    for _ in range(2):
        held.append(client.websocket_connect(LIVE, headers=bearer(tokens["bob"])))
        held[-1].__enter__()
    assert refused(client, tokens["cleo"])  # five are open
    held.pop(0).__exit__(None, None, None)
    assert not refused(client, tokens["cleo"])
    for one in held:
        one.__exit__(None, None, None)


def test_the_feed_is_read_once_for_all_sockets(client, monkeypatch):
    reads = 0
    read_events = sockets.read_events

    def counted(*arguments):
        nonlocal reads
        items = read_events(*arguments)
        reads += bool(items)
        return items

    monkeypatch.setattr(sockets, "read_events", counted)
    ground = ground_of(client)
    tokens = [users.add_user(ground, name, "viewer") for name in ("ann", "bob")]
    opened = [client.websocket_connect(LIVE, headers=bearer(token)) for token in tokens * 2]
    for one in opened:
        one.__enter__()
    say(ground, 1)
    messages = [one.receive_json() for one in opened]
    assert len({message["sequence"] for message in messages}) == 1 and reads == 1
    for one in opened:
        one.__exit__(None, None, None)


def test_a_client_that_comes_back_gets_what_it_missed_once_and_in_order(client, monkeypatch):
    monkeypatch.setattr(sockets, "BATCH", 3)
    ground = ground_of(client)
    with client.websocket_connect(LIVE) as socket:
        say(ground, 0)
        first = socket.receive_json()["sequence"]
    for number in range(1, 9):
        say(ground, number)
    with client.websocket_connect(f"{LIVE}?after={first}") as socket:
        for number in range(9, 12):
            say(ground, number)
        found = [socket.receive_json() for _ in range(11)]
    assert [one["payload"]["number"] for one in found] == list(range(1, 12))
    assert [one["sequence"] for one in found] == list(range(first + 1, first + 12))


def test_a_client_that_reads_too_slowly_is_closed_and_may_come_back(client, monkeypatch):
    ground = ground_of(client)
    with client.websocket_connect(LIVE) as socket:
        hub = client.app.state.sockets
        wait_for(lambda: hub._readers, "the session")
        (session,) = hub._readers
        monkeypatch.setattr(sockets, "QUEUED_LIMIT", 2)

        async def stuck(_text):
            await asyncio.sleep(60.0)

        session.socket.send_text = stuck
        for number in range(8):
            say(ground, number)
        assert closing_code(socket) == sockets.TRY_AGAIN_LATER


def receive(ground, folder, second, name="housekeeping", **values):
    """Ingest a packet of spacecraft 76 of a second."""
    fields = DICTIONARY.packet(name).fields
    zeros = {field.name: 0 if field.size == 1 else (0.0,) * field.size for field in fields}
    packet = DICTIONARY.pack(name, zeros | values, ticks=TICKS + second * 65_536, sequence_count=second)
    file = folder / f"{name}-{second}.cadu"
    file.write_bytes(encode_cadus([packet], spacecraft_id=76))
    ingest_file(ground, file)


def messages_until(socket, kind):
    """Return the messages up to the next one of a kind."""
    found = [socket.receive_json()]
    while found[-1]["kind"] != kind:
        found.append(socket.receive_json())
    return found


def test_newest_values_are_sent_on_request_and_only_those_that_changed(client, tmp_path):
    ground = ground_of(client)
    with client.websocket_connect(f"{LIVE}?values=true") as socket, client.websocket_connect(LIVE) as plain:
        receive(ground, tmp_path, 1, structure_id=1, temperature_c=70.25, mode=2)
        *before, first = messages_until(socket, "values")
        telemetry = next(one for one in before if one["kind"] == "telemetry")
        assert telemetry["payload"]["kinds"] == ["housekeeping"]
        assert first["sequence"] >= telemetry["sequence"]
        packet = first["payload"]
        assert (packet["spacecraft_id"], packet["instance"], packet["packet"]) == (76, "flight", "housekeeping")
        values = {one["name"]: one for one in packet["values"]}
        assert values["temperature_c"] == {
            "name": "temperature_c", "value": 70.25, "text": "70.25", "limit_state": "warning",
        }  # fmt: skip
        assert values["mode"]["text"] == "observing"
        receive(ground, tmp_path, 2, "frame_outcome")
        assert messages_until(socket, "values")[-1]["payload"]["packet"] == "frame_outcome"
        receive(ground, tmp_path, 3, structure_id=1)
        packet = messages_until(socket, "values")[-1]["payload"]
        assert (packet["packet"], {one["value"] for one in packet["values"] if one["name"] == "mode"}) == (
            "housekeeping",
            {0.0},
        )
        say(ground, 7)
        kinds = [one["kind"] for one in messages_until(plain, "test")]
        assert kinds.count("telemetry") == 3 and "values" not in kinds


def test_values_of_the_feed_are_those_of_the_parameters(client, tmp_path):
    ground = ground_of(client)
    with client.websocket_connect(f"{LIVE}?values=true") as socket:
        receive(ground, tmp_path, 1, structure_id=1, temperature_c=70.25)
        packet = messages_until(socket, "values")[-1]["payload"]
    listed = client.get("/api/v1/parameters?spacecraft_id=76").json()["items"]
    shared = ("name", "value", "text", "limit_state")
    assert packet["values"] == [{name: one[name] for name in shared} for one in listed]
    assert {one["time"] for one in listed} == {packet["time"]}


def test_a_slow_socket_skips_values_and_no_events():
    sent = []

    class Slow:
        async def send_text(self, text):
            sent.append(text)
            if text == "event 1":  # what comes while this is being sent
                for number in (2, 3):
                    session.offer(number, f"event {number}")
                    session.offer_values((1, "housekeeping"), f"values {number}")
            await asyncio.sleep(0)

    session = None

    async def run():
        nonlocal session
        session = sockets.Session(
            Slow(),  # only what is sent matters
            sockets.LOCAL_CALLER, None, asyncio.get_running_loop().create_future(), values={},
        )  # fmt: skip
        session.offer(1, "event 1")
        session.offer_values((1, "housekeeping"), "values 1")
        session.offer_values((1, "detections"), "values of detections")
        task = asyncio.create_task(session.send_offered(0))
        while "values of detections" not in sent:
            await asyncio.sleep(0)
        task.cancel()

    with ThreadPoolExecutor(1) as pool:
        pool.submit(asyncio.run, run()).result()
    assert sent == ["event 1", "event 2", "event 3", "values 3", "values of detections"]


@mark.parametrize("query", ["values=maybe", "values=true&values=true", "value=true"])
def test_an_invalid_query_is_refused(client, query):
    with raises((WebSocketDisconnect, WebSocketDenialResponse)):
        client.websocket_connect(f"{LIVE}?{query}").__enter__()
