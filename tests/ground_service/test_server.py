"""Starting the server: what is imported, and the addresses that are refused in one line."""

import contextlib
import os
import socket
import subprocess
import sys
from pathlib import Path

import httpx
import pytest

from ground_service.access.service import add_user
from ground_service.errors import ServerError
from ground_service.ground import open_ground
from ground_service.server import bind, serve
from ground_service.settings import Settings
from studies.mission_run.parts import listens
from tests.ground_service.conftest import free_port, wait_for


def test_a_port_in_use_is_one_clear_line(tmp_path: Path) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(
            ServerError, match=f"port {port}: is in use by another program; choose another with --port"
        ):
            serve(Settings(home=tmp_path, port=port))


def test_an_address_of_another_machine_cannot_be_bound() -> None:
    with pytest.raises(ServerError, match="cannot be bound"):
        bind("192.0.2.1", 0)


def test_binding_beyond_this_machine_needs_users(tmp_path: Path) -> None:
    with pytest.raises(ServerError, match=r"0\.0\.0\.0: expected users before binding beyond this machine"):
        serve(Settings(home=tmp_path, host="0.0.0.0", port=0))


def test_beyond_this_machine_it_asks_for_a_proxy_and_limits_connections(tmp_path: Path) -> None:
    with open_ground(tmp_path) as ground:
        add_user(ground, "ann", "admin")
    port = free_port()
    process = subprocess.Popen(
        [sys.executable, "-m", "linna", "serve", "--host", "0.0.0.0", "--port", str(port)],
        env={**os.environ, "LINNA_HOME": str(tmp_path), "LINNA_CONNECTIONS": "16"},
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stderr is not None
        assert any("a reverse proxy must limit" in line for line in process.stderr)
        url = f"http://127.0.0.1:{port}/readyz"
        wait_for(lambda: listens(port) and httpx.get(url).status_code == 200, "the service", 60.0)
        with contextlib.ExitStack() as held:
            for _ in range(20):
                held.enter_context(socket.create_connection(("127.0.0.1", port)))
            wait_for(lambda: httpx.get(url).status_code == 503, "the limit of connections", 10.0)
        wait_for(lambda: httpx.get(url).status_code == 200, "room for others", 10.0)
    finally:
        process.terminate()
        process.communicate()


def test_the_listener_names_its_protocol_so_that_answers_are_not_held_back_by_nagle() -> None:
    with bind("127.0.0.1", 0) as listener:
        assert listener.proto == socket.IPPROTO_TCP


def test_the_service_starts_without_libraries_that_only_computations_need() -> None:
    code = (
        "import sys, ground_service.server; "
        "print([m for m in sys.modules if m in ('scipy', 'matplotlib', 'cv2', 'numba', 'torch', 'celery')])"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"
