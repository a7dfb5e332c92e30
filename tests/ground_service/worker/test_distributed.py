"""The same service on PostgreSQL, Redis and real workers."""

import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from unittest.mock import MagicMock

import pytest

from ground_service.contacts.commanding.service import enter_command, note_timeouts, release_command, take_uplink
from ground_service.errors import DatabaseNotMigrated, SettingsError
from ground_service.evaluation.service import pass_summary
from ground_service.ground import open_ground
from ground_service.ingest.service import ingest_file
from ground_service.jobs.service import enter_job
from ground_service.passes.archive_import import import_archive
from ground_service.settings import Settings
from ground_service.store import repository
from ground_service.store.database import prepare_database
from ground_service.worker import app as app_module
from ground_service.worker.app import queued_jobs, run_worker, worker_answers
from ground_service.worker.dispatch import dispatcher_for
from ground_service.worker.jobs import run_job
from tests.ground_service.archive_hash import hash_of
from tests.serving import wait_for

SPACECRAFT = 76


def job_row(ground, job_id):
    return ground.read(repository.get, repository.JOBS, job_id, "job")


def finished(ground, job_id):
    wait_for(lambda: job_row(ground, job_id)["state"] in ("done", "failed"), f"the end of job {job_id}")
    return job_row(ground, job_id)


@pytest.fixture(scope="module")
def upgraded(postgres_url):
    with pytest.raises(DatabaseNotMigrated, match="run 'linna db upgrade'"):
        prepare_database(postgres_url)
    prepare_database(postgres_url, upgrade=True).engine.dispose()
    return postgres_url


@pytest.fixture(scope="module")
def ground_on_postgres(upgraded, tmp_path_factory):
    with open_ground(tmp_path_factory.mktemp("pg") / "home", database_url=upgraded) as ground:
        yield ground


def test_the_archive_is_the_same_as_on_sqlite(ground_on_postgres, ground, synthetic_pass):
    stream = synthetic_pass.folder / "downlink.cadu"
    hashes = []
    for one in (ground, ground_on_postgres):
        first = ingest_file(one, stream)
        again = ingest_file(one, stream)
        assert first.packets_new == first.packets == len(synthetic_pass.packets)
        assert again.packets_new == 0
        hashes.append(hash_of(one))
    assert hashes[0] == hashes[1]


def test_a_worker_makes_the_report(ground_on_postgres, redis_url, upgraded, synthetic_pass, tmp_path):
    """The worker is another process; a job entered while it is away is done when it comes."""
    ground = ground_on_postgres
    settings = Settings(home=ground.home, database_url=upgraded, broker_url=redis_url)
    pass_id = import_archive(ground, synthetic_pass.folder)
    dispatcher = dispatcher_for(ground, settings)
    waiting = dispatcher.submit("report", {"pass_id": pass_id})
    assert job_row(ground, waiting)["state"] == "queued"
    hopeless = dispatcher.submit("report", {"pass_id": 4711})
    assert not worker_answers(settings, timeout_s=1.0)
    places = {"LINNA_HOME": str(ground.home), "LINNA_DATABASE_URL": upgraded, "LINNA_BROKER_URL": redis_url}
    environment = os.environ | places | {"LINNA_LOG_FORMAT": "json"}
    environment.pop("LINNA_DATA", None)
    with (tmp_path / "worker.log").open("wb") as log:
        worker = subprocess.Popen([sys.executable, "-m", "linna", "worker"], env=environment, stdout=log, stderr=log)
        try:
            row = finished(ground, waiting)
            assert (row["state"], row["attempts"]) == ("done", 1), row
            failed = finished(ground, hopeless)
            assert (failed["state"], failed["error"]) == ("failed", "pass 4711: not found")
            assert worker_answers(settings, timeout_s=30.0)
        finally:
            worker.terminate()
            worker.wait(60)
    lines = (tmp_path / "worker.log").read_text().splitlines()
    logged = [json.loads(line) for line in lines if line.startswith("{")]
    assert {"job", "kind", "state", "seconds"} <= {key for entry in logged for key in entry}
    report = ground.read(repository.get, repository.REPORTS, row["result"]["report_id"], "report")
    assert report["summary"]["packets"] == pass_summary(ground, pass_id)["packets"]


def test_time_outs_are_found_on_a_server_as_well(ground_on_postgres):
    ground = ground_on_postgres
    command = enter_command(ground, "test_connection", {}, spacecraft_id=SPACECRAFT, timeout_s=7, actor="ann")
    release_command(ground, command, actor="ann")
    take_uplink(ground, spacecraft_id=SPACECRAFT, actor="ann")
    table = repository.TELECOMMANDS
    with ground.database.writing() as connection:
        connection.execute(table.update().values(sent_utc_ns=10**18))
    assert note_timeouts(ground, 10**18, 10**18 + 7 * 10**9) == []
    assert note_timeouts(ground, 10**18, 10**18 + 7 * 10**9 + 1) == [command]


def test_a_worker_without_a_broker_is_refused(tmp_path):
    for use in (run_worker, worker_answers):
        with pytest.raises(SettingsError, match="LINNA_BROKER_URL: expected a broker"):
            use(Settings(home=tmp_path))


def test_jobs_that_the_broker_lost_are_sent_again(ground_on_postgres, redis_url, upgraded):
    """The queue is emptied as if the broker had been killed; a job that somebody is doing is left to him."""
    import redis

    ground = ground_on_postgres
    settings = Settings(home=ground.home, database_url=upgraded, broker_url=redis_url)
    dispatcher = dispatcher_for(ground, settings)
    lost = dispatcher.submit("report", {"pass_id": 4712})
    with redis.Redis.from_url(redis_url) as broker:
        broker.delete(*broker.scan_iter())
    assert queued_jobs(settings) == []
    with ground.database.alone(lost) as mine, ground.database.alone(lost) as second:
        assert (mine, second) == (True, False)
        assert run_job(ground, lost).state == "queued"
    dispatcher.submit("report", {"pass_id": 4713})  # the queue is in use again
    dispatcher.resume()
    waiting = queued_jobs(settings)
    assert waiting.count(lost) == 1
    dispatcher.resume()  # it waits already: nothing is added
    assert queued_jobs(settings) == waiting
    assert run_job(ground, lost).error == "pass 4712: not found"


def use_queue(monkeypatch, **answer):
    """Let the queue of the broker give this answer."""
    connection = MagicMock()
    connection.__enter__.return_value.default_channel.client.lrange = MagicMock(**answer)
    connection.__exit__.return_value = False
    monkeypatch.setattr(app_module, "_app_of", lambda _: SimpleNamespace(connection_for_read=lambda: connection))


def test_messages_of_other_programs_in_the_queue_are_no_jobs(tmp_path, monkeypatch):
    messages = [b'{"headers": {"linna-job": "a1"}}', b"{}", b'{"headers": {}}', b"[1]", b"nothing"]
    use_queue(monkeypatch, return_value=messages)
    assert queued_jobs(Settings(home=tmp_path)) == ["a1"]


def test_a_broker_that_breaks_off_is_a_broker_that_is_away(ground, tmp_path, monkeypatch):
    import redis

    log = MagicMock()
    monkeypatch.setattr("ground_service.worker.dispatch.log", log)
    use_queue(monkeypatch, side_effect=redis.ConnectionError("reset by peer"))
    enter_job(ground, "report", {"pass_id": 1})
    dispatcher_for(ground, Settings(home=tmp_path, broker_url="redis://127.0.0.1:1/0")).resume()
    ((text, error), _) = log.warning.call_args
    assert text % error == "the broker is away: reset by peer"


def test_a_broker_that_is_away_refuses_nothing(ground, tmp_path):
    settings = Settings(home=tmp_path, broker_url="redis://127.0.0.1:1/0")
    dispatcher = dispatcher_for(ground, settings)
    job = dispatcher.submit("report", {"pass_id": 1})
    dispatcher.resume()
    assert job_row(ground, job)["state"] == "queued"


def test_two_files_that_are_ingested_at_once_are_joined(ground_on_postgres, synthetic_pass):
    """The packets that the cut between them goes through belong to neither, and come to light in any order."""
    octets = (synthetic_pass.folder / "downlink.cadu").read_bytes()
    cadu = 1279
    pieces = [octets[k : k + 2 * cadu] for k in range(0, len(octets), 2 * cadu)]
    folder = ground_on_postgres.home / "pieces"
    folder.mkdir()
    for number, piece in enumerate(pieces):
        (folder / f"{number}.cadu").write_bytes(piece)
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda path: ingest_file(ground_on_postgres, path, instance="pieces"), folder.iterdir()))
    whole = ingest_file(ground_on_postgres, synthetic_pass.folder / "downlink.cadu", instance="pieces")
    assert whole.packets_new == 0
