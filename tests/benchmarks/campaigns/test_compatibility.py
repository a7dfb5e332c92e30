"""Comparison of values, and rows of the table of compatibility that do not run."""

import json
import subprocess

from pytest import fixture, mark

from benchmarks.campaigns import compatibility
from benchmarks.campaigns.compatibility import ROWS, compare, format_page, result, versions


@mark.parametrize(
    "found, text",
    [
        ([[1.0, 1000.0], [2.0, 2000.0]], "equal (4 values)"),
        ([[1.0, 1000.0], [2.0, 2000.0 + 2e-5]], "equal to 8 digits (4 values)"),
        ([[1.0, 1000.0], [2.0, 2000.5]], "differs by 0.00025 of the greatest value"),
        ([[1.0, 1000.0]], "differs: 1 × 2 values of 2 × 2"),
        ([[1.0, None], [2.0, 2000.0]], "differs: other values are unknown"),
    ],
)
def test_numbers_are_compared_in_digits_of_the_greatest_value_of_their_column(found, text):
    assert compare([[1.0, 1000.0], [2.0, 2000.0]], found) == (text, text.startswith("equal"))


def test_values_are_compared_by_name_and_a_quaternion_and_its_negative_are_the_same():
    right, other = [[0.0, 0.6, 0.0, 0.0, 0.8]], [[0.0, -0.6, 0.0, 0.0, -0.8]]
    assert compare(right, other, rotations=True) == ("equal (5 values)", True)
    assert not compare(right, other)[1]
    right = [{"a": 1, "b": [1.5, None], "c": "ON"}]
    assert compare(right, [{"a": 1, "b": [1.5, float("nan")], "c": "ON"}]) == ("equal (4 values)", True)
    found = compare(right, [{"a": 2, "b": [1.5, None], "c": "ON"}])
    assert found == ("differs in 1 of 4 values: [0].a is 2, expected 1", False)


@fixture
def samples(tmp_path, monkeypatch):
    """Samples in a folder of their own."""
    monkeypatch.setattr(compatibility, "BUILD", tmp_path)
    (tmp_path / "expected.json").write_text(json.dumps({"arc": [[1.0]]}))
    return tmp_path


def test_a_program_that_cannot_be_installed_is_not_tried_and_says_why(samples, monkeypatch):
    def refuse(name):
        raise subprocess.CalledProcessError(1, "pip", stderr="looking\nno such version")

    monkeypatch.setattr(compatibility, "prepare", refuse)
    cells = result(ROWS[1], samples, again=False)
    assert [(one["way"], one["text"]) for one in cells] == [
        ("reads", "not tried: not installed: no such version"), ("writes", "not tried: not installed: no such version"),
    ]  # fmt: skip


def test_a_row_is_not_run_again_until_something_changed(samples, monkeypatch):
    runs = []

    def run(row, folder, out):
        runs.append(row.name)
        return [{"way": "reads", "what": "OEM", "expects": "arc", "values": [[1.0]]}]

    monkeypatch.setattr(compatibility, "run_row", run)
    cells = result(ROWS[1], samples, again=False)
    assert cells == result(ROWS[1], samples, again=False) and len(runs) == 1
    assert cells[0]["text"] == "equal (1 values)"
    (samples / "expected.json").write_text(json.dumps({"arc": [[2.0]]}))
    assert not result(ROWS[1], samples, again=False)[0]["good"] and len(runs) == 2


def test_a_refusal_needs_a_reason_and_a_reason_excuses_no_other_values(samples, monkeypatch):
    entry = {"way": "writes", "what": "SPK", "refused": "ValueError: frame"}
    other = {"way": "reads", "what": "OEM", "expects": [[1.0]], "values": [[2.0]], "why": "known"}
    monkeypatch.setattr(compatibility, "run_row", lambda *_: [entry, {**entry, "why": "a frame | of its own"}, other])
    bare, stated, differing = result(ROWS[1], samples, again=True)
    assert not bare["good"] and stated["good"] and not differing["good"]
    assert stated["text"] == "refused: ValueError: frame (a frame \\| of its own)"
    assert f"| {ROWS[1].name} |" in format_page({ROWS[1].name: [stated]})


def test_the_page_states_the_pinned_version_of_every_program():
    lines = compatibility.PAGE.read_text().splitlines()
    for row in ROWS:
        assert any(line.startswith(f"| {row.name} | {versions(row)} |") for line in lines), row.name
