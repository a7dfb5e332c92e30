"""`linna demo --live`: the parts start, documents are posted, and all end with the command or with a part."""

import sys
from threading import Event
from unittest.mock import MagicMock

from pytest import mark, raises

from ground_service.client import Client
from ground_service.errors import GroundError
from linna.data import data_folder
from payload_emulator.errors import ScenarioError
from payload_emulator.session.scenario import load_scenario
from studies.harness.parts import Part, bare_environment, free_port, listens
from studies.mission_run import living
from tests.serving import wait_for


def test_a_part_that_ends_is_named_after_the_documents_were_posted(tmp_path, monkeypatch):
    folder, client, said = tmp_path / "demo", MagicMock(), []
    client.__enter__.return_value = client

    def written(*_):
        (folder / "request.json").write_text('{"windows": 12}')
        return ""

    def parts(folder, *_):
        program = [sys.executable, "-c", "import time; time.sleep(0.5)"]
        return {"spacecraft": Part(program, folder / "spacecraft.log", lambda: True)}

    monkeypatch.setattr(living, "write_flight", written)
    monkeypatch.setattr(living, "_parts", parts)
    monkeypatch.setattr(living, "Client", lambda _: client)
    monkeypatch.setattr(living, "LOOK_S", 0.01)
    demo = (load_scenario("live-demo"), data_folder(), folder, 60.0, 8042, said.append, Event())
    with raises(GroundError, match="spacecraft: expected it to run, found its end; see "):
        living.living_demo(*demo)
    posted = [name for name, _, _ in client.method_calls]
    assert posted == ["add_catalogue", "add_mission", "add_ephemeris", "add_request"]
    client.add_request.assert_called_once_with({"windows": 12})
    assert said.pop() == "http://127.0.0.1:8042/ shows the shift at 60 times real time; Ctrl-C ends"
    client.reset_mock()
    with raises(GroundError, match="spacecraft: expected it to run, found its end; see "):
        living.living_demo(*demo)  # goes on: nothing is posted again
    assert client.method_calls == [] and said[-3].startswith("going on from the state of the spacecraft")
    other = (load_scenario("live-pictures"), *demo[1:])
    with raises(ScenarioError, match="that of a living demo of this scenario, found one with other files"):
        living.living_demo(*other)


def test_a_spacecraft_that_goes_on_has_its_state_and_ports_and_the_terrain_of_the_demo(tmp_path):
    command = living._parts(tmp_path, 60.0, 8042, {"madrid": (1, 2)})["spacecraft"]._command
    assert {"--state", "--journal", "madrid:1:2"} <= {*command}
    assert load_scenario("live-demo").terrain == load_scenario("selenita").terrain


@mark.campaign
def test_a_living_demo_plans_and_commands_until_it_is_ended(tmp_path):
    port, log = free_port(), tmp_path / "log"
    words = ["demo", "--live", "--out", tmp_path / "demo", "--port", port, "--rate", 240]
    environment = bare_environment()
    environment.pop("LINNA_DATA", None)
    demo = Part(
        [sys.executable, "-m", "linna", *map(str, words)], log,
        lambda: "shows the shift at 240 times real time" in log.read_text(), attempts=1, env=environment,
    )  # fmt: skip
    with demo, Client(f"http://127.0.0.1:{port}") as client:
        wait_for(
            lambda: (
                {"uplinked", "executing", "executed", "downlinked", "processed"}
                & {one.state for one in client.list_windows()}
            ),
            "telecommands of a window sent",
        )
        demo.finish()
        assert not listens(port)
