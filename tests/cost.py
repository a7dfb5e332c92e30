"""Processor time of the tests by folder, in turns of a calibration loop, compared with the table `cost.csv`.

A turn is the same work on any machine. The processor time includes that of child processes which have ended.
`python -m tests.cost` compares the last complete run with the table; `--write` makes the table.
"""

import os
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


def processor_s():
    """Return the processor time of this process and its ended children, s."""
    return sum(os.times()[:4])


def turn_s():
    """Return the processor time of one turn of the calibration loop, s: the fastest of five."""
    return min(timeit.repeat("sum(n * n % 7 for n in range(500_000))", timer=time.process_time, number=1))


class Cost:
    """Sums of the processor time of the tests, by file."""

    last_s, files = 0.0, Counter[str]()

    def pytest_collection_finish(self):
        self.last_s = processor_s()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self, item):
        report, now = (yield), processor_s()
        report.processor_s, self.last_s = now - self.last_s, now
        return report

    def pytest_runtest_logreport(self, report):
        self.files[report.nodeid.partition("::")[0]] += getattr(report, "processor_s", 0.0)

    def pytest_terminal_summary(self, terminalreporter, config):
        turn, folders = turn_s(), Counter[str]()
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
        TABLE.write_text(MEASURED.read_text())
    sys.exit("\n".join(grown(read(TABLE), read(MEASURED))) or 0)
