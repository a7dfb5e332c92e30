"""`linna mission run`: start the parts, let time pass from contact to contact, watch, and report."""

from __future__ import annotations

import json
import resource
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from ground_service.errors import GroundError
from lunar.constants import NANOSECONDS_PER_SECOND as NS
from lunar.datafolder import DataFolder
from lunar.timescales import format_utc, parse_utc
from payload_emulator.errors import LinkError, ScenarioError
from payload_emulator.session.flying import SPACECRAFT_ID
from payload_emulator.session.mission import SILENCE_S
from payload_emulator.session.scenario import Scenario, format_scenario, parse_scenario
from studies.mission_run.dynamics import DAY_NS, FlightDynamics
from studies.mission_run.figures import closing_figures
from studies.mission_run.ground import EmbeddedGround, PlanTerms, fill_plan
from studies.mission_run.spacecraft import SpacecraftFiles, SpacecraftProcess

DEFAULT_STATIONS = ("goldstone", "madrid", "canberra")
"""Stations where the scenario names none: the Moon is always above the horizon of one of them."""

SETTLE_NS = round(1.2 * SILENCE_S) * NS
"""Mission time after a contact at which the ground has noticed its end."""

ORBIT_S = 6_672.0
"""Orbital period of the scenarios of this project, for the latitudes of windows of a given length."""

TIME_RATE_EXPONENT = 4
SCRUB_PARAMETER = 15
SCRUB_INTERVAL_S = 600.0

OPERATIONS = """
[automation]
evaluate = true

[approval]
windows = "automatic"
one_person_for = [
  "enable_schedule", "set_parameter", "set_time_report_rate",
  "uplink_first", "uplink_middle", "uplink_last", "perform_function/set_mode",
  "perform_function/start_observation", "perform_function/stop_observation",
]
"""

Say = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class RunTerms:
    """What is run."""

    days: float
    rate: float = 0.0
    windows_per_day: int = 2
    window_s: float = 720.0

    @property
    def latitude_limit_deg(self) -> float:
        """Latitude north and south of the equator within which a pass lasts about as long as a window."""
        return min(180.0 * self.window_s / ORBIT_S, 60.0)


@dataclass(slots=True)
class Progress:
    """What the runner has seen; kept in the folder of the run."""

    wall_s: float = 0.0
    utc: str = ""
    starts: int = 0
    contacts: int = 0
    frames: int = 0
    packets: int = 0
    telecommands: int = 0
    interventions: int = 0
    reference_day: int = -1
    finished: bool = False
    incidents: list[dict[str, str]] = field(default_factory=list)
    memory_mib: list[float] = field(default_factory=list)


def run_mission(
    scenario: Scenario, data: DataFolder, folder: Path, terms: RunTerms, say: Say
) -> dict[str, Any]:
    """Run a mission in a folder, or go on with the one that is there; the closing figures.

    Raises
    ------
    ScenarioError
        The folder holds a run of another scenario or of other terms.
    GroundError, LinkError
        A part did not do what is expected of it; the run can be taken up again.
    """
    run = MissionRun(_prepared(scenario), data, folder, terms, say)
    return run.run()


def _prepared(scenario: Scenario) -> Scenario:
    if scenario.link.stations:
        return scenario
    return replace(scenario, link=replace(scenario.link, stations=DEFAULT_STATIONS))


class MissionRun:
    """One run of a mission in a folder, by this process."""

    def __init__(self, scenario: Scenario, data: DataFolder, folder: Path, terms: RunTerms, say: Say) -> None:
        self._scenario, self._data, self._folder, self._terms, self._say = scenario, data, folder, terms, say
        self._files = SpacecraftFiles(
            folder / "scenario.toml",
            folder / "spacecraft.state",
            folder / "clock",
            folder / "craters.csv",
            folder / "operations.toml",
            folder / "spacecraft.log",
        )
        self._progress_file = folder / "progress.json"
        self._progress = Progress()
        self._begun_s = time.monotonic()
        self._wall_before_s = 0.0

    def run(self) -> dict[str, Any]:
        """Run until the days are over; after an interruption the next call goes on."""
        self._folder.mkdir(parents=True, exist_ok=True)
        self._load()
        if self._progress.finished:
            self._say(f"{self._folder}: this run has ended; its report is {self._folder / 'report.html'}")
            return dict(json.loads((self._folder / "report.json").read_text()))
        dynamics = FlightDynamics.of(self._scenario, self._data)
        if not self._files.craters.exists():
            count = dynamics.save_craters(self._terms.latitude_limit_deg, self._files.craters)
            self._say(f"catalogue: {count} craters with rim heights")
        self._files.operations.write_text(OPERATIONS)
        self._progress.starts += 1
        spacecraft = SpacecraftProcess(
            self._files, self._scenario.link.stations, self._terms.days, self._terms.rate
        )
        try:
            ground = EmbeddedGround.open(self._folder / "ground", self._data, self._files.clock)
            try:
                self._operate(spacecraft, ground, dynamics)
                figures = self._close(ground)
            finally:
                ground.close()
        finally:
            spacecraft.stop()
            self._save()
        return figures

    def _operate(
        self, spacecraft: SpacecraftProcess, ground: EmbeddedGround, dynamics: FlightDynamics
    ) -> None:
        held = ground.client.add_catalogue(self._files.craters)
        text = spacecraft.mission_text().decode()
        ground.add_mission(text.replace("[catalogue]\n", f'[catalogue]\nsha256 = "{held.sha256}"\n').encode())
        self._deliver_reference(ground, dynamics, self._scenario.epoch_utc_ns)
        commissioned = self._progress.contacts > 0
        for message in spacecraft.messages():
            kind = message["kind"]
            if kind == "end":
                return
            if kind == "contact":
                self._note(message)
                now = parse_utc(message["utc"])
                if message["state"] == "started":
                    if not commissioned:
                        self._commission(ground)
                        commissioned = True
                    self._deliver_reference(ground, dynamics, now)
                    self._plan(ground, now)
                    ground.wait_sent()
                    time.sleep(0.1)
                    spacecraft.order("run")
                else:
                    spacecraft.order(f"until {format_utc(now + SETTLE_NS)}")
            elif kind == "paused":
                spacecraft.order("state")
            elif kind in ("state", "finished"):
                self._note({**message, "state": kind})
                ground.wait_received(message["sent"])
                self._watch(ground, message)
                spacecraft.order("run")
            elif kind == "error":
                raise LinkError(f"spacecraft: {message['text']}")
        raise LinkError(f"spacecraft: expected it to fly for {self._terms.days:g} days, found its end")

    def _commission(self, ground: EmbeddedGround) -> None:
        """Send what a new spacecraft is told once: reports of time, how often memory is checked."""
        for name, arguments in (
            ("set_time_report_rate", {"rate_exponent": TIME_RATE_EXPONENT}),
            ("set_parameter", {"parameter_id": SCRUB_PARAMETER, "value": SCRUB_INTERVAL_S}),
        ):
            command = ground.client.enter_telecommand(name, arguments, spacecraft_id=SPACECRAFT_ID)
            ground.client.release_telecommand(command.id)

    def _deliver_reference(self, ground: EmbeddedGround, dynamics: FlightDynamics, now: int) -> None:
        """Give the ground the orbit determination of the day."""
        day = (now - self._scenario.epoch_utc_ns) // DAY_NS
        if day > self._progress.reference_day:
            path = dynamics.save_reference(now, self._folder / "reference.oem")
            ground.client.add_ephemeris(path, name=f"orbit determination of day {day}", precedence=day)
            self._progress.reference_day = day

    def _plan(self, ground: EmbeddedGround, now: int) -> None:
        terms = PlanTerms(
            self._terms.windows_per_day,
            self._terms.latitude_limit_deg,
            self._terms.window_s,
            self._scenario.camera.frame_interval_s,
        )
        fill_plan(ground, terms, now, self._scenario.epoch_utc_ns, SPACECRAFT_ID)

    # What is seen

    def _note(self, message: dict[str, Any]) -> None:
        progress = self._progress
        progress.utc = message["utc"]
        progress.contacts += message["state"] == "started"
        progress.frames, progress.packets = message["frames"], message["packets"]
        progress.telecommands = message["telecommands"]

    def _watch(self, ground: EmbeddedGround, message: dict[str, Any]) -> None:
        progress = self._progress
        progress.memory_mib.append(round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0, 1))
        self._save()
        days = (parse_utc(message["utc"]) - self._scenario.epoch_utc_ns) / DAY_NS
        states = ", ".join(f"{count} {state}" for state, count in sorted(ground.state_counts().items()))
        self._say(
            f"day {days:6.2f} of {self._terms.days:g}, {progress.wall_s:6.0f} s: {progress.contacts} contacts, "
            f"{progress.frames} frames, {progress.packets} packets, windows: {states or 'none'}"
        )

    def _close(self, ground: EmbeddedGround) -> dict[str, Any]:
        self._save()
        figures = closing_figures(ground, self._progress, self._terms.days, self._scenario.name)
        (self._folder / "report.json").write_text(json.dumps(figures, indent=2) + "\n")
        from studies.mission_run.document import save_document

        save_document(figures, self._folder / "report.html")
        self._progress.finished = True
        return figures

    # State

    def _load(self) -> None:
        text = format_scenario(self._scenario)
        terms_file = self._folder / "terms.json"
        terms = json.dumps(asdict(self._terms))
        if self._files.scenario.exists():
            known = parse_scenario(self._files.scenario.read_text(), str(self._files.scenario))
            if known != self._scenario or terms_file.read_text() != terms:
                raise ScenarioError(
                    f"{self._folder}: expected a new folder, or the same scenario and options as before, "
                    f"found a run of {known.name} with {terms_file.read_text()}"
                )
        self._files.scenario.write_text(text)
        terms_file.write_text(terms)
        if self._progress_file.exists():
            self._progress = Progress(**json.loads(self._progress_file.read_text()))
            self._wall_before_s = self._progress.wall_s
            if not self._progress.finished:
                self._say(f"{self._folder}: goes on from {self._progress.utc or 'the start'}")

    def _save(self) -> None:
        self._progress.wall_s = round(self._wall_before_s + time.monotonic() - self._begun_s, 1)
        new_file = self._progress_file.with_name(self._progress_file.name + ".new")
        new_file.write_text(json.dumps(asdict(self._progress)))
        new_file.replace(self._progress_file)


__all__ = ["GroundError", "RunTerms", "run_mission"]
