"""Campaign of a simulated mission on a distributed service whose processes are killed.

    python -m benchmarks.campaigns.mission_kills selenita --days 3 --kill 7 [--kills N]

The service runs as separate processes on PostgreSQL and Redis. Processes and the spacecraft are killed (SIGKILL) at
random points of the seed and started again; a run that was stopped continues with the same command. The figures are
those of `linna mission run`, and `kills`. The exit status is 1 if a window was not processed or a packet was lost.
"""

import argparse
import json
import sys
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from benchmarks.campaigns._distributed import DistributedGround
from benchmarks.campaigns._kills import SPACECRAFT, Keeper, plan_kills
from linna.commands.mission import went_well
from linna.data import data_folder
from linna.output import log
from lunar.constants import DAY_NS
from lunar.datafolder import DataFolder
from payload_emulator.errors import LinkError
from payload_emulator.session.scenario import Scenario, load_scenario
from studies.mission_run.dynamics import FlightDynamics
from studies.mission_run.figures import Progress
from studies.mission_run.ground import MissionGround
from studies.mission_run.run import REPORT, MissionRun, RunTerms, Say, fly_whole, prepared, read_progress
from studies.mission_run.spacecraft import SpacecraftProcess


@dataclass(frozen=True, slots=True)
class KillTerms(RunTerms):
    """Terms of a run with `kills` kills of processes at points of `kill_seed`."""

    kill_seed: int = 0
    kills: int = 0


class SpacecraftKilled(LinkError):
    """The process of the spacecraft was killed; it can be started again from its last exact state."""


class KillableSpacecraft(SpacecraftProcess):
    """Spacecraft that another thread can kill."""

    def __init__(self, *given: Any, **options: Any) -> None:
        self._lock = threading.Lock()  # a killed process has ended before the next one starts
        super().__init__(*given, **options)

    def restart(self) -> None:
        with self._lock:
            self.was_killed = False
            super().restart()

    def kill(self) -> None:
        """Kill the process (SIGKILL)."""
        with self._lock:
            self.was_killed = True
            self._part.kill()

    def check_killed(self) -> None:
        """Raise `SpacecraftKilled` if `kill` was called since the last start."""
        if self.was_killed:
            raise SpacecraftKilled("spacecraft: its process was killed")

    def messages(self) -> Iterator[dict[str, Any]]:
        try:
            yield from super().messages()
        except LinkError:
            self.check_killed()
            raise
        self.check_killed()

    def order(self, word: str) -> None:
        try:
            super().order(word)
        except LinkError:
            self.check_killed()
            raise


class KilledRun(MissionRun):
    """Run of a mission on a distributed service; the archive stays as it is when the spacecraft goes back."""

    spacecraft_class = KillableSpacecraft
    keeps_archive = False
    _terms: KillTerms

    def _open_ground(self) -> MissionGround:
        return DistributedGround(self._folder, self._data, self._files.clock)

    def _operate(self, spacecraft: SpacecraftProcess, ground: MissionGround, dynamics: FlightDynamics) -> None:
        assert isinstance(spacecraft, KillableSpacecraft) and isinstance(ground, DistributedGround)
        self._keeper = self._made_keeper(spacecraft, ground)
        flight = self.flight(spacecraft, ground, dynamics)
        self._save()
        self._keeper.start()
        # A killed spacecraft takes the stations with it: what the ground waits for may need them.
        ground.while_waiting = spacecraft.check_killed
        try:
            while True:
                try:
                    return fly_whole(flight)
                except SpacecraftKilled:
                    self._go_back()
                    spacecraft.restart()
                    self._keeper.recovered()
                    flight = self._follow(spacecraft, ground, dynamics)
        finally:
            ground.while_waiting = lambda: None
            self._keeper.stop()

    def _made_keeper(self, spacecraft: KillableSpacecraft, ground: DistributedGround) -> Keeper:
        terms, epoch = self._terms, self._scenario.epoch_utc_ns
        stop = epoch + round(terms.days * DAY_NS)
        planned = plan_kills(terms.kill_seed, (*ground.parts, SPACECRAFT), epoch, stop, terms.kills)
        file = self._folder / "kills.json"
        return Keeper(ground.parts, planned, spacecraft.kill, ground.note_processes, file, self._say)

    def _at_stop(self, phase: str, utc_ns: int) -> None:
        self._keeper.at_stop(phase, utc_ns)

    def _is_over(self) -> bool:
        return self._keeper.wait()

    def _is_checkpoint_due(self) -> bool:
        return self._terms.kills > 0 or super()._is_checkpoint_due()

    def _go_back(self) -> None:
        """Return to the last exact state of the spacecraft; the ground keeps what it has."""
        known, kept = self._progress, self._checkpoints.restore()
        before = Progress() if kept is None else read_progress(kept)
        self._progress = replace(
            before, starts=known.starts, posts=known.posts, request_id=known.request_id,
            reference_day=known.reference_day,
        )  # fmt: skip

    def _resume(self) -> None:
        self._wall_before_s = self._progress.wall_s
        self._go_back()

    def close(self, ground: MissionGround) -> dict[str, Any]:
        figures = super().close(ground)
        figures["kills"] = {"seed": self._terms.kill_seed, **self._keeper.figures()}
        (self._folder / REPORT).write_text(json.dumps(figures, indent=2) + "\n")
        return figures


def run_killed(scenario: Scenario, data: DataFolder, folder: Path, terms: KillTerms, say: Say) -> dict[str, Any]:
    """Run a mission with kills in a folder, or continue the run that is there; return the closing figures."""
    return KilledRun(prepared(scenario, terms), data, folder, terms, say).run()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the campaign; return 1 if a window was not processed or a packet was lost."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.campaigns.mission_kills", description=__doc__)
    parser.add_argument("scenario")
    parser.add_argument("--days", type=float, required=True)
    parser.add_argument("--windows-per-day", type=int, default=2)
    parser.add_argument("--window-min", type=float, default=12.0)
    parser.add_argument("--kill", type=int, default=0, metavar="SEED")
    parser.add_argument("--kills", type=int, metavar="N", help="default: 4 a day")
    parser.add_argument("--folder", type=Path)
    given = parser.parse_args(arguments)
    scenario = load_scenario(given.scenario)
    kills = max(round(4 * given.days), 1) if given.kills is None else given.kills
    terms = KillTerms(
        given.days, 0.0, given.windows_per_day, 60.0 * given.window_min, kill_seed=given.kill, kills=kills
    )
    folder = given.folder or Path(f"run-{scenario.name}")
    figures = run_killed(scenario, data_folder(), folder, terms, log)
    print(json.dumps(figures["kills"], indent=2))
    return 0 if went_well(figures) else 1


if __name__ == "__main__":
    sys.exit(main())
