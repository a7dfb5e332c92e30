"""Waiting for a condition, and a service on a private port, for all tests."""

import threading
import time
import warnings
from contextlib import contextmanager

import uvicorn

from ground_service.access.service import add_user, authenticate
from ground_service.app import bind, create_app
from ground_service.errors import NotAuthorised
from ground_service.ground import ground_from_settings

with warnings.catch_warnings():
    # It recommends another HTTP library than the installed one; both serve it.
    warnings.simplefilter("ignore")
    from fastapi.testclient import TestClient as TestClient
    from starlette.testclient import WebSocketDenialResponse as WebSocketDenialResponse


def wait_for(reached, what):
    """Wait until a condition holds, on a loaded machine as well: only the limit of the suite ends the wait.

    `what` is among the values that the failure shows.
    """
    while not reached():
        time.sleep(0.01)


def token_valid(ground, token):
    """Return whether a token is accepted now."""
    try:
        return bool(authenticate(ground, token))
    except NotAuthorised:
        return False


@contextmanager
def served(settings, role="operator"):
    """Serve a deployment with the user ann; yield its URL and her token."""
    with ground_from_settings(settings) as ground:
        token = add_user(ground, "ann", role)
    listener = bind("127.0.0.1", 0)
    service = uvicorn.Server(uvicorn.Config(create_app(settings), log_level="error"))
    thread = threading.Thread(target=service.run, kwargs={"sockets": [listener]})
    thread.start()
    try:
        wait_for(lambda: service.started or not thread.is_alive(), "the server")
        yield f"http://127.0.0.1:{listener.getsockname()[1]}", token
    finally:
        service.should_exit = True
        thread.join()
        listener.close()
