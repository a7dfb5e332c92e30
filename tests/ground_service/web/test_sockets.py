"""WebSockets: closed after loss of authorisation, limited in number, and served from one feed."""

import asyncio
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from starlette.websockets import WebSocketDisconnect

from ground_service.access import service as users
from ground_service.app import create_app
from ground_service.settings import Settings
from ground_service.store.events import publish
from ground_service.web import sockets

with warnings.catch_warnings():
    # It recommends another HTTP library than the installed one; both serve it.
    warnings.simplefilter("ignore")
    from fastapi.testclient import TestClient

LIVE = "/api/v1/live"


@pytest.fixture
def client(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[TestClient]:
    """Service with limits of three sockets per caller and five in total, which verifies callers immediately."""
    monkeypatch.setattr(sockets, "VERIFY_S", 0.05)
    monkeypatch.setattr(sockets, "POLL_S", 0.05)
    settings = Settings(home=tmp_path, sockets_per_user=3, sockets=5)
    with TestClient(create_app(settings, inline_jobs=True)) as opened:
        yield opened


def ground_of(client: TestClient) -> Any:
    return client.app.state.ground


def bearer(token: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {token}"}


def say(ground: Any, number: int) -> None:
    with ground.database.writing() as connection:
        publish(connection, "test", {"number": number})


def closing_code(socket: Any) -> int:
    """Return the close code of a socket; skip earlier messages."""
    with pytest.raises(WebSocketDisconnect) as closed:
        while True:
            socket.receive_text()
    return int(closed.value.code)


def disable(ground: Any, name: str) -> None:
    users.change_user(ground, name, state="disabled")


def revoke(ground: Any, name: str) -> None:
    (token,) = users.list_tokens(ground, name)
    users.revoke_token(ground, token.id)


def renew(ground: Any, name: str) -> None:
    users.renew_token(ground, name)


@pytest.mark.parametrize("path", [LIVE, "/api/v1/payload"])
@pytest.mark.parametrize("end", [disable, revoke, renew])
def test_a_socket_ends_with_the_right_to_hold_it(
    client: TestClient, end: Callable[[Any, str], None], path: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def hold(session: Any) -> None:
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
    with pytest.raises(WebSocketDisconnect), client.websocket_connect(path, headers=bearer(token)):
        pass


def test_a_socket_without_a_token_ends_when_the_service_gets_users(client: TestClient) -> None:
    with client.websocket_connect(LIVE) as socket:
        users.add_user(ground_of(client), "ada", "admin")
        assert closing_code(socket) == sockets.POLICY_VIOLATION


def test_a_token_that_expires_ends_its_socket(client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    token = users.add_user(ground_of(client), "vera", "viewer", days_valid=1.0)
    with client.websocket_connect(LIVE, headers=bearer(token)) as socket:
        later = users.utc_now_ns() + 2 * 86_400 * 10**9
        monkeypatch.setattr(users, "utc_now_ns", lambda: later)
        assert closing_code(socket) == sockets.POLICY_VIOLATION


def test_an_operator_who_becomes_a_viewer_may_no_longer_steer(
    client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    roles: list[str] = []

    async def watch_role(session: Any) -> None:
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


def refused(client: TestClient, token: str | None) -> bool:
    from starlette.testclient import WebSocketDenialResponse

    headers = bearer(token) if token else {}
    try:
        with client.websocket_connect(LIVE, headers=headers):
            return False
    except WebSocketDenialResponse as refusal:
        assert refusal.status_code == 429 and refusal.json()["title"] == "too many sockets"
        return True


def test_sockets_are_limited_for_a_user_and_in_all(client: TestClient) -> None:
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


def test_the_feed_is_read_once_for_all_sockets(client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    reads = 0
    read_events = sockets.read_events

    def counted(*arguments: Any) -> Any:
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


def test_a_client_that_comes_back_gets_what_it_missed_once_and_in_order(
    client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
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


def test_a_client_that_reads_too_slowly_is_closed_and_may_come_back(
    client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    ground = ground_of(client)
    with client.websocket_connect(LIVE) as socket:
        hub = client.app.state.sockets
        until = time.monotonic() + 30.0
        while not hub._readers and time.monotonic() < until:
            time.sleep(0.01)
        (session,) = hub._readers
        session.messages._maxsize = 2

        async def stuck(_text: str) -> None:
            await asyncio.sleep(60.0)

        session.socket.send_text = stuck
        for number in range(8):
            say(ground, number)
        assert closing_code(socket) == sockets.TRY_AGAIN_LATER
