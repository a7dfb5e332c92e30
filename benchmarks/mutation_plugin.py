"""pytest plugin of the mutation tests: which tests reach a function, and the order in which they are run.

mutmut records the calls made while a test runs. A fixture of a wider scope runs inside the first test that asks for
it; here its calls are credited to every test that uses it, and its time to the first. Test files are run in ascending
order of their time, so that a mutant dies early.
"""

import importlib
import json
from collections.abc import Generator
from pathlib import Path
from typing import Any

import pytest

_STATISTICS = Path("mutmut-stats.json")
"""Written by mutmut before it runs the first mutant."""

_reached: dict[str, set[str]] = {}

"""Functions that a fixture of a wider scope calls, by the name of the fixture."""


def _state() -> Any:
    """Return what mutmut records; it is installed for the mutation tests only."""
    return importlib.import_module("mutmut.state").state()


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup(fixturedef: Any) -> Generator[None, Any, Any]:
    """Record what a fixture of a wider scope calls."""
    if fixturedef.scope == "function":
        return (yield)
    calls = _state()._stats
    before = set(calls)
    calls.clear()
    try:
        return (yield)
    finally:
        _reached.setdefault(fixturedef.argname, set()).update(calls)
        calls.update(before)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_teardown(item: pytest.Item) -> None:
    """Credit the calls of the fixtures of a test to it."""
    for name in getattr(item, "fixturenames", ()):
        _state()._stats.update(_reached.get(name, ()))


def pytest_runtest_makereport(item: pytest.Item, call: Any) -> None:
    """Add the time of the fixtures to that of the test, for the limit of a mutant's time."""
    if call.when == "setup" and item.nodeid in _state().duration_by_test:
        _state().duration_by_test[item.nodeid] += call.duration


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Sort the test files by their time; the order within a file stays, for the sake of its fixtures."""
    if not _STATISTICS.exists():
        return
    durations = json.loads(_STATISTICS.read_text())["duration_by_test"]
    total: dict[str, float] = {}
    for item in items:
        file = item.nodeid.partition("::")[0]
        total[file] = total.get(file, 0.0) + durations.get(item.nodeid, 0.0)
    items.sort(key=lambda item: (total[file := item.nodeid.partition("::")[0]], file))
