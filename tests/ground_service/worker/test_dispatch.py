"""Jobs in the process of the service and in workers: stopped, held back, going on; verification and upkeep."""

import itertools
import json
import os
import re
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock, Mock

import numpy as np
from pytest import approx, fixture, mark, raises
from sqlalchemy import func, select, text

from ground_service.access import service as users
from ground_service.access.service import audit
from ground_service.clock import utc_now_ns
from ground_service.contacts.commanding.service import enter_command, note_timeouts, release_command, take_uplink
from ground_service.errors import DatabaseNotMigrated, SettingsError, StorageFull
from ground_service.evaluation.service import make_report, pass_summary
from ground_service.ground import open_ground
from ground_service.http.model import Paging
from ground_service.ingest import reception
from ground_service.ingest import store as ingest_store
from ground_service.ingest.service import PiecePosition, enter_ingest, ingest_file
from ground_service.jobs.service import enter_job
from ground_service.passes import service as passes
from ground_service.passes.archive_import import import_archive
from ground_service.passes.core import downsample
from ground_service.passes.service import spacecraft_trends, trend_of
from ground_service.regression.archives import keep_archive, working_folder
from ground_service.regression.builds import load_build, register_build
from ground_service.regression.jobs import missing_replays, prepared
from ground_service.settings import Settings
from ground_service.store import files, repository
from ground_service.store.database import prepare_database
from ground_service.store.event_kinds import read_events
from ground_service.store.events import publish
from ground_service.store.models import METADATA, ROLLUPS
from ground_service.store.rows import table_digests
from ground_service.worker import app as app_module
from ground_service.worker import dispatch
from ground_service.worker.app import queued_jobs, run_worker, worker_answers
from ground_service.worker.dispatch import ThreadDispatcher, dispatcher_for
from ground_service.worker.integrity import same_values, verify
from ground_service.worker.jobs import run_job
from ground_service.worker.upkeep import nightly, nightly_job_id, tidy
from tests.ground_service.archive_hash import hash_of
from tests.ground_service.conftest import event_packet
from tests.ground_service.worker.test_automation import row_of
from tests.serving import token_valid, wait_for
from tmtc.dictionary.payload import DICTIONARY
from tmtc.downlink import encode_cadus


@fixture(scope="module")
def downlink(make_pass):
    return Path(make_pass(frames=30, seed=4).folder) / "downlink.cadu"


@fixture
def small_windows(monkeypatch):
    """The stream is stored in about ten transactions."""
    monkeypatch.setattr(files, "BLOCK_OCTETS", 4_000)
    monkeypatch.setattr(reception, "WINDOW_OCTETS", 4_000)


def enter(ground, downlink):
    stored = ground.files.put_file(downlink)
    return enter_ingest(ground, stored, "d", spacecraft_id=76, instance="flight")[1]


@mark.usefixtures("small_windows")
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
            assert go_on.wait()
        return result

    with monkeypatch.context() as slow:
        slow.setattr(ingest_store, "store_batch", store)
        with open_ground(tmp_path / "stopped") as ground:
            dispatcher = ThreadDispatcher(ground)
            job, behind = enter(ground, downlink), enter(ground, downlink)
            dispatcher.start(job)
            dispatcher.start(behind)
            assert middle.wait()
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
        for job in *replays, verdict:
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


@mark.parametrize("stated", [HERE, {**HERE, "place": PiecePosition("s", 100)}, {"instance": "twin"}])
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


@mark.parametrize(
    "damage, reason",
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
    for index, change, same in (1, 1e-16, True), (1, 1e-6, False), (3, 1e-16, False), (0, 1.0, False):
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


DAY_NS = 86_400_000_000_000


def test_a_trend_has_the_slope_of_its_line():
    field = DICTIONARY.packet("housekeeping").field("temperature_c")
    utc_ns = np.arange(200, dtype=np.int64) * (DAY_NS // 40)
    trend = trend_of(field, downsample(utc_ns, 20.0 + 3.0 * utc_ns / DAY_NS, 50))
    assert trend.slope_per_day == approx(3.0, rel=1e-9)
    assert (trend.samples, trend.limit_state) == (200, "within")
    # 62 degrees is above the warning limit of 60 of the dictionary, 90 above the alarm limit of 85
    for value, state in (62.0, "warning"), (90.0, "alarm"):
        hot = trend_of(field, downsample(utc_ns[:2], np.array([20.0, value]), 50))
        assert hot.limit_state == state
    assert trend_of(field, downsample(utc_ns[:0], np.zeros(0), 5)) is None


def test_the_night_tells_trends_and_broken_limits(ground, synthetic_pass):
    ingest_file(ground, synthetic_pass.folder / "downlink.cadu")
    trends = {trend.parameter: trend for trend in spacecraft_trends(ground, 76, "flight")}
    # 0.1 degrees more every 15 s: 576 degrees a day
    assert trends["temperature_c"].slope_per_day == approx(576.0, rel=1e-6)
    job = enter_job(ground, "nightly", {}, job_id=nightly_job_id(DAY_NS + 5))
    assert job == enter_job(ground, "nightly", {}, job_id=nightly_job_id(DAY_NS + 99))
    assert job != nightly_job_id(2 * DAY_NS)
    done = run_job(ground, job)
    assert done.state == "done", done.error
    assert (done.result["spacecraft"][0]["spacecraft_id"], done.result["limits_broken"]) == (76, [])


def test_what_is_old_goes_and_the_record_stays(ground, monkeypatch):
    with ground.database.writing() as connection:
        for _ in range(3):
            publish(connection, "note", {})
        with monkeypatch.context() as long_ago:
            long_ago.setattr("ground_service.access.service.utc_now_ns", lambda: 0)
            audit(connection, "ann", "look", "", {})
    with ground.database.writing() as connection:
        connection.execute(repository.EVENT_LOG.update().values(utc_ns=0))
        connection.execute(repository.ANSWERS.insert().values(key="k", request="r", answer={"id": 1}, created_utc_ns=0))
    for name in ".incoming-old", ".incoming-new":
        ground.files.root.mkdir(exist_ok=True)
        (ground.files.root / name).write_bytes(b"")
    os.utime(ground.files.root / ".incoming-old", (0, 0))
    regression = ground.home / "regression"
    (regression / "files").mkdir(parents=True)
    (regression / "files/.incoming-old").write_bytes(b"")
    (regression / "scratch/.working-old/archive").mkdir(parents=True)
    for name in "files/.incoming-old", "scratch/.working-old":
        os.utime(regression / name, (0, 0))
    with working_folder(ground) as in_use:
        removed = tidy(ground, 90)
        assert in_use.is_dir()
    assert removed == {"events": 2, "jobs": 0, "answers": 1, "sessions": 0, "files": 3}
    assert [path.name for path in (regression / "scratch").iterdir()] == []
    assert [item.number for item in read_events(ground.database, 0)] == [3]
    assert ground.read(repository.newest, repository.AUDIT, Paging())[1] == 1


def test_nothing_is_removed_in_the_first_night_after_a_jump_of_the_clock(ground, monkeypatch):
    enter_job(ground, "plan", {})
    now = utc_now_ns() + 400 * DAY_NS
    monkeypatch.setattr("ground_service.worker.upkeep.utc_now_ns", lambda: now)
    assert nightly(ground, {})["removed"] == {}
    enter_job(ground, "nightly", {}, job_id=nightly_job_id(now))
    now += DAY_NS
    assert "events" in nightly(ground, {})["removed"]


def counts(ground):
    with ground.database.reading() as connection:
        return {
            name: connection.execute(select(func.count()).select_from(table)).scalar_one()
            for name, table in METADATA.tables.items()
        }


def test_ten_years_later_the_record_is_complete_and_the_operation_is_gone(ground, synthetic_pass, monkeypatch):
    """The documented policy names every table, and the nightly job deletes from no other one."""
    text = (Path(__file__).parents[3] / "docs/archive.md").read_text()
    rows = text.partition("## Retention")[2].partition("## Schema")[0].splitlines()
    policy = {table: row.split("|")[1].strip() for row in rows for table in re.findall(r"`([a-z_]+)`", row)}
    assert set(policy) == set(METADATA.tables)
    make_report(ground, import_archive(ground, synthetic_pass.folder))
    run_job(ground, enter_job(ground, "plan", {}))
    before, files = counts(ground), sorted(ground.files.root.rglob("*"))
    later = utc_now_ns() + 3653 * DAY_NS
    for module in "upkeep", "jobs":
        monkeypatch.setattr(f"ground_service.worker.{module}.utc_now_ns", lambda: later)
    removed = tidy(ground, 90)
    after = counts(ground)
    assert {policy[name] for name in before if before[name] != after[name]} == {"operation"}
    assert removed["jobs"] == before["jobs"] >= 1 and after["event_log"] < before["event_log"]
    assert files == sorted(ground.files.root.rglob("*"))


def test_expired_sessions_are_deleted_and_tokens_are_kept(ground, monkeypatch):
    token = users.add_user(ground, "ann", "operator", days_valid=0.001)
    old, _ = users.start_session(ground, token)
    later = utc_now_ns() + DAY_NS
    for module in "ground_service.access.service", "ground_service.worker.upkeep":
        monkeypatch.setattr(f"{module}.utc_now_ns", lambda: later)
    new, _ = users.start_session(ground, users.add_token(ground, "ann"))
    tokens = {one.id for one in users.list_tokens(ground)}
    assert tidy(ground, 90)["sessions"] == 1
    assert tidy(ground, 90)["sessions"] == 0
    # The expired token of the user remains listed; the new session and its token are in force.
    assert len(tokens) == 4 and len({one.id for one in users.list_tokens(ground)}) == 3
    assert token_valid(ground, new) and not token_valid(ground, old)


def test_answers_are_kept_until_telemetry_is_new(ground, synthetic_pass, monkeypatch, tmp_path):
    half = len(synthetic_pass.packets) // 2
    (tmp_path / "a.cadu").write_bytes(encode_cadus(synthetic_pass.packets[:half], spacecraft_id=76))
    vehicle = ingest_file(ground, tmp_path / "a.cadu").vehicle_id
    read = Mock(wraps=passes._trends)
    monkeypatch.setattr(passes, "_trends", read)
    first = passes.vehicle_trends(ground, vehicle)
    assert passes.vehicle_trends(ground, vehicle) == first and read.call_count == 1
    ingest_file(ground, synthetic_pass.folder / "downlink.cadu")
    second = passes.vehicle_trends(ground, vehicle)
    assert read.call_count == 2
    assert {one.parameter: one.samples for one in second} != {one.parameter: one.samples for one in first}


def job_row(ground, job_id):
    return ground.read(repository.get, repository.JOBS, job_id, "job")


def finished(ground, job_id):
    wait_for(lambda: job_row(ground, job_id)["state"] in ("done", "failed"), f"the end of job {job_id}")
    return job_row(ground, job_id)


@fixture(scope="module")
def upgraded(postgres_url):
    with raises(DatabaseNotMigrated, match="run 'linna db upgrade'"):
        prepare_database(postgres_url)
    prepare_database(postgres_url, upgrade=True).engine.dispose()
    return postgres_url


@fixture(scope="module")
def ground_on_postgres(upgraded, tmp_path_factory):
    with open_ground(tmp_path_factory.mktemp("pg") / "home", database_url=upgraded) as ground:
        yield ground


def test_the_archive_is_the_same_as_on_sqlite(ground_on_postgres, ground, synthetic_pass):
    stream = synthetic_pass.folder / "downlink.cadu"
    hashes = []
    for one in ground, ground_on_postgres:
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
            worker.wait()
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
    for use in run_worker, worker_answers:
        with raises(SettingsError, match="LINNA_BROKER_URL: expected a broker"):
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


def test_a_broker_that_is_away_refuses_nothing_and_nobody_waits_for_it(ground, tmp_path, monkeypatch):
    pauses = []
    monkeypatch.setattr("kombu.utils.functional.sleep", pauses.append)
    settings = Settings(home=tmp_path, broker_url="redis://127.0.0.1:1/0")
    dispatcher = dispatcher_for(ground, settings)
    job = dispatcher.submit("report", {"pass_id": 1})
    dispatcher.resume()
    assert job_row(ground, job)["state"] == "queued" and sum(pauses) < 1.0


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
