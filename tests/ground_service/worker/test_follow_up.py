"""Events and their follow-up work: nothing lost, nothing done twice, re-evaluation after late data."""

import json
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

from fastapi.testclient import TestClient
from pytest import fixture, raises
from sqlalchemy import update

from ground_service.app import create_app
from ground_service.errors import StorageFull
from ground_service.evaluation.core import evaluate_pass
from ground_service.evaluation.model import ChangedFigure, changed_figures
from ground_service.evaluation.service import make_report
from ground_service.evaluation.store import list_reports
from ground_service.ground import open_ground
from ground_service.http.model import Paging
from ground_service.ingest.service import ingest_file
from ground_service.jobs.service import unfinished_jobs
from ground_service.passes.service import define_pass
from ground_service.settings import Settings
from ground_service.store import event_kinds as events
from ground_service.store import events as log
from ground_service.store import repository
from ground_service.store.event_kinds import (
    CommandsSent,
    CorrelationChanged,
    FollowUpFailed,
    PassEvaluated,
    TelemetryReceived,
    publish,
)
from ground_service.worker import follow_up
from ground_service.worker.follow_up import FollowUp, follow_in_process
from lunar.timescales import parse_utc
from tests.ground_service.conftest import SPACECRAFT, encode_downlink


def kinds(ground):
    return [event.kind for event in events.read_events(ground.database, 0, 1000)]


def position(ground):
    return ground.read(log.position_of, follow_up.CONSUMER)


def jobs_of(ground, kind):
    return ground.read(repository.newest, repository.JOBS, Paging(), kind=kind)[0]


def say(ground, *given):
    with ground.database.writing() as connection:
        for event in given:
            publish(connection, event)


def command(vehicle=1):
    return CommandsSent(vehicle_id=vehicle, telecommands=(1,))


class Recorded:
    """Stands in for the work: keeps what was asked for, and can fail."""

    def __init__(self, monkeypatch):
        self.done, self.error = [], None
        monkeypatch.setattr(follow_up, "DOING", {name: self._work(name) for name in follow_up.DOING})

    def _work(self, name):
        def work(_ground, key, _event):
            if self.error is not None:
                raise self.error
            self.done.append((name, key))
            return None

        return work


@fixture
def recorded(monkeypatch):
    return Recorded(monkeypatch)


def test_an_event_exists_only_if_its_change_was_committed(either):
    with raises(RuntimeError), either.database.writing() as connection:
        publish(connection, command())
        raise RuntimeError
    assert kinds(either) == []
    with raises(RuntimeError, match="writing"):
        either.read(publish, command())


def test_numbers_have_no_gaps_and_follow_the_order_of_commits(either):
    def write(seed):
        for k in range(10):
            if (seed + k) % 3 == 0:
                with raises(RuntimeError), either.database.writing() as connection:
                    log.publish(connection, "test", {"lost": k})
                    raise RuntimeError
            either.write(log.publish, "test", {"seed": seed, "k": k})

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(write, range(4)))
    found = events.read_events(either.database, 0, 1000)
    assert [event.number for event in found] == list(range(1, 41))
    for seed in range(4):
        assert [event.payload["k"] for event in found if event.payload["seed"] == seed] == list(range(10))


def test_equal_work_of_several_events_is_done_once_and_in_order(ground, recorded):
    with ground.database.listeners.held():
        for vehicle in (7, 5, 7):
            say(ground, TelemetryReceived(vehicle_id=vehicle, packets=1))
        assert recorded.done == []
    assert recorded.done == [
        ("recorrelate", 5), ("recorrelate", 7), ("alarms", 5), ("alarms", 7), ("advance windows", 5),
        ("advance windows", 7),
    ]  # fmt: skip
    assert position(ground) == 3


def test_work_of_a_failed_block_is_still_done(ground, recorded):
    with raises(RuntimeError), ground.database.listeners.held():
        say(ground, command(3))
        raise RuntimeError
    assert recorded.done == [("advance windows", 3)]


def test_events_of_a_process_that_ended_are_handled_by_the_next(tmp_path, recorded):
    with open_ground(tmp_path) as ground:  # ends between the commit and the follow-up work
        say(ground, command(3))
    assert recorded.done == []
    with open_ground(tmp_path) as ground:
        follow_in_process(ground).drain()
        assert recorded.done == [("advance windows", 3)]
        follow_in_process(ground).drain()
        assert recorded.done == [("advance windows", 3)]


def test_work_that_meets_a_passing_error_is_repeated(ground, recorded):
    recorded.error = StorageFull("disk")
    say(ground, command(3))
    assert (recorded.done, position(ground)) == ([], 0)
    recorded.error = None
    say(ground, command(4))
    assert recorded.done == [("advance windows", 3), ("advance windows", 4)]
    assert FollowUpFailed.event_kind not in kinds(ground)


def test_work_that_fails_is_reported_with_its_events_and_does_not_stop_others(ground, recorded):
    recorded.error = ValueError("broken")
    say(ground, command(3))
    recorded.error = None
    say(ground, command(4))
    assert recorded.done == [("advance windows", 4)]
    [failed] = [e for e in events.read_events(ground.database, 0) if e.kind == FollowUpFailed.event_kind]
    assert failed.payload == {"work": "advance windows 3", "events": [1], "error": "ValueError: broken"}


def test_an_event_that_cannot_be_read_does_not_stop_others(ground, recorded):
    with ground.database.writing() as connection:
        log.publish(connection, CommandsSent.event_kind, {"vehicle": "?"})
        publish(connection, command(4))
    assert recorded.done == [("advance windows", 4)]
    assert kinds(ground)[-1] == FollowUpFailed.event_kind


def test_several_processes_handle_each_event_once(migrated_postgres, recorded, tmp_path):
    url = migrated_postgres()
    grounds = [open_ground(tmp_path / f"{k}", database_url=url) for k in range(3)]
    for ground in grounds:
        follow_in_process(ground)

    def run(ground, first):
        for k in range(8):
            say(ground, command(first + k))
            assert ("advance windows", first + k) in recorded.done  # complete before the caller continues

    with ThreadPoolExecutor(3) as pool:
        list(pool.map(run, grounds, (0, 100, 200)))
    assert len(recorded.done) == len(set(recorded.done)) == 24
    assert position(grounds[0]) == 24
    for ground in grounds:
        ground.close()


def test_a_service_starts_while_another_process_handles_a_backlog(migrated_postgres, tmp_path, monkeypatch):
    def waits(_seconds):
        raise AssertionError("the start waits for another process")

    url = migrated_postgres()
    settings = Settings(home=tmp_path / "home", database_url=url, allow_database_owner=True)
    with open_ground(tmp_path / "other", database_url=url) as other, other.database.alone("events") as alone:
        assert alone
        say(other, command())
        monkeypatch.setattr(follow_up, "time", SimpleNamespace(sleep=waits))
        with TestClient(create_app(settings)):
            assert position(other) == 0


def test_old_events_are_deleted_only_after_they_were_handled(ground, recorded):
    say(ground, command())
    recorded.error = StorageFull("disk")
    say(ground, command(2), command(3))
    with ground.database.writing() as connection:
        connection.execute(update(repository.EVENT_LOG).values(utc_ns=0))
        assert log.delete_before(connection, 10) == 1
    assert [event.number for event in events.read_events(ground.database, 0)] == [2, 3]


@fixture(scope="module")
def halves(make_pass, tmp_path_factory):
    """Downlink of the first three quarters of a pass, and the rest."""
    packets, folder = make_pass(frames=24, seed=6).packets, tmp_path_factory.mktemp("late")
    cut, paths = len(packets) * 3 // 4, (folder / "early.cadu", folder / "late.cadu")
    for path, part in zip(paths, (packets[:cut], packets[cut:]), strict=True):
        path.write_bytes(encode_downlink(part))
    return paths


def reported_pass(ground, early):
    ingest_file(ground, early, spacecraft_id=SPACECRAFT)
    pass_id = define_pass(
        ground, name="late data", start_utc_ns=parse_utc("2029-08-07T05:50:00Z"),
        stop_utc_ns=parse_utc("2029-08-07T06:30:00Z"), spacecraft_id=SPACECRAFT,
    )  # fmt: skip
    make_report(ground, pass_id)
    return pass_id


def reports_of(ground, pass_id):
    rows, _ = ground.read(repository.newest, repository.REPORTS, Paging(limit=10), pass_id=pass_id)
    return sorted(rows, key=lambda row: int(row["created_utc_ns"]))


def test_late_data_make_a_report_with_the_changed_figures_and_their_event(either, halves):
    pass_id = reported_pass(either, halves[0])
    assert len(reports_of(either, pass_id)) == 1
    ingest_file(either, halves[1], spacecraft_id=SPACECRAFT)
    first, again = reports_of(either, pass_id)
    assert again["previous_id"] == first["id"] and first["event_number"] is None
    cause = next(e for e in events.read_events(either.database, 0, 1000) if e.number == again["event_number"])
    assert cause.kind == TelemetryReceived.event_kind
    changed = {one["figure"]: (one["before"], one["after"]) for one in again["changes"]}
    assert changed["frames"] == (first["summary"]["frames"], again["summary"]["frames"])
    assert first["summary"]["frames"] < again["summary"]["frames"]
    items = either.read(list_reports, pass_id, Paging()).items
    assert [one.id for one in items] == [again["id"], first["id"]]
    assert (items[0].event, items[0].previous) == (again["event_number"], first["id"])
    assert {one.figure for one in items[0].changes or ()} == set(changed) and items[1].changes is None
    made = [e for e in events.read_events(either.database, 0, 1000) if e.kind == PassEvaluated.event_kind]
    assert [e.payload.get("event") for e in made] == [None, again["event_number"]]


def test_the_same_data_again_make_no_report(ground, halves):
    pass_id = reported_pass(ground, halves[0])
    ingest_file(ground, halves[0], spacecraft_id=SPACECRAFT)
    assert len(reports_of(ground, pass_id)) == 1 and jobs_of(ground, "re-evaluation") == []


def test_late_data_evaluate_a_pass_once_for_the_comparison_and_the_report(ground, halves, monkeypatch):
    pass_id, evaluated = reported_pass(ground, halves[0]), list[str]()

    def evaluate(inputs):
        evaluated.append(inputs.pass_id)
        return evaluate_pass(inputs)

    monkeypatch.setattr("ground_service.evaluation.service.evaluate_pass", evaluate)
    ingest_file(ground, halves[1], spacecraft_id=SPACECRAFT)
    _, again = reports_of(ground, pass_id)
    assert evaluated == [str(pass_id)]
    made = json.loads(ground.files.get(again["json_sha256"]))["created_utc"]
    assert parse_utc(made) // 10**9 == again["created_utc_ns"] // 10**9


def test_an_event_that_changes_nothing_of_a_pass_makes_no_report(ground, halves):
    pass_id = reported_pass(ground, halves[0])
    vehicle = ground.read(repository.get, repository.PASSES, pass_id, "pass")["vehicle_id"]
    # Telemetry of another time does not evaluate the pass again.
    say(ground, TelemetryReceived(vehicle_id=vehicle, packets=1, first_ticks=0, last_ticks=1))
    say(ground, CorrelationChanged(vehicle_id=vehicle, segments=1))
    assert jobs_of(ground, "re-evaluation") == []
    # A correlation that moves its time does.
    say(ground, CorrelationChanged(vehicle_id=vehicle, segments=1, first_ticks=0, last_ticks=(1 << 48) - 1))
    [job] = jobs_of(ground, "re-evaluation")
    assert (job["state"], job["result"]["report_id"]) == ("done", None)
    assert len(reports_of(ground, pass_id)) == 1


def test_a_re_evaluation_that_waits_already_is_not_added_again(tmp_path, halves):
    with open_ground(tmp_path) as ground:
        follow = FollowUp(ground, start=lambda _job: None)
        pass_id = reported_pass(ground, halves[0])
        follow.drain()
        for cut in halves[::-1]:
            ingest_file(ground, cut, spacecraft_id=SPACECRAFT)
            follow.drain()
            follow.drain()
        assert len(jobs_of(ground, "re-evaluation")) == 1 == len(ground.read(unfinished_jobs))
        assert len(reports_of(ground, pass_id)) == 1


def test_changed_figures_of_nested_summaries():
    before = {"a": 1, "b": {"c": 2.0, "d": None}, "e": [1, 2]}
    after = {"a": 1, "b": {"c": 3.0, "d": None}, "e": [1, 3], "f": "new"}
    changes = ("b.c", 2.0, 3.0), ("e", [1, 2], [1, 3]), ("f", None, "new")
    assert changed_figures(before, after) == [ChangedFigure(figure=f, before=b, after=a) for f, b, a in changes]
    assert changed_figures(before, before) == []
