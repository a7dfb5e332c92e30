"""`linna emulate | replay`: the payload over a scenario, and a payload build over an archived pass."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from linna.data import data_folder
from linna.errors import UsageError
from linna.output import emit, finish, log, progress
from linna.parser import ABOVE_ZERO, number, option

if TYPE_CHECKING:
    from payload_emulator.session.scenario import Scenario
    from payload_emulator.session.world.external import ExternalFrames


def configure_emulate(parser: argparse.ArgumentParser) -> None:
    option(
        parser,
        "scenario",
        str,
        "scenario file, or the name of a shipped one (default with --images: scenario.toml of that folder)",
        nargs="?",
    )
    option(parser, "--out DIR", Path, "folder of the pass archive to write")
    option(
        parser,
        "--mode",
        ("paper", "spherical", "anchored"),
        "estimator to run (may be repeated); default: those of the scenario",
        action="append",
    )
    option(parser, "--seed", int, "another seed than the scenario's")
    option(
        parser,
        "--anchoring-catalogue F",
        Path,
        "table of `linna catalogue curate`, uploaded in place of the terrain's craters",
    )
    option(parser, "--frames", ("none", "some", "all"), "images kept in the archive (default: eight of them)", "some")
    option(
        parser,
        "--images DIR",
        Path,
        "frames that others took instead of rendered ones: frames.csv (file, utc), images, an OEM, an AEM",
    )
    option(
        parser,
        "--evidence",
        ("photographs", "other-renderer"),
        "what the images of --images are (default: not stated)",
        "",
    )
    option(parser, "--check", bool, "fly nothing: print what would be flown; exit status 2 with a fault")
    _add_live(parser)
    finish(parser, run_emulate)


def _add_live(parser: argparse.ArgumentParser) -> None:
    live = parser.add_argument_group("live", "the spacecraft as a process to watch and to command over TCP")
    add = live.add_argument
    add("--live", action="store_true", help="fly live instead of writing an archive")
    add("--no-operator", action="store_true", help="the ground commands, from the epoch of the scenario on")
    add(
        "--rate",
        type=number(least=0),
        default=1.0,
        help="simulated seconds a second, 0: as fast as possible (default: 1)",
    )
    add("--paused", action="store_true", help="wait for run or step on the console")
    add("--stop-at-end", action="store_true", help="end with the windows of the scenario")
    add("--days", type=ABOVE_ZERO, metavar="D", help="end after so many days (default: never)")
    add("--host", default="127.0.0.1", help="address to listen on (default: %(default)s)")
    add("--port", type=int, default=10015, help="telemetry of the first station (default: %(default)s)")
    add("--tc-port", type=int, default=10025, help="its telecommands, CLTUs or packets (default: %(default)s)")
    add(
        "--station-port",
        action="append",
        default=[],
        metavar="NAME:TM:TC",
        help="ports of a station (default: those after the ports of the station before)",
    )
    words = "run|pause|step|state|watch|save|until UTC|rate X|quit"
    add("--console-port", type=int, default=10035, help=f"JSON lines out, {words} in (default: %(default)s)")
    add("--mission-port", type=int, default=10045, help="mission description (default: %(default)s)")
    add("--craters", type=Path, metavar="FILE", help="craters on board from launch; made if there is no file")
    add("--operations", type=Path, metavar="FILE", help="TOML in place of the automation and approval of the mission")
    add("--hold-contacts", action="store_true", help="stop time at the start and the end of contacts until run")
    add("--keep-unacknowledged", action="store_true", help="stations keep telemetry until it is acknowledged")
    add("--end-with-console", action="store_true", help="end when the last connection of the console ends")
    add(
        "--state",
        type=Path,
        metavar="FILE",
        help="exact state, written after contacts, on save on the console and at the end; a start goes on from it",
    )
    add(
        "--journal",
        type=Path,
        metavar="FILE",
        help="transmissions that stations have confirmed; a start from --state repeats those after it",
    )
    add("--clock-file", type=Path, metavar="FILE", help="file for the mission time")


def run_emulate(arguments: argparse.Namespace) -> int:
    from payload_emulator.session.archive.emulator import emulate
    from payload_emulator.session.scenario import load_scenario
    from payload_emulator.session.world.external import SCENARIO, load_external

    if arguments.scenario is None and arguments.images is None:
        raise UsageError("emulate: expected a scenario or --images DIR, found none")
    if arguments.evidence and arguments.images is None:
        raise UsageError("--evidence: expected together with --images DIR, found alone")
    if arguments.images is not None and arguments.live:
        raise UsageError("--images: expected together with --out DIR alone")
    chosen = arguments.images / SCENARIO if arguments.scenario is None else arguments.scenario
    scenario = load_scenario(chosen).with_choices(
        modes=arguments.mode, seed=arguments.seed, anchoring_catalogue=arguments.anchoring_catalogue
    )
    if arguments.check:
        external = None if arguments.images is None else load_external(arguments.images, scenario)
        return _check_scenario(arguments, scenario, external)
    if arguments.live:
        return _live(arguments, scenario)
    if arguments.out is None:
        raise UsageError("emulate: expected --out DIR or --live, found neither")
    kept = {"none": 0, "some": 8, "all": None}[arguments.frames]
    external = None if arguments.images is None else load_external(arguments.images, scenario, arguments.evidence)
    summary = emulate(
        scenario,
        data_folder(),
        arguments.out,
        frames_kept=kept,
        external=external,
        progress=lambda frames, total: progress(frames, total, "frames", "frame"),
    )
    return emit(arguments, summary, text=describe(summary, arguments.out))


def _check_scenario(arguments: argparse.Namespace, scenario: Scenario, external: ExternalFrames | None) -> int:
    from ground_service.missions.model import parse_mission
    from lunar.timescales import format_utc
    from payload_emulator.session.archive.emulator import checked_world
    from payload_emulator.session.archive.mission import mission_text

    data = data_folder()
    world = checked_world(scenario, data, external)
    mission = parse_mission(mission_text(world, data), scenario.name)
    times = world.frame_utc_ns
    figures = {
        "scenario": scenario.name,
        "frames": len(times),
        "start_utc": format_utc(int(times[0]), 0),
        "stop_utc": format_utc(int(times[-1]), 0),
        "estimators": list(scenario.navigation.estimators),
        "stations": list(scenario.link.stations),
        "unknown": list(mission.unknown),
        "ends": world.ends,
        "data": list(world.data_names),
        "stated": scenario.words,
        "registration": "" if world.terrain.registration is None else world.terrain.registration.words,
    }
    return emit(
        arguments,
        figures,
        text=f"{scenario.name}: {len(times)} frames, {figures['start_utc']} to {figures['stop_utc']}, estimators "
        f"{', '.join(scenario.navigation.estimators)}\n{f'{world.ends}{chr(10)}' if world.ends else ''}"
        f"data: {'; '.join(world.data_names)}\nstated: {scenario.words}"
        + (f"\nregistration: {figures['registration']}" if figures["registration"] else ""),
    )


def _live(arguments: argparse.Namespace, scenario: Scenario) -> int:
    import signal
    from dataclasses import asdict

    from lunar.timescales import format_utc
    from payload_emulator.session.archive.mission import OPERATIONS, default_ports, live_mission_text
    from payload_emulator.session.live.contacts import station_names
    from payload_emulator.session.live.session import LiveSession
    from payload_emulator.session.spacecraft.loading import launch, load_scenario_payload
    from payload_emulator.session.world.world import build_world

    data, operated = data_folder(), not arguments.no_operator
    if operated:
        world = build_world(scenario, data)
        loaded, _, _ = load_scenario_payload(world, data)
    else:
        world, loaded = launch(scenario, data, arguments.craters)
    names = station_names(scenario, operated)
    ports = default_ports(names, arguments.port, arguments.tc_port)
    operations = None if operated else OPERATIONS
    if arguments.operations is not None:
        operations = arguments.operations.read_text(encoding="utf-8")
    days = arguments.days
    session = LiveSession(
        world,
        loaded,
        has_operator=operated,
        rate=arguments.rate,
        holds=arguments.hold_contacts,
        stop_utc_ns=None if days is None else scenario.epoch_utc_ns + round(days * 86_400e9),
        ends_with_scenario=arguments.stop_at_end,
        paused=arguments.paused,
        host=arguments.host,
        console_port=arguments.console_port,
        mission_port=arguments.mission_port,
        station_ports=ports | _station_ports(arguments.station_port, names),
        state_file=arguments.state,
        journal_file=arguments.journal,
        clock_file=arguments.clock_file,
        keeps=arguments.keep_unacknowledged,
        ends_with_console=arguments.end_with_console,
        mission=lambda world, used: live_mission_text(
            world, data, arguments.host, used, operations, arguments.keep_unacknowledged, arguments.craters
        ),
    )
    for ending in (signal.SIGINT, signal.SIGTERM):
        signal.signal(ending, lambda *_: session.stopping.set())
    log(", ".join(f"{name} on {arguments.host}:{port}" for name, port in session.ports.items()))
    session.run()
    account = asdict(session.account)
    figures = {"ports": session.ports, "utc": format_utc(session.utc_ns, 0), **account}
    counted = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in account.items())
    return emit(arguments, figures, text=f"stopped at {figures['utc']}; {counted}")


def _station_ports(texts: list[str], stations: tuple[str, ...]) -> dict[str, tuple[int, int]]:

    ports = {}
    for text in texts:
        name, *numbers = text.split(":")
        if name not in stations or len(numbers) != 2 or not all(one.isdigit() for one in numbers):
            raise UsageError(
                f"--station-port: expected NAME:TM:TC with a station of {', '.join(stations)}, found {text!r}"
            )
        ports[name] = (int(numbers[0]), int(numbers[1]))
    return ports


def describe(summary: dict[str, Any], out: Path) -> str:
    """A few lines about an emulated window, for people."""
    altitude, link = summary["altitude_km"], summary["link"]
    return "\n".join(
        [
            f"{summary['frames']} frames, {summary['start_utc']} to {summary['stop_utc']}, altitude "
            f"{altitude['min']:.1f} to {altitude['max']:.1f} km",
            f"{summary['packets']} packets, {summary['downlink_octets']} octets of downlink",
            f"link: {link['frames_sent']} frames sent, {link['frames_lost_on_link']} lost, "
            f"{link['frames_bad']} came beyond repair; of {link['packets_made']} packets "
            f"{link['packets_lost']} lost, {link['duplicates']} came again",
            outcomes_line(summary),
            *(f"warning: {text}" for text in summary["warnings"]),
            f"data: {'; '.join(summary['data'])}",
            f"archive: {out}",
        ]
    )


def outcomes_line(summary: dict[str, Any]) -> str:
    """Count the outcomes of frames, with the reasons of those without a usable image."""
    outcomes, reasons = (
        ", ".join(f"{name} {count}" for name, count in summary[key].items() if count)
        for key in ("outcomes", "no_image_reasons")
    )
    return f"outcomes: {outcomes}" + (f"; no image: {reasons}" if reasons else "")


def configure_replay(parser: argparse.ArgumentParser) -> None:
    option(parser, "archive", Path, "pass archive: a folder or a zip file", nargs="?")
    option(parser, "--build", str, "build file (TOML), or 'current': this flight code and its network", "current")
    option(parser, "--out DIR", Path, "output folder for downlink and summary")
    option(parser, "--check-build BUILD", Path, "only check a build file, and its parameters against this flight code")
    option(
        parser,
        "--complete",
        bool,
        "fly nothing; write to --out a copy of the archive with all its frames, rendered from its scenario",
    )
    option(
        parser,
        "--recorded-only",
        bool,
        "refuse an archive that lacks frames instead of rendering them from its scenario",
    )
    finish(parser, run_replay)


def run_replay(arguments: argparse.Namespace) -> int:
    if arguments.check_build is not None:
        return _check_build(arguments)
    if arguments.archive is None or arguments.out is None:
        lacking = "ARCHIVE" if arguments.archive is None else "--out DIR"
        raise UsageError(f"replay: expected {lacking}, or --check-build BUILD, found neither")
    if arguments.archive.is_dir():
        return _fly(arguments, arguments.archive)
    from ground_service.regression.archives import opened_archive

    with opened_archive(arguments.archive) as archive:
        return _fly(arguments, archive)


def _fly(arguments: argparse.Namespace, archive: Path) -> int:
    if arguments.complete:
        return _complete(arguments, archive)
    from payload_emulator.session.archive.replay import FlightBuild, load_flight_build, names_command, replay_archive

    current = arguments.build == "current"
    if not current and names_command(Path(arguments.build)):
        return _run_command(arguments, archive)
    flight = FlightBuild() if current else load_flight_build(Path(arguments.build))
    data = None
    if not arguments.recorded_only:
        data = data_folder()
    summary = replay_archive(archive, flight, arguments.out, data=data, progress=_bar)
    return emit(arguments, summary, text=_describe(summary, arguments.out))


def _check_build(arguments: argparse.Namespace) -> int:
    from ground_service.errors import InvalidInput
    from ground_service.regression.builds import load_build
    from payload_emulator.errors import ParameterError
    from payload_emulator.session.archive.replay import check_parameters

    fault: InvalidInput | ParameterError
    try:
        load_build(arguments.check_build)
        check_parameters(arguments.check_build)
    except InvalidInput as error:
        fault, place = error, (error.what, error.where)
    except ParameterError as error:
        fault, place = error, (error.file, error.key)
    else:
        return emit(arguments, {"fault": None}, text=f"{arguments.check_build}: the build is valid")
    names = ("file", "key", "expected", "found")
    figures = {"fault": dict(zip(names, (*place, fault.expected, fault.found), strict=True))}
    emit(arguments, figures, text=str(fault))
    return 2


def _complete(arguments: argparse.Namespace, archive: Path) -> int:
    from payload_emulator.session.archive.replay import complete_archive

    manifest = complete_archive(archive, arguments.out, data_folder(), progress=_bar)
    frames = sum(name.startswith("frames/") for name in manifest["files"])
    return emit(
        arguments, {"archive": str(arguments.out), "frames": frames}, text=f"{frames} frames, archive: {arguments.out}"
    )


def _run_command(arguments: argparse.Namespace, archive: Path) -> int:
    from ground_service.regression.build_runs import run_build
    from ground_service.regression.builds import load_build
    from ground_service.settings import load_settings

    runner = load_settings().runner_exchange
    summary = run_build(load_build(arguments.build), archive, arguments.out, runner=runner).summary()
    emit(arguments, summary, text=summary["text"])
    return 0 if summary["outcome"] == "ok" else 1


def _bar(items: Iterable[Any], total: int) -> Any:
    return progress(items, total, "frames", "frame")


def _describe(summary: dict[str, Any], out: Path) -> str:
    return "\n".join(
        [
            f"{summary['frames']} frames flown again, {summary['packets']} packets, "
            f"{summary['downlink_octets']} octets of downlink",
            outcomes_line(summary),
            f"CPU time: {summary['cpu_ms_per_frame']:.1f} ms per frame",
            f"downlink: {out / 'downlink.cadu'}",
        ]
    )
