"""The cost of the suite: collection without heavy libraries, and folders compared with the table."""

import csv
import os
import tempfile
from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests import cost


def test_the_collection_imports_no_heavy_library(imported_while_collecting):
    assert imported_while_collecting == []


@pytest.mark.parametrize(("turns", "named"), [(119.0, []), (121.0, ["a: 121 turns, limit 120"])])
def test_a_folder_that_costs_a_fifth_more_than_the_table_is_named(turns, named):
    assert cost.grown({"a": 100.0, "gone": 50.0}, {"a": turns}) == named


def test_a_new_folder_may_cost_little():
    assert cost.grown({}, {"small": 19.0, "large": 21.0}) == ["large: 21 turns, limit 20"]


def test_what_was_measured_is_written_and_read_as_turns_by_folder(tmp_path, monkeypatch):
    written = tmp_path / "build" / "cost.csv"
    monkeypatch.setattr(cost, "MEASURED", written)
    monkeypatch.setattr(cost, "turn_s", lambda: 0.5)
    measured, lines = cost.Cost(), []
    measured.files = Counter({"tests/b/test_x.py": 0.7, "tests/b/test_y.py": 0.5, "tests/a/test_z.py": 5.0})
    report = SimpleNamespace(section=lines.append, write_line=lines.append)
    config = SimpleNamespace(
        args_source=pytest.Config.ArgsSource.TESTPATHS, getoption={"keyword": "", "markexpr": "not campaign"}.get
    )
    measured.pytest_terminal_summary(report, config)
    assert cost.read(written) == {"tests/a": 10.0, "tests/b": 2.0}
    assert [line.split()[-1] for line in lines[1:3]] == ["tests/a", "tests/b"]


def test_every_entry_of_the_campaigns_is_a_test_with_a_twin():
    tests = Path(__file__).parent
    with (tests / "campaigns.csv").open(newline="") as lines:
        rows = list(csv.DictReader(lines))
    assert len({row["test"] for row in rows}) == len(rows) > 50
    for row in rows:
        file, _, name = row["test"].partition("[")[0].partition("::")
        assert f"def {name}(" in (tests / file).read_text() or not name, row
        assert row["twin"], row


def test_temporary_files_are_where_the_environment_says():
    assert tempfile.gettempdir() == os.environ.get("TMPDIR", tempfile.gettempdir())
