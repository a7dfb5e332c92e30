"""Jobs: each ends exactly once, and reports its error in one public line."""

import errno
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from ground_service.client.connection import Conflict as ClientConflict
from ground_service.client.local import local_client
from ground_service.clock import utc_now_ns
from ground_service.errors import Conflict, DatabaseUnavailable, FileDamaged, InvalidInput, StorageFull, public_text
from ground_service.http.model import Paging
from ground_service.ingest.service import enter_ingest
from ground_service.jobs.service import add_job, enter_job, unfinished_jobs
from ground_service.store import repository
from ground_service.store.states import JOB, move
from ground_service.worker import jobs
from ground_service.worker.condition import complaints, read_condition
from ground_service.worker.dispatch import InlineDispatcher
from ground_service.worker.jobs import run_job
from ground_service.worker.scheduler import Scheduler

Row = dict[str, Any]


@pytest.fixture
def job_that(monkeypatch, ground):
    """A function that enters a job with the given work."""

    def enter(work):
        monkeypatch.setitem(jobs.WORK, "nightly", work)
        return enter_job(ground, "nightly", {})

    return enter


def row_of(ground, job):
    return ground.read(repository.get, repository.JOBS, job, "job")


MISSING = FileNotFoundError(errno.ENOENT, "No such file or directory", "/srv/linna/files/ab")


@pytest.mark.parametrize(
    ("error", "shown"),
    [
        (OverflowError("Python int too large"), "OverflowError: Python int too large"),
        (KeyError("vehicle"), "KeyError: 'vehicle'"), (ValueError("first\nsecond"), "ValueError: first second"),
        (MemoryError(), "MemoryError"), (MISSING, "FileNotFoundError: No such file or directory"),
        (InvalidInput("/srv/linna/a.zip", "", "a zip", "none"), "a.zip: expected a zip, found none"),
    ],
)  # fmt: skip
def test_whatever_error_a_job_meets_it_ends_as_failed_and_is_not_repeated(ground, job_that, error, shown):
    work = Mock(side_effect=error)
    job = job_that(work)
    for _ in range(3):
        row = run_job(ground, job)
    assert (row.state, row.error, row.attempts, work.call_count) == ("failed", shown, 1, 1)
    assert ground.read(unfinished_jobs) == []


def test_a_failed_ingest_is_repeated_with_longer_and_longer_waits(either, monkeypatch):
    """An acknowledged ingest is done at most 85 minutes after its cause is gone, without anybody."""
    work, waits_min = Mock(side_effect=[*[FileNotFoundError("gone")] * 5, {}]), (1, 4, 16, 64)
    monkeypatch.setitem(jobs.WORK, "ingest", work)
    monkeypatch.setitem(jobs.WORK, "report", work)
    job, other = (enter_job(either, kind, {"pass_id": 1, "ingest_id": 1}) for kind in ("ingest", "report"))
    scheduler = Scheduler(either, InlineDispatcher(either), lambda: None, {"retention_days": 90})
    assert run_job(either, other).state == run_job(either, job).state == "failed"
    shown = complaints(read_condition(either, None))
    assert "1 ingests have failed; repeat or dismiss them on the page Shift." in shown
    for attempt, minutes in enumerate(waits_min, start=1):
        for passed_min, attempts in ((minutes - 0.5, attempt), (minutes, attempt + 1)):
            since = utc_now_ns() - int(passed_min * 60e9)
            with either.database.writing() as connection:
                connection.execute(repository.JOBS.update().values(finished_utc_ns=since))
            scheduler.tick()
            assert row_of(either, job)["attempts"] == attempts
    assert (row_of(either, job)["state"], row_of(either, other)["attempts"]) == ("done", 1)


def test_a_failed_job_is_repeated_by_one_action(ground, job_that, monkeypatch):
    job = job_that(lambda *_: {}["missing"])
    assert run_job(ground, job).state == "failed"
    monkeypatch.setitem(jobs.WORK, "nightly", lambda *_: {"repeated": True})
    with local_client(ground, "ann") as client:
        assert client.repeat_job(job).result == {"repeated": True}
        with pytest.raises(ClientConflict, match="expected state failed, found done"):
            client.repeat_job(job)
        assert next(iter(client.list_audit(action="repeat job"))).actor == "ann"
        with pytest.raises(ClientConflict, match="expected state failed, found done"):
            client.delete_job(job)


def test_a_failed_ingest_is_dismissed(ground, job_that):
    job = job_that(lambda *_: {}["missing"])
    run_job(ground, job)
    with local_client(ground, "ann") as client:
        client.delete_job(job)
        assert [one.id for one in client.list_jobs()] == []
        assert next(iter(client.list_audit(action="dismiss job"))).target == job


def test_the_traceback_of_an_unexpected_error_is_in_the_log(ground, job_that, caplog):
    job = job_that(lambda *_: {}["missing"])
    run_job(ground, job)
    [record] = [one for one in caplog.records if one.levelname == "ERROR"]
    assert record.exc_info is not None and job in record.getMessage()


def test_a_full_disk_is_no_fault_of_the_job(ground, job_that):
    job = job_that(Mock(side_effect=OSError(errno.ENOSPC, "No space left on device")))
    with pytest.raises(StorageFull):
        run_job(ground, job)
    row = row_of(ground, job)
    assert (row["state"], row["attempts"]) == ("queued", 0)


def test_a_result_that_the_database_cannot_hold_fails_the_job(ground, job_that):
    row = run_job(ground, job_that(lambda *_: {"median": float("nan")}))
    assert row.state == "failed" and "JSON" in row.error


def test_an_attempt_that_another_has_overtaken_changes_nothing(ground, job_that):
    """This occurs after a network failure, if the database grants the lock of the first worker to a second one."""

    def work(_ground, _arguments, job_id):
        ground.write(move, JOB, job_id, "running", attempts=2)
        return {"made by": "the first"}

    row = run_job(ground, job_that(work))
    assert (row.state, row.attempts, row.result) == ("running", 2, None)


def test_an_id_that_stands_for_another_request_is_refused(ground):
    enter_job(ground, "report", {"pass_id": 1}, job_id="a" * 32)
    assert enter_job(ground, "report", {"pass_id": 1}, job_id="a" * 32) == "a" * 32
    for kind, arguments in (("report", {"pass_id": 2}), ("nightly", {})):
        with pytest.raises(Conflict, match="found another"):
            ground.write(add_job, kind, arguments, job_id="a" * 32)


def test_an_ingest_asked_for_twice_is_one_and_of_another_file_is_refused(ground):
    one, other = (ground.files.put_octets(octets) for octets in (b"one", b"other"))
    given = {"spacecraft_id": 76, "instance": "flight", "job_id": "b" * 32}
    first = enter_ingest(ground, one, "one", **given)
    assert enter_ingest(ground, one, "one", **given) == first
    for stored, changed in ((other, {}), (one, {"spacecraft_id": 77}), (one, {"instance": "else"})):
        with pytest.raises(Conflict, match="found another"):
            enter_ingest(ground, stored, "one", **(given | changed))
    assert ground.read(repository.newest, repository.INGESTS, Paging())[1] == 1


@pytest.mark.parametrize(
    ("error", "shown"),
    [
        (DatabaseUnavailable("postgresql://linna:***@db/linna", "gone"), "database (address) cannot be opened: gone"),
        (FileDamaged(Path("/srv/linna/files/ab/cdef"), "1", "2"), "cdef: expected octets with SHA-256 1, found 2"),
        (InvalidInput("window", "name", "a line", "'\x1b[2J\n'"), "window, name: expected a line, found ' [2J '"),
        (ValueError(), "ValueError"),
        (InvalidInput("x", "", "a number from 0/1 to 3", "and/or"), "x: expected a number from 0/1 to 3, found and/or"),
    ],
)  # fmt: skip
def test_what_is_shown_of_an_error_is_one_line_without_places_of_the_server(error, shown):
    assert public_text(error) == shown


def test_a_long_error_is_cut():
    assert len(public_text(ValueError("x" * 9000))) == 500
