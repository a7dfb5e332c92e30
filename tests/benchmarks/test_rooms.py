"""Rooms, floors and arrows of packages; the table of the benchmarks."""

from graphlib import CycleError

from pytest import raises

from benchmarks import _rows
from benchmarks.__main__ import main
from benchmarks.rooms import Rooms, measure

MODULES = {
    "house": "",
    "house.attic": "import json\nfrom house.hall import (\n    door,\n)\n\n\ndef f():\n    from house import cellar\n",
    "house.hall": "", "house.hall.door": "from house.hall.key import KEY\nfrom house.cellar import STAIRS\n",
    "house.hall.key": "KEY = 1\n", "house.cellar": "STAIRS = 1\n", "houses": "import house\n",
}  # fmt: skip


def test_rooms_and_arrows_are_those_of_the_imports_and_a_circle_is_refused():
    """attic → hall → cellar, and attic → cellar inside a function; 7 of 12 lines import."""
    assert measure("house", MODULES) == Rooms(3, 3, 3, 6, 12, 7 / 12)
    with raises(CycleError, match="cycle"):
        measure("house", MODULES | {"house.cellar": "from house import attic\n"})


def test_a_benchmark_states_its_ratio_to_the_build_before(tmp_path, monkeypatch, capsys):
    def run(names, root=_rows.ROOT):
        now = root == _rows.ROOT
        rows = [_rows.Row("rate", 30.0 if now else 20.0, "packets/s"), _rows.Row("time", 2.0 if now else 3.0, "ms")]
        yield names[0], [*rows, _rows.Row("new", 1.0, "ms")] if now else rows, ""

    monkeypatch.setattr(_rows, "run", run)
    assert _rows.report(["tmtc"], as_json=False, before=tmp_path) == 0
    rate, time, new = capsys.readouterr().out.splitlines()[2:5]
    assert rate.endswith("ratio to the build before: 1.50") and time.endswith("ratio to the build before: 1.50")
    assert new.endswith("no peer")
    assert main(["tmtc", "--before", "no-such-commit"]) == 2
    assert capsys.readouterr().err == "benchmarks: expected a commit of this project, found no-such-commit\n"
