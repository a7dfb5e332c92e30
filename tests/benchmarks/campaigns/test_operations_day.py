"""A day against a payload that flies live, as the campaign rehearses it: separate processes and TCP all the way."""

from pathlib import Path
from typing import Any

import pytest

from benchmarks.campaigns.operations_day import rehearse, went_well
from tests.scenarios import live_scenario

SCENARIO = live_scenario("live", 3, 360.0)


@pytest.mark.campaign
def test_a_day_is_planned_flown_live_and_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("LINNA_DATA", raising=False)
    (tmp_path / "live.toml").write_text(SCENARIO)
    lines, figures = rehearse(
        str(tmp_path / "live.toml"), tmp_path, distributed=False, minutes=1.5, echo=False
    )
    assert went_well(figures), str(figures)
    assert figures["telecommands"] == {"completed": 12}
    assert "report.pdf" in figures["report"]
    assert any(line.startswith("eve $ linna mission add") for line in lines)
    assert any(line.startswith("# audit: bob release telecommand") for line in lines)


def test_a_day_with_a_fault_is_reported() -> None:
    figures: dict[str, Any] = {
        "window": "processed", "packets_lost": 0, "telecommands": {"completed": 6}, "refused": [401, 403, 421],
        "verify": "intact", "frames": 6, "frames_planned": 6, "median_error_m": {"spherical": 80.0},
    }  # fmt: skip
    assert went_well(figures)
    for change in (
        {"window": "downlinked"},
        {"packets_lost": 1},
        {"refused": [200, 401, 421]},
        {"verify": "damaged"},
        {"frames": 5},
        {"telecommands": {"completed": 4, "sent": 1}},
        {"median_error_m": {"spherical": None}},
    ):
        assert not went_well({**figures, **change}), change
