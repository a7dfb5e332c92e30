"""Jobs done in the process of the service: stopped in the middle, held back, and going on."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from ground_service.errors import StorageFull
from ground_service.ground import Ground, open_ground
from ground_service.ingest import reception
from ground_service.ingest import store as ingest_store
from ground_service.ingest.service import enter_ingest, ingest_file
from ground_service.store import files
from ground_service.worker import dispatch
from ground_service.worker.dispatch import ThreadDispatcher
from tests.ground_service.archive_hash import hash_of
from tests.ground_service.worker.test_jobs import row_of


@pytest.fixture(scope="module")
def downlink(make_pass: Callable[..., Any]) -> Path:
    return Path(make_pass(frames=30, seed=4).folder) / "downlink.cadu"


@pytest.fixture
def small_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    """The stream is stored in about ten transactions."""
    monkeypatch.setattr(files, "BLOCK_OCTETS", 4_000)
    monkeypatch.setattr(reception, "WINDOW_OCTETS", 4_000)


def enter(ground: Ground, downlink: Path) -> str:
    stored = ground.files.put_file(downlink)
    return enter_ingest(ground, stored, "d", spacecraft_id=76, instance="flight")[1]


@pytest.mark.usefixtures("small_windows")
def test_an_ingest_is_broken_off_when_the_service_stops_and_goes_on_at_the_next_start(
    downlink: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with open_ground(tmp_path / "whole") as ground:
        ingest_file(ground, downlink)
        expected = hash_of(ground)
    stored: list[int] = []
    middle, go_on = threading.Event(), threading.Event()
    original = ingest_store.store_batch

    def store(*given: Any) -> Any:
        result = original(*given)
        stored.append(result.new)
        if len(stored) == 3:
            middle.set()
            assert go_on.wait(60.0)
        return result

    with monkeypatch.context() as slow:
        slow.setattr(ingest_store, "store_batch", store)
        with open_ground(tmp_path / "stopped") as ground:
            dispatcher = ThreadDispatcher(ground)
            job, behind = enter(ground, downlink), enter(ground, downlink)
            dispatcher.start(job)
            dispatcher.start(behind)
            assert middle.wait(60.0)
            assert 0.0 < row_of(ground, job)["progress"] < 1.0
            ground.stopping.set()  # as closing the dispatcher does, which waits
            go_on.set()
            dispatcher.close()
            assert len(stored) == 3
            assert [row_of(ground, one)["state"] for one in (job, behind)] == ["queued", "queued"]
            assert row_of(ground, job)["attempts"] == 0
    with open_ground(tmp_path / "stopped") as ground:
        dispatcher = ThreadDispatcher(ground)
        dispatcher.resume()
        dispatcher._pool.shutdown(wait=True)
        assert [row_of(ground, one)["state"] for one in (job, behind)] == ["done", "done"]
        assert hash_of(ground) == expected


def test_a_job_that_the_disk_stops_is_held_back_longer_each_time(
    downlink: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = [0.0]
    tried: list[float] = []

    def no_space(*_: Any) -> Any:
        tried.append(clock[0])
        raise StorageFull("database")

    monkeypatch.setattr(dispatch.time, "monotonic", lambda: clock[0])
    with open_ground(tmp_path) as ground:
        job = enter(ground, downlink)
        dispatcher = ThreadDispatcher(ground)
        with monkeypatch.context() as disk:
            disk.setattr(ingest_store, "store_batch", no_space)
            for _ in range(80):  # every 15 s for 20 minutes, as the service sweeps
                dispatcher.resume()
                dispatcher._pool.submit(int).result()
                clock[0] += 15.0
        waits = [later - earlier for earlier, later in itertools.pairwise(tried)]
        assert waits == [15.0, 30.0, 45.0, 90.0, 165.0, 300.0, 300.0]
        # However long the disk was full, the job is not given up.
        assert row_of(ground, job)["attempts"] == 0
        clock[0] += 300.0
        dispatcher.resume()
        dispatcher.close()
        assert row_of(ground, job)["state"] in ("done", "queued")


def test_a_job_is_done_once_the_disk_has_space(
    downlink: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with open_ground(tmp_path) as ground:
        job = enter(ground, downlink)
        dispatcher = ThreadDispatcher(ground)
        with monkeypatch.context() as disk:
            disk.setattr(
                ingest_store, "store_batch", lambda *_: (_ for _ in ()).throw(StorageFull("database"))
            )
            dispatcher.resume()
            dispatcher._pool.submit(int).result()
        assert row_of(ground, job)["state"] == "queued"
        monkeypatch.setattr(dispatch.time, "monotonic", lambda: 1e12)
        dispatcher.resume()
        dispatcher._pool.submit(int).result()
        assert row_of(ground, job)["state"] == "done"
        dispatcher.close()
