"""`linna mission write | check | add | list | show | run`: mission descriptions, and simulated missions."""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from linna.commands._table import Command, Commands, CustomCommand, as_json
from linna.data import data_folder
from linna.errors import UsageError
from linna.output import emit, finish, log, watched_rims
from linna.parser import ABOVE_ZERO, LinnaParser, number, option


def _configure_write(writing: LinnaParser) -> None:
    option(writing, "scenario SCENARIO", str, "scenario file or name", nargs="?")
    option(writing, "--xtce FILE", Path, "instead of a scenario: packets of another mission")
    option(writing, "--spacecraft-id N", int, "spacecraft of these packets", 0)
    option(writing, "--out FILE", Path, "", Path("mission.toml"))
    option(
        writing,
        "--flight",
        bool,
        "of a spacecraft that the ground commands, with craters.csv, reference.oem and request.json in the same folder",
    )
    option(writing, "--windows N", int, "windows a day of the request", 2)
    option(writing, "--window-min M", float, "duration of its windows", 12.0)
    finish(writing, write)


def _configure_check(checking: LinnaParser) -> None:
    option(checking, "file FILE", Path)
    option(
        checking,
        "--flight",
        bool,
        "dry run: plan request.json over reference.oem in the folder of the file, and release the telecommands",
    )
    finish(checking, check)


def _configure_run(running: LinnaParser) -> None:
    option(running, "scenario SCENARIO", str, "scenario file or name; several are a fleet", nargs="+")
    option(running, "--days D", ABOVE_ZERO, "simulated days", required=True)
    option(running, "--speed X|max", str, "simulated seconds per second", "max")
    option(running, "--observe-hours-a-day H", ABOVE_ZERO, "observation a day", 0.4)
    option(running, "--window-min M", number(least=1), "window (default: 12 min)", 12.0)
    option(
        running,
        "--real-time-factor F",
        number(least=0),
        "simulated seconds per second that do not wait for the ground, instead of --speed",
        0.0,
    )
    option(running, "--disturbances FILE", str, "faults of spacecraft, stations and flight dynamics")
    option(running, "--folder DIR", Path, "folder of the run (default: run-SCENARIO)")
    finish(running, run_mission)


def write(arguments: argparse.Namespace) -> int:
    from ground_service.missions.definitions import minimal_description
    from ground_service.missions.service import read_mission
    from payload_emulator.session.archive.mission import scenario_mission_text
    from payload_emulator.session.scenario import load_scenario

    if (arguments.scenario is None) == (arguments.xtce is None):
        raise UsageError("mission write: expected SCENARIO or --xtce FILE")
    scenario = load_scenario(arguments.scenario) if arguments.scenario else None
    if scenario is None:
        text = minimal_description(arguments.xtce, arguments.spacecraft_id)
    elif arguments.flight:
        from studies.mission_run.dynamics import write_flight

        window_s = 60.0 * arguments.window_min
        log("computing the orbit, measuring the rims of the craters around the windows ...")
        folder = data_folder()
        text = write_flight(scenario, folder, arguments.out, arguments.windows, window_s, watched=watched_rims)
    else:
        text = scenario_mission_text(scenario, data_folder())
    mission, _ = read_mission(text.encode(), str(arguments.out))
    arguments.out.write_text(text, encoding="utf-8")
    figures = {**_figures(mission), "file": str(arguments.out)}
    return emit(arguments, figures, text=f"{arguments.out}\n{_described(figures)}")


def check(arguments: argparse.Namespace) -> int:
    from ground_service.missions.service import check_mission_file

    mission, faults = check_mission_file(arguments.file)
    if mission is None:
        figures: dict[str, Any] = {"mission": None, "revision": None, "unknown": [], "remarks": [], "faults": faults}
        emit(arguments, figures, text="\n".join(faults))
        return 2
    figures = {**_figures(mission), "faults": []}
    lines = [_described(figures)]
    if arguments.flight:
        from ground_service.planning.dry_run import fly

        flown = fly(arguments.file, data_folder())
        figures |= {
            "faults": list(flown.faults),
            "windows": [
                {"start": str(one.start), "stop": str(one.stop), "telecommands": len(one.telecommands)}
                for one in flown.windows
            ],
        }
        lines += [
            f"window {one['start']} to {one['stop']}: {one['telecommands']} telecommands" for one in figures["windows"]
        ]
        lines += flown.faults
    emit(arguments, figures, text="\n".join(lines))
    return 2 if figures["faults"] else 0


def _figures(mission: Any) -> dict[str, Any]:
    from ground_service.missions.definitions import definition_remarks

    return {
        "mission": mission.name,
        "revision": mission.revision,
        "stated": mission.words,
        "unknown": list(mission.unknown),
        "remarks": definition_remarks(mission),
    }


def _described(figures: Mapping[str, Any]) -> str:
    unknown = figures["unknown"]
    lines = [
        f"mission {figures['mission']}, revision {figures['revision'][:16]}",
        *figures.get("stated", "").splitlines(),
    ]
    if unknown:
        lines.append(f"not stated ({len(unknown)}): {', '.join(unknown)}")
    return "\n".join([*lines, *figures.get("remarks", ())])


def run_mission(arguments: argparse.Namespace) -> int:
    from payload_emulator.session.scenario import load_scenario
    from studies.mission_run import run
    from studies.mission_run.disturbances import UNDISTURBED, load_disturbances

    try:
        rate = 0.0 if arguments.speed == "max" else float(arguments.speed)
    except ValueError:
        rate = -1.0
    if rate < 0.0 or (rate == 0.0 and arguments.speed != "max"):
        raise UsageError(f"--speed: expected a number above 0 or max, found {arguments.speed!r}")
    factor = arguments.real_time_factor
    if factor and rate:
        raise UsageError("--real-time-factor: expected no --speed with it, found one")
    disturbances = UNDISTURBED
    if arguments.disturbances is not None:
        disturbances = load_disturbances(arguments.disturbances)
    scenarios = [load_scenario(one) for one in arguments.scenario]
    terms = run.RunTerms(
        arguments.days,
        rate,
        max(1, round(60.0 * arguments.observe_hours_a_day / arguments.window_min)),
        60.0 * arguments.window_min,
        factor,
        disturbances,
    )
    folder = arguments.folder or Path(f"run-{'-'.join(one.name for one in scenarios)}")
    if len(scenarios) > 1:
        fleet = run.run_fleet(scenarios, data_folder(), folder, terms, log)
        found = list(fleet["fleet"].values())
        emit(arguments, fleet, text="\n".join(_closing_text(one, folder) for one in found))
        return 0 if all(map(went_well, found)) else 1
    figures = run.run_mission(scenarios[0], data_folder(), folder, terms, log)
    emit(arguments, figures, text=_closing_text(figures, folder))
    return 0 if went_well(figures) else 1


def _closing_text(figures: Mapping[str, Any], folder: Path) -> str:
    windows, missing = figures["windows"], figures["missing_windows"]
    return (
        f"{figures['spacecraft']}, {figures['days']:g} days in {figures['wall_s']:.0f} s: "
        f"{windows['requested']} windows requested, {windows['flown']} flown, {windows['processed']} processed, "
        f"{windows['failed']} failed; {figures['packets_lost']} packets lost, {figures['reports']} reports, "
        f"{figures['alerts']} alerts, {figures['interventions']} interventions\n"
        + "\n".join(
            [f"day {one['day']}: {one['missing']} windows missing: {one['reason']}" for one in missing]
            + [*figures["monthly_reports"], str(folder / "report.json")]
        )
    )


def went_well(figures: Mapping[str, Any]) -> bool:
    """Return whether each window flown is processed, each missing one explained, and no packet lost."""
    from studies.mission_run.figures import UNKNOWN

    windows = figures["windows"]
    explained = all(one["reason"] != UNKNOWN for one in figures["missing_windows"])
    return explained and windows["processed"] == windows["flown"] and not figures["packets_lost"]


MISSION: Commands = {
    "write": CustomCommand("write the mission description of a scenario", _configure_write),
    "check": CustomCommand("check a mission description; print one line for each fault", _configure_check),
    "add": Command("add_mission", "add a mission description as a revision", lambda made: _described(as_json(made))),
    "list": Command(
        "list_missions",
        "list the revisions, newest first",
        lambda one: f"{one.revision[:16]}  {str(one.entered)[:19]}Z  {one.mission}  ({len(one.unknown)} not stated)",
        "missions",
        "no mission descriptions",
    ),
    "show": Command(
        "get_mission",
        "show a revision",
        lambda found: f"{_described(as_json(found))}\n\n{found.text.rstrip()}",
        options={"revision": "the hash or its first eight digits"},
    ),
    "run": CustomCommand("run payload, stations, ground service and automation for days", _configure_run),
}
