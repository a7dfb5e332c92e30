"""The processes of the compose file without containers, from its one declaration: a pass through each overlay."""

import os
import re
import ssl
import subprocess
import sys
from collections.abc import Callable
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import httpx
from pytest import mark

from benchmarks._servers import PostgresServer
from ground_service.ground import open_ground
from ground_service.ingest.service import ingest_file
from ground_service.regression.runner import alive
from studies.harness.parts import Part, answers_http, bare_environment, free_port, listens
from tests.ground_service.access.openid import CLIENT, running_provider
from tests.ground_service.archive_hash import hash_of
from tests.ground_service.object_server import running_objects
from tests.ground_service.test_deployment import ROOT, SERVICES, default_of, environment_of
from tests.ground_service.test_proxy import configured_proxy
from tests.serving import wait_for

PIECES = 8
APIS = ("api", "api2")


@dataclass(frozen=True)
class Overlay:
    """Settings of one deployment, and the server that they name: how it is lost, and what an upload gets meanwhile."""

    settings: dict[str, str] = field(default_factory=dict)
    stop: Callable[[], None] = lambda: None
    start: Callable[[], None] = lambda: None
    meanwhile: int = 202


@dataclass(frozen=True)
class Deployed:
    """A running deployment: parts by their names in the compose file, addresses, and token of the administrator."""

    parts: dict[str, Part]
    addresses: dict[str, str]
    secrets: Path
    database_url: str

    def client(self, name):
        """Return a client of the proxy or of one API process."""
        token = (self.secrets / "admin_token").read_text()
        return httpx.Client(
            base_url=self.addresses[name], headers={"Authorization": f"Bearer {token}"},
            verify=ssl.create_default_context(cafile=str(self.secrets / "tls/certificate")), timeout=30.0,
        )  # fmt: skip


@contextmanager
def deployed(folder, overlay, *, is_shared):
    """Run every process that stays, after the migration; only addresses and folders are not the declared ones.

    The volume of the archive is one folder, or with an object store a folder for each process.
    """
    secrets, broker = folder / "secrets", free_port()
    programs = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    run = {"PATH": programs, "LINNA_SECRETS_DIR": str(secrets), "LINNA_SECRETS": str(secrets)}
    subprocess.run(["sh", str(ROOT / "deploy/secrets.sh")], check=True, env=run, capture_output=True)
    with PostgresServer(folder, superuser="postgres") as database, ExitStack() as running:
        here = {
            "/run/secrets": str(secrets),
            "@db:5432": f"@127.0.0.1:{database.port}",
            "@broker:6379": f"@127.0.0.1:{broker}",
            default_of("${LINNA_FRONT_SUBNET:-172.30.42.0/24}"): "127.0.0.1/32",
        }
        volumes = {f"/{name}": folder / name for name in ("data", "exchange", "backup")}
        for volume in volumes.values():
            volume.mkdir()

        def local(text):
            found = "|".join(re.escape(one) for one in here)
            text = re.sub(found, lambda match: here[match[0]], default_of(text)).replace("$$", "$")
            return str(volumes.get(text, text))

        def environment(name):
            home = folder / ("home" if is_shared else name)
            home.mkdir(exist_ok=True)
            declared = {key: local(value) for key, value in environment_of(name).items()}
            return bare_environment(**declared, PATH=programs) | {"LINNA_HOME": str(home)} | overlay

        server = {"PGHOST": "127.0.0.1", "PGPORT": str(database.port)}
        roles = {**run, **server, "POSTGRES_USER": "postgres", "POSTGRES_DB": "linna"}
        subprocess.run(["sh", str(ROOT / "deploy/postgres-roles.sh")], check=True, env=roles)
        migration = [local(word) for word in SERVICES["migrate"]["entrypoint"]]
        subprocess.run(migration, check=True, env=environment("migrate"))
        words = ["--port", str(broker), "--bind", "127.0.0.1", "--dir", str(folder)]
        parts = {"db": database.part}
        parts["broker"] = Part(
            ["sh", str(ROOT / "deploy/redis.sh"), *words], folder / "broker.log", lambda: listens(broker),
            env={**run, "LINNA_REDIS_USERS": f"{folder}/users"},
        )  # fmt: skip
        ports = {name: free_port() for name in (*APIS, "proxy")}
        for name in (*APIS, "worker", "scheduler", "runner"):
            command, log = [local(word) for word in SERVICES[name]["command"]], folder / f"{name}.log"
            if name in APIS:
                command[command.index("--host") + 1] = "127.0.0.1"
                command[command.index("--port") + 1] = str(ports[name])
            ready = {
                **{api: lambda api=api: answers_http(f"http://127.0.0.1:{ports[api]}/readyz") for api in APIS},
                "runner": lambda: alive(folder / "exchange"),
            }.get(name, lambda log=log: log.exists() and log.stat().st_size > 0)
            parts[name] = Part([sys.executable, "-m", "linna", *command], log, ready, env=environment(name))
        proxy = configured_proxy(folder, secrets, ports["proxy"], (ports["api"], ports["api2"]))
        parts["proxy"] = Part(
            ["nginx", "-c", str(proxy), "-e", f"{folder}/error.log", "-g", "daemon off;"],
            folder / "proxy.log",
            lambda: listens(ports["proxy"]),
        )
        for name, part in parts.items():
            running.callback(part.end)
            if name != "db":
                part.start()
        addresses = {name: f"http://127.0.0.1:{ports[name]}" for name in APIS}
        yield Deployed(
            parts, {**addresses, "proxy": f"https://localhost:{ports['proxy']}"}, secrets,
            local("postgresql+psycopg://linna@db:5432/linna"),
        )  # fmt: skip


def carried(downlink, service, overlay):
    """Give pieces to the proxy while broker, database, an API process and the overlay's server are lost.

    Returns
    -------
    str
        Page of sign-in that both API processes name.
    """
    size, jobs = -(-len(downlink) // PIECES), []
    with service.client("proxy") as proxy:

        def answer(k):
            path = f"/api/v1/telemetry?spacecraft_id=76&stream=downlink&offset={k * size}"
            piece = downlink[k * size : (k + 1) * size]
            return proxy.post(path, content=piece, headers={"Idempotency-Key": f"piece {k}"})

        def accepted(k):
            found = answer(k)
            assert found.status_code in (202, 502, 503), found.text
            if found.status_code == 202:
                jobs.append(found.json()["job_id"])
            return found.status_code == 202

        lost = {3: "broker", 5: "db", 6: "api"}
        for k in range(PIECES):
            if k in lost:
                service.parts[lost[k]].kill()
                service.parts[lost[k]].start()
            if k == 2:
                overlay.stop()
                assert answer(k).status_code == overlay.meanwhile
                overlay.start()
            wait_for(lambda k=k: accepted(k), f"piece {k}")
        for job in jobs:
            wait_for(lambda job=job: proxy.get(f"/api/v1/jobs/{job}").json()["state"] == "done", job)
    assert not [name for name, part in service.parts.items() if part.has_ended]
    # Both API processes answer the same, also for what a provider needs.
    found, signed = [], set()
    for name in APIS:
        with service.client(name) as api:
            signed.add(api.get("/sign-in/provider").headers.get("location", "").split("?")[0])
            found.append(api.get("/api/v1/ingests").json()["items"])
    assert found[0] == found[1] and len(found[0]) == PIECES
    assert len(signed) == 1
    return signed.pop()


@mark.campaign
@mark.parametrize("kind", ["base", "objects", "provider"])
def test_no_acknowledged_piece_is_lost_with_any_server_lost(kind, synthetic_pass, tmp_path):
    downlink = synthetic_pass.folder / "downlink.cadu"
    with open_ground(tmp_path / "reference") as ground:
        ingest_file(ground, downlink)
        expected = hash_of(ground)
    with ExitStack() as stack:
        overlay = Overlay()
        if kind == "objects":
            objects = stack.enter_context(running_objects("deployed"))
            overlay = Overlay(objects.environment(), objects.stop, objects.start, 503)
        if kind == "provider":
            provider = stack.enter_context(running_provider())
            settings = {"ISSUER": provider.issuer, "CLIENT_ID": CLIENT, "ROLES": "operator=linna-operators"}
            named = {f"LINNA_OIDC_{name}": value for name, value in settings.items()}
            overlay = Overlay(named, provider.stop, provider.start)
        (tmp_path / "run").mkdir()
        running = deployed(tmp_path / "run", overlay.settings, is_shared=kind != "objects")
        service = stack.enter_context(running)
        page = carried(downlink.read_bytes(), service, overlay)
        assert (page != "") == (kind == "provider")
        with open_ground(tmp_path / "run", database_url=service.database_url) as ground:
            assert hash_of(ground) == expected
