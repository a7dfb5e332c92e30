"""Live feed of several API processes: PostgreSQL holds the events, Redis carries the wake-ups."""

import asyncio
import threading
from concurrent.futures import ThreadPoolExecutor
from unittest.mock import MagicMock

from pytest import fixture

from benchmarks._servers import Deployment
from ground_service.app import create_app
from ground_service.settings import Settings
from ground_service.store import leases
from ground_service.web import sockets
from tests.ground_service.contacts.links.conftest import HEAD, Station
from tests.ground_service.web.test_displays import ask as fetch
from tests.serving import TestClient, wait_for
from tmtc.dictionary.payload import DICTIONARY
from tmtc.downlink import encode_cadus

NEVER_S = 3600.0
LIVE = "/api/v1/live?values=true"


@fixture
def server_url(migrated_postgres):
    """An empty PostgreSQL database with the schema."""
    return migrated_postgres()


def ask(port, path, body=None):
    return fetch(f"http://127.0.0.1:{port}/api/v1/{path}", body)


def housekeeping(second, **values):
    fields = {field.name: 0 for field in DICTIONARY.packet("housekeeping").fields}
    packet = DICTIONARY.pack(
        "housekeeping", fields | values | {"structure_id": 1}, ticks=(900_000_000 + second) * 65_536,
        sequence_count=second,
    )  # fmt: skip
    return encode_cadus([packet], spacecraft_id=76)


def keep_sending(connection, stop):
    """Send a packet each tenth of a second, from second 23."""
    second = 23
    while not stop.wait(0.1):
        connection.sendall(housekeeping(second, temperature_c=float(second)))
        second += 1


def temperature_after(socket):
    """Return the temperature of the next message with values."""
    while (message := socket.receive_json())["kind"] != "values":
        pass
    (value,) = (one["value"] for one in message["payload"]["values"] if one["name"] == "temperature_c")
    return float(value)


@fixture
def other(tmp_path, server_url, monkeypatch):
    """An API process A with links, and the client of an API B in this process, which never polls."""
    monkeypatch.setattr(sockets, "POLL_S", NEVER_S)
    monkeypatch.setattr(leases, "RETRY_S", 0.1)
    with Deployment(tmp_path, url=server_url) as processes:
        settings = Settings(
            home=processes.home, database_url=server_url, broker_url=processes.broker_url, links=False,
        )  # fmt: skip
        with TestClient(create_app(settings)) as client:
            yield processes, client


def test_telemetry_received_by_one_process_is_shown_by_the_other_through_a_restart_of_redis(other, monkeypatch):
    processes, client = other
    log = MagicMock()
    monkeypatch.setattr(leases, "log", log)
    station = Station()
    try:
        with client.websocket_connect(LIVE) as socket:
            status, body, _ = ask(processes.ports[0], "missions", (HEAD + station.link()).encode())
            assert status == 201, body
            connection = station.accept(60.0)
            connection.sendall(housekeeping(1, temperature_c=21.0))
            assert temperature_after(socket) == 21.0  # by a wake-up: this process does not poll

            processes.parts["broker"].kill()
            wait_for(lambda: log.warning.called, "the loss of Redis is noticed")
            monkeypatch.setattr(sockets, "POLL_S", 0.1)
            client.app.state.sockets._committed.set()  # polls from now on
            connection.sendall(housekeeping(2, temperature_c=22.0))
            assert temperature_after(socket) == 22.0

            monkeypatch.setattr(sockets, "POLL_S", NEVER_S)
            processes.parts["broker"].start()
            wait_for(lambda: log.info.called, "the return of Redis is noticed")
            # The process that receives tries Redis again some time after its last attempt.
            stop = threading.Event()
            sender = threading.Thread(target=keep_sending, args=(connection, stop))
            sender.start()
            try:
                assert temperature_after(socket) >= 23.0
            finally:
                stop.set()
                sender.join()
        history = client.get(
            "/api/v1/spacecraft/76/telemetry/temperature_c",
            params={"start": "1998-01-01T00:00:00Z", "stop": "2040-01-01T00:00:00Z", "max_points": 1000},
        ).json()
        assert {21.0, 22.0} <= {one["mean"] for one in history["buckets"]}
    finally:
        station.close()


def test_a_wake_up_of_another_process_is_received_and_an_own_one_is_not(redis_url):
    received = []
    connected, woken = threading.Event(), threading.Event()

    def wake():
        (woken if connected.is_set() else connected).set()
        received.append("wake")

    async def run():
        task = asyncio.create_task(leases.listen(redis_url, wake))
        assert await asyncio.to_thread(connected.wait, 60.0)
        leases.Waker(redis_url)(frozenset({"telemetry"}))
        leases.Waker(redis_url, b"another process")(frozenset({"telemetry"}))
        assert await asyncio.to_thread(woken.wait, 60.0)
        task.cancel()

    with ThreadPoolExecutor(1) as pool:
        pool.submit(asyncio.run, run()).result()
    assert received == ["wake", "wake"]


def test_an_unavailable_broker_is_reported_once_and_not_asked_at_each_commit(monkeypatch):
    log = MagicMock()
    monkeypatch.setattr(leases, "log", log)
    waker = leases.Waker("redis://127.0.0.1:1/0")
    for _ in range(3):
        waker(frozenset({"telemetry"}))
    assert log.warning.call_count == 1
    client = MagicMock()
    waker._client = client
    waker(frozenset({"telemetry"}))
    assert not client.publish.called
    monkeypatch.setattr(leases.time, "monotonic", lambda: float("inf"))
    waker(frozenset({"telemetry"}))
    assert client.publish.call_count == 1 and log.info.call_count == 1
