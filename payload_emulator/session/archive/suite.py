"""Small archived passes for regression tests of payload builds, emulated from the scenarios of a suite."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from lunar.datafolder import DataFolder
from payload_emulator.errors import ScenarioError
from payload_emulator.session.archive.emulator import Progress, emulate
from payload_emulator.session.scenario import SHIPPED, Scenario, load_scenario

SUITE = SHIPPED / "suite"


@dataclass(frozen=True, slots=True)
class SuitePass:
    """A pass of a suite as it was written."""

    folder: Path
    scenario: str
    frames: int
    altitude_km: tuple[float, float]


def suite_scenarios(given: Sequence[str] = (), *, frames: int | None = None, seeds: int = 1) -> list[Scenario]:
    """Load the scenarios of a suite: those shipped, or those given, each with a number of seeds.

    Parameters
    ----------
    given
        Names of shipped passes ("low"), or scenario files.
    frames
        Length of each pass; None keeps the scenario's own.
    seeds
        The scenario's own seed and those that follow it: another Moon where it is procedural, other light, other noise.
    """
    shipped = {path.stem: path for path in sorted(SUITE.glob("*.toml"))}
    if frames is not None and frames < 1:
        raise ScenarioError(f"suite: expected at least one frame a pass, found {frames}")
    scenarios = []
    for path in [shipped.get(name, name) for name in given] or shipped.values():
        scenario = load_scenario(path)
        if frames is not None:
            duration_s = frames * scenario.camera.frame_interval_s
            scenario = replace(scenario, window=replace(scenario.window, duration_s=duration_s))
        scenarios += [
            replace(scenario, seed=scenario.seed + number, name=scenario.name + f"-{number}" * (number > 0))
            for number in range(seeds)
        ]
    return scenarios


def write_suite(
    scenarios: Sequence[Scenario], data: DataFolder, out: Path, *, progress: Progress | None = None
) -> list[SuitePass]:
    """Emulate every scenario into a separate archive with all frames; existing archives are not changed."""
    written = []
    for scenario in scenarios:
        folder = out / scenario.name
        if not (folder / "manifest.json").is_file():
            emulate(scenario, data, folder, frames_kept=None, progress=progress)
        written.append(_described(folder, scenario))
    return written


def _described(folder: Path, scenario: Scenario) -> SuitePass:
    summary = json.loads((folder / "summary.json").read_text())
    altitude = summary["altitude_km"]
    return SuitePass(folder, scenario.name, int(summary["frames"]), (altitude["min"], altitude["max"]))
