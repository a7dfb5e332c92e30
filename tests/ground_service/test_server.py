"""Starting the server: what is imported, and the addresses that are refused in one line."""

import socket
import subprocess
import sys
from pathlib import Path

import pytest

from ground_service.errors import ServerError
from ground_service.server import bind, serve
from ground_service.settings import Settings


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
