"""Shared by all tests: where the real data are, and what is skipped without them."""

import csv
import gc
import os
import sys
import tempfile
from collections import Counter
from pathlib import Path

import pytest
from _pytest.assertion import rewrite
from hypothesis import settings
from pytest import fixture, mark

from ground_service import clock
from tests.cost import TABLE, Cost, read


def _keep_temporary_files_in_memory():
    """Use a folder in memory, if there is one with room: a disk takes milliseconds for each commit of a database."""
    place = Path("/dev/shm")
    if not os.access(place, os.W_OK):
        return
    found = os.statvfs(place)
    if found.f_bavail * found.f_frsize >= 4 << 30 and not found.f_flag & os.ST_NOEXEC:
        os.environ.setdefault("TMPDIR", str(place))
        tempfile.tempdir = None  # chosen already, when pytest began to keep what is printed


_keep_temporary_files_in_memory()
gc.disable()  # until all modules are imported: what the collection makes stays
os.environ.setdefault("MALLOC_ARENA_MAX", "2")  # memory that threads of ended tests have used is used again
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("GOMP_SPINCOUNT", "0")
os.environ.setdefault("NUMBA_SLP_VECTORIZE", "1")
os.environ.setdefault("MPLBACKEND", "Agg")
# The role of the tests owns the databases of the tests; tests of the roles remove this.
os.environ.setdefault("LINNA_ALLOW_DATABASE_OWNER", "true")

# Properties are tried on the same examples everywhere, and a busy machine is no failure.
settings.register_profile("linna", deadline=None, derandomize=True, max_examples=50)
settings.load_profile("linna")


# Libraries that no test needs before it runs: they cost each process seconds and hundreds of megabytes.
HEAVY = ("torch", "astropy", "scipy.stats", "matplotlib", "onnxscript", "playwright", "pandas", "pyarrow", "rasterio")
IMPORTED = pytest.StashKey[list[str]]()


PASSED = Path(__file__).parents[1] / "build/campaigns.txt"


def pytest_addoption(parser):
    """Add the option that resumes the campaigns."""
    parser.addoption("--resume", action="store_true", help="leave out campaigns that have passed, and note new ones")


def pytest_runtest_logreport(report):
    """Note a campaign that has passed."""
    if "campaign" in report.keywords and report.when == "call" and report.passed:
        PASSED.parent.mkdir(exist_ok=True)
        with PASSED.open("a") as passed:
            passed.write(f"{report.nodeid}\n")


def pytest_configure(config):
    """Sum the cost of the tests, and rewrite assertions once, before several processes would each do it."""
    config.pluginmanager.register(Cost(), "cost")
    if getattr(config.option, "numprocesses", None) and not hasattr(config, "workerinput"):
        _rewrite_assertions(config)
        gc.enable()


def _rewrite_assertions(config):
    """Write the compiled form of each test module that lacks one, where `pytest` looks for it."""
    if sys.dont_write_bytecode:
        return
    state = config.stash[rewrite.assertstate_key]
    tests = Path(__file__).parent
    for path in (*tests.rglob("test_*.py"), *tests.rglob("conftest.py")):
        folder = rewrite.get_cache_dir(path)
        compiled = folder / (path.stem + rewrite.PYC_TAIL)
        if rewrite.try_makedirs(folder) and rewrite._read_pyc(path, compiled) is None:
            source_hash, code = rewrite._rewrite_test(path, config)
            rewrite._write_pyc(state, code, source_hash, compiled)


def pytest_collection_finish(session):
    """Note which heavy libraries the collection has imported; search garbage in what the tests make only."""
    session.config.stash[IMPORTED] = [name for name in HEAVY if name in sys.modules]
    gc.freeze()
    gc.set_threshold(20_000)
    gc.enable()


@fixture(scope="session")
def imported_while_collecting(pytestconfig):
    """The heavy libraries that were imported before the first test."""
    return pytestconfig.stash[IMPORTED]


def _campaigns():
    """Return the tests that `campaigns.csv` moves out of the suite: files, tests, or single cases of tests."""
    with Path(__file__).with_name("campaigns.csv").open(newline="") as lines:
        return {f"tests/{row['test']}" for row in csv.DictReader(lines)}


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config, items):
    """Mark campaigns; run the costliest folders first, in them browser tests and slow files; real data with LINNA_DATA.

    With several processes this needs `--no-loadscope-reorder`.
    """
    moved = _campaigns()
    for item in items:
        if {item.nodeid, item.nodeid.partition("[")[0], item.nodeid.partition("::")[0]} & moved:
            item.add_marker("campaign")
    if config.getoption("resume") and PASSED.exists():
        passed = set(PASSED.read_text().splitlines())
        items[:] = [item for item in items if item.nodeid not in passed]
    driven = {item.path for item in items if "browser" in getattr(item, "fixturenames", ())}
    sizes = Counter(item.path for item in items if item.path in driven)
    slow = Counter(item.path for item in items if "slow" in item.keywords)
    costs = read(TABLE) if _by_folder(config) else {}
    items.sort(key=lambda item: (-costs.get(_folder(item.nodeid), 0.0), -sizes[item.path], -slow[item.path]))
    if os.environ.get("LINNA_DATA"):
        return
    skip = mark.skip(reason="LINNA_DATA is not set: no real data on this machine")
    for item in items:
        if "real_data" in item.keywords:
            item.add_marker(skip)


def _folder(nodeid):
    return nodeid.partition("::")[0].rpartition("/")[0]


def _by_folder(config):
    """Return whether each process gets whole folders; campaigns, of which a few folders hold nearly all, go by file."""
    return config.getoption("markexpr") == "not campaign"


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Give each process whole folders, so that the tests of a folder share servers, flights and libraries."""
    from xdist.scheduler import LoadScopeScheduling

    if not _by_folder(config):
        return None
    scheduling = LoadScopeScheduling(config, log)
    scheduling._split_scope = _folder
    return scheduling


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call():
    """Forget the mission clock of a command that a test has run in this process: its home may be removed."""
    stated = clock._mission.stated
    yield
    clock.follow_missions(stated)


@fixture(scope="session")
def data_path():
    """The folder of real data products (only for tests marked real_data)."""
    return Path(os.environ["LINNA_DATA"])


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    """In continuous integration a test that lacks a server, a browser or a library fails; it does not skip."""
    report = yield
    if os.environ.get("CI") and report.skipped and "real_data" not in item.keywords:
        report.outcome = "failed"
        report.longrepr = f"skipped in continuous integration: {report.longrepr}"
    return report


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector):
    """The same for a whole file that leaves itself out because a library is missing."""
    report = yield
    if os.environ.get("CI") and report.outcome == "skipped":
        report.outcome = "failed"
        report.longrepr = f"skipped in continuous integration: {report.longrepr}"
    return report
