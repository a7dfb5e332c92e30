"""Front process: health checks are answered at any load of the server, other connections are passed on unchanged."""

import mmap
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

import ground_service
from ground_service.http import front
from ground_service.http.front import HEARTBEAT, STALE_S

PATIENCE_S = 60.0
HEALTH = b"GET /healthz HTTP/1.1\r\nHost: a\r\n\r\n"
OTHER = b"GET /readyz HTTP/1.1\r\nHost: a\r\n\r\n"


class Front:
    """Front process with this test as the server."""

    def __init__(self) -> None:
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.channel, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        self.channel.settimeout(PATIENCE_S)
        descriptor = os.memfd_create("heartbeat")
        os.ftruncate(descriptor, HEARTBEAT.size)
        self.heartbeat = mmap.mmap(descriptor, HEARTBEAT.size)
        self.beat()
        passed = [self.listener.fileno(), theirs.fileno(), descriptor]
        root = Path(ground_service.__file__).resolve().parent.parent
        self.process = subprocess.Popen(
            [sys.executable, "-m", front.__name__, *map(str, passed)], pass_fds=passed, cwd=root
        )
        theirs.close()
        os.close(descriptor)

    def beat(self, age_s: float = 0.0) -> None:
        HEARTBEAT.pack_into(self.heartbeat, 0, time.monotonic() - age_s)

    def connect(self, octets: bytes = b"") -> socket.socket:
        client = socket.create_connection(self.listener.getsockname(), PATIENCE_S)
        client.sendall(octets)
        return client

    def handed(self) -> socket.socket:
        """Return the next connection that is passed on."""
        message, descriptors, _, _ = socket.recv_fds(self.channel, 1, 1)
        assert message == b"c"
        client = socket.socket(fileno=descriptors[0])
        client.settimeout(PATIENCE_S)
        return client

    def close(self) -> None:
        self.channel.close()
        self.listener.close()
        self.process.wait(PATIENCE_S)


@pytest.fixture
def fronted() -> Iterator[Front]:
    made = Front()
    yield made
    made.close()


def answer(client: socket.socket) -> bytes:
    """Return all octets of a connection until its end."""
    with client, client.makefile("rb") as stream:
        return stream.read()


def test_health_is_answered_while_the_server_takes_no_connection(fronted: Front) -> None:
    held = [
        fronted.connect(OTHER) for _ in range(700)
    ]  # more connections than the channel to the server can hold
    for request in (HEALTH, HEALTH.replace(b"healthz", b"healthz?x=1")):
        told = answer(fronted.connect(request))
        assert told.startswith(b"HTTP/1.1 200 OK\r\n") and told.endswith(b'\r\n\r\n{"status":"ok"}')
    taken = [fronted.handed() for _ in held]
    assert {client.recv(100) for client in taken} == {OTHER}
    for client in (*held, *taken):
        client.close()


def test_a_server_whose_loop_has_stopped_is_not_healthy(fronted: Front) -> None:
    fronted.beat(age_s=STALE_S + 1.0)
    told = answer(fronted.connect(HEALTH))
    assert told.startswith(b"HTTP/1.1 503 ") and b"application/problem+json" in told
    fronted.beat()
    assert answer(fronted.connect(HEALTH)).startswith(b"HTTP/1.1 200 ")


@pytest.mark.parametrize(
    "octets", [OTHER, b"GET /healthzz HTTP/1.1\r\n", b"POST /healthz HTTP/1.1\r\n", b"G", b"GET /hea"]
)
def test_what_is_not_a_request_for_health_is_handed_over_with_every_octet(
    fronted: Front, octets: bytes
) -> None:
    client = fronted.connect(octets)
    with fronted.handed() as taken:
        assert taken.recv(100, socket.MSG_PEEK) == octets
        client.sendall(b"more")
        client.shutdown(socket.SHUT_WR)
        with taken.makefile("rb") as stream:
            assert stream.read() == octets + b"more"
        taken.sendall(b"answer")
    assert answer(client) == b"answer"


def test_a_client_that_sends_nothing_is_the_servers_to_wait_for(fronted: Front) -> None:
    with fronted.connect() as client, fronted.handed() as taken:
        client.sendall(b"late")
        assert taken.recv(100) == b"late"


def test_a_beginning_of_a_request_for_health_is_not_looked_at_again_and_again() -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
    with socket.create_server(("127.0.0.1", 0)) as listener, ours, theirs:
        theirs.setblocking(False)
        made = front.Front(listener, theirs, mmap.mmap(-1, HEARTBEAT.size))
        with socket.create_connection(listener.getsockname()) as client:
            client.sendall(HEALTH[:8])
            listener.setblocking(False)
            made._accept()
            assert made._waiting == {}
            _, (descriptor,), _, _ = socket.recv_fds(ours, 1, 1)
            os.close(descriptor)


def test_the_process_ends_with_the_server(fronted: Front) -> None:
    assert answer(fronted.connect(HEALTH))
    fronted.channel.close()
    assert fronted.process.wait(PATIENCE_S) == 0
