"""Processor time of the tests by folder, in turns of a calibration loop, compared with the table `cost.csv`.

A turn is the same work on any machine; it is measured between the tests, under the load that they have. The
processor time includes that of child processes which have ended. `python -m tests.cost` compares the last complete run
with the table; `--write` makes the table, of the greatest costs where files of several runs follow.
"""

import os
import statistics
import sys
import time
import timeit
from collections import Counter
from pathlib import Path

import pytest

TABLE = Path(__file__).with_name("cost.csv")
MEASURED = Path(__file__).parents[1] / "build/test-cost.csv"
MARGIN = 1.2
SMALLEST_TURNS = 20  # folders below this are noise
CALIBRATE_EACH = 25  # tests of a process
SHARED = "(shared)/processes"  # of the whole session: they end with the last test


def processor_s():
    """Return the processor time of this process and its ended children, s."""
    return sum(os.times()[:4])


def turn_s():
    """Return the processor time of one turn of the calibration loop, s, measured for a fifth of it."""
    return 5 * timeit.timeit("sum(n * n % 7 for n in range(100_000))", timer=time.process_time, number=1)


class Cost:
    """Sums of the processor time of the tests, by file, and the turns measured between them."""

    last_s, ends, count = 0.0, False, 0

    def __init__(self):
        self.files, self.turns = Counter[str](), []

    def pytest_collection_finish(self):
        self.last_s = processor_s()

    def pytest_runtest_teardown(self, nextitem):
        self.ends, self.count = nextitem is None, self.count + 1

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self, call):
        report, spent, turn = (yield), processor_s() - self.last_s, None
        if call.when == "teardown" and self.count % CALIBRATE_EACH == 1:
            turn = turn_s()
        name = SHARED if call.when == "teardown" and self.ends else report.nodeid.partition("::")[0]
        report.cost = (name, spent, turn)
        self.last_s = processor_s()
        return report

    def pytest_runtest_logreport(self, report):
        name, spent, turn = getattr(report, "cost", (SHARED, 0.0, None))
        self.files[name] += spent
        self.turns += [turn] if turn else []

    def pytest_terminal_summary(self, terminalreporter, config):
        turn, folders = statistics.median(self.turns or [turn_s()]), Counter[str]()
        for name, spent in self.files.items():
            folders[str(Path(name).parent)] += spent
        terminalreporter.section("processor time of the tests")
        for title, costs in (("folder", folders.most_common()), ("file", self.files.most_common(20))):
            for name, spent in costs:
                terminalreporter.write_line(f"{spent:8.1f} s {spent / turn:8.0f} turns  {title} {name}")
        whole = config.args_source is pytest.Config.ArgsSource.TESTPATHS and not config.getoption("keyword")
        if whole and config.getoption("markexpr") == "not campaign":
            MEASURED.parent.mkdir(exist_ok=True)
            rows = (f"{name},{round(spent / turn)}\n" for name, spent in sorted(folders.items()))
            MEASURED.write_text("".join(rows))


def read(path):
    """Read a table of turns by folder."""
    return {name: float(n) for name, _, n in (line.partition(",") for line in path.read_text().split())}


def grown(table, measured):
    """Return a line for each folder that costs more than the table allows."""
    limits = {name: max(MARGIN * table.get(name, 0.0), SMALLEST_TURNS) for name in measured}
    found = sorted((name, turns) for name, turns in measured.items() if turns > limits[name])
    return [f"{name}: {turns:.0f} turns, limit {limits[name]:.0f}" for name, turns in found]


if __name__ == "__main__":
    if "--write" in sys.argv:
        runs = [read(Path(path)) for path in sys.argv[2:] or [MEASURED]]
        greatest = {name: max(run.get(name, 0.0) for run in runs) for name in sorted(set().union(*runs))}
        TABLE.write_text("".join(f"{name},{turns:.0f}\n" for name, turns in greatest.items()))
    sys.exit("\n".join(grown(read(TABLE), read(MEASURED))) or 0)
