"""A disk that is full or read-only: clear words, nothing lost, and the service says that it is not ready."""

import errno
import importlib.util
import os
import tempfile

from pytest import mark, raises

from ground_service.errors import StorageFull
from ground_service.http.model import Paging
from ground_service.ingest import store as ingest_store
from ground_service.ingest.service import enter_ingest
from ground_service.store import repository
from ground_service.worker.jobs import run_job
from tests.ground_service.archive_hash import archive_hash
from tests.ground_service.conftest import wait_for

V1 = "/api/v1"


@mark.parametrize(
    "code, status, words", [(errno.ENOSPC, 507, "no space left"), (errno.EROFS, 503, "cannot be written")]
)
def test_an_upload_that_cannot_be_kept_is_refused_and_readiness_tells(
    client, synthetic_pass, monkeypatch, code, status, words
):
    def failing(*_, **__):
        raise OSError(code, os.strerror(code))

    stream = (synthetic_pass.folder / "downlink.cadu").read_bytes()
    assert client.get("/readyz").status_code == 200
    with monkeypatch.context() as disk:
        disk.setattr(tempfile, "mkstemp", failing)
        disk.setattr(tempfile, "TemporaryFile", failing)
        answers = [client.post(f"{V1}/telemetry", content=stream), client.get("/readyz")]
        assert client.get("/healthz").status_code == 200
        assert client.get(f"{V1}/passes").status_code == 200
    for answer in answers:
        assert answer.status_code == status
        assert words in answer.json()["detail"]
        assert answer.headers["content-type"] == "application/problem+json"
    assert client.get(f"{V1}/ingests").json()["total"] == 0
    assert client.get("/readyz").status_code == 200
    assert client.post(f"{V1}/telemetry", content=stream).status_code == 202
    assert client.get(f"{V1}/ingests/1").json()["state"] == "done"


def test_a_database_that_may_not_be_written_is_not_ready(client, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, mode: mode != os.W_OK)
    answer = client.get("/readyz")
    assert answer.status_code == 503
    assert "cannot be written" in answer.json()["detail"]


def test_an_ingest_that_a_full_disk_stops_is_done_when_there_is_space(client, synthetic_pass, monkeypatch):
    ground = client.app.state.ground
    stored = ground.files.put_file(synthetic_pass.folder / "downlink.cadu")
    _, job = enter_ingest(ground, stored, "d", spacecraft_id=76, instance="flight")

    def no_space(*_):
        raise StorageFull("database")

    with monkeypatch.context() as disk:
        disk.setattr(ingest_store, "store_batch", no_space)
        with raises(StorageFull):
            run_job(ground, job)
    stopped = client.get(f"{V1}/jobs/{job}").json()
    assert (stopped["state"], stopped["attempts"]) == ("queued", 0)
    assert (
        client.get(f"{V1}/ingests/1").json()["state"] == "queued"
    )  # nothing of a small piece is stored before all of it
    client.app.state.dispatcher.resume()  # the thread of the recurring work may have resumed it already
    wait_for(lambda: client.get(f"{V1}/jobs/{job}").json()["state"] == "done", "the ingest")
    with ground.database.reading() as connection:
        found = archive_hash(connection, 1)
        packets = repository.newest(connection, repository.PACKETS, Paging(limit=1))[1]
    assert packets == len(synthetic_pass.packets)
    client.post(f"{V1}/telemetry", content=(synthetic_pass.folder / "downlink.cadu").read_bytes())
    with ground.database.reading() as connection:
        assert archive_hash(connection, 1) == found


def test_a_missing_library_is_named_with_its_remedy(client, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    answer = client.post(f"{V1}/exports", json={"pass_id": 1, "format": "spk"})
    assert answer.status_code == 501 and "install linna[spice]" in answer.json()["detail"]
