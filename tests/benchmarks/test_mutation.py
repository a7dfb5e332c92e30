"""Groups of the mutation tests; figures and limits of the benchmarks, and the list of them."""

import json
import math

import numpy as np
from pytest import approx, mark, raises

from benchmarks import _rows, mutation
from benchmarks.__main__ import NAMES, main
from benchmarks._rows import NotMeasured, Row, line, needs, report
from benchmarks.render import compare_renderings
from payload_emulator.sim.render.renderer import Rendering


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


def rendering(dark_columns, radiance=0.02, size=16):
    lit = np.ones((size, size), np.float32)
    lit[:, :dark_columns] = 0.0
    bright = np.linspace(0.5, 1.5, size, dtype=np.float32)[:, None] * np.float32(radiance)
    return Rendering(np.where(lit > 0, bright, 0.0).astype(np.float32), lit, np.full((size, size), 2e4, np.float32))


def test_shadows_are_counted_over_all_views_and_radiance_is_compared_with_the_mean_of_the_reference():
    found = compare_renderings([rendering(4), rendering(8)], [rendering(6), rendering(8)])
    # 4 of 6 columns and 8 of 8: 12 of 14.
    assert found.shadow_iou == approx(12.0 / 14.0)
    assert found.dark_pixels == 14 * 16 and found.views == 2
    found = compare_renderings([rendering(0, 0.02)], [rendering(0, 0.022)])
    # A tenth too bright everywhere: 0.1 sqrt(mean b^2) / mean b for b even from 0.5 to 1.5.
    b = np.linspace(0.5, 1.5, 16)
    assert found.radiance_rmse == approx(0.1 * math.sqrt(np.mean(b**2)), rel=1e-4)
    assert found.correlation == approx(1.0)
    assert math.isnan(compare_renderings([rendering(0)], [rendering(0)]).shadow_iou)
    assert math.isnan(compare_renderings([], []).correlation)


@mark.parametrize("unit, ratio", [("packets/s", 2.0), ("s", 0.5), ("packets", 2.0), ("MiB", 0.5)])
def test_a_ratio_above_one_is_better_than_the_peer(unit, ratio):
    assert Row("job", 10.0, unit, "peer", 5.0).ratio == ratio
    assert Row("job", 10.0, unit).ratio is None


def test_a_line_names_the_peer_the_contradiction_and_a_missing_program():
    text = line(Row("job", 10.0, "s", "other program", 5.0, "values differ"))
    assert "0.50 x" in text and "other program: 5" in text and text.endswith("DIFFERENT: values differ")
    assert "no peer" in line(Row("job", 10.0, "s")) and "DIFFERENT" not in line(Row("job", 10.0, "s"))
    with raises(NotMeasured, match=r"^Thing is not installed$"):
        needs("Thing", "no-such-program-1", "no-such-program-2")
    assert needs("a shell", "no-such-program-1", "sh").endswith("sh")


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
