"""The processes of the compose file without containers, from its one declaration: a pass through each overlay."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest

from ground_service.access.service import add_user
from ground_service.ground import open_ground
from ground_service.ingest.service import ingest_file
from studies.harness.parts import Part, PostgresServer, answers_http, bare_environment, free_port, listens
from tests.ground_service.access.openid import CLIENT, running_provider
from tests.ground_service.archive_hash import hash_of
from tests.ground_service.object_server import running_objects
from tests.ground_service.test_deployment import ROOT, SERVICES, default_of, environment_of
from tests.serving import wait_for

PIECES = 8


@contextmanager
def deployed(folder: Path, overlay: dict[str, str], *, is_shared: bool) -> Iterator[dict[str, Part]]:
    """Run the processes with the declared settings, `overlay` for all of them, and private ports and folders.

    The volume of the archive is one folder, or with an object store a folder for each process.
    """
    for name in ("secret", "broker_password"):
        (folder / name).write_text("secret")
    with PostgresServer(folder) as database, ExitStack() as running:
        service, broker, ports = database.prepare_service(), free_port(), {}
        places = {
            "LINNA_DATABASE_URL": service,
            "LINNA_BROKER_URL": f"redis://linna@127.0.0.1:{broker}/0",
            **{f"LINNA_{name}": str(folder / name) for name in ("DATA", "RUNNER_EXCHANGE", "BACKUPS")},
            **{f"LINNA_{name}_PASSWORD_FILE": str(folder / "secret") for name in ("DATABASE", "BROKER")},
        }
        (folder / "DATA").mkdir()
        words = ["--port", str(broker), "--bind", "127.0.0.1", "--dir", str(folder)]
        with open_ground(folder, database_url=service) as ground:
            (folder / "token").write_text(add_user(ground, "ann", "operator"))
        (folder / "url").write_text(service)
        parts = {"db": database.part}
        parts["broker"] = Part(
            ["sh", str(ROOT / "deploy/redis.sh"), *words],
            folder / "broker.log",
            lambda: listens(broker),
            env={**os.environ, "LINNA_SECRETS": str(folder), "LINNA_REDIS_USERS": f"{folder}/users"},
        )
        for name in ("api", "api2", "worker", "scheduler"):
            home, log, ports[name] = (
                folder / ("home" if is_shared else name),
                folder / f"{name}.log",
                free_port(),
            )
            home.mkdir(exist_ok=True)
            declared = {key: default_of(value) for key, value in environment_of(name).items()}
            there = {key: value for key, value in places.items() if key in declared}
            declared |= there | {"LINNA_HOME": str(home)} | overlay
            command = [*SERVICES[name]["command"]]
            if name.startswith("api"):
                command[command.index("--host") + 1] = "127.0.0.1"
                command[command.index("--port") + 1] = str(ports[name])
            ready = (
                (lambda port=ports[name]: answers_http(f"http://127.0.0.1:{port}/readyz"))
                if name.startswith("api")
                else (lambda log=log: log.exists() and log.stat().st_size > 0)
            )
            parts[name] = Part(
                [sys.executable, "-m", "linna", *command], log, ready, env=bare_environment(**declared)
            )
            (folder / f"{name}.port").write_text(str(ports[name]))
        for name, part in parts.items():
            running.callback(part.end)
            if name != "db":
                part.start()
        yield parts


def carried(folder: Path, downlink: bytes, parts: dict[str, Part]) -> str:
    """Give pieces to both API processes in turn while broker and database are killed; return the page of sign-in."""
    token = (folder / "token").read_text()
    apis = [
        httpx.Client(
            base_url=f"http://127.0.0.1:{(folder / f'{name}.port').read_text()}",
            headers={"Authorization": f"Bearer {token}"},
            timeout=30.0,
        )
        for name in ("api", "api2")
    ]
    size, jobs = -(-len(downlink) // PIECES), []
    for k in range(PIECES):
        if k in (3, 5):
            parts["broker" if k == 3 else "db"].kill()
            parts["broker" if k == 3 else "db"].start()

        def accepted(k: int = k) -> bool:
            path = f"/api/v1/telemetry?spacecraft_id=76&stream=downlink&offset={k * size}"
            answer = apis[k % 2].post(
                path, content=downlink[k * size : (k + 1) * size], headers={"Idempotency-Key": f"piece {k}"}
            )
            assert answer.status_code in (202, 503), answer.text
            if answer.status_code == 202:
                jobs.append(answer.json()["job_id"])
            return answer.status_code == 202

        wait_for(accepted, f"piece {k}")
    for job in jobs:
        wait_for(lambda job=job: apis[0].get(f"/api/v1/jobs/{job}").json()["state"] == "done", job, 120.0)
    assert not [name for name, part in parts.items() if part.has_ended]
    # Both API processes answer the same, also for what a provider needs.
    signed = {tuple(api.get("/sign-in/provider").headers.get("location", "").split("?")[:1]) for api in apis}
    assert len(signed) == 1
    found = [api.get("/api/v1/ingests").json()["items"] for api in apis]
    assert found[0] == found[1] and len(found[0]) == PIECES
    for api in apis:
        api.close()
    return signed.pop()[0]


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize(
    "overlay", ["base", *(pytest.param(one, marks=pytest.mark.campaign) for one in ("objects", "provider"))]
)
def test_no_acknowledged_piece_is_lost_with_broker_and_database_killed(
    overlay: str, synthetic_pass: Any, tmp_path: Path
) -> None:
    downlink = synthetic_pass.folder / "downlink.cadu"
    with open_ground(tmp_path / "reference") as ground:
        ingest_file(ground, downlink)
        expected = hash_of(ground)
    with ExitStack() as stack:
        given: dict[str, str] = {}
        if overlay == "objects":
            given = stack.enter_context(running_objects("deployed")).environment()
        if overlay == "provider":
            provider = stack.enter_context(running_provider())
            given = {
                "LINNA_OIDC_ISSUER": provider.issuer,
                "LINNA_OIDC_CLIENT_ID": CLIENT,
                "LINNA_OIDC_ROLES": "operator=linna-operators",
            }
        (tmp_path / "run").mkdir()
        parts = stack.enter_context(deployed(tmp_path / "run", given, is_shared=overlay != "objects"))
        page = carried(tmp_path / "run", downlink.read_bytes(), parts)
        assert (page != "") == (overlay == "provider")
        url = (tmp_path / "run/url").read_text()
        with open_ground(tmp_path / "run", database_url=url) as ground:
            assert hash_of(ground) == expected
