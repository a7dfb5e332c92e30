"""`linna demo --live`: the parts start, telecommands of a window are sent, and all end with the command."""

from __future__ import annotations

import sys
from pathlib import Path
from threading import Event

import pytest

from ground_service.client import Client
from linna.data import data_folder
from payload_emulator.errors import ScenarioError
from payload_emulator.session.scenario import load_scenario
from studies.harness.parts import Part, bare_environment, free_port, listens
from studies.mission_run.living import living_demo
from tests.serving import wait_for


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_living_demo_plans_and_commands_until_it_is_ended(tmp_path: Path) -> None:
    port, log = free_port(), tmp_path / "log"
    words = ["demo", "--live", "--out", tmp_path / "demo", "--port", port, "--rate", 240]
    environment = bare_environment()
    environment.pop("LINNA_DATA", None)
    demo = Part(
        [sys.executable, "-m", "linna", *map(str, words)],
        log,
        lambda: "shows the shift at 240 times real time" in log.read_text(),
        attempts=1,
        env=environment,
    )
    with demo, Client(f"http://127.0.0.1:{port}") as client:
        wait_for(
            lambda: (
                {"uplinked", "executing", "executed", "downlinked", "processed"}
                & {one.state for one in client.list_windows()}
            ),
            "telecommands of a window sent",
            200.0,
        )
        demo.finish()
        assert not listens(port)
    with pytest.raises(ScenarioError, match="expected a new folder for a living demo, found one with files"):
        living_demo(load_scenario("live-demo"), data_folder(), tmp_path / "demo", 1.0, port, print, Event())
