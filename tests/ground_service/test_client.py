"""Client of the HTTP interface with a busy server: repeated requests, their duration, and their limits."""

import json
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from ground_service import client as client_module
from ground_service.client import BUSY_S, Client, ServiceProblem

EPHEMERIS = {"id": 1}


class Clock:
    """Clock of the client, which advances during sleep."""

    def __init__(self) -> None:
        self.now = 0.0
        self.slept: list[float] = []

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.slept.append(seconds)
        self.now += seconds


class Service:
    """Server with prepared responses, of which the last one is repeated; it records the received bodies."""

    def __init__(self) -> None:
        self.answers: list[tuple[int, dict[str, str]]] = []
        self.bodies: list[bytes] = []
        service = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                service.bodies.append(self.rfile.read(int(self.headers.get("Content-Length", "0"))))
                status, headers = service.answers[min(len(service.bodies), len(service.answers)) - 1]
                body = json.dumps(EPHEMERIS if status < 300 else {"detail": "busy now"}).encode()
                self.send_response(status)
                for name, value in headers.items():
                    self.send_header(name, value)
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, *_: Any) -> None:
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.thread = threading.Thread(target=self.server.serve_forever)
        self.thread.start()
        self.url = f"http://127.0.0.1:{self.server.server_address[1]}"


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(client_module, "time", made)
    return made


@pytest.fixture
def service() -> Iterator[Service]:
    made = Service()
    yield made
    made.server.shutdown()
    made.server.server_close()
    made.thread.join()


@pytest.fixture
def body(tmp_path: Path) -> Path:
    path = tmp_path / "reference.oem"
    path.write_bytes(b"octets " * 1000)
    return path


def test_an_upload_that_finds_the_service_busy_is_sent_again_whole(
    service: Service, clock: Clock, body: Path
) -> None:
    service.answers = [(503, {"Retry-After": "1"}), (503, {"Retry-After": "3"}), (201, {})]
    assert Client(service.url).add_ephemeris(body) == EPHEMERIS
    assert clock.slept == [1.0, 3.0]
    assert service.bodies == [body.read_bytes()] * 3


def test_a_service_that_stays_busy_is_given_up_in_its_own_words(
    service: Service, clock: Clock, body: Path
) -> None:
    service.answers = [(503, {"Retry-After": "600"})]
    with pytest.raises(ServiceProblem, match="busy now") as caught:
        Client(service.url).add_ephemeris(body)
    assert caught.value.status == 503
    assert clock.slept == [10.0] * int(BUSY_S / 10.0)  # it waits 10 s at most, however long it is asked to


@pytest.mark.parametrize(
    "answer", [(503, {}), (503, {"Retry-After": "soon"}), (500, {"Retry-After": "1"}), (409, {}), (429, {})]
)
def test_what_is_no_invitation_to_come_again_is_told_at_once(
    service: Service, clock: Clock, body: Path, answer: tuple[int, dict[str, str]]
) -> None:
    service.answers = [answer]
    with pytest.raises(ServiceProblem) as caught:
        Client(service.url).add_ephemeris(body)
    assert caught.value.status == answer[0]
    assert (len(service.bodies), clock.slept) == (1, [])
