"""Free memory goes back to the system, at most once in an interval; heaps are limited in a new process."""

import ctypes
import subprocess
import sys
from unittest.mock import MagicMock

from pytest import fixture, mark

from kernels import memory

RESIDENT = """
import sys
from kernels import memory
def resident():
    return int(open("/proc/self/statm").read().split()[1]) * 4 // 1024
blocks = [b"." * 60_000 + bytes([k % 256]) for k in range(4000)]
kept = blocks[::400]
full = resident()
del blocks
before = resident()
assert memory.give_back()
print(full, before, resident(), len(kept))
"""


@fixture
def library(monkeypatch):
    found = MagicMock(spec=["mallopt", "malloc_trim"])
    monkeypatch.setattr(memory, "_c_library", lambda: found)
    monkeypatch.setattr(memory, "_last_s", -memory.INTERVAL_S)
    return found


def test_memory_is_given_back_once_in_an_interval(library, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(memory.time, "monotonic", lambda: now[0])
    done = []
    for now[0] in (0.0, memory.INTERVAL_S - 0.1, memory.INTERVAL_S, memory.INTERVAL_S + 0.1):
        done.append(memory.give_back())
    assert done == [True, False, True, False]
    assert library.malloc_trim.call_count == 2


def test_the_number_of_heaps_is_limited(library):
    memory.limit_heaps()
    library.mallopt.assert_called_once_with(-8, memory.HEAPS)


def test_another_c_library_is_left_alone(library):
    del library.mallopt, library.malloc_trim
    memory.limit_heaps()
    assert memory.give_back() is False


@mark.skipif(not hasattr(ctypes.CDLL(None), "malloc_trim"), reason="needs glibc")
def test_free_memory_between_blocks_in_use_goes_back():
    done = subprocess.run([sys.executable, "-c", RESIDENT], capture_output=True, text=True, check=True)
    full, before, after, _ = map(int, done.stdout.split())
    assert full > 200
    assert after < full - 150, (full, before, after)
