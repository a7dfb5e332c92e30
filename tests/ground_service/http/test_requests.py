"""Invalid, ambiguous and too large requests are refused first; errors and logs contain what is public."""

import asyncio
import json
import logging
import logging.config
import os
import stat
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import get_args

from fastapi.routing import APIRoute
from pydantic import BaseModel
from pytest import fixture, mark, raises
from starlette.requests import ClientDisconnect

from ground_service import logs
from ground_service.app import create_app
from ground_service.errors import DatabaseUnavailable, FileDamaged, StorageFull, StorageReadOnly
from ground_service.ground import open_ground
from ground_service.http import limits
from ground_service.http.limits import BodyLimit
from ground_service.http.requests import parse_json
from ground_service.logs import JsonFormatter, logging_config
from ground_service.missions.timekeeping.model import ReceptionIn, TimePointIn
from ground_service.planning.model import WindowIn
from ground_service.regression.routes import RegressionRequest
from ground_service.settings import Settings
from tests.ground_service.conftest import cells
from tests.serving import TestClient, WebSocketDenialResponse

V1 = "/api/v1"
JSON = {"Content-Type": "application/json"}


@fixture(scope="module")
def client(tmp_path_factory):
    """An empty service."""
    settings = Settings(home=tmp_path_factory.mktemp("requests"))
    with TestClient(create_app(settings, inline_jobs=True), raise_server_exceptions=False) as opened:
        yield opened


def detail(answer, status):
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    return str(answer.json()["detail"])


@mark.parametrize("query", ["kind=%00", "kind=a%0Ab", "kind=%1b[31m", "kind=%7f", "kind=%C2%85", "%00=1"])
def test_control_characters_in_a_query_are_refused(client, query):
    assert detail(client.get(f"{V1}/jobs?{query}"), 422).startswith("query: expected no control characters")


def test_control_characters_in_a_path_are_refused(client):
    assert detail(client.get(f"{V1}/passes/1/telemetry/a%00b"), 422).startswith("path: expected no control")


UNKNOWN = """
limti=5 | expected 'limit', found 'limti'
kinds=report | expected 'kind', found 'kinds'
x=1 | expected one of kind, limit, offset, found 'x'
limit=5&__= | found '__'
"""


@mark.parametrize("query, words", cells(UNKNOWN))
def test_an_unknown_query_key_is_refused_with_the_nearest_known(client, query, words):
    assert words in detail(client.get(f"{V1}/jobs?{query}"), 422)


REPEATED = """
/jobs?limit=5&limit=6 | query: expected 'limit' once, found it 2 times
/jobs?limit=5&kind=a&limit=5&limit=5 | query: expected 'limit' once, found it 3 times
/passes/1/states?value=mode&max_points=5&max_points=5 | query: expected 'max_points' once
"""


@mark.parametrize("path, words", cells(REPEATED))
def test_a_query_key_with_one_value_is_taken_once(client, path, words):
    assert words in detail(client.get(V1 + path), 422)


def test_a_query_key_with_a_list_of_values_is_taken_several_times(client):
    answer = client.get(f"{V1}/passes/1/states?value=nis&value=matched")
    assert "once" not in detail(answer, 404)


@mark.parametrize("path", ["live?afer=1", "live?after=1&after=2", "payload?after=1"])
def test_a_websocket_refuses_query_keys_it_does_not_know(client, path):
    with raises(WebSocketDenialResponse) as refusal, client.websocket_connect(f"{V1}/{path}"):
        pass
    assert "expected" in detail(refusal.value, 422)


def test_known_query_keys_are_taken(client):
    assert client.get(f"{V1}/jobs?kind=report&limit=5&offset=0").status_code == 200
    assert "expected one of none" in detail(client.get(f"{V1}/links?limit=1"), 422)


AMBIGUOUS = r"""
{"name": "x", "cadence_s": NaN} | found NaN
{"name": "x", "cadence_s": -Infinity} | found -Infinity
{"name": "x", "cadence_s": 1e400} | found 1e400
{"name": "a\u0000b"} | without NUL
{"a\u0000b": 1} | without NUL
{"name": ["\ud800"]} | lone surrogates
{"name": "x", "name": "y"} | found a duplicate
"""


@mark.parametrize("body, words", cells(AMBIGUOUS))
def test_json_with_no_or_two_meanings_is_refused(client, body, words):
    for path in "/windows", "/telecommands", "/passes", "/requests":
        assert words in detail(client.post(f"{V1}{path}", content=body, headers=JSON), 422)


def test_ordinary_json_is_read_as_it_stands():
    assert parse_json(b'{"a": [1, 2.5, "\\u00e4\\ud83d\\ude00 \\\\u0000", null, true]}') == {
        "a": [1, 2.5, "ä😀 \\u0000", None, True]
    }


def models_in(annotation):
    """The models that a value of this type consists of."""
    for inner in get_args(annotation):
        yield from models_in(inner)
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
        for field in annotation.model_fields.values():
            yield from models_in(field.annotation)


def test_no_request_model_takes_a_value_of_one_type_for_another(client):
    routes = client.app.state.operations
    bodies = [body for route in routes if isinstance(route, APIRoute) for body in route.dependant.body_params]
    models = {model for body in bodies for model in models_in(body.field_info.annotation)}
    assert {TimePointIn, ReceptionIn, WindowIn, RegressionRequest} <= models
    lax = [model.__name__ for model in models if not model.model_config.get("strict")]
    assert lax == []


METHODS = """
DELETE | /passes | GET, POST
PUT | /windows/1 | DELETE, GET, PATCH
GET | /uplink | POST
"""


@mark.parametrize("method, path, allowed", cells(METHODS))
def test_a_method_that_is_not_allowed_is_answered_with_those_that_are(client, method, path, allowed):
    answer = client.request(method, V1 + path)
    assert detail(answer, 405)
    assert answer.headers["Allow"] == allowed


@mark.parametrize(
    "error",
    [
        DatabaseUnavailable("postgresql+psycopg://linna:***@db.internal:5432/linna", "server closed"),
        StorageFull("/var/lib/linna/files"),
        StorageReadOnly("/var/lib/linna/files"),
        FileDamaged(Path("/var/lib/linna/files/ab/abcd"), "ab", "cd"),
    ],
)
def test_errors_of_the_store_name_no_place_and_carry_the_id_of_the_log_entry(client, error, monkeypatch, caplog):
    def fail(*_, **__):
        raise error

    monkeypatch.setattr("ground_service.store.repository.page", fail)
    answer = client.get(f"{V1}/jobs", headers={"X-Request-ID": "r-1"})
    assert answer.status_code in (503, 507)
    assert answer.json()["request_id"] == "r-1"
    for secret in "postgresql", "db.internal", "/var", "linna/files":
        assert secret not in answer.text
    assert str(error) in caplog.text


def test_the_home_and_its_files_are_the_owners_alone(tmp_path):
    home = tmp_path / "home"
    home.mkdir()
    home.chmod(0o755)
    before = os.umask(0o022)
    try:
        with open_ground(home) as ground:
            stored = ground.files.put_octets(b"x")
    finally:
        os.umask(before)
    (home / "linna.db").chmod(0o644)
    with open_ground(home):
        modes = {path: stat.S_IMODE(path.stat().st_mode) for path in (home, home / "linna.db", stored.path)}
    assert list(modes.values()) == [0o700, 0o600, 0o400]


class Bodies:
    """Requests to a guarded application that reads bodies; the test sends each body in parts."""

    def __init__(self):
        self.guard = BodyLimit(self._read, upload_paths=("/upload",), upload_limit_octets=1 << 20)

    async def _read(self, _scope, receive, send):
        while True:
            message = await receive()
            if message["type"] == "http.disconnect":
                raise ClientDisconnect
            if not message.get("more_body"):
                break
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await send({"type": "http.response.body", "body": b""})

    def ask(self, path="/x"):
        """Start a request; the queue takes the parts of its body, and whether more follow."""
        parts = asyncio.Queue()
        started = []

        async def receive():
            body, more = await parts.get()
            return {"type": "http.request", "body": body, "more_body": more}

        async def send(message):
            if message["type"] == "http.response.start":
                started.append((message["status"], dict(message["headers"]).get(b"retry-after")))

        async def run():
            scope = {"type": "http", "method": "POST", "path": path, "headers": [], "state": {}}
            await self.guard(scope, receive, send)
            return started[0]

        return parts, asyncio.create_task(run())


def test_bodies_of_all_requests_together_are_held_within_one_budget(monkeypatch):
    monkeypatch.setattr(limits, "HELD_LIMIT_OCTETS", 1000)

    async def test():
        bodies = Bodies()
        first_parts, first = bodies.ask()
        first_parts.put_nowait((b"x" * 600, True))
        await asyncio.sleep(0.01)
        upload_parts, upload = bodies.ask("/upload")  # is streamed to the archive and not counted
        upload_parts.put_nowait((b"x" * 5000, False))
        assert await upload == (200, None)
        parts, second = bodies.ask()
        parts.put_nowait((b"x" * 401, False))
        assert await second == (503, b"1")
        parts, third = bodies.ask()
        parts.put_nowait((b"x" * 400, False))
        assert await third == (200, None)
        first_parts.put_nowait((b"", False))
        assert await first == (200, None)
        parts, after = bodies.ask()
        parts.put_nowait((b"x" * 1000, False))
        assert await after == (200, None)

    with ThreadPoolExecutor(1) as pool:
        pool.submit(asyncio.run, test()).result()


def test_a_log_entry_is_one_json_object_with_what_was_passed():
    try:
        raise ValueError("broken")
    except ValueError:
        record = logging.LogRecord("linna", logging.ERROR, "f.py", 1, "job %s\nfailed", ("7",), sys.exc_info())
    record.job = "7"
    assert "trace_id" not in json.loads(JsonFormatter().format(record))
    with logs.span("request"):
        line, trace_id = JsonFormatter().format(record), logs.trace_id()
    assert "\n" not in line and trace_id is not None
    entry = json.loads(line)
    assert (entry["level"], entry["message"], entry["job"]) == ("error", "job 7\nfailed", "7")
    assert entry["trace_id"] == trace_id
    assert "ValueError: broken" in entry["trace"]
    assert entry["time"].endswith("+00:00")
    for style in "text", "json":
        logging.config.DictConfigurator(logging_config(style))


@mark.parametrize("style", ["text", "json"])
def test_what_a_client_sent_makes_neither_a_line_nor_a_terminal_sequence(style):
    """A path is decoded before it is logged: `GET /%0a2026-01-01 INFO forged`."""
    configuration = logging.config.DictConfigurator(logging_config(style))
    formatter = configuration.configure_formatter(configuration.config["formatters"]["line"])
    forged = "/x\n2026-01-01 INFO forged\r\x1b[2J\x7f\x9b31m\u2028"
    try:
        raise ValueError(forged)
    except ValueError:
        record = logging.LogRecord("linna", logging.INFO, "f.py", 1, "GET %s", (forged,), sys.exc_info())
    lines = formatter.format(record).split("\n")
    assert all(line.isprintable() for line in lines)
    assert not any(line.startswith("2026-01-01 INFO forged") for line in lines[:-1])


def test_addresses_of_webhooks_are_not_logged():
    """The HTTP client logs the address of each request at the level INFO."""
    assert logging_config("json")["loggers"]["httpx"]["level"] == "WARNING"
