"""The kill campaign in its shortest form: the API and its jobs on SQLite, killed during ingest."""

import json
import sys
from pathlib import Path
from typing import Any

import pytest

from benchmarks.campaigns import kill
from benchmarks.campaigns.kill import holds, main, totals

SHORT = "--laptop --packets 1200 --pieces 4 --reports 0 --pause 0.3 --json"


def campaign(monkeypatch: Any, capsys: pytest.CaptureFixture[str], words: str) -> tuple[int, Any]:
    monkeypatch.setattr(sys, "argv", ["kill", *words.split()])
    code = main()
    return code, json.loads(capsys.readouterr().out)


def test_nothing_is_lost_or_doubled_by_kills_and_a_campaign_goes_on_where_it_ended(
    monkeypatch: Any, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    state = tmp_path / "state.json"
    code, figures = campaign(monkeypatch, capsys, f"{SHORT} --kills 3 --state {state}")
    assert code == 0
    assert figures["kills"] == {"api": 3}
    assert figures["lost"] == figures["doubled"] == 0
    assert figures["jobs"] == figures["ingests"] == {"done": figures["uploads"]}
    assert campaign(monkeypatch, capsys, f"{SHORT} --kills 3 --state {state}") == (0, figures)


def test_a_lost_packet_or_an_unfinished_job_fails_the_campaign() -> None:
    run = {
        "kills": {"api": 2}, "jobs": {"done": 3}, "ingests": {"done": 2}, "uploads": 2, "attempts": 4, "lost": 0,
        "doubled": 0, "seconds": 5, "archive_identical": True,
    }  # fmt: skip
    assert holds(totals([run, run]))
    for injury in (
        {"lost": 1}, {"doubled": 1}, {"archive_identical": False}, {"jobs": {"failed": 1}}, {"ingests": {"running": 1}},
    ):  # fmt: skip
        assert not holds(totals([run, {**run, **injury}]))


def test_a_pass_whose_definition_was_cut_off_is_looked_for_before_it_is_asked_for_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[str] = []

    def ask(_api: str, method: str, _path: str, _body: bytes | None = None, key: str = "") -> Any:
        asked.append(f"{method} {key}".strip())
        if method == "GET":
            return {"items": []}
        if key == "pass 0":
            raise SystemExit("POST /passes: 409 b'begun and its end is not known'")
        return {"id": 7}

    monkeypatch.setattr(kill, "ask", ask)
    assert kill.the_pass("http://nowhere", b"{}") == 7
    assert asked == ["POST pass 0", "GET", "POST pass 1"]
