"""Groups of the mutation tests; figures and limits of the benchmarks, and the list of them."""

import json

from pytest import mark

from benchmarks import _rows, mutation
from benchmarks.__main__ import NAMES, main
from benchmarks._rows import Row, report


@mark.parametrize("name", sorted(mutation.GROUPS))
def test_a_group_names_modules_and_tests_that_exist(name):
    group = mutation.GROUPS[name]
    assert group.modules and group.tests
    assert [path for path in group.modules + group.tests if not (mutation.ROOT / path).exists()] == []


@mark.parametrize(
    "difference",
    [
        "-    a = np.zeros(n, dtype=np.int64)\n+    a = np.zeros(n, dtype=None)",
        "-    a = np.zeros(n, dtype=np.int64)\n+    a = np.zeros(n, )",
        "-    a = b.astype(np.int64)\n+    a = b.astype(None)",
        '-    raise Conflict("not queued")\n+    raise Conflict("XXnot queuedXX")',
        '-    raise Refused("a", b, "not so", "c")\n+    raise Refused("a", b, "NOT SO", "c")',
    ],
)
def test_element_types_and_wording_are_left_out(difference):
    assert mutation.reason_left_out(difference) is not None


@mark.parametrize(
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
def test_what_decides_is_tested(difference):
    assert mutation.reason_left_out(difference) is None


@mark.parametrize(
    "rows, fault, status",
    [
        ([Row("job", 1.0, "s")], "", 0), ([], "not measured: Chromium is not installed", 0),
        ([Row("job", 1.0, "s", wrong="values differ")], "", 1), ([], "exit status 1", 1),
        ([Row("job", 1.0, "s")], "did not finish in 300 s", 1),
    ],
)  # fmt: skip
def test_the_status_tells_contradictions_from_missing_programs(rows, fault, status, monkeypatch, capsys):
    monkeypatch.setattr(_rows, "run", lambda names: iter([(names[0], rows, fault)]))
    assert report(["tmtc"], as_json=True) == status
    found = json.loads(capsys.readouterr().out)
    assert [one["benchmark"] for one in found] == ["tmtc"] and found[0]["fault"] == fault
    assert report(["tmtc"], as_json=False) == status
    assert fault in capsys.readouterr().out


def test_an_unknown_name_is_refused_in_one_line(capsys):
    assert main(["year"]) == 2
    assert capsys.readouterr().err.startswith("benchmarks: expected tmtc, ")


def test_every_benchmark_of_the_list_yields_rows_in_a_process_of_its_own(monkeypatch):
    import importlib

    assert all(callable(importlib.import_module(f"benchmarks.{name}").rows) for name in NAMES)
    monkeypatch.setattr(_rows, "LIMIT_S", 0.01)
    assert list(_rows.run(["tmtc"])) == [("tmtc", [], "did not finish in 0 s")]
