"""Recurring work: one process has the lease, and another one continues when it is killed."""

import os
import signal
import subprocess
import sys
import textwrap
from itertools import pairwise
from unittest.mock import MagicMock, Mock

from pytest import fixture, mark

from ground_service.errors import StorageFull
from ground_service.ground import open_ground
from ground_service.regression import jobs
from ground_service.regression.model import COMPLETE, TELEMETRY_ONLY
from ground_service.store import leases
from ground_service.worker import scheduler as scheduling
from ground_service.worker.scheduler import LEASE, LEASE_NS, Scheduler, has_scheduler
from ground_service.worker.upkeep import nightly_job_id, plan_job_id
from linna import cli
from lunar.constants import DAY_NS
from lunar.timescales import parse_utc
from tests.serving import wait_for


class Recorder:
    """A dispatcher that keeps what it gets."""

    def __init__(self):
        self.resumed, self.submitted = 0, []

    def resume(self):
        self.resumed += 1

    def submit(self, kind, _arguments, *, job_id=None):
        assert kind in ("nightly", "plan", "regression")
        self.submitted.append(job_id)


def make(ground, placebo_passes=0, **options):
    recorder, nightly = Recorder(), {"retention_days": 90, "placebo_passes": placebo_passes}
    return Scheduler(ground, recorder, lambda: None, nightly, **options), recorder


@fixture(autouse=True)
def by_day(monkeypatch):
    """A time at which no nightly job is entered."""
    monkeypatch.setattr(scheduling, "utc_now_ns", lambda: parse_utc("2029-08-07T00:10:00Z"))


def test_one_of_two_works_until_its_lease_ends(either, monkeypatch):
    (first, work_1), (second, work_2) = make(either), make(either)
    now = [parse_utc("2029-08-07T00:00:00Z")]
    monkeypatch.setattr(leases, "database_now_ns", lambda connection: now[0])
    assert not has_scheduler(either)
    assert first.tick() and not second.tick() and first.tick() and has_scheduler(either)
    assert (work_1.resumed, work_2.resumed) == (2, 0)
    now[0] += LEASE_NS
    assert not second.tick()
    now[0] += 1
    assert not has_scheduler(either)
    assert second.tick() and not first.tick()
    assert (work_1.resumed, work_2.resumed) == (2, 1)


def test_a_lease_of_a_clock_that_was_ahead_is_ended(either, monkeypatch):
    (first, _), (second, _) = make(either), make(either)
    now = [parse_utc("2031-08-07T00:00:00Z")]
    monkeypatch.setattr(leases, "database_now_ns", lambda connection: now[0])
    assert first.tick()
    now[0] = parse_utc("2029-08-07T00:00:00Z")
    assert not has_scheduler(either)
    assert second.tick() and has_scheduler(either) and not first.tick()


def test_a_process_that_stops_gives_its_lease_back(ground, monkeypatch):
    monkeypatch.setattr(scheduling, "TICK_S", 0.01)
    (first, work), (second, _) = make(ground), make(ground)
    first.start()
    wait_for(lambda: work.resumed > 0, "the first scheduler")
    assert not second.tick()
    first.stop()
    assert second.tick()


def test_a_lease_is_not_given_back_by_somebody_else(either):
    with either.database.writing() as connection:
        assert leases.acquire(connection, "x", "ann", LEASE_NS)
        leases.release(connection, "x", "ben")
        assert leases.owner_of(connection, "x") == "ann"
        assert not leases.acquire(connection, "x", "ben", LEASE_NS)
        assert leases.acquire(connection, "y", "ben", LEASE_NS)


def test_the_nightly_job_is_entered_once_after_half_past_midnight(ground, monkeypatch):
    monkeypatch.setattr(scheduling, "CATCH_UP_S", -1.0)
    one, work = make(ground)
    midnight = parse_utc("2029-08-07T00:00:00Z")
    for minute, entered in (29, 0), (30, 1), (31, 1), (1439, 1), (1440 + 29, 1), (1440 + 30, 2):
        now = midnight + minute * 60_000_000_000
        monkeypatch.setattr(scheduling, "utc_now_ns", lambda now=now: now)
        one.tick()
        assert len(work.submitted) == entered, minute
    assert work.submitted == [nightly_job_id(midnight), nightly_job_id(midnight + DAY_NS)]


def test_each_night_a_placebo_takes_kept_archives_by_turns(ground, monkeypatch):
    kept = [MagicMock(digest=f"{k}" * 64, state=COMPLETE if k else TELEMETRY_ONLY) for k in range(5)]
    monkeypatch.setattr(jobs, "kept_archives", lambda ground: kept)
    chosen = []
    for night in range(3):
        now = parse_utc(f"2029-08-0{7 + night}T00:40:00Z")
        monkeypatch.setattr(jobs, "utc_now_ns", lambda now=now: now)
        placebo = jobs.nightly_placebo(ground, 3)
        assert placebo["candidate"] == placebo["baseline"] and placebo["placebo"] == now // DAY_NS
        chosen.append({one[0] for one in placebo["archives"]})
    assert [len(one) for one in chosen] == [3, 3, 3] and chosen[0] | chosen[1] == set("1234")
    assert chosen[0] != chosen[1] != chosen[2] and jobs.nightly_placebo(ground, 0) is None
    monkeypatch.setattr(scheduling, "utc_now_ns", lambda: now)
    monkeypatch.setattr(scheduling, "CATCH_UP_S", -1.0)
    one, work = make(ground, 3)
    one.tick()
    assert work.submitted == [nightly_job_id(now), nightly_job_id(now, "placebo")]
    kept.clear()
    assert jobs.nightly_placebo(ground, 3) is None


@mark.parametrize("hourly", [False, True])
def test_without_the_hourly_plan_only_events_plan(ground, hourly, monkeypatch):
    monkeypatch.setattr(scheduling, "needs_plan", lambda ground: True)
    begin, (one, work) = parse_utc("2029-08-07T05:00:00Z"), make(ground, plan_hourly=hourly)
    monkeypatch.setattr(scheduling, "mission_now_ns", lambda: begin)
    assert one.tick()
    assert (plan_job_id(begin) in work.submitted) == hourly


def test_the_plan_is_entered_once_an_hour_of_mission_time(ground, monkeypatch):
    one, work = make(ground)
    monkeypatch.setattr(scheduling, "needs_plan", lambda ground: True)
    begin = parse_utc("2029-08-07T05:00:00Z")
    for second, entered in (0, 1), (10, 1), (3599, 1), (3600, 2), (3610, 2):
        now = begin + second * 1_000_000_000
        monkeypatch.setattr(scheduling, "mission_now_ns", lambda now=now: now)
        one.tick()
        assert len(work.submitted) == entered, second
    assert work.submitted == [plan_job_id(begin), plan_job_id(begin + 3_600_000_000_000)]


@mark.parametrize("error", [StorageFull("database"), ConnectionError("refused")])
def test_one_part_of_the_work_that_fails_does_not_stop_the_others(ground, error, monkeypatch, caplog):
    one, work = make(ground)
    monkeypatch.setattr(scheduling, "needs_plan", lambda ground: True)
    work.resume = Mock(side_effect=error)
    assert one.tick() and len(work.submitted) == 1
    assert [one.message for one in caplog.records if one.levelname == "ERROR"] == [
        f"recurring work (unfinished jobs): failed: {error}"
    ]


def test_a_night_that_was_missed_is_made_up_for_after_a_while(ground, monkeypatch):
    monkeypatch.setattr(scheduling, "utc_now_ns", lambda: parse_utc("2029-08-07T12:00:00Z"))
    one, work = make(ground)
    one.tick()
    assert work.submitted == []
    monkeypatch.setattr(scheduling, "CATCH_UP_S", -1.0)
    other, work = make(ground)
    ground.write(leases.release, LEASE, one.owner)
    other.tick()
    assert len(work.submitted) == 1


def test_the_command_has_the_lease_until_it_is_stopped(tmp_path, monkeypatch, capsys):
    home = tmp_path / "home"
    monkeypatch.setenv("LINNA_HOME", str(home))
    with open_ground(home) as ground:
        assert cli.run(["scheduler", "--check"]) == 1
        expected = "linna: expected a process with the lease of the recurring work, found none\n"
        assert capsys.readouterr().err == expected
        process = subprocess.Popen([sys.executable, "-m", "linna", "scheduler"])
        try:
            wait_for(lambda: has_scheduler(ground), "the scheduler")
            assert cli.run(["scheduler", "--check"]) == 0
            process.terminate()
            assert process.wait() == 0
        finally:
            process.kill()
            process.wait()
        assert not has_scheduler(ground)


PROCESS = """
    import sys
    from pathlib import Path
    from ground_service.ground import open_ground
    from ground_service.store import repository
    from ground_service.worker import scheduler as scheduling

    scheduling.TICK_S, scheduling.LEASE_NS = 0.05, int(sys.argv[4])
    scheduling.utc_now_ns = lambda: 20 * DAY_NS
    ground = open_ground(Path(sys.argv[1]), database_url=sys.argv[2])

    class Recorder:
        def resume(self):
            with ground.database.reading() as connection:
                lease = repository.find(connection, repository.LEASES, name=scheduling.LEASE)
            if lease["owner"] == one.owner:
                with open(sys.argv[3], "a") as lines:
                    lines.write(f"{one.owner} {lease['lease_utc_ns']}\\n")

    one = scheduling.Scheduler(ground, Recorder(), lambda: None, {"retention_days": 90})
    one.run()
"""


def test_processes_on_postgresql_have_the_lease_one_after_the_other(migrated_postgres, tmp_path):
    """The one with the lease is killed, twice; each next one begins after the end of the lease before."""
    url, lines, lease_ns = migrated_postgres(), tmp_path / "lines", 700_000_000
    command = [sys.executable, "-c", textwrap.dedent(PROCESS), str(tmp_path / "home"), url, str(lines)]
    processes = [subprocess.Popen([*command, str(lease_ns)]) for _ in range(3)]

    def seen():
        found = lines.read_text().splitlines() if lines.exists() else []
        return [(owner, int(until)) for owner, until in (line.split() for line in found)]

    killed = []
    try:
        for _ in range(3):
            wait_for(lambda: any(owner not in killed for owner, _ in seen()), "the next scheduler")
            owner = next(owner for owner, _ in reversed(seen()) if owner not in killed)
            killed.append(owner)
            os.kill(int(owner.split(":")[1]), signal.SIGKILL)
    finally:
        for process in processes:
            process.kill()
            process.wait()
    assert len(set(killed)) == 3
    for (before, ended), (after, until) in pairwise(sorted(seen(), key=lambda one: one[1])):
        assert before == after or until - lease_ns > ended
