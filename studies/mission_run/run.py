"""`linna mission run`: start the parts, let time pass from contact to contact, watch, and report."""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from ground_service.clock import ClockFile, set_mission_clock
from lunar.constants import DAY_NS
from lunar.constants import NS as NS
from lunar.datafolder import DataFolder
from lunar.timescales import format_utc, parse_utc
from payload_emulator.errors import LinkError, ScenarioError
from payload_emulator.session.archive.mission import SILENCE_S
from payload_emulator.session.scenario import Scenario, format_scenario, parse_scenario
from payload_emulator.session.world.world import open_world
from studies.mission_run.checkpoints import Checkpoints
from studies.mission_run.disturbances import UNDISTURBED, Disturbances
from studies.mission_run.dynamics import LAST_NS, FlightDynamics
from studies.mission_run.figures import Progress, closing_figures, months, note_plan, windows_asked
from studies.mission_run.ground import POLL_S, SETTLE_S, EmbeddedGround, MissionGround
from studies.mission_run.spacecraft import SpacecraftFiles, SpacecraftProcess

REPORT = "report.json"
DEFAULT_STATIONS = ("goldstone", "madrid", "canberra")
"""Stations where the scenario names none: the Moon is always above the horizon of one of them."""

SETTLE_NS = (round(SILENCE_S) + 5) * NS
"""Mission time after a contact at which the ground notices its end."""

TURN_NS = 1_500 * NS
"""Mission time for which one spacecraft of a fleet flies at a time: below the silence that ends a contact, and whole
steps of a minute, so that it adds none."""

CHECKPOINT_S = 60.0
"""Wall time between two checkpoints."""

COUNTED = (
    "frames", "images_lost", "packets", "packets_lost_on_link", "telecommands", "telecommand_octets_lost", "resets",
)  # fmt: skip
"""Counters of the spacecraft."""

Say = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class RunTerms:
    """Terms of a run.

    Attributes
    ----------
    factor
        Simulated seconds per second that pass without waiting for the ground; 0: time waits.
    """

    days: float
    rate: float = 0.0
    windows_per_day: int = 2
    window_s: float = 720.0
    factor: float = 0.0
    disturbances: Disturbances = UNDISTURBED


def run_mission(scenario: Scenario, data: DataFolder, folder: Path, terms: RunTerms, say: Say) -> dict[str, Any]:
    """Run a mission in a folder, or go on with the one that is there; the closing figures.

    Raises
    ------
    ScenarioError
        The folder holds a run of another scenario or of other terms.
    GroundError, LinkError
        A part did not do what is expected of it; the run can be taken up again.
    """
    return MissionRun(prepared(scenario, terms), data, folder, terms, say).run()


def run_fleet(
    scenarios: Sequence[Scenario], data: DataFolder, folder: Path, terms: RunTerms, say: Say
) -> dict[str, Any]:
    """Run several spacecraft with one ground service; the closing figures of each by its name.

    One spacecraft at a time flies for at most `TURN_NS`, and the mission time of the service is that of its work. With
    a factor they fly at the same time.

    Raises
    ------
    ScenarioError
        Two spacecraft have the same name or number, or the folder is not empty.
    GroundError, LinkError
        A part did not do what is expected of it.
    """
    names, numbers = [one.spacecraft for one in scenarios], [one.spacecraft_id for one in scenarios]
    for key, values in (("spacecraft", names), ("spacecraft_id", numbers)):
        if len({str(one).casefold() for one in values}) < len(values):
            raise ScenarioError(f"fleet: expected scenarios with different {key}, found {values}")
    if folder.exists() and any(folder.iterdir()):
        raise ScenarioError(f"{folder}: expected a new folder for a fleet, found one with files")
    runs = [
        MissionRun(prepared(one, terms), data, folder / one.spacecraft, terms, say, is_of_fleet=True)
        for one in scenarios
    ]
    posts: list[tuple[int, int]] = []
    with ExitStack() as started:
        ground = EmbeddedGround.open(folder / "ground", data, runs[0].clock_file)
        started.callback(ground.close)
        flights = []
        for one in runs:
            spacecraft, dynamics = one.begin(posts)
            started.callback(spacecraft.stop)
            set_mission_clock(ClockFile(one.clock_file).read)
            flights.append(one.flight(spacecraft, ground, dynamics))
        if terms.factor:
            set_mission_clock(ClockFile(runs[0].clock_file).read)
            with ThreadPoolExecutor(len(flights)) as threads:
                list(threads.map(fly_whole, flights))
        else:
            _take_turns(runs, flights)
        figures = {name: one.close(ground) for name, one in zip(names, runs, strict=True)}
    (folder / REPORT).write_text(json.dumps({"fleet": figures}, indent=2) + "\n")
    return {"fleet": figures}


def _take_turns(runs: Sequence[MissionRun], flights: Sequence[Iterator[int]]) -> None:
    """Let the spacecraft whose time is the earliest fly, until all have ended."""
    due, clocks = [(0, k) for k in range(len(runs))], [ClockFile(one.clock_file) for one in runs]
    while due:
        _, k = due.pop(due.index(min(due)))
        set_mission_clock(clocks[k].read)
        utc_ns = next(flights[k], None)
        if utc_ns is not None:
            due.append((utc_ns, k))


def fly_whole(flight: Iterator[int]) -> None:
    """Let a flight go on to its end."""
    for _ in flight:
        pass


def prepared(scenario: Scenario, terms: RunTerms) -> Scenario:
    """Return the scenario of a run: with ground stations, and with the disturbances of the terms."""
    if not scenario.link.stations:
        scenario = replace(scenario, link=replace(scenario.link, stations=DEFAULT_STATIONS))
    return terms.disturbances.apply(scenario)


class MissionRun:
    """One run of a mission in a folder, by this process."""

    spacecraft_class = SpacecraftProcess
    keeps_archive = True
    """True if checkpoints contain the archive of the ground service."""

    def __init__(
        self, scenario: Scenario, data: DataFolder, folder: Path, terms: RunTerms, say: Say, is_of_fleet: bool = False
    ) -> None:
        self._is_of_fleet = is_of_fleet
        self._settle_ns: int | None = None
        self._scenario, self._data, self._folder, self._terms, self._say = scenario, data, folder, terms, say
        self._files = SpacecraftFiles(
            folder / "scenario.toml",
            folder / "clock",
            folder / "craters.csv",
            folder / "spacecraft.log",
            folder / "spacecraft.state",
            folder / "spacecraft.journal",
        )
        home = folder / "ground" if self.keeps_archive else None
        self._checkpoints = Checkpoints(folder, home, self._files.state)
        self._progress_file = folder / "progress.json"
        self._progress = Progress()
        self._begun_s = self._kept_s = time.monotonic()
        self._wall_before_s = 0.0

    @property
    def clock_file(self) -> Path:
        """File of the mission time."""
        return self._files.clock

    def begin(self, posts: list[tuple[int, int]]) -> tuple[SpacecraftProcess, FlightDynamics]:
        """Start the spacecraft of a fleet, whose posts are those of all; return it with its flight dynamics."""
        self._folder.mkdir(mode=0o700, parents=True)
        self._load()
        self._progress.posts = posts
        return self._started()

    def flight(self, spacecraft: SpacecraftProcess, ground: MissionGround, dynamics: FlightDynamics) -> Iterator[int]:
        """Post what a user posts; return the flight, which gives way at each yield, of its mission time."""
        self._post(spacecraft, ground, dynamics)
        follow = self._accompany if self._terms.factor else self._follow
        return follow(spacecraft, ground, dynamics)

    def run(self) -> dict[str, Any]:
        """Run until the days are over; after an interruption the next call continues from the last checkpoint."""
        self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        self._load()
        if self._progress.finished:
            self._say(f"{self._folder}: this run has ended; its figures are in {self._folder / REPORT}")
            return dict(json.loads((self._folder / REPORT).read_text()))
        spacecraft, dynamics = self._started()
        try:
            ground = self._open_ground()
            try:
                self._operate(spacecraft, ground, dynamics)
                return self.close(ground)
            finally:
                ground.close(is_finished=self._progress.finished)
        finally:
            spacecraft.stop()
            self._save()

    def _started(self) -> tuple[SpacecraftProcess, FlightDynamics]:
        world = open_world(self._scenario, self._data)
        dynamics = FlightDynamics(world, self._terms.disturbances.reference)
        if not self._files.craters.exists():
            count = dynamics.save_craters(self._terms.window_s, self._files.craters)
            self._say(f"catalogue: {count} craters with rim heights")
        self._progress.starts += 1
        spacecraft = self.spacecraft_class(
            self._files,
            self._scenario.link.stations,
            self._terms.days,
            self._terms.factor or self._terms.rate,
            self._data.root,
            holds=not self._terms.factor,
        )
        return spacecraft, dynamics

    def _open_ground(self) -> MissionGround:
        return EmbeddedGround.open(self._folder / "ground", self._data, self._files.clock)

    def _operate(self, spacecraft: SpacecraftProcess, ground: MissionGround, dynamics: FlightDynamics) -> None:
        flight = self.flight(spacecraft, ground, dynamics)
        self._save()
        fly_whole(flight)

    def _go(self, spacecraft: SpacecraftProcess, now: int) -> None:
        """Let time go on, to the time after a contact, or to the end of a turn of the fleet."""
        stops = [] if self._settle_ns is None else [self._settle_ns]
        if self._is_of_fleet:
            epoch = self._scenario.epoch_utc_ns
            stops.append(epoch + ((now - epoch) // TURN_NS + 1) * TURN_NS)
        spacecraft.order(f"until {format_utc(min(stops))}" if stops else "run")

    def _accompany(
        self, spacecraft: SpacecraftProcess, ground: MissionGround, dynamics: FlightDynamics
    ) -> Iterator[int]:
        """Watch the flight, whose time does not wait, until the end of the run."""
        messages = spacecraft.messages()
        spacecraft.order("run")
        for message in messages:
            if message["kind"] == "error":
                raise LinkError(f"spacecraft: {message['text']}")
            if message["kind"] not in ("contact", "finished"):
                continue
            self._note(message)
            if message["kind"] == "finished":
                self._wait_acknowledged(spacecraft, messages)
                ground.wait_ingested()
                ground.wait_settled()
                self._watch(ground, message)
                return
            if message["state"] == "started":
                self._deliver_reference(ground, dynamics, parse_utc(message["utc"]))
            else:
                self._watch(ground, message)
            yield parse_utc(message["utc"])
        raise LinkError(f"spacecraft: expected it to fly for {self._terms.days:g} days, found its end")

    def _follow(self, spacecraft: SpacecraftProcess, ground: MissionGround, dynamics: FlightDynamics) -> Iterator[int]:
        """Let time pass from contact to contact until the end of the run."""
        messages = spacecraft.messages()
        now = parse_utc(self._progress.utc) if self._progress.utc else self._scenario.epoch_utc_ns
        self._settle_ns = None
        self._go(spacecraft, now)
        for message in messages:
            kind = message["kind"]
            now = parse_utc(message["utc"]) if "utc" in message else now
            if kind == "contact":
                self._note(message)
                self._at_stop(message["state"], now)
                if message["state"] == "started":
                    self._deliver_reference(ground, dynamics, now)
                    # The links have begun the contact; they ingest its first frame with the next ones.
                    self._wait_acknowledged(spacecraft, messages)
                    ground.wait_idle()
                    ground.wait_sent(message["station"], self._scenario.spacecraft_id)
                else:
                    # The ground has everything before time goes on, so that a run gives the same at any speed.
                    self._wait_acknowledged(spacecraft, messages)
                    ground.wait_ingested()
                    self._settle_ns = now + SETTLE_NS
                self._go(spacecraft, now)
            elif kind == "paused" and (self._settle_ns is None or now < self._settle_ns):
                self._wait_acknowledged(spacecraft, messages)
                ground.wait_ingested()
                yield now
                self._go(spacecraft, now)
            elif kind == "paused":
                self._settle_ns = None
                spacecraft.order("state")
            elif kind in ("state", "finished"):
                self._note({**message, "state": kind})
                self._at_stop("settled", now)
                self._wait_acknowledged(spacecraft, messages)
                ground.wait_ingested()
                ground.wait_settled()
                if message["station"]:
                    ground.wait_sent(message["station"], self._scenario.spacecraft_id)
                self._watch(ground, message)
                if kind == "finished":
                    if not self._is_over():
                        continue
                    return
                if self._is_checkpoint_due():
                    spacecraft.order("save")
                else:
                    self._go(spacecraft, now)
            elif kind == "saved":
                if message["saved"]:
                    self._checkpoints.keep(self._progress_file)
                    self._kept_s = time.monotonic()
                self._go(spacecraft, now)
            elif kind == "error":
                raise LinkError(f"spacecraft: {message['text']}")
        raise LinkError(f"spacecraft: expected it to fly for {self._terms.days:g} days, found its end")

    @staticmethod
    def _wait_acknowledged(spacecraft: SpacecraftProcess, messages: Iterator[dict[str, Any]]) -> None:
        """Wait until the links have stored everything that the stations have received, whose time stands still."""
        until = time.monotonic() + SETTLE_S
        while True:
            spacecraft.order("state")
            left = int(_next_state(messages)["unacknowledged"])
            if not left:
                return
            if time.monotonic() >= until:
                raise LinkError(
                    f"stations: expected the acknowledgement of all telemetry within {SETTLE_S:.0f} s, "
                    f"found {left} octets without it"
                )
            time.sleep(POLL_S)

    def _is_checkpoint_due(self) -> bool:
        return time.monotonic() - self._kept_s >= CHECKPOINT_S and not self._is_of_fleet

    def _at_stop(self, phase: str, utc_ns: int) -> None:
        """Do what a campaign does at a stop of simulated time: "started", "ended" or "settled"."""

    def _is_over(self) -> bool:
        """Return whether the run ends with the flight; False if a campaign has killed the spacecraft at its end."""
        return True

    def _post(self, spacecraft: SpacecraftProcess, ground: MissionGround, dynamics: FlightDynamics) -> None:
        """Post what a user posts: catalogue, mission description, ephemeris, standing request.

        A later start posts the mission description only, which names the ports of the spacecraft.
        """
        before = ground.audit_head()
        ground.client.add_catalogue(self._files.craters)
        ground.add_mission(spacecraft.mission_text())
        if self._progress.request_id is None:
            self._deliver_reference(ground, dynamics, self._scenario.epoch_utc_ns)
            request = dynamics.request(self._terms.windows_per_day, self._terms.window_s, self._terms.days)
            self._progress.request_id = ground.client.add_request(request).id
        dynamics.world.terrain.close()
        self._progress.posts.append((before + 1, ground.audit_head()))

    def _deliver_reference(self, ground: MissionGround, dynamics: FlightDynamics, now: int) -> None:
        """Give the ground the orbit determination of the day."""
        day = (now - self._scenario.epoch_utc_ns) // DAY_NS
        if day > self._progress.reference_day and not dynamics.is_late(day):
            ground.deliver_reference(dynamics.save_reference(now, self._folder / "reference.oem"), day)
            self._progress.reference_day = day

    # What is seen

    def _note(self, message: dict[str, Any]) -> None:
        progress = self._progress
        progress.utc = message["utc"]
        progress.contacts += message["state"] == "started"
        for name in COUNTED:
            setattr(progress, name, message[name])

    def _watch(self, ground: MissionGround, message: dict[str, Any]) -> None:
        progress = self._progress
        days = (parse_utc(message["utc"]) - self._scenario.epoch_utc_ns) / DAY_NS
        plan = ground.read(lambda client: client.get_request_plan(progress.request_id or 0))
        note_plan(progress, plan, self._scenario.epoch_utc_ns)
        self._save()
        counts = Counter(one.state for one in ground.windows(self._scenario.spacecraft_id))
        states = ", ".join(f"{count} {state}" for state, count in sorted(counts.items()))
        self._say(
            f"{self._scenario.spacecraft}: day {days:6.2f} of {self._terms.days:g}, {progress.wall_s:6.0f} s: "
            f"{progress.contacts} contacts, {progress.frames} frames, {progress.packets} packets, "
            f"windows: {states or 'none'}"
        )

    def close(self, ground: MissionGround) -> dict[str, Any]:
        """Write the figures of the run, and the reports that the service makes of its months."""
        self._save()
        terms = self._terms
        asked = windows_asked(terms.days, terms.windows_per_day, LAST_NS / DAY_NS)
        figures = {
            "scenario": self._scenario.name,
            "spacecraft": self._scenario.spacecraft,
            "days": terms.days,
            **closing_figures(
                ground,
                self._progress,
                asked,
                terms.windows_per_day,
                self._scenario.epoch_utc_ns,
                self._scenario.spacecraft_id,
            ),
            "monthly_reports": [],
        }
        for month in months(one["start"] for one in figures["performance"]["passes"]):
            made = ground.client.add_monthly_report(self._scenario.spacecraft_id, month)
            path = self._folder / f"report-{month}.html"
            ground.client.get_monthly_report(made.id, path)
            figures["monthly_reports"].append(str(path))
        (self._folder / REPORT).write_text(json.dumps(figures, indent=2) + "\n")
        self._progress.finished = True
        return figures

    # State

    def _load(self) -> None:
        text, known_folder = format_scenario(self._scenario), self._files.scenario.exists()
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
        if not known_folder:
            return
        if self._progress_file.exists():
            self._progress = read_progress(self._progress_file)
        if self._progress.finished:
            return
        self._resume()
        self._say(f"{self._folder}: continues from {self._progress.utc or 'the start'}")

    def _resume(self) -> None:
        """Return to the last checkpoint."""
        # The archive goes back as well, and sends again what the spacecraft has not seen.
        self._files.journal.unlink(missing_ok=True)
        kept = self._checkpoints.restore()
        self._progress = Progress() if kept is None else read_progress(kept)
        self._wall_before_s = self._progress.wall_s

    def _save(self) -> None:
        self._progress.wall_s = round(self._wall_before_s + time.monotonic() - self._begun_s, 1)
        new_file = self._progress_file.with_name(self._progress_file.name + ".new")
        new_file.write_text(json.dumps(asdict(self._progress)))
        new_file.replace(self._progress_file)


def _next_state(messages: Iterator[dict[str, Any]]) -> dict[str, Any]:
    """Return the next message with the state of the spacecraft, whose time stands still."""
    message = next((one for one in messages if one["kind"] in ("state", "error")), None)
    if message is None:
        raise LinkError("spacecraft: expected its state, found its end")
    if message["kind"] == "error":
        raise LinkError(f"spacecraft: {message['text']}")
    return message


def read_progress(path: Path) -> Progress:
    """Return the progress of a run from its file."""
    try:
        stated = json.loads(path.read_text())
        posts = [(first, last) for first, last in stated["posts"]]
        return Progress(**{**stated, "posts": posts})
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ScenarioError(
            f"{path}: expected the progress of a run of this version of the program, found another file "
            f"({type(error).__name__}: {error}); start the run in a new folder"
        ) from None
