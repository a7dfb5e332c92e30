"""The whole path with an object store: hosts that share no folder, loss of the store, integrity, backup."""

import os
import subprocess
import sys
import uuid
from contextlib import contextmanager

from pytest import fixture, mark, raises

from ground_service.app import create_app
from ground_service.errors import ObjectsUnavailable
from ground_service.ground import open_ground
from ground_service.http.model import Paging
from ground_service.ingest.service import ingest_file
from ground_service.jobs.service import enter_job
from ground_service.passes.archive_import import import_archive, zip_folder
from ground_service.regression.archives import keep_archive, let_go, store_of
from ground_service.regression.builds import load_build, register_build, registered_build
from ground_service.regression.jobs import missing_replays, prepared
from ground_service.settings import Settings
from ground_service.store import repository
from ground_service.worker.backup import backup, restore
from ground_service.worker.follow_up import follow_in_process
from ground_service.worker.integrity import verify
from ground_service.worker.jobs import run_job
from tests.ground_service.object_server import running_objects
from tests.serving import TestClient, wait_for

OWN = {"Origin": "http://testserver"}


@fixture
def server():
    with running_objects(f"path-{uuid.uuid4().hex[:8]}") as running:
        yield running


@fixture
def opened(server, tmp_path):
    """A function that opens the service on a host with its own folder; by default with a database there."""
    made = []

    def make(host, database_url=None, folder=""):
        objects = server.store().under(folder) if folder else server.store()
        made.append(open_ground(tmp_path / host, database_url=database_url, objects=objects))
        follow_in_process(made[-1])
        return made[-1]

    yield make
    for one in made:
        one.close()


@contextmanager
def worker(home, environment):
    """A worker on a host with this folder, while the context lasts."""
    home.mkdir(exist_ok=True)
    with (home.parent / f"{home.name}.log").open("ab") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "linna", "worker", "--concurrency", "1"],
            env={**os.environ, **environment, "LINNA_HOME": str(home), "LINNA_DATA": ""}, stdout=log, stderr=log,
        )  # fmt: skip
        try:
            yield
        finally:
            process.terminate()
            process.wait()


def job_of(ground, key):
    return ground.read(repository.get, repository.JOBS, key, "job")


def result_of(ground, key):
    wait_for(lambda: job_of(ground, key)["state"] in ("done", "failed"), f"the end of job {key}")
    row = job_of(ground, key)
    assert row["state"] == "done", row
    return dict(row["result"])


@mark.campaign
def test_upload_report_and_regression_on_hosts_without_a_common_folder(
    server, migrated_postgres, redis_url, make_flyable, make_build, tmp_path
):
    common = {"database_url": migrated_postgres(), "broker_url": redis_url}
    environment = {f"LINNA_{name.upper()}": value for name, value in common.items()} | server.environment()
    environment["LINNA_ALLOW_DATABASE_OWNER"] = "true"
    settings = Settings(home=tmp_path / "a", allow_database_owner=True, **common, **server.settings())
    flown = make_flyable(frames=10, seed=71)
    with TestClient(create_app(settings), headers=OWN) as client:
        ground = client.app.state.ground
        packed = zip_folder(flown.folder)
        answer = client.post("/api/v1/archives", params={"name": "pass.zip"}, content=packed.read_bytes())
        packed.unlink()
        assert answer.status_code == 202, answer.text
        with worker(tmp_path / "b", environment):
            pass_id = result_of(ground, answer.json()["id"])["pass_id"]
        answer = client.post(f"/api/v1/passes/{pass_id}/reports")
        assert answer.status_code == 202, answer.text
        with worker(tmp_path / "c", environment):
            report = result_of(ground, answer.json()["id"])["report_id"]
            page = client.get(f"/api/v1/reports/{report}", headers={"Accept": "text/html"})
            assert page.status_code == 200 and b"<html" in page.content[:500]
            archives = [keep_archive(ground, flown.folder).digest]
            packets = {"synthetic pass 71": flown.packets}
            builds = [
                register_build(ground, load_build(make_build(name, packets, network_ms=cost))).digest
                for name, cost in (("old", 10.0), ("new", 10.1))
            ]
            arguments = prepared(ground, builds[1], builds[0], archives)
            submit = client.app.state.dispatcher.submit
            replays = [submit("replay", one) for one in missing_replays(ground, arguments)]
            verdict = submit("regression", arguments)
            assert [result_of(ground, one)["outcome"] for one in replays] == ["ok"] * 2
            assert result_of(ground, verdict)["verdict"] in ("pass", "inconclusive")
        assert client.get(f"/regressions/{verdict}").status_code == 200
        assert verify(ground).verdict == "intact"
    homes = {name: {p.name for p in (tmp_path / name / "files").rglob("*") if p.is_file()} for name in "abc"}
    assert homes["b"] and homes["c"] and homes["b"] != homes["c"] != homes["a"]


def test_an_upload_is_refused_while_the_store_is_away_and_accepted_afterwards(server, synthetic_pass, tmp_path):
    octets = (synthetic_pass.folder / "downlink.cadu").read_bytes()
    settings = Settings(home=tmp_path / "home", **server.settings())
    with TestClient(create_app(settings, inline_jobs=True), headers=OWN) as client:

        def upload():
            return client.post("/api/v1/telemetry", params={"name": "a.cadu"}, content=octets)

        assert client.get("/readyz").status_code == 200
        server.stop()
        refused = upload()
        assert refused.status_code == 503, refused.text
        assert "object store" in refused.json()["detail"] and server.bucket not in refused.text
        assert client.get("/readyz").status_code == 503
        ground = client.app.state.ground
        assert ground.read(repository.newest, repository.INGESTS, Paging())[1] == 0
        server.start()
        assert upload().status_code == 202
        assert verify(ground, rebuild=True).verdict == "intact"


def test_a_job_without_the_store_waits_and_loses_nothing(server, opened, synthetic_pass, tmp_path):
    """The store goes away between the acknowledgement and the work, on a host that has no copy."""
    first = opened("first")
    url = f"sqlite:///{tmp_path / 'first' / 'linna.db'}"
    packed = zip_folder(synthetic_pass.folder)
    stored = first.files.put_file(packed)
    packed.unlink()
    job = enter_job(first, "archive", {"sha256": stored.sha256, "name": "pass.zip"})
    second = opened("second", url)
    server.stop()
    with raises(ObjectsUnavailable):
        run_job(second, job)
    assert job_of(first, job)["state"] == "queued"
    server.start()
    assert run_job(second, job).state == "done"
    assert verify(first, rebuild=True).verdict == "intact"


def test_an_import_that_loses_the_store_half_way_is_repeated(server, opened, synthetic_pass, monkeypatch):
    ground = opened("home")
    put, calls = type(server.store()).put, []

    def failing(*given):
        calls.append(given)
        if len(calls) == 3:
            server.stop()
        put(*given)

    monkeypatch.setattr(type(server.store()), "put", failing)
    with raises(ObjectsUnavailable):
        import_archive(ground, synthetic_pass.folder)
    server.start()
    assert len(calls) == 3
    import_archive(ground, synthetic_pass.folder)
    assert verify(ground, rebuild=True).verdict == "intact"


def test_integrity_check_reads_the_store_and_not_the_cache(server, opened, synthetic_pass):
    ground = opened("home")
    ingest_file(ground, synthetic_pass.folder / "downlink.cadu")
    store = server.store().under("files")
    (sha256,) = (row["sha256"] for row in ground.read(repository.newest, repository.FILES, Paging())[0])
    octets = ground.files.get(sha256)
    assert verify(ground, rebuild=True).verdict == "intact"

    def found(body):
        if body is None:
            store.remove(sha256)
        else:
            store._client().put_object(Bucket=store.bucket, Key=store.key(sha256), Body=body)
        return [str(one) for one in verify(ground).damaged]

    assert "expected octets with this SHA-256" in found(octets[:-1] + b"?")[0]
    assert f"found {len(octets) - 1}" in found(octets[:-1])[0]
    assert "expected the file, found nothing" in found(None)[0]
    assert found(octets) == []
    store._client().put_object(Bucket=store.bucket, Key=f"{store.prefix}zz/foreign", Body=b"x")
    assert "expected no such file in the archive" in found(octets)[0]


def test_a_backup_of_an_object_store_is_restored_into_another(opened, synthetic_pass, make_build, tmp_path):
    """Also the way to move a service from folders into an object store."""
    ground = opened("home")
    pass_id = import_archive(ground, synthetic_pass.folder)
    build = register_build(ground, load_build(make_build("one", {"a": [b"packet"]})))
    for path in (tmp_path / "home/files").rglob("*"):
        if path.is_file():
            path.unlink()  # the backup reads the store
    backup(ground, tmp_path / "backup", now_utc_ns=10**18)
    assert not [path for path in (tmp_path / "home/files").rglob("*") if path.is_file()]
    other = opened("other", folder="other")
    restore(tmp_path / "backup", other)
    assert verify(other, rebuild=True).verdict == "intact"
    assert registered_build(other, build.digest).files == build.files
    assert pass_id > 0


def test_a_build_keeps_its_programs_on_another_host(opened, make_build, tmp_path):
    file = make_build("runs", {"a": [b"packet"]})
    (file.parent / "fly.py").chmod(0o755)
    first = opened("first")
    build = register_build(first, load_build(file))
    second = opened("second", f"sqlite:///{tmp_path / 'first' / 'linna.db'}")
    there = registered_build(second, build.digest)
    assert there.folder.is_relative_to(second.home) and there.digest == build.digest
    assert os.access(there.folder / "fly.py", os.X_OK)
    assert not (there.folder / "costs.json").stat().st_mode & 0o111


def test_files_of_an_archive_that_is_let_go_leave_the_store(opened, make_flyable):
    ground = opened("home")
    archive = keep_archive(ground, make_flyable(frames=4, seed=81).folder)
    kept = keep_archive(ground, make_flyable(frames=4, seed=82).folder, pinned=True)

    def names():
        return {name for name, _ in store_of(ground).names()}

    before = names()
    assert let_go(ground, unused_for_ns=-1) == [archive.digest]
    assert {entry["sha256"] for entry in kept.manifest["files"].values()} <= names() < before
