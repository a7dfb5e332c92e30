"""`linna emulate`: run the payload over a scenario and write a pass archive."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from linna.output import add_json_flag, emit, log, progress

if TYPE_CHECKING:
    from payload_emulator.session.scenario import Scenario


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "scenario",
        nargs="?",
        help="scenario file, or the name of a shipped one (default with --images: scenario.toml of that folder)",
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder of the pass archive to write")
    parser.add_argument(
        "--mode",
        action="append",
        choices=("paper", "spherical", "anchored"),
        help="estimator to run (may be repeated); default: those of the scenario",
    )
    parser.add_argument("--seed", type=int, help="another seed than the scenario's")
    parser.add_argument(
        "--anchoring-catalogue",
        type=Path,
        metavar="F",
        help="table of `linna catalogue curate`, uploaded in place of the terrain's craters",
    )
    parser.add_argument(
        "--frames",
        choices=("none", "some", "all"),
        default="some",
        help="images kept in the archive (default: eight of them)",
    )
    parser.add_argument(
        "--images",
        type=Path,
        metavar="DIR",
        help="frames that others took instead of rendered ones: frames.csv (file, utc), images, an OEM, an AEM",
    )
    parser.add_argument(
        "--evidence",
        choices=("photographs", "other-renderer"),
        default="",
        help="what the images of --images are (default: not stated)",
    )
    _add_live(parser)
    _add_continuous(parser)
    parser.add_argument(
        "--campaign", metavar="FILE", help="fly the fault campaign of a file, or a shipped one by name"
    )
    add_json_flag(parser)
    parser.set_defaults(handler=run)


def _add_live(parser: argparse.ArgumentParser) -> None:
    live = parser.add_argument_group("live", "the payload as a process to watch and to command over TCP")
    live.add_argument("--live", action="store_true", help="fly live instead of writing an archive")
    live.add_argument("--host", default="127.0.0.1", help="address to listen on (default: %(default)s)")
    live.add_argument("--port", type=int, default=10015, help="telemetry, CADUs (default: %(default)s)")
    live.add_argument(
        "--tc-port", type=int, default=10025, help="telecommands, CLTUs or packets (default: %(default)s)"
    )
    live.add_argument(
        "--console-port",
        type=int,
        default=10035,
        help="snapshots as JSON lines out, pause|run|step|rate X|quit in (default: %(default)s)",
    )
    live.add_argument(
        "--mission-port",
        type=int,
        default=10045,
        help="mission description, sent to each client (default: %(default)s)",
    )
    live.add_argument(
        "--rate",
        type=float,
        default=1.0,
        help="simulated seconds a second, 0: as quick as it goes (default: 1)",
    )
    live.add_argument("--paused", action="store_true", help="wait for run or step on the console")
    live.add_argument(
        "--no-operator",
        action="store_true",
        help="the ground commands: the scenario's own operator is silent",
    )
    live.add_argument("--stop-at-end", action="store_true", help="end with the scenario")


def _add_continuous(parser: argparse.ArgumentParser) -> None:
    endless = parser.add_argument_group(
        "continuous",
        "the spacecraft in operation: images in commanded windows alone, contacts of the stations",
    )
    endless.add_argument(
        "--continuous", action="store_true", help="fly from the scenario's epoch on, whatever its windows"
    )
    endless.add_argument("--days", type=float, metavar="D", help="end after so many days (default: never)")
    endless.add_argument(
        "--station-port",
        action="append",
        default=[],
        metavar="NAME:TM:TC",
        help="telemetry and telecommand port of a station (default: any free ports)",
    )
    endless.add_argument(
        "--hold-contacts",
        action="store_true",
        help="stop time at the beginning and the end of each contact until run on the console",
    )
    endless.add_argument(
        "--keep-unacknowledged",
        action="store_true",
        help="stations keep telemetry until the client acknowledges it",
    )
    endless.add_argument(
        "--end-with-console", action="store_true", help="end when the last connection of the console ends"
    )
    endless.add_argument(
        "--state",
        type=Path,
        metavar="FILE",
        help="exact state, written after contacts, on save on the console and at the end; a start goes on from it",
    )
    endless.add_argument(
        "--journal",
        type=Path,
        metavar="FILE",
        help="transmissions that stations have confirmed; a start from --state repeats those after it",
    )
    endless.add_argument("--clock-file", type=Path, metavar="FILE", help="file for the mission time")
    endless.add_argument(
        "--craters", type=Path, metavar="FILE", help="crater catalogue with rim heights, on board from launch"
    )
    endless.add_argument(
        "--operations", type=Path, metavar="FILE", help="TOML appended to the mission description"
    )


def run(arguments: argparse.Namespace) -> int:
    from linna.data import data_folder
    from linna.errors import UsageError
    from payload_emulator.session.emulator import emulate
    from payload_emulator.session.external import SCENARIO, load_external
    from payload_emulator.session.scenario import load_scenario

    if arguments.scenario is None and arguments.images is None:
        raise UsageError("emulate: expected a scenario or --images DIR, found none")
    if arguments.evidence and arguments.images is None:
        raise UsageError("--evidence: expected together with --images DIR, found alone")
    if arguments.images is not None and (arguments.live or arguments.continuous or arguments.campaign):
        raise UsageError("--images: expected together with --out DIR alone")
    chosen = arguments.images / SCENARIO if arguments.scenario is None else arguments.scenario
    scenario = load_scenario(chosen).with_choices(
        modes=arguments.mode, seed=arguments.seed, anchoring_catalogue=arguments.anchoring_catalogue
    )
    if arguments.campaign:
        return _campaign(arguments, scenario)
    if arguments.continuous:
        return _continuous(arguments, scenario)
    if arguments.live:
        return _live(arguments, scenario)
    if arguments.out is None:
        raise UsageError("emulate: expected --out DIR, --live, --continuous or --campaign FILE, found none")
    kept = {"none": 0, "some": 8, "all": None}[arguments.frames]
    external = (
        None if arguments.images is None else load_external(arguments.images, scenario, arguments.evidence)
    )
    summary = emulate(
        scenario,
        data_folder(),
        arguments.out,
        frames_kept=kept,
        external=external,
        progress=lambda frames, total: progress(frames, total, "frames", "frame"),
    )
    emit(arguments, summary, text=describe(summary, arguments.out))
    return 0


def _campaign(arguments: argparse.Namespace, scenario: Scenario) -> int:
    from dataclasses import asdict

    from linna.data import data_folder
    from payload_emulator.session.campaign import load_campaign, run_campaign, table

    campaign = load_campaign(arguments.campaign)
    results = run_campaign(
        scenario,
        campaign,
        data_folder(),
        progress=lambda runs, total: progress(runs, total, "campaign", "run"),
    )
    rows = table(results)
    missed = sum(row["runs"] - row["detected"] for row in rows)
    lost = sum(row["lost"] for row in rows)
    figures = {
        "campaign": campaign.name,
        "scenario": scenario.name,
        "runs": len(results),
        "undetected": missed,
        "lost": lost,
        "table": rows,
        "results": [asdict(result) for result in results],
    }
    width = max(len(row["case"]) for row in rows)
    lines = [f"{'case':<{width}}  runs  detected  recovered  contained  lost  latest  frames"]
    lines += [
        f"{row['case']:<{width}}  {row['runs']:>4}  {row['detected']:>8}  {row['recovered']:>9}  "
        f"{row['contained']:>9}  {row['lost']:>4}  {row['latency_max_s']:>4.0f} s  "
        f"{row['frames_processed']}/{row['frames_expected']}"
        for row in rows
    ]
    lines.append(f"{len(results)} runs, {missed} undetected, {lost} lost")
    emit(arguments, figures, text="\n".join(lines))
    return 1 if missed or lost else 0


def _live(arguments: argparse.Namespace, scenario: Scenario) -> int:
    import signal

    from linna.data import data_folder
    from linna.errors import UsageError
    from payload_emulator.session.emulator import load_scenario_payload, new_spacecraft
    from payload_emulator.session.live import LivePayload
    from payload_emulator.session.mission import mission_text
    from payload_emulator.session.world import build_world

    if not arguments.rate >= 0.0:
        raise UsageError(f"--rate: expected a number from 0, found {arguments.rate}")
    data = data_folder()
    world = build_world(scenario, data)
    loaded, _, _ = load_scenario_payload(world, data)
    live = LivePayload(
        world,
        new_spacecraft(world, loaded),
        arguments.port,
        arguments.tc_port,
        arguments.console_port,
        arguments.host,
        arguments.rate,
        arguments.paused,
        arguments.stop_at_end,
        not arguments.no_operator,
        mission_text(world, data),
        arguments.mission_port,
    )
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: live.stopping.set())
    log(", ".join(f"{name} on {arguments.host}:{port}" for name, port in live.ports.items()))
    live.run()
    figures = {"ports": live.ports, "sent": live.sent, **live.spacecraft.payload.summary()}
    emit(
        arguments,
        figures,
        text=f"stopped; {live.sent} transmissions, mode {live.spacecraft.payload.mode.name}",
    )
    return 0


def _continuous(arguments: argparse.Namespace, scenario: Scenario) -> int:
    import signal
    from dataclasses import asdict

    from linna.data import data_folder
    from linna.errors import UsageError
    from lunar.catalogue import load_catalogue
    from payload_emulator.session.continuous import ContinuousSession
    from payload_emulator.session.mission import operations_mission_text

    if not scenario.link.stations:
        raise UsageError(f"--continuous: expected link.stations in scenario {scenario.name}, found none")
    if not arguments.rate >= 0.0 or (arguments.days is not None and not arguments.days > 0.0):
        raise UsageError(
            f"--rate, --days: expected numbers above 0, found {arguments.rate}, {arguments.days}"
        )
    data = data_folder()
    further = arguments.operations.read_text(encoding="utf-8") if arguments.operations else ""
    days = arguments.days
    session = ContinuousSession(
        scenario,
        data,
        rate=arguments.rate,
        holds=arguments.hold_contacts,
        stop_utc_ns=None if days is None else scenario.epoch_utc_ns + round(days * 86_400e9),
        paused=arguments.paused,
        host=arguments.host,
        console_port=arguments.console_port,
        mission_port=arguments.mission_port,
        station_ports=_station_ports(arguments.station_port, scenario.link.stations),
        state_file=arguments.state,
        journal_file=arguments.journal,
        clock_file=arguments.clock_file,
        keeps=arguments.keep_unacknowledged,
        ends_with_console=arguments.end_with_console,
        catalogue=load_catalogue(arguments.craters) if arguments.craters else None,
        mission=lambda world, ports: operations_mission_text(
            world, data, arguments.host, ports, further, arguments.keep_unacknowledged
        ),
    )
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: session.stopping.set())
    log(", ".join(f"{name} on {arguments.host}:{port}" for name, port in session.ports.items()))
    session.run()
    account = asdict(session.account)
    figures = {"ports": session.ports, "utc": format_time(session.utc_ns), **account}
    counted = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in account.items())
    emit(arguments, figures, text=f"stopped at {figures['utc']}; {counted}")
    return 0


def format_time(utc_ns: int) -> str:
    """Return a time for people, to the second."""
    from lunar.timescales import format_utc

    return format_utc(utc_ns, 0)


def _station_ports(texts: list[str], stations: tuple[str, ...]) -> dict[str, tuple[int, int]]:
    from linna.errors import UsageError

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
    outcomes = ", ".join(f"{name} {count}" for name, count in summary["outcomes"].items() if count)
    return "\n".join(
        [
            f"{summary['frames']} frames, {summary['start_utc']} to {summary['stop_utc']}, altitude "
            f"{altitude['min']:.1f} to {altitude['max']:.1f} km",
            f"{summary['packets']} packets, {summary['downlink_octets']} octets of downlink",
            f"link: {link['frames_sent']} frames sent, {link['frames_lost_on_link']} lost, "
            f"{link['frames_bad']} came beyond repair; of {link['packets_made']} packets "
            f"{link['packets_lost']} lost, {link['duplicates']} came again",
            f"outcomes: {outcomes}",
            f"data: {'; '.join(summary['data'])}",
            f"archive: {out}",
        ]
    )
