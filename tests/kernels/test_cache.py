"""The cache of compiled functions, shared by processes and clones; memory that goes back to the system."""

import ctypes
import gc
import importlib
import os
import subprocess
import sys
import time
from pathlib import Path
from unittest.mock import MagicMock

from pytest import fixture, mark

from kernels import KEPT_S, keep, kept, memory

ROOT = Path(__file__).resolve().parents[2]
CALLEE = """
from typing import NamedTuple
import numpy as np
from kernels.compiled import njit
from numba.extending import intrinsic

STEP = 1
STEPS = np.arange(2000)
OPTIONS = {"fastmath": {"nsz", "contract"}}

class Pair(NamedTuple):
    first: float
    second: float

@intrinsic
def same(context, x):
    def write(context, builder, signature, arguments):
        return arguments[0]
    return x(x), write

@njit
def inner(x, by=1):
    return x + by
"""
CALLER = """
import callee
from callee import OPTIONS, STEP, STEPS, Pair, inner, same
from kernels.compiled import njit

@njit(**OPTIONS, ahead="i8")
def outer(x):
    return inner(x) * 10 + callee.STEP - STEP

@njit
def of_array(x):
    return x + STEPS[1000]

@njit
def of_intrinsic(x):
    return same(x)

@njit(ahead="Pair(f8, f8)")
def of_pair(pair):
    return pair.first

@njit
def _sum(x, y, is_twice):
    return x + y * (2 if is_twice else 1)

@njit
def of_constants(x):
    return _sum(x, 1, True) + _sum(x, x, x > 1)
"""
KERNELS = ("outer", "of_array", "of_intrinsic", "of_pair")
CALL = "import caller, sys; print(caller.outer(1), sum(caller.outer.stats.cache_hits.values()))"
WHAT_COMPILES = "; print('numba.np.linalg' in sys.modules)"


def write(folder, old="", new=""):
    """Write both modules, the first with a change."""
    assert old in CALLEE
    folder.mkdir(exist_ok=True)
    (folder / "callee.py").write_text(CALLEE.replace(old, new) if old else CALLEE)
    (folder / "caller.py").write_text(CALLER)
    return folder


def start(folder, cache, also="", **variables):
    environment = {
        **os.environ, "PYTHONPATH": os.pathsep.join([str(folder), str(ROOT)]), "PYTHONDONTWRITEBYTECODE": "1",
        "NUMBA_CACHE_DIR": str(cache), **variables
    }  # fmt: skip
    return subprocess.Popen([sys.executable, "-c", CALL + also], stdout=subprocess.PIPE, text=True, env=environment)


def run(folder, cache, also="", **variables):
    """Result of `outer(1)`, and how often it came from the cache."""
    process = start(folder, cache, also, **variables)
    output, _ = process.communicate()
    assert process.returncode == 0
    return output.strip()


def test_clones_share_compiled_code_until_a_callee_changes(tmp_path):
    cache, first, second = tmp_path / "cache", write(tmp_path / "first"), write(tmp_path / "second")
    assert run(first, cache) == "20 0"
    assert run(second, cache) == "20 1"  # compiled by another clone
    write(second, "x + by", "x - by")
    assert run(second, cache) == "0 0"
    assert run(first, cache) == "20 1"  # both versions are kept
    assert run(first, cache, NUMBA_CPU_NAME="generic", NUMBA_CPU_FEATURES="") == "20 0"


def test_a_kernel_that_moved_to_another_module_is_compiled_again(tmp_path):
    """Compiled code names the module that it came from, which the new version does not have."""
    cache, folder = tmp_path / "cache", write(tmp_path / "code")
    assert run(folder, cache) == "20 0"
    (folder / "callee.py").rename(folder / "moved.py")
    (folder / "caller.py").write_text(CALLER.replace("callee", "moved"))
    assert run(folder, cache) == "20 0"


def test_processes_that_compile_at_once_leave_whole_files(tmp_path):
    cache, folder = tmp_path / "cache", write(tmp_path / "code")
    processes = [start(folder, cache) for _ in range(3)]
    assert {process.communicate()[0].split()[0] for process in processes} == {"20"}
    assert len(list(cache.iterdir())) == 2  # outer and inner, without remains
    assert run(folder, cache) == "20 1"


def test_the_folder_is_private_and_files_of_others_are_ignored(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    keep("a-1", b"code")
    uid = os.getuid()
    assert (tmp_path / "cache").stat().st_mode & 0o777 == (0o700 if uid else 0o755)
    assert kept("a-1") == b"code"
    monkeypatch.setattr(os, "getuid", lambda: uid + 1)
    assert kept("a-1") == (b"code" if uid == 0 else None)
    os.chown(tmp_path / "cache/a-1", 12345, -1) if uid == 0 else None
    assert kept("a-1") is None
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "of-a-user"))
    monkeypatch.setattr(os, "getuid", lambda: uid or 12345)
    keep("a-1", b"code")
    assert (tmp_path / "of-a-user").stat().st_mode & 0o777 == 0o700


def test_the_newest_files_of_a_kind_stay_and_not_each_one_costs_a_look_at_all(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    looks, scandir = [], os.scandir
    monkeypatch.setattr(os, "scandir", lambda folder: looks.append(folder) or scandir(folder))
    for number in range(70):
        keep(f"a-{number:03}", b"", 32)
    assert len(looks) == 35
    assert sorted(file.name for file in (tmp_path / "cache").iterdir())[0] > "a-035"
    assert kept("a-038") == kept("a-069") == b""


def test_damaged_and_unwritable_caches_are_compiled_around(tmp_path):
    cache, folder = tmp_path / "cache", write(tmp_path / "code")
    run(folder, cache)
    forgotten = cache / "forgotten"
    forgotten.touch()
    os.utime(forgotten, (0.0, time.time() - KEPT_S - 60.0))
    for file in cache.glob("outer-*"):
        file.write_bytes(file.read_bytes()[:-1])
    assert run(folder, cache) == "20 0"
    assert run(folder, cache) == "20 1"
    assert not forgotten.exists()
    assert run(folder, folder / "caller.py") == "20 0"  # not a folder


def imported(folder, monkeypatch):
    """The modules of a folder, not compiled."""
    with monkeypatch.context() as patch:
        patch.syspath_prepend(folder)
        for name in ("caller", "callee"):
            patch.delitem(sys.modules, name, raising=False)
        module = importlib.import_module("caller")
        patch.delitem(sys.modules, "callee")
        patch.delitem(sys.modules, "caller")
    return module


def dependencies(module):
    """Return the hash of all that the compiled code of each kernel depends on."""
    return {name: getattr(module, name)._cache._dependencies for name in KERNELS}


@mark.parametrize(
    "old, new, changed",
    [
        ("STEP = 1", "STEP = 2", {"outer"}), ("by=1", "by=2", {"outer"}), ("x + by", "x - by", {"outer"}),
        ('"nsz", "contract"', '"nsz", "arcp"', {"outer"}), ("@njit\n", "@njit(error_model='numpy')\n", {"outer"}),
        ("np.arange(2000)", "np.arange(2000) + (np.arange(2000) == 1000)", {"of_array"}),
        ('"nsz", "contract"', '"contract", "nsz"', set()),
        ("return arguments[0]", "return builder.neg(arguments[0])", set())
    ]
)  # fmt: skip
def test_a_kernel_depends_on_all_that_it_names_and_on_nothing_else(tmp_path, monkeypatch, old, new, changed):
    before = dependencies(imported(write(tmp_path / "one"), monkeypatch))
    after = dependencies(imported(write(tmp_path / "two", old, new), monkeypatch))
    # An intrinsic writes instructions with any code of its file, so that every change of the file counts.
    assert {name for name in KERNELS if before[name] != after[name]} == changed | {"of_intrinsic"}


def test_the_order_of_the_fields_of_a_tuple_counts(tmp_path, monkeypatch):
    from numba import typeof
    from numba.core.registry import cpu_target

    names = []
    for folder, old, new in (("one", "", ""), ("two", "first: float\n    second", "second: float\n    first")):
        module = imported(write(tmp_path / folder, old, new), monkeypatch)
        signature = (typeof((module.callee.Pair(1.0, 2.0),)),)
        names.append(module.of_pair._cache._name(signature, cpu_target.target_context.codegen()))
    assert names[0] != names[1]
    assert names[0].startswith("of_pair-")


def test_constants_and_variables_call_one_version_without_an_entry_from_python(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    module = imported(write(tmp_path / "code"), monkeypatch)
    assert module.of_constants(1) == 5
    (version,) = module._sum.overloads.values()
    assert "cpython" not in version.library.get_llvm_str()
    assert gc.isenabled()  # switched off while the kernels compiled


def test_declared_versions_are_compiled_at_the_same_time_and_once(tmp_path, monkeypatch):
    from kernels.compiled import compiling_ahead

    folder, cache, said = write(tmp_path / "code"), tmp_path / "cache", list[str]()
    monkeypatch.syspath_prepend(folder)
    for variable, value in (("NUMBA_CACHE_DIR", cache), ("PYTHONDONTWRITEBYTECODE", "1")):
        monkeypatch.setenv(variable, str(value))
    module = imported(folder, monkeypatch)
    monkeypatch.setitem(sys.modules, "caller", module)
    for _ in range(2):
        with compiling_ahead([["caller"], ["callee"]], said.append) as wait:
            wait()
    assert said == ["compiling, once: 1 of 2", "compiling, once: 2 of 2"]
    assert run(folder, cache, WHAT_COMPILES) == "20 1\nFalse"
    assert module.of_pair(module.Pair(2.0, 3.0)) == 2.0
    assert len(module.of_pair.stats.cache_hits) == 1
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(folder / "caller.py"))  # not a folder: no process could keep a file
    with compiling_ahead([["caller"]], said.append) as wait:
        wait()
    assert len(said) == 2


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
