"""The distributed form of a mission run: processes are killed, and the figures are those of the embedded form."""

import json
import socket
import sys
import threading
from pathlib import Path

from pytest import MonkeyPatch, approx, mark, raises

from benchmarks._servers import PidFile, PostgresServer
from benchmarks.campaigns._kills import PHASES, Keeper, Kill, PlannedKill, plan_kills
from benchmarks.campaigns.mission_kills import KillableSpacecraft, KillTerms, run_killed
from ground_service.contacts.links import service as links
from ground_service.errors import GroundError
from lunar.datafolder import DataFolder
from payload_emulator.session.scenario import parse_scenario
from studies.harness.parts import Part, kill_family, runs
from studies.mission_run.run import RunTerms, run_mission
from tests.mission_reports import figures_of
from tests.scenarios import commanded_scenario

HOUR_NS = 3_600_000_000_000

SCENARIO = commanded_scenario("half-a-day")

KILLED = (
    ("started", "database", 0.0), ("started", "spacecraft", 0.1), ("ended", "link", 0.3), ("ended", "worker", 0.0),
    ("settled", "broker", 0.2), ("settled", "api", 0.0),
)  # fmt: skip


def hold_telecommands_until_the_spacecraft_was_killed(monkeypatch):
    """Let the ground wait for the stations of a spacecraft that is killed meanwhile."""
    was_restarted = threading.Event()
    restart, unsent = KillableSpacecraft.restart, links.unsent

    def note_restart(spacecraft):
        restart(spacecraft)
        was_restarted.set()

    monkeypatch.setattr(KillableSpacecraft, "restart", note_restart)
    monkeypatch.setattr(links, "unsent", lambda *given: unsent(*given) or int(not was_restarted.is_set()))


@mark.campaign
def test_kills_do_not_change_the_figures_of_a_run(tmp_path, monkeypatch):
    monkeypatch.delenv("LINNA_DATA", raising=False)
    scenario, data = parse_scenario(SCENARIO), DataFolder(None)
    terms = RunTerms(days=0.25, windows_per_day=4, window_s=600.0)
    whole = run_mission(scenario, data, tmp_path / "whole", terms, print)
    planned = tuple(PlannedKill(scenario.epoch_utc_ns, phase, part, delay_s, 0.1) for phase, part, delay_s in KILLED)
    monkeypatch.setattr("benchmarks.campaigns.mission_kills.plan_kills", lambda *_: planned)
    hold_telecommands_until_the_spacecraft_was_killed(monkeypatch)
    folder = tmp_path / "killed"
    killing = KillTerms(0.25, windows_per_day=4, window_s=600.0, kill_seed=1, kills=len(planned))
    killed = run_killed(scenario, data, folder, killing, print)
    assert killed["kills"]["by_part"] == {part: 1 for _, part, _ in sorted(KILLED, key=lambda one: one[1])}
    assert killed["kills"]["done"] == killed["kills"]["planned"] == len(KILLED)
    # A report uses the time correlation of that moment, which further time reports of the contact change a little.
    assert figures_of(killed) == approx(figures_of(whole), rel=1e-5, abs=0.0, nan_ok=True)
    assert len(figures_of(whole)) > 50
    assert killed["windows"]["processed"] == killed["windows"]["flown"] > 0 and killed["interventions"] == 0
    assert killed["packets_received"] == killed["packets"] > 0 and killed["packets_lost"] == 0
    kills = killed["kills"]["list"]
    assert len(kills) == len(KILLED) and all(0.0 < one["recovery_s"] < 120.0 for one in kills)
    # Nothing is left of the deployment.
    assert not any(runs(pid) for pid, _ in json.loads((folder / "processes.json").read_text()).values())
    assert not Path((folder / "postgres-folder").read_text()).exists()


def test_a_kill_waits_for_the_process_that_it_kills_and_for_no_later_one(tmp_path, monkeypatch):
    """The run starts the spacecraft again as soon as it notices the kill."""
    part = sleeper(tmp_path)
    part.start()
    first = part.pid

    def kill_and_start(pid):
        kill_family(pid)
        part.start()

    monkeypatch.setattr("studies.harness.parts.kill_family", kill_and_start)
    part.kill()
    monkeypatch.undo()
    assert not runs(first) and runs(part.pid)
    part.end()


def test_a_spacecraft_is_started_again_after_the_kill_has_ended():
    done = []
    killing, started = threading.Event(), threading.Event()

    class SlowPart:
        def start(self):
            done.append("start")

        def kill(self):
            killing.set()
            started.wait(0.5)  # a restart that does not wait comes now
            done.append("killed")

    left, right = socket.socketpair()
    spacecraft = KillableSpacecraft.__new__(KillableSpacecraft)
    spacecraft.__dict__ |= {"_part": SlowPart(), "_lock": threading.Lock(), "_console": left}
    with left, right, MonkeyPatch.context() as patch:
        patch.setattr(KillableSpacecraft, "_disconnect", lambda _: None)
        killer = threading.Thread(target=spacecraft.kill)
        killer.start()
        killing.wait()
        spacecraft.restart()
        started.set()
        killer.join()
        spacecraft._lines.close()
    assert done == ["killed", "start"] and not spacecraft.was_killed


def test_kills_are_planned_by_their_seed_for_every_part_in_every_phase():
    parts = ["api", "database", "spacecraft"]
    found = plan_kills(7, parts, 0, 30 * HOUR_NS, 30)
    assert found == plan_kills(7, parts, 0, 30 * HOUR_NS, 30) != plan_kills(8, parts, 0, 30 * HOUR_NS, 30)
    assert [one.utc_ns // HOUR_NS for one in found] == list(range(30))
    assert {one.part for one in found[:3]} == {one.part for one in found[27:]} == set(parts)
    assert {one.phase for one in found} == set(PHASES)
    assert all(0.0 <= one.delay_s <= 2.0 and 0.0 <= one.down_s <= 2.0 for one in found)
    assert plan_kills(7, parts, 0, HOUR_NS, 0) == ()


def sleeper(folder):
    return Part([sys.executable, "-c", "import time; time.sleep(600)"], folder / "log", lambda: True)


def made_keeper(parts, planned, folder):
    return Keeper(parts, planned, lambda: None, lambda: None, folder / "kills.json", lambda line: None)


def test_a_part_is_killed_at_its_stop_once_and_a_part_that_ends_is_started_again(tmp_path):
    part = sleeper(tmp_path)
    planned = (PlannedKill(5, "ended", "api", 0.0, 0.0), PlannedKill(5, "started", "api", 0.0, 0.0))
    keeper = made_keeper({"api": part}, planned, tmp_path)
    part.start()
    try:
        first = part.pid
        keeper.start()
        keeper.at_stop("ended", 4)  # not due yet
        assert keeper.wait() and not keeper.kills
        keeper.at_stop("ended", 5)
        assert keeper.wait() and [(one.part, one.phase) for one in keeper.kills] == [("api", "ended")]
        second = part.pid
        assert second != first and not runs(first) and runs(second)
        part.kill()
        while part.pid == second:
            keeper.check()
        keeper.stop()
        assert runs(part.pid) and keeper.figures()["ended_by_themselves"] == {"api": 1}
        # A run that is continued carries out what is left.
        again = made_keeper({"api": part}, planned, tmp_path)
        assert again.kills == keeper.kills and isinstance(again.kills[0], Kill)
        again.start()
        again.at_stop("ended", 5)
        again.at_stop("started", 5)
        again.wait()
        again.stop()
        assert [one.phase for one in again.kills] == ["ended", "started"]
        assert again.figures()["by_part"] == {"api": 2}
    finally:
        part.end()


def test_a_part_that_ends_while_the_spacecraft_is_down_is_started_again(tmp_path):
    part = sleeper(tmp_path)
    keeper = made_keeper({"worker": part}, (PlannedKill(5, "ended", "spacecraft", 0.0, 0.0),), tmp_path)
    part.start()
    try:
        keeper.start()
        keeper.at_stop("ended", 5)
        assert not keeper.wait()  # the spacecraft is down
        first = part.pid
        part.kill()
        while part.pid == first:
            keeper.check()
        assert runs(part.pid)
        keeper.recovered()
        keeper.stop()
        assert [one.part for one in keeper.kills] == ["spacecraft"]
    finally:
        keeper.recovered()
        part.end()


def test_a_part_that_does_not_start_ends_the_run_with_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr("studies.harness.parts.START_S", 0.5)
    part = Part([sys.executable, "-c", "raise SystemExit('no home')"], tmp_path / "log", lambda: False)
    keeper = made_keeper({"api": part}, (), tmp_path)
    with raises(GroundError, match=r"expected it to start within .* found: no home"):
        part.start()
    keeper.start()
    with raises(GroundError, match="supervision of its parts"):
        while True:
            keeper.check()


def test_a_part_that_ends_at_once_is_given_up_after_its_attempts(tmp_path):
    log = tmp_path / "log"
    part = Part([sys.executable, "-c", "print('no home')"], log, lambda: False, attempts=2)
    with raises(GroundError, match=r"found: no home \| no home$"):
        part.start()
    assert log.read_text() == "no home\n" * 2


def test_processes_that_a_killed_run_has_left_are_ended_and_no_others(tmp_path):
    left, other = sleeper(tmp_path), sleeper(tmp_path)
    left.start()
    other.start()
    try:
        file = tmp_path / "processes.json"
        PidFile(file).note({"api": left.pid})
        known = json.loads(file.read_text())
        # A number that belongs to a later process now.
        known["worker"] = [other.pid, known["api"][1] - 1]
        file.write_text(json.dumps(known))
        PidFile(file).end_left_over()
        assert not runs(left.pid) and runs(other.pid) and not file.exists()
    finally:
        left.end()
        other.end()


def test_a_database_server_continues_with_its_files(tmp_path):
    first = PostgresServer(tmp_path)
    assert "//service@" in first.prepare_service()
    first.part.kill()
    again = PostgresServer(tmp_path)
    try:
        assert again.prepare_service().rpartition("/")[2] == "linna"
    finally:
        again.part.end()
        again.remove()
