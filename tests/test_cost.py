"""The cost of the suite: collection without heavy libraries, and folders compared with the table."""

import csv
from pathlib import Path

import pytest

from tests import cost


def test_the_collection_imports_no_heavy_library(imported_while_collecting: list[str]) -> None:
    assert imported_while_collecting == []


@pytest.mark.parametrize(
    ("turns", "named"),
    [(119.0, []), (121.0, ["a: 121 turns, limit 120"])],
)
def test_a_folder_that_costs_a_fifth_more_than_the_table_is_named(turns: float, named: list[str]) -> None:
    assert cost.grown({"a": 100.0, "gone": 50.0}, {"a": turns}) == named


def test_a_new_folder_may_cost_little() -> None:
    assert cost.grown({}, {"small": 19.0, "large": 21.0}) == ["large: 21 turns, limit 20"]


def test_the_table_is_read_as_it_was_written(tmp_path: Path) -> None:
    cost.write(tmp_path / "cost.csv", {"tests/b": 2.4, "tests/a": 10.0})
    assert cost.read(tmp_path / "cost.csv") == {"tests/a": 10.0, "tests/b": 2.0}


def test_every_entry_of_the_campaigns_is_a_test_with_a_twin() -> None:
    tests = Path(__file__).parent
    with (tests / "campaigns.csv").open(newline="") as lines:
        rows = list(csv.DictReader(lines))
    assert len({row["test"] for row in rows}) == len(rows) > 50
    for row in rows:
        file, _, name = row["test"].partition("[")[0].partition("::")
        assert f"def {name}(" in (tests / file).read_text() or not name, row
        assert row["twin"], row
