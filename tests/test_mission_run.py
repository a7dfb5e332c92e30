"""A simulated mission from end to end: spacecraft, stations, ground, reports; and what goes on after a stop."""

import json
import re
import sqlite3
import subprocess
import sys
from contextlib import closing, nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
from pytest import approx, fixture, mark, raises

from ground_service.client.local import local_client
from ground_service.clock import mission_now_ns, set_mission_clock
from ground_service.ground import open_ground
from ground_service.http.model import UtcTime
from ground_service.planning.model import PlannedCandidate, RequestPlan
from linna import cli
from lunar.boxes import Box, inside_box
from lunar.catalogue import make_catalogue
from lunar.datafolder import DataFolder
from lunar.messages.ephemeris_files import load_ephemeris
from lunar.timescales import parse_utc
from payload_emulator.errors import LinkError, ScenarioError
from payload_emulator.session.archive.mission import live_mission_text
from payload_emulator.session.scenario import parse_scenario
from payload_emulator.session.world.regions import observed_boxes
from payload_emulator.session.world.world import open_world
from studies.harness.parts import descendants
from studies.mission_run.checkpoints import Checkpoints
from studies.mission_run.disturbances import UNDISTURBED, ReferenceDisturbances, load_disturbances
from studies.mission_run.dynamics import FlightDynamics
from studies.mission_run.figures import Progress, missing_windows, note_plan, windows_asked
from studies.mission_run.ground import EmbeddedGround
from studies.mission_run.run import MissionRun, RunTerms, _take_turns, read_progress, run_fleet, run_mission
from tests.mission_reports import figures_of
from tests.scenarios import commanded_scenario

SCENARIO = commanded_scenario("half-a-day", "[clock]\noffset_s = 0.4\ndrift_ppm = 5.0\n")
SECOND = f'spacecraft = "Second"\nspacecraft_id = 77{SCENARIO.replace("seed = 3", "seed = 4")}'
DRIFT_PPM = 5.0


NO_DATA = DataFolder(None)
TERMS = RunTerms(days=0.25, windows_per_day=1, window_s=300.0)


@fixture(scope="module")
def whole(tmp_path_factory):
    """Folder and figures of a run without a stop."""
    folder = tmp_path_factory.mktemp("whole")
    return folder, run_mission(parse_scenario(SCENARIO), NO_DATA, folder, TERMS, print)


@mark.slow
def test_six_hours_are_planned_flown_received_and_reported_without_a_person(whole):
    folder, figures = whole
    said = []
    windows = figures["windows"]
    assert windows["requested"] == windows["flown"] == windows["processed"] == figures["reports"] == 1
    assert windows["failed"] == figures["images_lost"] == figures["packets_lost"] == 0
    assert figures["missing_windows"] == [] and figures["packets_received"] == figures["packets"] > 0
    (flown,) = figures["performance"]["passes"]
    assert 18 <= flown["frames"] <= 22  # 300 s / 15 s
    assert figures["frames"] == figures["frames_received"] == flown["frames"]
    assert figures["navigation"]["spherical"]["median_m"] == flown["median_error_m"] > 0.0
    # The clock of this scenario drifts: the time reports of the contacts tell by how much.
    with open_ground(folder / "ground") as ground, local_client(ground, "viewer") as client:
        (line,) = [one for one in client.list_correlations(76) if one.in_force]
    assert line.points >= 3 and line.rejected == 0
    assert line.drift_ppb == approx(-1e3 * DRIFT_PPM, abs=20.0)
    assert line.residual_max_ns < 100e3
    # All that was posted is the set-up: catalogue, mission, ephemeris, standing request.
    assert figures["interventions"] == 0 and figures["interventions_list"] == []
    assert figures["alerts"] == len(figures["alarms"]) == 0
    assert figures["monthly_reports"] == [str(folder / "report-2029-08.html")]
    assert "2029-08" in (folder / "report-2029-08.html").read_text()
    assert json.loads((folder / "report.json").read_text())["windows"] == windows
    # The same again prints the figures of the run that has ended; other terms need another folder.
    again = run_mission(parse_scenario(SCENARIO), NO_DATA, folder, TERMS, said.append)
    assert again["windows"] == windows and "this run has ended" in said[-1]
    with raises(ScenarioError, match="expected a new folder, or the same scenario and options"):
        run_mission(parse_scenario(SCENARIO), NO_DATA, folder, replace(TERMS, days=0.5), said.append)


def assert_same_figures(one, other):
    """A report uses the time correlation of its moment: a microsecond of it is 1.6 mm along the track."""
    first, second = figures_of(one), figures_of(other)
    assert first == approx(second, rel=0.0, abs=2e-3, nan_ok=True) and len(first) > 50
    drift = {name: value for name, value in second.items() if name.endswith("drift_percent")}
    assert {name: first[name] for name in drift} == approx(drift, rel=0.0, abs=1e-6)


def memory_by_day(folder, days):
    """Return the resident memory in MiB of ground and spacecraft after each contact of a run, by day and process."""
    found = {}
    command = [sys.executable, *f"-m linna mission run selenita --days {days} --folder {folder}".split()]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as run:
        for line in run.stderr:
            if day := re.search(r": day +(\d+)\.", line):
                for pid in (run.pid, *descendants(run.pid)):
                    with suppress(FileNotFoundError):
                        pages = Path(f"/proc/{pid}/statm").read_text().split()[1]
                        found.setdefault(pid, {}).setdefault(int(day[1]), []).append(int(pages) >> 8)
    assert run.returncode == 0
    return [one for one in found.values() if len(one) >= days and max(one[days - 1]) > 100]


@mark.campaign
def test_the_memory_of_a_simulated_week_ends_within_a_twentieth_of_that_of_its_second_day(tmp_path, monkeypatch):
    monkeypatch.delenv("LINNA_DATA", raising=False)  # with real terrain, the first three days have no window
    processes = memory_by_day(tmp_path / "week", 7)
    assert len(processes) == 2
    for days in processes:
        assert np.median(days[6]) < 1.05 * np.median(days[1])


@mark.campaign
def test_three_spacecraft_of_two_missions_have_the_figures_that_each_has_alone(tmp_path):
    other = commanded_scenario("other", "[clock]\noffset_s = -2.0\n").replace("[orbit]", "[orbit]\nraan_deg = 40.0")
    other = f'spacecraft = "Other"\nspacecraft_id = 78{other}'
    scenarios = [parse_scenario(text) for text in (SCENARIO, SECOND, other)]
    fleet = run_fleet(scenarios, NO_DATA, tmp_path / "fleet", TERMS, print)["fleet"]
    assert list(fleet) == ["SelenITA", "Second", "Other"]
    for name, scenario in (("SelenITA", scenarios[0]), ("Other", scenarios[2])):
        single = run_mission(scenario, NO_DATA, tmp_path / name, TERMS, print)
        assert_same_figures(fleet[name], single)
    assert all(one["windows"]["processed"] == 1 and one["packets_lost"] == 0 for one in fleet.values())
    assert all(one["interventions"] == 0 for one in fleet.values())
    assert fleet["Second"]["performance"] != fleet["SelenITA"]["performance"]


@mark.campaign
def test_time_that_does_not_wait_gives_reports_too(tmp_path):
    terms = replace(TERMS, factor=300.0)
    fleet = run_fleet([parse_scenario(text) for text in (SCENARIO, SECOND)], NO_DATA, tmp_path, terms, print)["fleet"]
    for figures in fleet.values():
        assert figures["windows"]["processed"] == figures["reports"] == 1 and figures["packets_lost"] == 0
        assert figures["wall_s"] > 0.25 * 86_400.0 / 300.0


def test_a_fleet_has_a_new_folder_and_different_spacecraft(tmp_path):
    scenarios = [parse_scenario(text) for text in (SCENARIO, SECOND)]
    (tmp_path / "file").touch()
    with raises(ScenarioError, match="expected a new folder for a fleet"):
        run_fleet(scenarios, NO_DATA, tmp_path, TERMS, print)
    for second, key in ((SCENARIO, "spacecraft"), (SECOND.replace("77", "76"), "spacecraft_id")):
        fleet = [scenarios[0], parse_scenario(second)]
        with raises(ScenarioError, match=f"with different {key}, found"):
            run_fleet(fleet, NO_DATA, tmp_path / "new", TERMS, print)


def test_the_spacecraft_whose_time_is_the_earliest_flies_and_its_time_is_that_of_the_service(tmp_path):
    seen = []
    runs = [SimpleNamespace(clock_file=tmp_path / name) for name in ("a", "b")]

    def flight(run, times):
        for time in times:
            run.clock_file.write_bytes(time.to_bytes(8, "little"))
            seen.append((run.clock_file.name, mission_now_ns()))
            yield time

    try:
        _take_turns(runs, [flight(run, times) for run, times in zip(runs, ([5, 20, 30], [10, 15]), strict=True)])
    finally:
        set_mission_clock()
    assert seen == [("a", 5), ("b", 10), ("a", 20), ("b", 15), ("a", 30)]


DISTURBED = """
[link]
frame_loss = 0.25
missed_contacts = ["madrid 6 12", "all 20 21.5"]
clocks = ["madrid 3600"]
[payload]
clock_steps = ["0.5 1.0"]
attitude_bias_deg = 0.2
hot_pixels = 0.001
events = ["camera_dark at 600 for 60"]
[reference]
late_days = [1]
wrong_days = [2]
wrong_by_m = 500.0
"""


def test_disturbances_change_the_spacecraft_and_not_the_inputs_of_the_ground(tmp_path):
    path = tmp_path / "disturbed.toml"
    path.write_text(DISTURBED)
    scenario = parse_scenario(SCENARIO + "[link]\nstations = ['madrid', 'canberra']\n")
    found = load_disturbances(path).apply(scenario)
    assert found.link.frame_loss == 0.25 and found.link.clock_errors == ("madrid 3600",)
    begin = [" ".join(one.split()[:2]).partition(".")[0] for one in found.link.missed]
    assert begin == ["madrid 2029-08-07T06:00:00", "madrid 2029-08-07T20:00:00", "canberra 2029-08-07T20:00:00"]
    assert found.link.outages == scenario.link.outages
    assert found.faults.events == ("clock_jump at 1800.0 size 1.0", "camera_dark at 600 for 60")
    assert found.attitude.knowledge_bias_deg == 0.2 and found.sensor.hot_pixels == 0.001
    assert UNDISTURBED.apply(scenario) == scenario
    # The ground knows of announced outages only, and never of these.
    text = live_mission_text(open_world(found, NO_DATA), NO_DATA, "127.0.0.1", {"madrid": (1, 2)}, "")
    assert "missed" not in text.partition("[world]")[0]
    assert load_disturbances("month").link.clocks == ("madrid 3600",)


WRONG = """\
[link];frame_los = 0.1 | link.frame_los: expected 'frame_loss', found an unknown key
[lynk]; | lynk: expected 'link', found an unknown key
[link];frame_loss = 'much' | link.frame_loss: expected a number, found 'much'
[link | expected a TOML file of disturbances
[link];missed_contacts = ['madrid 6'] | link.missed_contacts: expected STATION FROM TO
[link];missed_contacts = ['rome 6 9'] | link.outages: expected STATION START STOP
[link];clocks = ['madrid soon'] | link.clock_errors: expected STATION SECONDS
[payload];clock_steps = ['x 1'] | payload.clock_steps: expected HOURS SECONDS"""


@mark.parametrize("row", WRONG.splitlines())
def test_a_wrong_file_of_disturbances_is_refused_in_one_line(tmp_path, row):
    text, message = row.split(" | ")
    path = tmp_path / "disturbed.toml"
    path.write_text(text.replace(";", "\n"))
    with raises(ScenarioError) as caught:
        load_disturbances(path).apply(parse_scenario(SCENARIO))
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_orbit_determinations_are_late_and_wrong_on_their_days(tmp_path):
    world = open_world(parse_scenario(SCENARIO), NO_DATA)
    plain = FlightDynamics(world)
    disturbed = FlightDynamics(world, ReferenceDisturbances((1,), (0,), 500.0))
    assert [disturbed.is_late(day) for day in range(3)] == [False, True, False] and not plain.is_late(1)
    start = world.scenario.epoch_utc_ns
    at = np.array([start + 3_600 * 10**9])
    right, wrong = (
        load_ephemeris(one.save_reference(start, tmp_path / f"{k}.oem")).at(at)[0][0]
        for k, one in enumerate((plain, disturbed))
    )
    assert 100.0 < np.linalg.norm(wrong - right) < 2_500.0  # three draws of 500 m, 1 sigma


def state(octets):
    return {"kind": "state", "unacknowledged": octets}


@mark.parametrize(
    "said, error",
    [
        ([{"kind": "error", "text": "out of memory"}, state(0)], "spacecraft: out of memory"),
        ([state(10)], "expected its state, found its end"),
        ([state(10)] * 3, "all telemetry within 0 s, found 10 octets without it"),
        ([{"kind": "paused"}, state(10), state(0)], None),
    ],
)
def test_a_wait_for_stored_telemetry_ends_with_an_error_or_with_all(said, error, monkeypatch):
    monkeypatch.setattr("studies.mission_run.run.SETTLE_S", 0.0 if len(said) == 3 and error else 60.0)
    spacecraft = Mock()
    with nullcontext() if error is None else raises(LinkError, match=error):
        MissionRun._wait_acknowledged(spacecraft, iter(said))
    assert {one.args for one in spacecraft.order.call_args_list} == {("state",)}


@mark.parametrize("text", ["", "[]", "{}", '{"posts": [], "unknown": 1}', '{"posts": [1]}', '{"posts": null}'])
def test_the_folder_of_another_version_is_refused_in_one_line(tmp_path, text):
    (tmp_path / "progress.json").write_text(text)
    with raises(ScenarioError, match=r"progress.json: expected .* start the run in a new folder$"):
        read_progress(tmp_path / "progress.json")


@mark.parametrize("days, asked", [(0.1, 0), (0.5, 2), (1.0, 2), (1.2, 4), (30.0, 60)])
def test_what_is_asked_for_is_counted_by_the_days_of_the_request(days, asked):
    assert windows_asked(days, 2, 4.0 / 24.0) == asked


def test_each_missing_window_has_the_reason_of_the_plan_of_its_day():
    start = parse_utc("2029-08-07T00:00:00Z")
    at = [UtcTime(start + round(hours * 3.6e12)) for hours in (3.0, 5.0, 30.0, 50.0)]
    night, contact = "Sun below the horizon", "no contact before it to send its telecommands"
    candidates = [
        PlannedCandidate(start=one, stop=one, outcome="rejected", window_id=None, reason=why)
        for one, why in zip(at, (contact, night, contact, None), strict=True)
    ]
    plan = RequestPlan(
        request_id=1, planned=at[1], until=at[3], reason=None, basis="", candidates=candidates, replaced=[]
    )
    progress = Progress()
    note_plan(progress, plan, start)
    note_plan(progress, plan.model_copy(update={"candidates": [], "reason": night}), start)
    found = missing_windows([at[0].utc_ns, at[2].utc_ns, at[2].utc_ns], start, 2, 6, progress)
    assert [(one["day"], one["missing"], one["reason"]) for one in found] == [(0, 1, night), (2, 2, "not known")]
    assert progress.not_entered["1"] == contact


def test_what_a_person_does_after_the_posts_is_an_intervention(tmp_path):
    clock = tmp_path / "clock"
    ground = EmbeddedGround.open(tmp_path / "home", NO_DATA, clock)
    try:
        ground.client.add_mission(b'name = "x"\n[spacecraft]\nid = 76\n')
        posted = (1, ground.audit_head())
        assert ground.interventions([posted]) == []
        assert len(ground.interventions([])) == 1
        command = ground.client.enter_telecommand("test_connection", 76)
        ground.client.release_telecommand(command.id)
        assert [one["text"].split(":")[0] for one in ground.interventions([posted])] == ["mission-run"] * 2
    finally:
        ground.close()


def test_a_restored_checkpoint_has_archive_spacecraft_and_progress_of_one_moment(tmp_path):
    home, snapshot, progress = tmp_path / "ground", tmp_path / "exact", tmp_path / "progress.json"
    (home / "incoming").mkdir(parents=True)
    checkpoints = Checkpoints(tmp_path, home, snapshot)

    def write(number):
        snapshot.write_text(str(number))
        progress.write_text(str(number))
        with closing(sqlite3.connect(home / "linna.db")) as connection, connection:
            connection.execute("create table if not exists one (number)")
            connection.execute("insert into one values (?)", (number,))

    for number in (1, 2):
        write(number)
        checkpoints.keep(progress)
    write(3)
    (home / "incoming/segment").touch()
    assert checkpoints.restore().read_text() == snapshot.read_text() == "2"
    with closing(sqlite3.connect(home / "linna.db")) as connection:
        assert connection.execute("select number from one").fetchall() == [(1,), (2,)]
    assert not (home / "incoming").exists()
    assert Checkpoints(tmp_path / "other", home, snapshot).restore() is None and not home.exists()


@mark.campaign
def test_a_stopped_run_continues_and_ends_with_the_same_figures(whole, tmp_path, monkeypatch):
    monkeypatch.setattr("studies.mission_run.run.CHECKPOINT_S", 0.0)
    lines = []

    def stop(line):
        lines.append(line)
        if len(lines) == 3:
            raise KeyboardInterrupt

    folder = tmp_path / "stopped"
    with raises(KeyboardInterrupt):
        run_mission(parse_scenario(SCENARIO), NO_DATA, folder, TERMS, stop)
    assert (folder / "checkpoint/archive.db").exists()
    monkeypatch.setattr("studies.mission_run.run.CHECKPOINT_S", 3600.0)
    again = run_mission(parse_scenario(SCENARIO), NO_DATA, folder, TERMS, lines.append)
    assert any("continues from 2029-08-07T" in line for line in lines)
    assert again["starts"] == 2 and again["interventions"] == 0
    assert_same_figures(again, whole[1])


def flat_terrain(listed, tiles):
    """Return real terrain with craters (latitude, longitude, complete), and rasters on cells by their corners."""
    latitude, longitude, complete = (np.array(column) for column in zip(*listed, strict=True))
    catalogue = make_catalogue(
        np.radians(latitude), np.radians(longitude), np.full(len(listed), 6e3), source="x", complete=complete
    )

    def covers(latitude_rad, longitude_rad):
        south, west = np.degrees(latitude_rad), np.degrees(longitude_rad)
        held = np.zeros(np.broadcast(south, west).shape, dtype=bool)
        for low, left in tiles:
            held |= (south >= low) & (south < low + 15) & (west >= left) & (west < left + 15)
        return held

    return SimpleNamespace(is_real=True, catalogue=catalogue, covers=covers)


def test_windows_are_requested_where_rasters_and_catalogue_describe_the_ground():
    listed = [
        # Catalogued from 30 S to 30 N at 0 to 15 E, from 30 N to 60 N at 15 to 30 E, in parts at 30 to 45 E.
        *((latitude, 5.0, True) for latitude in (-20.0, -5.0, 5.0, 20.0)),
        *((latitude, 20.0, True) for latitude in (35.0, 50.0)),
        *((latitude, 35.0, latitude < 0.0) for latitude in (-5.0, 5.0)),
    ]
    equator = observed_boxes(flat_terrain(listed, []), 13.0)
    assert equator == [Box(0.0, 15.0, -13.0, 13.0), Box(15.0, 30.0, 32.0, 58.0)]
    # Ground with height rasters alone, also further away from the equator: coarse ones show few craters.
    assert observed_boxes(flat_terrain(listed, [(0.0, 0.0), (15.0, 0.0)]), 13.0) == [Box(0.0, 15.0, 2.0, 28.0)]
    # Part of the height is not enough.
    assert observed_boxes(flat_terrain(listed, [(0.0, 0.0)]), 13.0) == equator
    assert observed_boxes(SimpleNamespace(is_real=False), 13.0) == [Box(-180.0, 180.0, -13.0, 13.0)]
    widened = Box(-5.0, 15.0, -13.0, 13.0).widened(5.0)
    places = np.array([0.0, 17.0, 19.0]), np.array([352.0, 19.0, 0.0])
    assert inside_box(widened, *places).tolist() == [True, True, False]


@mark.parametrize("words", [["--speed", "0"], ["--speed", "quick"], ["--window-min", "0.1"], ["--kill", "1"]])
def test_options_that_do_not_fit_are_refused_in_one_line(words, capsys):
    assert cli.run(["mission", "run", "selenita", "--days", "1", *words]) == 2
    assert capsys.readouterr().err.count("\n") == 1
