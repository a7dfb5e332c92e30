"""Mission time: the wall clock, a function, or a file that another process writes."""

import struct
import time

from ground_service.clock import ClockFile, mission_now_ns, set_mission_clock


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
