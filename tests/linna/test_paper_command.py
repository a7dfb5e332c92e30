"""`linna paper` end to end in small: every step, a second run that repeats none, and reasons without torch."""

import csv
import importlib.util
import json

from pytest import MonkeyPatch, fixture

from linna.cli import run
from lunar.datafolder import find_data
from studies import paper_steps
from studies.paper_steps import Effort, StepFolder

SMALL = Effort(
    hours=0.1, unseen_passes=1, sample_frames=8, method_frames=8, training_steps=1, days=1.0, fov_step_s=600.0
)


@fixture(scope="module")
def document(tmp_path_factory):
    out = tmp_path_factory.mktemp("paper") / "paper"
    lines = []
    with MonkeyPatch.context() as patch:
        find_spec = importlib.util.find_spec
        patch.setattr(importlib.util, "find_spec", lambda name, *a: None if name == "torch" else find_spec(name, *a))
        patch.setattr(paper_steps, "QUICK", SMALL)
        patch.setattr("linna.commands.study.log", lines.append)
        patch.delenv("LINNA_DATA", raising=False)
        patch.setenv("XDG_DATA_HOME", str(out.parent))
        words = ["paper", "--quick", "--out", str(out)]
        assert run(words) == 0
        first = len(lines)
        assert run(words) == 0
    return out, json.loads((out / "paper.json").read_text()), lines[first:]


def test_the_document_has_the_figures_tables_and_differences(document):
    out, index, _ = document
    rows = list(csv.DictReader((out / "paper.csv").read_text().splitlines()))
    assert [row["quantity"] for row in rows] == [one["quantity"] for one in index["values"]]
    assert {f"{figure['key']}.png" for figure in index["figures"]} <= {one.name for one in (out / "figures").iterdir()}
    assert (out / "paper.pdf").read_bytes().startswith(b"%PDF")
    assert {
        "fov", "classes", "region", "samples", "ours-outcomes", "ours-ground", "ours-altitude", "ours-simulator",
    } <= {figure["key"] for figure in index["figures"]}  # fmt: skip
    assert index["tables"][-1]["columns"] == ["subject", "paper", "this system", "reason"]
    images = next(row for row in index["differences"] if row["subject"] == "Images of the session")
    assert "5" in images["paper"] and "0.1 h" in images["here"] and "32.5 h" in images["reason"]


def test_a_second_run_repeats_no_step_and_the_document_says_what_lacks_without_torch_and_data(document):
    announced, *steps = document[2]
    assert announced.startswith("this takes") and steps
    assert all(line.endswith(": already done") for line in steps)
    assert "torch" in document[1]["not_available"]["sessions"]
    assert not [figure for figure in document[1]["figures"] if figure["key"].startswith("own-")]
    levels = {figure["key"]: figure["level"] for figure in document[1]["figures"]}
    assert all(level.startswith(("level 1", "level 2")) for level in levels.values()), levels


def test_a_step_is_done_again_when_what_it_is_made_from_changes(tmp_path):
    calls = []

    def make():
        calls.append(len(calls))
        return len(calls)

    steps = StepFolder(tmp_path, find_data(None), SMALL, None, lambda _: None, lambda items, total: iter(items))
    assert [
        steps.step("one", {"a": 1}, make),
        steps.step("one", {"a": 1}, make),
        steps.step("one", {"a": 2}, make),
    ] == [1, 1, 2]


def test_hours_out_of_range_are_refused(tmp_path, typed):
    assert typed(f"paper --out {tmp_path}/p --hours 0", 2) == (
        "linna paper: error: argument --hours: expected a number from 0.5 and up to 240, found '0'"
    )
    assert not (tmp_path / "p").exists()
