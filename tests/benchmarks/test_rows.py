"""The list of benchmarks: rows with peers, what is missing on the machine, and rows that contradict the expectation."""

import json

import pytest

from benchmarks import _rows
from benchmarks.__main__ import NAMES, main
from benchmarks._rows import NotMeasured, Row, line, needs, report


@pytest.mark.parametrize(("unit", "ratio"), [("packets/s", 2.0), ("s", 0.5), ("packets", 2.0), ("MiB", 0.5)])
def test_a_ratio_above_one_is_better_than_the_peer(unit: str, ratio: float) -> None:
    assert Row("job", 10.0, unit, "peer", 5.0).ratio == ratio
    assert Row("job", 10.0, unit).ratio is None


def test_a_line_names_the_peer_and_the_contradiction() -> None:
    text = line(Row("job", 10.0, "s", "other program", 5.0, "values differ"))
    assert "0.50 x" in text and "other program: 5" in text and text.endswith("DIFFERENT: values differ")
    assert "no peer" in line(Row("job", 10.0, "s")) and "DIFFERENT" not in line(Row("job", 10.0, "s"))


def test_a_missing_program_is_named() -> None:
    with pytest.raises(NotMeasured, match=r"^Thing is not installed$"):
        needs("Thing", "no-such-program-1", "no-such-program-2")
    assert needs("a shell", "no-such-program-1", "sh").endswith("sh")


@pytest.mark.parametrize(
    ("rows", "fault", "status"),
    [
        ([Row("job", 1.0, "s")], "", 0),
        ([], "not measured: Chromium is not installed", 0),
        ([Row("job", 1.0, "s", wrong="values differ")], "", 1),
        ([], "exit status 1", 1),
        ([Row("job", 1.0, "s")], "did not finish in 300 s", 1),
    ],
)
def test_the_status_tells_contradictions_from_missing_programs(
    rows: list[Row],
    fault: str,
    status: int,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(_rows, "run", lambda names: iter([(names[0], rows, fault)]))
    assert report(["tmtc"], as_json=True) == status
    found = json.loads(capsys.readouterr().out)
    assert [one["benchmark"] for one in found] == ["tmtc"] and found[0]["fault"] == fault
    assert report(["tmtc"], as_json=False) == status
    assert fault in capsys.readouterr().out


def test_an_unknown_name_is_refused_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["year"]) == 2
    assert capsys.readouterr().err.startswith("benchmarks: expected tmtc, ")


def test_every_benchmark_of_the_list_yields_rows_in_a_process_of_its_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    import importlib

    assert all(callable(importlib.import_module(f"benchmarks.{name}").rows) for name in NAMES)
    monkeypatch.setattr(_rows, "LIMIT_S", 0.01)
    assert list(_rows.run(["tmtc"])) == [("tmtc", [], "did not finish in 0 s")]
