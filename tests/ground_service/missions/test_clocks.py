"""Mission time: the wall clock, a function, a file, and the descriptions in force."""

import struct
import time
from argparse import Namespace

from pytest import fixture, mark, raises

from ground_service.access.service import LOCAL_CALLER, session_of
from ground_service.app import create_app
from ground_service.clock import (
    ClockFile,
    follow_missions,
    independent_now_ns,
    is_recorded,
    mission_now_ns,
    set_mission_clock,
)
from ground_service.errors import InvalidInput
from ground_service.missions import clocks
from ground_service.missions.clocks import mission_clock, read_mission_clock
from ground_service.missions.model import parse_mission
from ground_service.missions.service import add_mission
from ground_service.passes.archive_import import import_archive
from ground_service.settings import Settings
from ground_service.worker.app import _ground_of
from ground_service.worker.condition import service_status
from linna.commands._ground import ground_client
from lunar.timescales import format_utc, parse_utc
from tests.serving import TestClient, wait_for

YEAR_2029 = parse_utc("2029-08-07T06:00:00Z")
TEXT = """
name = "{name}"
[spacecraft]
id = {number}
[time]
mission_clock = {{ {clock} }}
"""


def simulated(rate=1.0):
    wall = format_utc(time.time_ns())
    return f'source = "simulated", mission = "2029-08-07T06:00:00Z", wall = "{wall}", rate = {rate}'


def state(ground, clock, number=76):
    add_mission(ground, TEXT.format(name=f"m{number}", number=number, clock=clock).encode())


@fixture(autouse=True)
def _wall_clock_again():
    yield
    follow_missions(None)


def seconds_after_start():
    return (mission_now_ns() - YEAR_2029) / 1e9


def test_a_simulated_clock_runs_at_its_rate(ground):
    state(ground, simulated(rate=1000.0))
    read_mission_clock(ground)
    first = seconds_after_start()
    time.sleep(0.05)
    assert 50.0 <= seconds_after_start() - first < 60_000.0


def test_a_command_of_this_machine_has_the_clock_of_its_descriptions(ground):
    state(ground, simulated())
    with ground_client(Namespace(home=ground.home, server=None, actor="ann")):
        assert 0.0 <= seconds_after_start() < 600.0


def test_a_stated_clock_is_behind_that_of_a_simulation_and_ends_with_the_description(ground):
    state(ground, simulated())
    set_mission_clock(lambda: 7)
    read_mission_clock(ground)
    assert mission_now_ns() == 7
    set_mission_clock(None)
    assert abs(seconds_after_start()) < 600.0
    state(ground, 'source = "wall"')
    read_mission_clock(ground)
    assert abs(mission_now_ns() - time.time_ns()) < 600e9


def test_the_clock_of_telemetry_stands_at_the_newest(ground, synthetic_pass):
    state(ground, 'source = "telemetry"')
    read_mission_clock(ground)
    assert abs(mission_now_ns() - time.time_ns()) < 600e9  # no telemetry yet
    with TestClient(create_app(Settings(home=ground.home), inline_jobs=True)) as client:
        octets = (synthetic_pass.folder / "downlink.cadu").read_bytes()
        client.post("/api/v1/telemetry", content=octets)
        read_mission_clock(ground)
        last = synthetic_pass.utc_ns[-1]
        assert 0 <= mission_now_ns() - last < 1e9
        assert parse_utc(client.get("/api/v1/session").json()["time"]) // 1000 == mission_now_ns() // 1000
        assert {one["age_s"] < 600.0 for one in client.get("/api/v1/parameters?spacecraft_id=76").json()["items"]} == {
            True
        }


def test_archives_alone_have_the_time_of_their_data(ground, synthetic_pass):
    import_archive(ground, synthetic_pass.folder)
    read_mission_clock(ground)
    assert 0 <= mission_now_ns() - synthetic_pass.utc_ns[-1] < 1e9
    seen = session_of(ground, LOCAL_CALLER, browser=False)
    assert seen.recorded and seen.time.utc_ns == mission_now_ns()
    status = service_status(ground, None)
    assert status.mission_time == seen.time and abs(status.time.utc_ns - time.time_ns()) < 600e9
    assert abs((independent_now_ns() or 0) - time.time_ns()) < 600e9  # new telemetry is judged by the wall clock
    add_mission(ground, b'name = "m"\n[spacecraft]\nid = 76\n')
    read_mission_clock(ground)
    assert not is_recorded() and abs(mission_now_ns() - time.time_ns()) < 600e9


def test_several_stated_clocks_are_none(ground, caplog):
    state(ground, simulated())
    state(ground, 'source = "telemetry"', number=77)
    read_mission_clock(ground)
    assert abs(mission_now_ns() - time.time_ns()) < 600e9
    assert "several mission clocks" in caplog.text


def test_a_running_service_takes_a_new_clock(tmp_path, monkeypatch):
    monkeypatch.setattr(clocks, "REFRESH_S", 0.05)
    with TestClient(create_app(Settings(home=tmp_path))) as client:
        state(client.app.state.ground, simulated())
        wait_for(lambda: abs(seconds_after_start()) < 600.0, "mission time in 2029")
        assert client.get("/api/v1/session").json()["time"].startswith("2029-08-07T06:")
    assert abs(mission_now_ns() - time.time_ns()) < 600e9  # the service has ended


def test_a_worker_and_a_scheduler_have_the_clock_of_the_service(ground):
    state(ground, simulated())
    _ground_of(Settings(home=ground.home))
    assert abs(seconds_after_start()) < 600.0
    follow_missions(None)
    with mission_clock(ground):
        assert abs(seconds_after_start()) < 600.0


@mark.parametrize(
    "clock", ['source = "simulated"', 'source = "wall", mission = "2029-08-07T06:00:00Z"', 'source = "moon"']
)
def test_an_incomplete_clock_is_refused(clock):
    with raises(InvalidInput, match="mission_clock"):
        parse_mission(TEXT.format(name="m", number=1, clock=clock))


def test_mission_time_is_the_wall_clock_until_a_simulation_sets_it():
    before = time.time_ns()
    assert before <= mission_now_ns() <= time.time_ns()
    set_mission_clock(lambda: 1_880_000_000_000_000_000)
    assert mission_now_ns() == 1_880_000_000_000_000_000
    set_mission_clock()
    assert mission_now_ns() >= before


def test_a_clock_file_is_read_as_it_is_written(tmp_path):
    path = tmp_path / "clock"
    clock = ClockFile(path)
    before = time.time_ns()
    assert clock.read() >= before  # there is no file yet
    path.write_bytes(struct.pack("<q", 5))
    assert clock.read() == 5
    with path.open("r+b") as file:
        file.write(struct.pack("<q", 7))
    assert clock.read() == 7
