"""Invalid and ambiguous requests are refused before the operations; errors contain only public information."""

import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import pytest
from fastapi.routing import APIRoute
from pydantic import BaseModel

from ground_service.app import create_app
from ground_service.errors import DatabaseUnavailable, FileDamaged, StorageFull, StorageReadOnly
from ground_service.ground import open_ground
from ground_service.http.requests import parse_json
from ground_service.missions.timekeeping.model import ReceptionIn, TimePointIn
from ground_service.planning.model import WindowIn
from ground_service.regression.routes import RegressionRequest
from ground_service.settings import Settings
from tests.serving import TestClient, WebSocketDenialResponse

V1 = "/api/v1"
JSON = {"Content-Type": "application/json"}


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    """An empty service."""
    settings = Settings(home=tmp_path_factory.mktemp("requests"))
    with TestClient(create_app(settings, inline_jobs=True), raise_server_exceptions=False) as opened:
        yield opened


def detail(answer: Any, status: int) -> str:
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    return str(answer.json()["detail"])


@pytest.mark.parametrize(
    "query", ["kind=%00", "kind=a%0Ab", "kind=%1b[31m", "kind=%7f", "kind=%C2%85", "%00=1"]
)
def test_control_characters_in_a_query_are_refused(client: TestClient, query: str) -> None:
    assert detail(client.get(f"{V1}/jobs?{query}"), 422).startswith("query: expected no control characters")


def test_control_characters_in_a_path_are_refused(client: TestClient) -> None:
    assert detail(client.get(f"{V1}/passes/1/telemetry/a%00b"), 422).startswith("path: expected no control")


@pytest.mark.parametrize(
    ("query", "words"),
    [
        ("limti=5", "expected 'limit', found 'limti'"),
        ("kinds=report", "expected 'kind', found 'kinds'"),
        ("x=1", "expected one of kind, limit, offset, found 'x'"),
        ("limit=5&__=", "found '__'"),
    ],
)
def test_an_unknown_query_key_is_refused_with_the_nearest_known(
    client: TestClient, query: str, words: str
) -> None:
    assert words in detail(client.get(f"{V1}/jobs?{query}"), 422)


@pytest.mark.parametrize(
    ("path", "words"),
    [
        ("/jobs?limit=5&limit=6", "query: expected 'limit' once, found it 2 times"),
        ("/jobs?limit=5&kind=a&limit=5&limit=5", "query: expected 'limit' once, found it 3 times"),
        ("/passes/1/states?value=mode&max_points=5&max_points=5", "query: expected 'max_points' once"),
    ],
)
def test_a_query_key_with_one_value_is_taken_once(client: TestClient, path: str, words: str) -> None:
    assert words in detail(client.get(V1 + path), 422)


def test_a_query_key_with_a_list_of_values_is_taken_several_times(client: TestClient) -> None:
    answer = client.get(f"{V1}/passes/1/states?value=nis&value=matched")
    assert "once" not in detail(answer, 404)


@pytest.mark.parametrize("path", ["live?afer=1", "live?after=1&after=2", "payload?after=1"])
def test_a_websocket_refuses_query_keys_it_does_not_know(client: TestClient, path: str) -> None:
    with pytest.raises(WebSocketDenialResponse) as refusal, client.websocket_connect(f"{V1}/{path}"):
        pass
    assert "expected" in detail(refusal.value, 422)


def test_known_query_keys_are_taken(client: TestClient) -> None:
    assert client.get(f"{V1}/jobs?kind=report&limit=5&offset=0").status_code == 200
    assert "expected one of none" in detail(client.get(f"{V1}/links?limit=1"), 422)


@pytest.mark.parametrize(
    ("body", "words"),
    [
        (b'{"name": "x", "cadence_s": NaN}', "found NaN"),
        (b'{"name": "x", "cadence_s": -Infinity}', "found -Infinity"),
        (b'{"name": "x", "cadence_s": 1e400}', "found 1e400"),
        (b'{"name": "a\\u0000b"}', "without NUL"),
        (b'{"a\\u0000b": 1}', "without NUL"),
        (b'{"name": ["\\ud800"]}', "lone surrogates"),
        (b'{"name": "x", "name": "y"}', "found a duplicate"),
    ],
)
def test_json_with_no_or_two_meanings_is_refused(client: TestClient, body: bytes, words: str) -> None:
    for path in ("/windows", "/telecommands", "/passes", "/requests"):
        assert words in detail(client.post(f"{V1}{path}", content=body, headers=JSON), 422)


def test_ordinary_json_is_read_as_it_stands() -> None:
    assert parse_json(b'{"a": [1, 2.5, "\\u00e4\\ud83d\\ude00 \\\\u0000", null, true]}') == {
        "a": [1, 2.5, "ä😀 \\u0000", None, True]
    }


def models_in(annotation: Any) -> Iterator[type[BaseModel]]:
    """The models that a value of this type consists of."""
    for inner in get_args(annotation):
        yield from models_in(inner)
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
        for field in annotation.model_fields.values():
            yield from models_in(field.annotation)


def test_no_request_model_takes_a_value_of_one_type_for_another(client: TestClient) -> None:
    routes = client.app.state.operations
    bodies = [body for route in routes if isinstance(route, APIRoute) for body in route.dependant.body_params]
    models = {model for body in bodies for model in models_in(body.field_info.annotation)}
    assert {TimePointIn, ReceptionIn, WindowIn, RegressionRequest} <= models
    lax = [model.__name__ for model in models if not model.model_config.get("strict")]
    assert lax == []


@pytest.mark.parametrize(
    ("method", "path", "allowed"),
    [
        ("DELETE", "/passes", "GET, POST"),
        ("PUT", "/windows/1", "DELETE, GET, PATCH"),
        ("GET", "/uplink", "POST"),
    ],
)
def test_a_method_that_is_not_allowed_is_answered_with_those_that_are(
    client: TestClient, method: str, path: str, allowed: str
) -> None:
    answer = client.request(method, V1 + path)
    assert detail(answer, 405)
    assert answer.headers["Allow"] == allowed


@pytest.mark.parametrize(
    "error",
    [
        DatabaseUnavailable("postgresql+psycopg://linna:***@db.internal:5432/linna", "server closed"),
        StorageFull("/var/lib/linna/files"),
        StorageReadOnly("/var/lib/linna/files"),
        FileDamaged(Path("/var/lib/linna/files/ab/abcd"), "ab", "cd"),
    ],
)
def test_errors_of_the_store_name_no_place_and_carry_the_id_of_the_log_entry(
    client: TestClient, error: Exception, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(*_: Any, **__: Any) -> Any:
        raise error

    monkeypatch.setattr("ground_service.store.repository.page", fail)
    answer = client.get(f"{V1}/jobs", headers={"X-Request-ID": "r-1"})
    assert answer.status_code in (503, 507)
    assert answer.json()["request_id"] == "r-1"
    for secret in ("postgresql", "db.internal", "/var", "linna/files"):
        assert secret not in answer.text
    assert str(error) in caplog.text


def test_the_home_and_its_files_are_the_owners_alone(tmp_path: Path) -> None:
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
