"""Loss and return of the PostgreSQL server: the service reconnects, and no acknowledged upload is lost."""

from __future__ import annotations

import random
import threading
import time
from collections.abc import Callable
from pathlib import Path

import httpx
import pytest
from sqlalchemy import text

from benchmarks.campaigns._clients import Session, cut_pieces
from benchmarks.campaigns._deployment import Deployment, wait_until
from benchmarks.campaigns.kill import contents, ends_of
from benchmarks.ground import mixed_downlink
from ground_service.access.service import add_user
from ground_service.ground import open_ground
from ground_service.ingest.service import ingest_file
from ground_service.store.database import open_database

AWAY_S, PIECES = 3.0, 24


def test_a_commit_waits_for_the_standby_even_if_the_role_is_set_up_otherwise(
    new_postgres_database: Callable[[], str],
) -> None:
    url = new_postgres_database()
    for unsafe in ("local", "remote_write", "off"):
        database = open_database(f"{url}?options=-csynchronous_commit%3D{unsafe}")
        with database.reading() as connection:
            assert connection.execute(text("SHOW synchronous_commit")).scalar() == "on"
        database.engine.dispose()


@pytest.mark.slow
def test_uploads_and_jobs_go_on_after_the_server_was_killed_and_came_back(tmp_path: Path) -> None:
    stream = mixed_downlink(600)
    (tmp_path / "whole.cadu").write_bytes(stream)
    with open_ground(tmp_path / "reference") as ground:
        ingest_file(ground, tmp_path / "whole.cadu")
        expected, _ = contents(ground)
    service = Deployment(tmp_path)
    try:
        with open_ground(service.home, database_url=service.url) as ground:
            session = Session(service.apis, add_user(ground, "ann", "operator"))
        jobs: list[str] = []
        broken: list[bytes] = []

        def upload() -> None:
            for piece in cut_pieces(stream, PIECES, random.Random(5), "piece"):
                path = f"/telemetry?spacecraft_id=76&{piece.place}"
                answer = session.ask("POST", path, piece.octets, piece.name)
                if answer.status != 202:
                    broken.append(answer.body)
                    return
                jobs.append(answer.json()["job_id"])

        client = threading.Thread(target=upload, daemon=True)
        client.start()
        wait_until(lambda: len(jobs) >= 6 or bool(broken), "first uploads")
        wait_until(lambda: session.get(f"/jobs/{jobs[0]}")["state"] == "done", "workers")
        service.parts["database"].kill()
        assert httpx.get(f"{service.api}/healthz").status_code == 200
        ready = httpx.get(f"{service.api}/readyz", timeout=30.0)
        assert ready.status_code == 503
        time.sleep(AWAY_S)
        service.parts["database"].start()
        client.join(180.0)
        assert not broken and len(jobs) == PIECES
        assert not [name for name, part in service.parts.items() if part.has_ended]
        states, _ = ends_of(session, jobs)
        assert states == {"done": PIECES}
        with open_ground(service.home, database_url=service.url) as ground:
            assert contents(ground)[0] == expected
    finally:
        service.stop()
