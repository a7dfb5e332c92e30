"""Groups of the mutation tests, and excluded mutants."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from benchmarks import mutation, mutation_plugin


@pytest.mark.parametrize("name", sorted(mutation.GROUPS))
def test_a_group_names_modules_and_tests_that_exist(name: str) -> None:
    group = mutation.GROUPS[name]
    assert group.modules and group.tests
    assert [path for path in group.modules + group.tests if not (mutation.ROOT / path).exists()] == []


@pytest.mark.parametrize(
    "difference",
    [
        "-    a = np.zeros(n, dtype=np.int64)\n+    a = np.zeros(n, dtype=None)",
        "-    a = np.zeros(n, dtype=np.int64)\n+    a = np.zeros(n, )",
        "-    a = b.astype(np.int64)\n+    a = b.astype(None)",
        '-    raise Conflict("not queued")\n+    raise Conflict("XXnot queuedXX")',
        '-    raise Refused("a", b, "not so", "c")\n+    raise Refused("a", b, "NOT SO", "c")',
    ],
)
def test_element_types_and_wording_are_left_out(difference: str) -> None:
    assert mutation.reason_left_out(difference) is not None


@pytest.mark.parametrize(
    "difference",
    [
        "-    if a > limit:\n+    if a >= limit:",
        "-    a = np.zeros(n, dtype=np.int64)\n+    a = np.zeros(None, dtype=np.int64)",
        '-    return table["a"] + 1\n+    return table["a"] + 2',
        '-    if state == "queued":\n+    if state == "XXqueuedXX":',
        "-    raise Conflict(name)\n+    raise Conflict(None)",
        '-    raise Refused("a", b, "c")\n+    raise Refused("a", c, "c")',
        "-    order = np.argsort(a, kind=b)\n+    order = np.argsort(a)",
    ],
)
def test_what_decides_is_tested(difference: str) -> None:
    assert mutation.reason_left_out(difference) is None


@pytest.fixture
def state(monkeypatch: pytest.MonkeyPatch) -> Any:
    """What mutmut records, without mutmut."""
    recorded = SimpleNamespace(_stats=set(), duration_by_test={"a": 1.0})
    monkeypatch.setattr(mutation_plugin, "_state", lambda: recorded)
    monkeypatch.setattr(mutation_plugin, "_reached", {})
    return recorded


def set_up(state: Any, name: str, scope: str, calls: set[str]) -> None:
    """Run the hook around a fixture that makes these calls."""
    hook = mutation_plugin.pytest_fixture_setup(SimpleNamespace(argname=name, scope=scope))
    next(hook)
    state._stats.update(calls)
    with pytest.raises(StopIteration):
        hook.send(None)


def test_what_a_shared_fixture_calls_is_credited_to_every_test_that_uses_it(state: Any) -> None:
    state._stats.add("own")
    set_up(state, "shared", "module", {"inner"})
    set_up(state, "alone", "function", {"other"})
    assert state._stats == {"own", "inner", "other"}
    state._stats.clear()
    mutation_plugin.pytest_runtest_teardown(SimpleNamespace(fixturenames=["shared", "alone"]))
    assert state._stats == {"inner"}
    state._stats.clear()
    mutation_plugin.pytest_runtest_teardown(SimpleNamespace(fixturenames=["alone"]))
    assert state._stats == set()


def test_the_time_of_a_test_holds_that_of_its_fixtures(state: Any) -> None:
    for when, total in (("call", 1.0), ("setup", 3.5)):
        mutation_plugin.pytest_runtest_makereport(
            SimpleNamespace(nodeid="a"),
            SimpleNamespace(when=when, duration=2.5),
        )
        assert state.duration_by_test == {"a": total}


def test_the_fastest_files_are_run_first_and_their_tests_stay_in_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = ["slow.py::b", "slow.py::a", "quick.py::b", "unknown.py::x", "quick.py::a"]
    items: Any = [SimpleNamespace(nodeid=name) for name in names]
    path = tmp_path / "statistics.json"
    monkeypatch.setattr(mutation_plugin, "_STATISTICS", path)
    mutation_plugin.pytest_collection_modifyitems(items)
    assert [item.nodeid for item in items] == names
    durations = {"slow.py::a": 2.0, "slow.py::b": 0.1, "quick.py::a": 1.0, "quick.py::b": 1.0}
    path.write_text(json.dumps({"duration_by_test": durations}))
    mutation_plugin.pytest_collection_modifyitems(items)
    assert [item.nodeid for item in items] == [names[3], names[2], names[4], names[0], names[1]]
