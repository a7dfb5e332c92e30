"""Pages of other origins cannot read or change data through the browser of a user."""

import json
import logging

from pytest import fixture, mark, raises
from starlette.websockets import WebSocketDisconnect

from ground_service.access.service import add_user
from ground_service.app import create_app
from ground_service.errors import SettingsError
from ground_service.ground import open_ground
from ground_service.settings import Settings, load_settings
from tests.serving import TestClient

V1 = "/api/v1"
BASE = "http://127.0.0.1:8042"
OWN = {"Origin": BASE}
PING = {"name": "test_connection", "arguments": {}, "spacecraft_id": 76}


@fixture(scope="module")
def client(tmp_path_factory):
    """A service without users, as on a laptop."""
    settings = Settings(home=tmp_path_factory.mktemp("origins"), allowed_hosts=("ground.example",))
    with TestClient(create_app(settings, inline_jobs=True), base_url=BASE) as opened:
        yield opened


def refused(answer, status):
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    return bool(answer.json()["status"] == status)


@mark.parametrize(
    "host",
    ["attacker.example", "attacker.example:8042", "127.0.0.1.attacker.example", "localhost.attacker.example",
     "192.0.2.7:8042", "user@127.0.0.1", "[::2]:8042", "0.0.0.0:8042"],
)  # fmt: skip
def test_a_name_that_is_not_ours_reads_nothing(client, host):
    for path in (f"{V1}/passes", "/", "/metrics", f"{V1}/openapi.json"):
        answer = client.get(path, headers={"Host": host})
        assert answer.status_code in (400, 421), (path, answer.text)
    with raises(WebSocketDisconnect), client.websocket_connect(f"{V1}/live", headers={"Host": host}):
        pass


@mark.parametrize("host", ["127.0.0.1", "localhost:8042", "LOCALHOST.", "[::1]:8042", "[0:0::1]", "ground.example:443"])
def test_our_own_names_are_served(client, host):
    assert client.get(f"{V1}/passes", headers={"Host": host}).status_code == 200


def test_a_supervisor_may_ask_for_health_by_any_name(client):
    assert client.get("/healthz", headers={"Host": "10.1.2.3:8042"}).status_code == 200
    assert client.get("/readyz", headers={"Host": "api"}).status_code == 200


BROWSERS = """
{"Origin": "https://attacker.example"}
{"Origin": "null"}
{"Origin": "http://127.0.0.1:3000"}
{"Origin": "http://127.0.0.1"}
{"Origin": "http://localhost:8042"}
{"Origin": "file://"}
{"Sec-Fetch-Site": "cross-site"}
{"Sec-Fetch-Site": "same-site"}
{"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate", "Origin": "http://127.0.0.1:8042"}
{"Cookie": "session=1"}
{"Origin": "http://127.0.0.1:8042", "Content-Type": "text/plain"}
{"Origin": "http://127.0.0.1:8042", "Content-Type": "application/x-www-form-urlencoded; charset=utf-8"}
"""


@mark.parametrize("browser", [*map(json.loads, BROWSERS.strip().splitlines())], ids=str)
def test_a_page_of_another_origin_changes_nothing(client, browser):
    queued = client.post(f"{V1}/telecommands", json=PING).json()["id"]
    for method, path, body in (
        ("POST", f"/telecommands/{queued}/release", None),
        ("POST", "/telecommands", PING),
        ("POST", "/uplink?spacecraft_id=76", None),
        ("DELETE", "/windows/1", None),
        ("PATCH", "/windows/1", {"state": "approved"}),
    ):
        kind = {} if body is None else {"Content-Type": "application/json"}
        assert refused(client.request(method, V1 + path, json=body, headers={**kind, **browser}), 403), path
    assert client.get(f"{V1}/telecommands/{queued}").json()["state"] == "queued"
    assert refused(client.post(f"{V1}/telemetry", content=b"x", headers=browser), 403)


def test_pages_of_this_service_and_programs_may_change_what_they_like(client):
    same = {**OWN, "Sec-Fetch-Site": "same-origin", "Cookie": "other=1"}
    for headers in (same, OWN, {}, {"Sec-Fetch-Site": "none"}, {"User-Agent": "curl/8"}):
        assert client.post(f"{V1}/telecommands", json=PING, headers=headers).status_code == 201
    # What `curl --data-binary @file` sends.
    form = {"Content-Type": "application/x-www-form-urlencoded"}
    assert client.post(f"{V1}/telemetry", content=b"hello", headers=form).status_code == 202
    other = {"Host": "ground.example", "Origin": "https://ground.example"}
    assert client.post(f"{V1}/telecommands", json=PING, headers=other).status_code == 201


def test_pages_of_another_site_do_not_watch_or_read_but_may_link(client):
    for path in (f"{V1}/live", f"{V1}/payload"):
        for origin in ("https://attacker.example", "null", "http://127.0.0.1:3000"):
            headers = {"Origin": origin, "Host": "127.0.0.1:8042"}
            with raises(WebSocketDisconnect), client.websocket_connect(path, headers=headers):
                pass
    for headers in ({}, OWN):
        with client.websocket_connect(f"{V1}/live", headers={"Host": "127.0.0.1:8042", **headers}):
            pass
    cross = {"Sec-Fetch-Site": "cross-site"}
    assert refused(client.get(f"{V1}/passes", headers={**cross, "Sec-Fetch-Mode": "no-cors"}), 403)
    assert client.get("/passes", headers={**cross, "Sec-Fetch-Mode": "navigate"}).status_code == 200


@mark.parametrize(
    "proxies, client, secure",
    [(("10.0.0.0/24",), "198.51.100.4", True), (("10.0.1.0/24",), "10.0.0.5", False), ((), "10.0.0.5", False)],
)
def test_forwarded_headers_count_only_from_a_trusted_proxy(tmp_path, caplog, proxies, client, secure):
    settings = Settings(home=tmp_path, trusted_proxies=proxies, allowed_hosts=("ground.example",))
    with open_ground(tmp_path) as ground:
        token = add_user(ground, "ann", "operator")
    # What the client itself claims stands to the left of its address.
    forwarded = {"X-Forwarded-For": "1.1.1.1, 198.51.100.4", "X-Forwarded-Proto": "https"}
    headers = {"Host": "ground.example", "Origin": "https://ground.example", **forwarded}
    with (
        caplog.at_level(logging.INFO, "ground_service.worker.metrics"),
        TestClient(create_app(settings), base_url=BASE, client=("10.0.0.5", 1)) as opened,
    ):
        answer = opened.post(f"{V1}/session", json={"token": token}, headers=headers)
    assert answer.status_code == 200
    assert ("Secure" in answer.headers["set-cookie"]) == secure
    assert client in [getattr(one, "address", None) for one in caplog.records]


def test_a_proxy_that_is_no_address_is_refused_at_the_start(monkeypatch):
    monkeypatch.setenv("LINNA_TRUSTED_PROXIES", "10.0.0.1, proxy.example")
    with raises(SettingsError, match=r"LINNA_TRUSTED_PROXIES: .*found 'proxy\.example'"):
        load_settings()
    monkeypatch.setenv("LINNA_TRUSTED_PROXIES", "10.0.0.1, 10.2.0.0/16,")
    monkeypatch.setenv("LINNA_ALLOWED_HOSTS", "ground.example,other.example")
    settings = load_settings()
    assert settings.trusted_proxies == ("10.0.0.1", "10.2.0.0/16")
    assert settings.allowed_hosts == ("ground.example", "other.example")
