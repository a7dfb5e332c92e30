"""Starting and ending the server: what is imported, refused addresses, draining."""

import contextlib
import os
import resource
import signal
import socket
import subprocess
import sys
import threading

import httpx
import uvicorn
from pydantic import BaseModel, Field, ValidationError
from pytest import mark, raises

from ground_service.access.service import add_user
from ground_service.app import _server, bind, create_app, serve
from ground_service.errors import InvalidInput, ServerError
from ground_service.ground import open_ground
from ground_service.settings import Settings
from ground_service.toml import LINE_PATTERN_JSON, require_line
from studies.harness.parts import listens
from tests.ground_service.conftest import free_port, wait_for


def test_a_port_in_use_is_one_clear_line(tmp_path):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with raises(ServerError, match=f"port {port}: is in use by another program; choose another with --port"):
            serve(Settings(home=tmp_path, port=port))


def test_an_address_of_another_machine_cannot_be_bound():
    with raises(ServerError, match="cannot be bound"):
        bind("192.0.2.1", 0)


def test_binding_beyond_this_machine_needs_users(tmp_path):
    with raises(ServerError, match=r"0\.0\.0\.0: expected users before binding beyond this machine"):
        serve(Settings(home=tmp_path, host="0.0.0.0", port=0))


def test_beyond_this_machine_it_asks_for_a_proxy_and_limits_connections(tmp_path):
    with open_ground(tmp_path) as ground:
        add_user(ground, "ann", "admin")
    port = free_port()
    process = subprocess.Popen(
        [sys.executable, "-m", "linna", "serve", "--host", "0.0.0.0", "--port", str(port)],
        env={**os.environ, "LINNA_HOME": str(tmp_path)},
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_NOFILE, (400, 400)),  # leaves 16 connections
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert any("a reverse proxy must limit" in line for line in process.stderr)
        url = f"http://127.0.0.1:{port}/readyz"
        wait_for(lambda: listens(port) and httpx.get(url).status_code == 200, "the service")
        with contextlib.ExitStack() as held:
            for _ in range(20):
                held.enter_context(socket.create_connection(("127.0.0.1", port)))
            wait_for(lambda: httpx.get(url).status_code == 503, "the limit of connections")
        wait_for(lambda: httpx.get(url).status_code == 200, "room for others")
    finally:
        process.terminate()
        process.communicate()


def test_the_listener_names_its_protocol_so_that_answers_are_not_held_back_by_nagle():
    with bind("127.0.0.1", 0) as listener:
        assert listener.proto == socket.IPPROTO_TCP


def test_the_service_starts_without_libraries_that_only_computations_need():
    code = (
        "import sys, ground_service.app; "
        "print([m for m in sys.modules if m in ('scipy', 'matplotlib', 'cv2', 'numba', 'torch', 'celery')])"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"


def test_a_terminated_server_drains_before_it_ends(tmp_path):
    """It is not ready any more, answers for the time of the draining with the end of each connection, and ends."""
    app = create_app(Settings(home=tmp_path))
    listener = bind("127.0.0.1", 0)
    url = "http://{}:{}".format(*listener.getsockname())
    listener.listen()
    server = _server(uvicorn.Config(app, log_level="error"), app.state, drain_s=1.0)
    running = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    running.start()

    def ask(path):
        answer = httpx.get(f"{url}{path}", timeout=60)
        return answer.status_code, answer.headers.get("Connection")

    wait_for(lambda: server.started or not running.is_alive(), "the server")
    assert ask("/readyz") == (200, None)
    server.handle_exit(signal.SIGTERM, None)
    assert ask("/readyz") == (503, "close")
    assert ask("/api/v1/missions") == (200, "close")
    running.join()
    with raises(httpx.ConnectError):
        ask("/readyz")


BAD = ["a\nb", "\x1b[31m", "\x00", "tab\t", "\x7f", "\x85", "\u2028", "\u202e", "\u2066"]


class Named(BaseModel):
    """A model with a name, as requests have them."""

    name: str = Field(pattern=LINE_PATTERN_JSON)


@mark.parametrize("text", ["evening pass", "Überflug 7", "\u6708 \U0001f315", "a/b: c=1"])
def test_a_printable_line_is_taken_as_it_is(text):
    assert require_line(text, "window", "name") == Named(name=text).name == text


@mark.parametrize("text", BAD)
def test_control_characters_are_refused_and_shown_by_their_codes(text):
    with raises(InvalidInput, match="window, name: expected a line of 1 to 200 characters") as refused:
        require_line(text, "window", "name")
    assert str(refused.value).isprintable()
    with raises(ValidationError):
        Named(name=text)


@mark.parametrize("text", ["", "x" * 201, "\ud800", 7, None])
def test_what_is_no_line_is_refused(text):
    with raises(InvalidInput):
        require_line(text, "pass", "name")
