"""The reverse proxy of the compose file before a service: TLS, HSTS, addresses of clients, limits, WebSockets."""

import json
import os
import shutil
import socket
import ssl
import subprocess
import sys
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import httpx
from pytest import fixture, mark, raises, skip, warns
from websockets.sync.client import connect

from ground_service.access.service import add_user
from ground_service.ground import open_ground
from tests.ground_service.conftest import free_port
from tests.serving import wait_for

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True)
class Proxied:
    """A service behind the proxy, with a token of an operator."""

    host: str
    folder: Path
    certificate: Path
    token: str

    @property
    def url(self):
        return f"https://{self.host}"

    def client(self):
        context = ssl.create_default_context(cafile=str(self.certificate))
        return httpx.Client(base_url=self.url, verify=context, timeout=30.0)

    def listens(self):
        """Return whether something listens on the port of the proxy; no request is counted."""
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", int(self.host.split(":")[1]))) == 0

    def answers(self):
        """Return whether the service behind the proxy answers a client that trusts the present certificate only."""
        with self.client() as client:
            try:
                return client.get("/api/v1/session").status_code == 401
            except httpx.HTTPError:
                return False

    def served_certificate(self):
        return ssl.get_server_certificate(("localhost", int(self.host.split(":")[1]))).strip()

    @contextmanager
    def running(self, configuration):
        """Run the proxy."""
        errors = str(configuration.with_name("error.log"))
        command = ["nginx", "-c", str(configuration), "-e", errors, "-g", "daemon off;"]
        process = subprocess.Popen(command)
        try:
            yield
        finally:
            process.terminate()
            process.wait()


def make_secrets(folder):
    environment = {"PATH": os.environ["PATH"], "LINNA_SECRETS_DIR": str(folder)}
    subprocess.run(["sh", str(ROOT / "deploy/secrets.sh")], check=True, env=environment, capture_output=True)


def configured_proxy(folder, secrets, port, upstreams):
    """Write the configuration of the compose file's proxy, with private ports and folders; return its file."""
    text = (ROOT / "deploy/nginx.conf").read_text()
    for old, new in (
        (" /tmp/", f" {folder}/"),
        ("worker_processes 2;", "worker_processes 1;" + ("user root;" if os.geteuid() == 0 else "")),
        ("server api:8042 ", f"server 127.0.0.1:{upstreams[0]} "),
        ("server api2:8042 ", f"server 127.0.0.1:{upstreams[1]} "),
        ("listen 8443 ssl;", f"listen 127.0.0.1:{port} ssl;"),
        ("/run/tls/", f"{secrets}/tls/"),
        ("error_log /dev/stderr", f"error_log {folder}/error.log"),
    ):
        assert old in text
        text = text.replace(old, new)
    (folder / "nginx.conf").write_text(text)
    return folder / "nginx.conf"


@fixture(scope="module")
def proxied(tmp_path_factory):
    if shutil.which("nginx") is None:
        skip("nginx is not installed")
    folder = tmp_path_factory.mktemp("proxy")
    secrets, upstream, port = folder / "secrets", free_port(), free_port()
    make_secrets(secrets)
    configuration = configured_proxy(folder, secrets, port, (upstream, upstream))
    with open_ground(folder / "home") as ground:
        token = add_user(ground, "ann", "operator")
    settings = {
        **os.environ, "LINNA_HOME": str(folder / "home"), "LINNA_TRUSTED_PROXIES": "127.0.0.1/32",
        "LINNA_LOG_FORMAT": "json",
    }  # fmt: skip
    with (folder / "service.log").open("wb") as out:
        service = subprocess.Popen(
            [sys.executable, "-m", "linna", "serve", "--port", str(upstream)], env=settings, stdout=out, stderr=out,
        )  # fmt: skip
    made = Proxied(f"localhost:{port}", folder, secrets / "tls/certificate", token)

    try:
        with made.running(configuration):
            wait_for(made.answers, "the service behind the proxy")
            yield made
    finally:
        service.terminate()
        service.wait()


def test_the_service_is_reached_over_new_tls_with_hsts_only(proxied):
    with proxied.client() as client:
        answer = client.get("/api/v1/passes", headers={"Authorization": f"Bearer {proxied.token}"})
    assert answer.status_code == 200
    assert answer.headers["strict-transport-security"] == "max-age=31536000"
    # The headers of the service are kept, once each.
    assert answer.headers["x-content-type-options"] == "nosniff"
    answer = httpx.get(f"http://{proxied.host}/passes?a=1")
    assert (answer.status_code, answer.headers["location"]) == (308, f"{proxied.url}/passes?a=1")
    context = ssl.create_default_context(cafile=str(proxied.certificate))
    context.set_ciphers("ALL:@SECLEVEL=0")
    context.options &= ~ssl.OP_NO_TLSv1_1
    with warns(DeprecationWarning):
        context.minimum_version, context.maximum_version = ssl.TLSVersion.TLSv1_1, ssl.TLSVersion.TLSv1_1
    with raises(httpx.ConnectError, match=r"(?i)protocol|alert"):
        httpx.get(f"{proxied.url}/", verify=context)


@mark.parametrize("path", ["/metrics", "/healthz", "/readyz"])
def test_metrics_and_health_are_not_passed_on(proxied, path):
    with proxied.client() as client:
        assert client.get(path).status_code == 404


def test_the_address_of_the_client_cannot_be_forged(proxied):
    with proxied.client() as client:
        client.get("/forged", headers={"X-Forwarded-For": "203.0.113.9"})
    log = proxied.folder / "service.log"

    def addresses():
        logged = [json.loads(line) for line in log.read_text().splitlines() if line.startswith("{")]
        return [one["address"] for one in logged if one.get("path") == "/forged"]

    wait_for(lambda: addresses() != [], "the log entry")  # written after the answer
    assert addresses() == ["127.0.0.1"]


def test_the_cookie_of_a_session_is_for_tls_only_and_a_websocket_goes_through(proxied):
    with proxied.client() as client:
        answer = client.post("/api/v1/session", json={"token": proxied.token}, headers={"Origin": proxied.url})
        assert answer.status_code == 200, answer.text
        assert "secure" in answer.headers["set-cookie"].lower().split("; ")
        assert client.get("/api/v1/session").json()["name"] == "ann"
    context = ssl.create_default_context(cafile=str(proxied.certificate))
    address = f"wss://{proxied.host}/api/v1/live"
    headers = {"Authorization": f"Bearer {proxied.token}"}
    with connect(address, ssl=context, additional_headers=headers) as opened:
        assert opened.response is not None and opened.response.status_code == 101


def test_a_flood_is_limited_before_the_service_but_not_others_of_its_address(proxied, tmp_path):
    """With smaller figures than the shipped ones: 1 + 5 requests pass, the others are refused by the proxy."""
    port = free_port()
    text = (proxied.folder / "nginx.conf").read_text()
    for old, new in (
        ("rate=100r/s", "rate=1r/m"),
        ("burst=400", "burst=5"),
        (f"listen 127.0.0.1:{proxied.host.split(':')[1]} ssl", f"listen 127.0.0.1:{port} ssl"),
        (f"pid {proxied.folder}/", f"pid {tmp_path}/"),
    ):
        assert old in text
        text = text.replace(old, new)
    (tmp_path / "nginx.conf").write_text(text)
    other = Proxied(f"localhost:{port}", proxied.folder, proxied.certificate, proxied.token)
    with other.running(tmp_path / "nginx.conf"), other.client() as client:
        wait_for(lambda: other.listens(), "the second proxy")
        answers = [client.get("/api/v1/session") for _ in range(12)]
        bearer = {"Authorization": f"Bearer {proxied.token}"}
        assert client.get("/api/v1/session", headers=bearer).status_code == 200
    statuses = [answer.status_code for answer in answers]
    assert statuses == [401] * 6 + [429] * 6
    assert all(answer.headers["strict-transport-security"] for answer in answers)


def test_a_renewed_certificate_is_served_after_a_reload_and_clients_stay_connected(proxied, tmp_path):
    tls = proxied.certificate.parent
    assert proxied.served_certificate() == proxied.certificate.read_text().strip()
    context = ssl.create_default_context(cafile=str(proxied.certificate))
    headers = {"Authorization": f"Bearer {proxied.token}"}
    with connect(f"wss://{proxied.host}/api/v1/live", ssl=context, additional_headers=headers) as opened:
        make_secrets(tmp_path)
        for name in "certificate", "key":
            (tmp_path / "tls" / name).replace(tls / name)
        configuration = str(proxied.folder / "nginx.conf")
        errors = str(proxied.folder / "error.log")
        subprocess.run(["nginx", "-c", configuration, "-e", errors, "-s", "reload"], check=True)

        def renewed():
            return proxied.served_certificate() == proxied.certificate.read_text().strip()

        wait_for(renewed, "the new certificate")
        wait_for(proxied.answers, "an answer to a client that trusts the new certificate only")
        opened.ping().wait()
