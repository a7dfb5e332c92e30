"""Jobs done in the process of the service: stopped in the middle, held back, and going on. A regression as jobs,
one for each replay and one for the verdict. Verification derives everything again from the raw files, as in
their first ingest, and compares.
"""

import itertools
import threading
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import text

from ground_service.errors import StorageFull
from ground_service.ground import open_ground
from ground_service.ingest import reception
from ground_service.ingest import store as ingest_store
from ground_service.ingest.service import PiecePosition, enter_ingest, ingest_file
from ground_service.regression.archives import keep_archive
from ground_service.regression.builds import load_build, register_build
from ground_service.regression.jobs import missing_replays, prepared
from ground_service.settings import Settings
from ground_service.store import files, repository
from ground_service.store.models import ROLLUPS
from ground_service.store.rows import table_digests
from ground_service.worker import dispatch
from ground_service.worker.dispatch import ThreadDispatcher, dispatcher_for
from ground_service.worker.integrity import same_values, verify
from ground_service.worker.jobs import run_job
from tests.ground_service.archive_hash import hash_of
from tests.ground_service.conftest import event_packet
from tests.ground_service.worker.test_jobs import row_of
from tmtc.dictionary.payload import DICTIONARY
from tmtc.downlink import encode_cadus


@pytest.fixture(scope="module")
def downlink(make_pass):
    return Path(make_pass(frames=30, seed=4).folder) / "downlink.cadu"


@pytest.fixture
def small_windows(monkeypatch):
    """The stream is stored in about ten transactions."""
    monkeypatch.setattr(files, "BLOCK_OCTETS", 4_000)
    monkeypatch.setattr(reception, "WINDOW_OCTETS", 4_000)


def enter(ground, downlink):
    stored = ground.files.put_file(downlink)
    return enter_ingest(ground, stored, "d", spacecraft_id=76, instance="flight")[1]


@pytest.mark.usefixtures("small_windows")
def test_an_ingest_is_broken_off_when_the_service_stops_and_goes_on_at_the_next_start(downlink, tmp_path, monkeypatch):
    with open_ground(tmp_path / "whole") as ground:
        ingest_file(ground, downlink)
        expected = hash_of(ground)
    stored = []
    middle, go_on = threading.Event(), threading.Event()
    original = ingest_store.store_batch

    def store(*given):
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


def test_a_job_that_the_disk_stops_is_held_back_longer_each_time(downlink, tmp_path, monkeypatch):
    clock = [0.0]
    tried = []

    def no_space(*_):
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


def test_a_job_is_done_once_the_disk_has_space(downlink, tmp_path, monkeypatch):
    with open_ground(tmp_path) as ground:
        job = enter(ground, downlink)
        dispatcher = ThreadDispatcher(ground)
        with monkeypatch.context() as disk:
            disk.setattr(ingest_store, "store_batch", lambda *_: (_ for _ in ()).throw(StorageFull("database")))
            dispatcher.resume()
            dispatcher._pool.submit(int).result()
        assert row_of(ground, job)["state"] == "queued"
        monkeypatch.setattr(dispatch.time, "monotonic", lambda: 1e12)
        dispatcher.resume()
        dispatcher._pool.submit(int).result()
        assert row_of(ground, job)["state"] == "done"
        dispatcher.close()


def test_replays_are_separate_jobs_and_the_verdict_follows(redis_url, make_flyable, make_build, tmp_path):
    flown = {f"synthetic pass {seed}": make_flyable(frames=10, seed=seed) for seed in (61, 62)}
    packets = {name: one.packets for name, one in flown.items()}
    home = tmp_path / "home"
    with open_ground(home) as ground:
        archives = [keep_archive(ground, one.folder).digest for one in flown.values()]
        builds = [
            register_build(ground, load_build(make_build(name, packets, network_ms=cost))).digest
            for name, cost in (("old", 10.0), ("new", 10.1))
        ]
        dispatcher = dispatcher_for(ground, Settings(home=home, broker_url=redis_url))
        arguments = prepared(ground, builds[1], builds[0], archives)
        replays = [dispatcher.submit("replay", replay) for replay in missing_replays(ground, arguments)]
        assert len(replays) == 4
        verdict = dispatcher.submit("regression", arguments)
        for job in (*replays, verdict):
            run_job(ground, job)
        rows = [row_of(ground, job) for job in (*replays, verdict)]
        assert [row["state"] for row in rows] == ["done"] * 5
        assert rows[-1]["result"] == {"regression_id": verdict, "verdict": "pass"}
        assert [row["result"]["outcome"] for row in rows[:-1]] == ["ok"] * 4
        kept = ground.read(repository.get, repository.REGRESSIONS, verdict, "regression")
        assert [one["state"] for one in kept["result"]["passes"]] == ["judged", "judged"]


SPACECRAFT = 76


def stream_of(spacecraft=SPACECRAFT):
    return encode_cadus([event_packet(k << 16, k, "boot") for k in range(1, 41)], spacecraft_id=spacecraft)


def ingest(ground, octets, **stated):
    path = ground.home / "d.cadu"
    path.write_bytes(octets)
    ingest_file(ground, path, **stated)


HERE = {"spacecraft_id": SPACECRAFT}


@pytest.mark.parametrize("stated", [HERE, {**HERE, "place": PiecePosition("s", 100)}, {"instance": "twin"}])
def test_what_was_stated_with_a_downlink_holds_for_its_verification(ground, stated):
    """A spacecraft filter excludes the same packets; pieces with a position are joined by position."""
    octets = stream_of() + stream_of(SPACECRAFT + 1)
    place = stated.pop("place", None)
    cuts = [0, len(octets)] if place is None else [*range(0, 1200, 60), len(octets)]
    for start, stop in reversed(list(itertools.pairwise(cuts))):
        stands = None if place is None else PiecePosition(place.stream, place.offset + start)
        ingest(ground, octets[start:stop], place=stands, **stated)
    result = verify(ground, rebuild=True)
    assert (result.verdict, result.damaged) == ("intact", [])


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        ("UPDATE rollups SET rows = rows + 1 WHERE level = 6", "values of its packets, found others"),
        ("DELETE FROM rollups WHERE level = 6", "expected this row, found none"),
    ],
)
def test_a_damaged_row_is_named(either, damage, reason):
    values = {field.name: 1 for field in DICTIONARY.packet("housekeeping").fields}
    packet = DICTIONARY.pack("housekeeping", values, ticks=1 << 16, sequence_count=0)
    ingest(either, encode_cadus([packet], spacecraft_id=SPACECRAFT))
    assert verify(either, rebuild=True).damaged == []
    with either.database.writing() as connection:
        connection.execute(text(damage))
    assert reason in " ".join(f"{one.kind} {one.key}: {one.reason}" for one in verify(either, rebuild=True).damaged)
    assert verify(either).damaged == []


def test_an_ingest_before_version_1_has_no_piece(either):
    """The spacecraft of the ingest selects the frames."""
    ingest(either, stream_of() + stream_of(SPACECRAFT + 1), spacecraft_id=SPACECRAFT)
    with either.database.writing() as connection:
        connection.execute(text("DELETE FROM pieces"))
    assert verify(either, rebuild=True).damaged == []


def test_sums_of_roll_ups_may_differ_by_the_order_of_addition(ground):
    row = np.array([3.0, 0.6, 0.1, 0.3, 0.0, 0.0, np.inf, -np.inf])
    for index, change, same in ((1, 1e-16, True), (1, 1e-6, False), (3, 1e-16, False), (0, 1.0, False)):
        other = row.copy()
        other[index] += change
        pair = [((1,), (1, 2, 3, one.tobytes())) for one in (row, other)]
        assert same_values(ROLLUPS, *pair) == same


def test_a_rebuild_writes_nothing_to_the_archive(either):
    ingest(either, stream_of())
    with either.database.snapshot() as connection:
        before = table_digests(connection)
    names = sorted(either.files.names())
    assert verify(either, rebuild=True).verdict == "intact"
    with either.database.snapshot() as connection:
        assert table_digests(connection) == before
    assert sorted(either.files.names()) == names
