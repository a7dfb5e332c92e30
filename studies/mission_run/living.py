"""`linna demo --live`: a spacecraft that flies and the service that operates it, until both are stopped."""

import json
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path

from ground_service.client import Client
from ground_service.clock import ClockFile
from ground_service.errors import GroundError
from lunar.constants import DAY_NS
from lunar.datafolder import DataFolder
from payload_emulator.errors import ScenarioError
from payload_emulator.session.live.contacts import station_names
from payload_emulator.session.scenario import Scenario, format_scenario
from payload_emulator.session.world.rims import Watched
from payload_emulator.session.world.world import open_world
from studies.harness.parts import Part, answers_http, bare_environment, free_port
from studies.mission_run.dynamics import FlightDynamics, write_flight

WINDOWS_A_DAY = 12
"""A window in almost every revolution, so that a visitor sees one soon."""

WINDOW_S = 480.0
LOOK_S = 1.0


def living_demo(
    scenario: Scenario,
    data: DataFolder,
    folder: Path,
    rate: float,
    port: int,
    say: Callable[[str], None],
    stopping: threading.Event,
    watched: Watched = iter,
) -> None:
    """Start spacecraft and service, post what a user posts, and deliver an orbit a day until `stopping` is set.

    Parameters
    ----------
    folder
        New folder for documents, logs and ground service; or that of a demo of this scenario, which goes on.
    rate
        Simulated seconds per second.
    port
        Port of the service on this machine.
    watched
        Yields the parts of the longest step and shows its progress.

    Raises
    ------
    ScenarioError
        The folder has other files.
    GroundError
        A part does not start, or ends by itself.
    """
    mission, flown, clock = folder / "mission.toml", folder / "scenario.toml", folder / "clock"
    ports, stated = folder / "ports.json", format_scenario(scenario)
    goes_on = ports.is_file() and flown.read_text(encoding="utf-8") == stated
    if not goes_on and folder.exists() and any(folder.iterdir()):
        raise ScenarioError(
            f"{folder}: expected a new folder, or that of a living demo of this scenario, found one with other files"
        )
    folder.mkdir(parents=True, exist_ok=True)
    if goes_on:
        say("going on from the state of the spacecraft and the archive of the service ...")
        stations = {name: (down, up) for name, (down, up) in json.loads(ports.read_text()).items()}
    else:
        say("making the mission description, the craters, the orbit and the request ...")
        stations = {name: (free_port(), free_port()) for name in station_names(scenario, has_operator=False)}
        text = write_flight(scenario, data, mission, WINDOWS_A_DAY, WINDOW_S, stations, watched)
        mission.write_text(text, encoding="utf-8")
        flown.write_text(stated, encoding="utf-8")
    address = f"http://127.0.0.1:{port}"
    with ExitStack() as running:
        parts = _parts(folder, rate, port, stations)
        for name, part in parts.items():
            say(f"starting the {name} ...")
            running.enter_context(part)
        client = running.enter_context(Client(address))
        if not goes_on:
            client.add_catalogue(folder / "craters.csv")
            client.add_mission(mission)
            client.add_ephemeris(folder / "reference.oem")
            client.add_request(json.loads((folder / "request.json").read_text(encoding="utf-8")))
            ports.write_text(json.dumps(stations), encoding="utf-8")  # all is posted: from now on, it can go on
        say(f"{address}/ shows the shift at {rate:g} times real time; Ctrl-C ends")
        dynamics, now = None, ClockFile(clock)
        day = (now.read() - scenario.epoch_utc_ns) // DAY_NS if goes_on else 0
        while not stopping.wait(LOOK_S):
            ended = next((name for name, part in parts.items() if part.has_ended), None)
            if ended is not None:
                raise GroundError(f"{ended}: expected it to run, found its end; see {folder / ended}.log")
            utc_ns = now.read()
            if (utc_ns - scenario.epoch_utc_ns) // DAY_NS > day:
                day = (utc_ns - scenario.epoch_utc_ns) // DAY_NS
                dynamics = dynamics or FlightDynamics(open_world(scenario, data))
                orbit = dynamics.save_reference(utc_ns, folder / "reference.oem")
                client.add_ephemeris(orbit, name=f"orbit determination of day {day}", precedence=day)


def _parts(folder: Path, rate: float, port: int, stations: Mapping[str, tuple[int, int]]) -> dict[str, Part]:
    """Return the processes in the order of their start."""
    clock, console = folder / "clock", free_port()
    settings = bare_environment(LINNA_CLOCK_FILE=str(clock), LINNA_LIVE_CONSOLE=f"127.0.0.1:{console}")
    flight = ["emulate", folder / "scenario.toml", "--live", "--no-operator", "--rate", rate]
    flight += ["--craters", folder / "craters.csv", "--clock-file", clock]
    flight += ["--state", folder / "state", "--journal", folder / "journal"]
    flight += ["--console-port", console, "--mission-port", free_port()]
    for name, (telemetry, telecommand) in stations.items():
        flight += ["--station-port", f"{name}:{telemetry}:{telecommand}"]

    def part(name: str, words: Sequence[object], ready: Callable[[], bool]) -> Part:
        command = [sys.executable, "-m", "linna", *map(str, words)]
        return Part(command, folder / f"{name}.log", ready, attempts=1, env=settings)

    return {
        "spacecraft": part("spacecraft", flight, lambda: clock.exists() and clock.stat().st_size > 0),
        "service": part(
            "service",
            ["serve", "--home", folder / "ground", "--port", port],
            lambda: answers_http(f"http://127.0.0.1:{port}/readyz"),
        ),
    }
