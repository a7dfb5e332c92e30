"""Shared by all tests: where the real data are, and what is skipped without them."""

import os
from collections import Counter
from pathlib import Path

import pytest
from hypothesis import settings

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("GOMP_SPINCOUNT", "0")
os.environ.setdefault("NUMBA_SLP_VECTORIZE", "1")
os.environ.setdefault("MPLBACKEND", "Agg")
# The role of the tests owns the databases of the tests; tests of the roles remove this.
os.environ.setdefault("LINNA_ALLOW_DATABASE_OWNER", "true")

# Properties are tried on the same examples everywhere, and a busy machine is no failure.
settings.register_profile("linna", deadline=None, derandomize=True, max_examples=50)
settings.load_profile("linna")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Slow files run first, browser tests last, the largest file first; real data only if LINNA_DATA is set.

    A driven browser keeps an event loop in the thread of the tests, in which `asyncio.run` is then refused.
    With several processes this needs `--no-loadscope-reorder`.
    """
    driven = {item.path for item in items if "browser" in getattr(item, "fixturenames", ())}
    sizes = Counter(item.path for item in items if item.path in driven)
    slow = Counter(item.path for item in items if "slow" in item.keywords)
    items.sort(key=lambda item: (item.path in driven, -slow[item.path], -sizes[item.path]))
    if os.environ.get("LINNA_DATA"):
        return
    skip = pytest.mark.skip(reason="LINNA_DATA is not set: no real data on this machine")
    for item in items:
        if "real_data" in item.keywords:
            item.add_marker(skip)


@pytest.fixture(scope="session")
def data_path() -> Path:
    """The folder of real data products (only for tests marked real_data)."""
    return Path(os.environ["LINNA_DATA"])


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]):
    """In continuous integration a test that lacks a server, a browser or a library fails; it does not skip."""
    report = yield
    if os.environ.get("CI") and report.skipped and "real_data" not in item.keywords:
        report.outcome = "failed"
        report.longrepr = f"skipped in continuous integration: {report.longrepr}"
    return report


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector: pytest.Collector):
    """The same for a whole file that leaves itself out because a library is missing."""
    report = yield
    if os.environ.get("CI") and report.outcome == "skipped":
        report.outcome = "failed"
        report.longrepr = f"skipped in continuous integration: {report.longrepr}"
    return report
